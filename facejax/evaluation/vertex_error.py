"""Vertex errors of decoders in millimetres, by person and region.

G meshes, N vertices, L landmarks, T frames of a person, R regions (masks (N,)).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import NamedTuple

import jax
import numpy as np

from facejax.data import dataset, mesh_subset
from facejax.data.mesh_subset import Batch, MeshSubset
from facejax.inference import pipeline

BIN_EDGES = np.geomspace(1e-5, 20.0, 253)  # mm, of cumulative curves: forty per decade


class Distances(NamedTuple):
    """Sums over the vertex distances of G meshes; those of cross-validation folds add up."""

    count: int  # G  # pyright: ignore[reportIncompatibleMethodOverride]
    total: np.ndarray  # (N,) mm
    squares: np.ndarray  # (N,) mm^2
    histogram: np.ndarray  # (R, len(BIN_EDGES) + 1) counts of vertices x meshes by region; the outer bins are open

    def add(self, other: Distances) -> Distances:
        """Return the sums over both sets of meshes."""
        return Distances(
            self.count + other.count,
            self.total + other.total,
            self.squares + other.squares,
            self.histogram + other.histogram,
        )

    def mean_std(self, mask: np.ndarray) -> tuple[float, float]:
        """Return mean and standard deviation in mm over the vertices of a mask (N,) and all meshes."""
        mean, square = (float(x[mask].mean()) / self.count for x in (self.total, self.squares))
        return mean, float(np.sqrt(max(square - mean**2, 0.0)))

    def cumulative(self) -> np.ndarray:
        """Return the fraction of each region's vertices x meshes with an error up to each of BIN_EDGES, (R, B)."""
        return np.cumsum(self.histogram, axis=1)[:, :-1] / self.histogram.sum(axis=1, keepdims=True)


def distances(
    apply: Callable[[np.ndarray, np.ndarray], np.ndarray], test: MeshSubset, regions: dict[str, np.ndarray], *,
    noise: float = 0.0, seed: int = 0,
) -> Distances:  # fmt: skip
    """Measure a decoder on every person of a test set.

    Args:
      apply: (landmark displacements (T, L, 3), neutral (N, 3)) -> vertices (T, N, 3); mm.
      test: meshes.
      regions: masks (N,) by name.
      noise: standard deviation in mm of Gaussian noise on every landmark coordinate, as of a landmark detector.
      seed: of the noise.

    Raises:
      ValueError: there are no meshes.
    """

    def predictions():
        for subject in test.subjects:
            neutral, landmarks, moved = test.person(subject)
            if noise:
                rng = np.random.default_rng([seed, int(subject)])
                landmarks = landmarks + noise * rng.standard_normal(landmarks.shape)
            # Padded to a multiple of 32, so that other numbers of frames do not compile again.
            padded = np.pad(landmarks.astype(np.float32), ((0, -len(landmarks) % 32), (0, 0), (0, 0)), mode="edge")
            yield np.asarray(apply(padded, neutral))[: len(landmarks)] - neutral, moved

    return _accumulate(predictions(), regions)


def vertex_errors(
    decode: Callable[[np.ndarray], jax.Array], meshes: Iterable[Batch], regions: dict[str, np.ndarray]
) -> dict[str, dict[str, float]]:
    """Return mean and standard deviation of the vertex distance over vertices x frames, by region.

    For decoders that do not depend on the face: `decode` maps landmark displacements (B, L, 3) to vertex displacements
    (B, N, 3).
    """
    found = _accumulate(((np.asarray(decode(landmarks)), vertices) for landmarks, vertices in meshes), regions)
    return {name: dict(zip(("mean_mm", "std_mm"), found.mean_std(mask), strict=True)) for name, mask in regions.items()}


def _accumulate(pairs: Iterable[Batch], regions: dict[str, np.ndarray]) -> Distances:
    """Accumulate distances over pairs of predicted and true displacements (B, N, 3)."""
    total = None
    for predicted, true in pairs:
        error = np.linalg.norm(predicted - true, axis=-1).astype(np.float64)
        bins = np.searchsorted(BIN_EDGES, error)
        counts = [np.bincount(bins[:, mask].ravel(), minlength=len(BIN_EDGES) + 1) for mask in regions.values()]
        batch = Distances(len(error), error.sum(axis=0), (error**2).sum(axis=0), np.stack(counts))
        total = batch if total is None else total.add(batch)
    if total is None:
        raise ValueError("expected meshes to measure on, got none")
    return total


def model_errors(models: pipeline.Models, data: dataset.Dataset, *splits: str) -> dict[str, float]:
    """Return the mean vertex error in mm by region ("head", "face") of models on the people of splits.

    Default: validation and test. Empty where there are no such people.
    """
    held = [split for split in splits or ("validation", "test") if len(data.subjects(split))]
    if not held:
        return {}
    regions = {"head": np.ones(len(models.face.vertices), bool), "face": np.asarray(models.face.mask)}
    at = models.face.landmark_index
    found = distances(
        lambda marks, rest: np.asarray(pipeline.meshes(models, rest[at] + marks, rest)),
        mesh_subset.of_split(data, *held), regions,
    )  # fmt: skip
    return {name: found.mean_std(mask)[0] for name, mask in regions.items()}
