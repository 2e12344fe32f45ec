"""Vertex errors of anything that turns landmark displacements into vertex displacements, millimetres."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import jax
import numpy as np

from facejax import metrics
from facejax.data.meshes import Batch, Meshes
from facejax.models import linear

ALPHAS = tuple(10.0**e for e in range(-8, 3))
FOLDS = 4


def vertex_errors(
    decode: Callable[[np.ndarray], jax.Array], meshes: Iterable[Batch], regions: dict[str, np.ndarray]
) -> dict[str, dict[str, float]]:
    """Mean and standard deviation of the vertex distance over vertices x frames, per region (a mask (N,))."""
    count, total, squares = 0, 0.0, 0.0
    for landmarks, vertices in meshes:
        distance = np.asarray(metrics.vertex_distance(decode(landmarks), vertices), np.float64)
        count += len(distance)
        total, squares = total + distance.sum(axis=0), squares + (distance**2).sum(axis=0)
    if count == 0:
        raise ValueError("expected meshes to measure on, got none")
    found = {}
    for name, mask in regions.items():
        mean = float((total / count)[mask].mean())
        square = float((squares / count)[mask].mean())
        found[name] = {"mean_mm": mean, "std_mm": float(np.sqrt(max(square - mean**2, 0.0)))}
    return found


def fit_linear(model: linear.Model, train: Meshes, **options) -> tuple[linear.Params, float]:
    """Fit ridge or PCA with the prior's weight chosen by cross-validation over training subjects; and that weight."""
    # Every third mesh decides well enough, and the moments are what takes the time.
    thin = train.where(np.arange(train.count) % 3 == 0)
    alpha, _ = linear.choose(model, thin.folds(FOLDS), ALPHAS, **options)
    return model.fit(train, alpha=alpha, **options), alpha
