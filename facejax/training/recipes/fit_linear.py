"""Fit linear maps from landmarks to vertices, with the regularisation chosen by cross-validation."""

from __future__ import annotations

from typing import Any

from facejax.data.mesh_subset import MeshSubset
from facejax.models.decoders import linear

ALPHAS = tuple(10.0**e for e in range(-8, 3))
FOLDS = 4


def fit_linear(
    model: linear.Model, train: MeshSubset, *, by: str = "subjects", **options: Any
) -> tuple[linear.LinearMap, float]:
    """Fit ridge, PCA or a dictionary; returns the map and the chosen regularisation.

    Folds are quarters of the training subjects, or with `by="labels"` of the expressions.
    """
    # Every third mesh suffices for the choice; the moments take most of the time.
    alpha, _ = linear.choose(model, train.thin(3).folds(FOLDS, by=by), ALPHAS, **options)
    return model.fit(train, alpha=alpha, **options), alpha
