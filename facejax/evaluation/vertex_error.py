"""How far from the truth, in millimetres: vertices of a decoder, landmarks of expression networks."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from facejax.data import sequences
from facejax.data.mesh_subset import Batch, Meshes
from facejax.models import expression_lstm
from facejax.models.decoders import linear

ALPHAS = tuple(10.0**e for e in range(-8, 3))
FOLDS = 4
EDGES = np.geomspace(1e-5, 20.0, 253)  # mm, of cumulative curves: forty a decade


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
    apply: Callable[[np.ndarray, np.ndarray], np.ndarray], test: Meshes, regions: dict[str, np.ndarray], *,
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
        bins = np.searchsorted(EDGES, off)
        counts = [np.bincount(bins[:, mask].ravel(), minlength=len(EDGES) + 1) for mask in regions.values()]
        mine = Distances(len(off), off.sum(axis=0), (off**2).sum(axis=0), np.stack(counts))
        found = mine if found is None else found.add(mine)
    if found is None:
        raise ValueError("expected meshes to measure on, got none")
    return found


def fit_linear(model: linear.Model, train: Meshes, *, by: str = "subjects", **options) -> tuple[linear.Params, float]:
    """Fit ridge, PCA or a dictionary, the prior's weight chosen by cross-validation; and that weight.

    Held out in turn are quarters of the training subjects, or `by="labels"` of the expressions.
    """
    # Every third mesh decides well enough, and the moments are what takes the time.
    alpha, _ = linear.choose(model, train.thin(3).folds(FOLDS, by=by), ALPHAS, **options)
    return model.fit(train, alpha=alpha, **options), alpha


class MeanSequence(NamedTuple):
    """The mean over training recordings of one expression, frame by frame; unitless."""

    curve: np.ndarray  # (F, L, 3), standing still at the ends of shorter recordings
    steps: np.ndarray  # (F - 1, L, 3)


def mean_sequence(train: sequences.Sequences, frames: int) -> MeanSequence:
    """The mean of recordings over the first `frames` frames."""
    curve = sequences.extend(train, frames).curves[:, :frames].mean(axis=0)
    return MeanSequence(curve, np.diff(curve, axis=0))


def expression_scores(
    params: expression_lstm.Params,
    held_out: sequences.Sequences,
    train: sequences.Sequences,
    *,
    start: str,
    prefix: int = 10,
) -> dict[str, float]:
    """How well one expression's network moves faces that it has not seen, in mm, beside what asks for no network.

    `next_*`: distance of the next frame's landmarks from where they are, given all frames before. `rest_*`: the frames
    after the first `prefix`, given those. `whole_*`: all frames, given the neutral face. Means over the frames of each
    sequence, then over sequences. `energy` (mean squared step) and `acceleration` (mean norm of second differences) of
    what is made from the neutral face, over those of the recordings in the same frames.
    """
    frames = held_out.curves.shape[1]
    mean = mean_sequence(train, frames)
    truth, scale, count = held_out.curves, held_out.scale, held_out.frames
    neutral = jnp.asarray(held_out.neutral) if start == "neutral" else None

    def error(curves, first=0):
        off = np.linalg.norm(np.asarray(curves) - truth, axis=-1).mean(axis=-1) * scale[:, None]
        return float(np.mean([row[first:end].mean() for row, end in zip(off, count, strict=True)]))

    steps = np.diff(truth, axis=1)
    known = np.concatenate([np.zeros_like(steps[:, :1]), steps[:, :-1]], axis=1)
    before = truth[:, :-1]

    def after(following):
        return np.concatenate([truth[:, :1], before + np.asarray(following)], axis=1)

    here, velocity = truth[:, prefix - 1 : prefix], steps[:, prefix - 2 : prefix - 1]
    ahead = np.arange(frames)[:, None, None] - (prefix - 1)
    free = np.broadcast_to(np.asarray(expression_lstm.generate(params, neutral, frames=frames)), truth.shape)
    led = expression_lstm.generate(params, neutral, jnp.asarray(truth[:, :prefix]), frames=frames)

    def over_real(curves, order):
        """Mean squared steps, or mean norms of second differences, over those of the recordings."""

        def strength(rows):
            # In NumPy: every sequence has its own length, and a jitted function would compile for each.
            changes = (
                np.linalg.norm(np.diff(row[:end] * mm, n=order, axis=0), axis=-1)
                for row, mm, end in zip(rows, scale, count, strict=True)
            )
            return np.mean([np.mean(change**2 if order == 1 else change) for change in changes])

        return float(strength(curves) / strength(truth))

    mean_curves = np.broadcast_to(mean.curve, truth.shape)
    return {
        "next_network": error(after(expression_lstm.predict(params, known, neutral)), 1),
        "next_velocity": error(after(known), 1),
        "next_mean": error(after(np.broadcast_to(mean.steps, steps.shape)), 1),
        "rest_network": error(led, prefix),
        "rest_velocity": error(here + ahead * velocity, prefix),
        "rest_mean": error(mean_curves, prefix),
        "rest_mean_steps": error(mean.curve + here - mean.curve[prefix - 1], prefix),
        "whole_network": error(free),
        "whole_mean": error(mean_curves),
        "energy": over_real(free, 1),
        "energy_mean": over_real(mean_curves, 1),
        "acceleration": over_real(free, 2),
        "acceleration_mean": over_real(mean_curves, 2),
    }
