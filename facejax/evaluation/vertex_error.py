"""Vertex errors of decoders in millimetres, by person and region."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import NamedTuple

import jax
import numpy as np

from facejax.data import dataset, mesh_subset
from facejax.data.mesh_subset import Batch, MeshSubset
from facejax.inference import pipeline

BIN_EDGES = np.geomspace(1e-5, 20.0, 253)  # mm, of cumulative curves: forty a decade


class Distances(NamedTuple):
    """How far vertices were from where they should be, over G meshes; sums, so that folds add up."""

    count: int  # G
    total: np.ndarray  # (N,) mm
    squares: np.ndarray  # (N,) mm^2
    histogram: np.ndarray  # (R, len(EDGES) + 1) vertices x meshes of each of R regions, under, between and over EDGES

    def add(self, other: Distances) -> Distances:
        """Both together."""
        return Distances(*(a + b for a, b in zip(self, other, strict=True)))

    def mean_std(self, mask: np.ndarray) -> tuple[float, float]:
        """Mean and standard deviation over the vertices of a mask (N,) x meshes, in mm."""
        mean, square = (float(x[mask].mean()) / self.count for x in (self.total, self.squares))
        return mean, float(np.sqrt(max(square - mean**2, 0.0)))

    def cumulative(self) -> np.ndarray:
        """The share of each region's vertices x meshes that err by no more than each of EDGES, (R, len(EDGES))."""
        return np.cumsum(self.histogram, axis=1)[:, :-1] / self.histogram.sum(axis=1, keepdims=True)


def distances(
    apply: Callable[[np.ndarray, np.ndarray], np.ndarray], test: MeshSubset, regions: dict[str, np.ndarray], *,
    noise: float = 0.0, seed: int = 0,
) -> Distances:  # fmt: skip
    """Judge `apply(landmark displacements (T, L, 3), neutral (N, 3)) -> vertices (T, N, 3)` person by person.

    `noise` is added to every landmark's coordinates, in mm: what a landmark detector would get wrong. `regions` are
    masks (N,).
    """

    def made():
        for subject in test.subjects:
            neutral, landmarks, moved = test.person(subject)
            if noise:
                rng = np.random.default_rng([seed, int(subject)])
                landmarks = landmarks + noise * rng.standard_normal(landmarks.shape)
            # Filled up to a multiple, so that people with other numbers of frames compile nothing new.
            filled = np.pad(landmarks.astype(np.float32), ((0, -len(landmarks) % 32), (0, 0), (0, 0)), mode="edge")
            yield np.asarray(apply(filled, neutral))[: len(landmarks)] - neutral, moved

    return _summed(made(), regions)


def vertex_errors(
    decode: Callable[[np.ndarray], jax.Array], meshes: Iterable[Batch], regions: dict[str, np.ndarray]
) -> dict[str, dict[str, float]]:
    """Mean and standard deviation of the vertex distance over vertices x frames, per region (a mask (N,)).

    Of what knows no faces: `decode(landmark displacements (B, L, 3)) -> vertex displacements (B, N, 3)`.
    """
    found = _summed(((np.asarray(decode(landmarks)), vertices) for landmarks, vertices in meshes), regions)
    return {name: dict(zip(("mean_mm", "std_mm"), found.mean_std(mask), strict=True)) for name, mask in regions.items()}


def _summed(pairs: Iterable[Batch], regions: dict[str, np.ndarray]) -> Distances:
    """Of pairs of made and true displacements (B, N, 3)."""
    found = None
    for made, true in pairs:
        off = np.linalg.norm(made - true, axis=-1).astype(np.float64)
        bins = np.searchsorted(BIN_EDGES, off)
        counts = [np.bincount(bins[:, mask].ravel(), minlength=len(BIN_EDGES) + 1) for mask in regions.values()]
        mine = Distances(len(off), off.sum(axis=0), (off**2).sum(axis=0), np.stack(counts))
        found = mine if found is None else found.add(mine)
    if found is None:
        raise ValueError("expected meshes to measure on, got none")
    return found


def model_errors(models: pipeline.Models, data: dataset.Dataset, *splits: str) -> dict[str, float]:
    """Mean vertex error in mm by region on the people of splits, else on all held out; empty where nobody is."""
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
