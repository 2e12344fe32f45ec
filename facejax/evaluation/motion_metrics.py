"""Metrics of sets of generated motions against real ones, and of a motion's path, on the host.

K, M motions, T frames, L landmarks, N vertices. Curves (K, T, L, 3) are displacements of landmarks from neutral. The
distance of two curves is the Euclidean distance per landmark, averaged over landmarks and frames (`facejax.metrics`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from facejax import metrics
from facejax.geometry import sphere, srvf
from facejax.models.motion import generators, start_poses


def pair_scores(
    generated: Sequence[np.ndarray],
    real: Sequence[np.ndarray],
    references: Sequence[np.ndarray],
    training: Sequence[np.ndarray],
) -> list[dict[str, float]]:
    """Score the generated motions of each pair of labels against held-out real ones, at equal counts.

    The first half of the real motions of a pair serves as the real set. Score the second half (`second_halves`) in
    place of generated motions to get the scores of real motions, the reference for all figures.

    Args:
        generated: per pair (K, T, L, 3), in mm.
        real: per pair (M, T, L, 3), in mm.
        references: per pair (T, L, 3): the single held-out motion of OT23's specificity (section 4.3).
        training: per pair, motions of the training set; the nearest one gives Davies' distance.

    Returns:
        One dict per pair: specificity, Davies' distance (2002) and their counterparts among real motions in mm;
        diversity and acceleration as ratios to real motions; coverage and energy distance.
    """
    rows = []
    for samples, all_real, reference, known in zip(generated, real, references, training, strict=True):
        count = min(len(samples), len(all_real) // 2)
        samples, truth = samples[:count], all_real[:count]
        across, own, own_real = (
            metrics.distances(a, b) for a, b in ((samples, truth), (samples, samples), (truth, truth))
        )
        spread = float(metrics.mean_off_diagonal(own_real))
        acceleration, acceleration_real = (np.mean(metrics.acceleration(x)) for x in (samples, truth))
        rows.append(
            {
                "specificity_mm": float(metrics.specificity(samples, reference)),
                "specificity_all_mm": float(np.mean(across)),
                "real_all_mm": spread,
                "davies_mm": float(np.mean(metrics.nearest_distance(samples, known))),
                "davies_real_mm": float(np.mean(metrics.nearest_distance(truth, known))),
                "diversity_ratio": float(metrics.mean_off_diagonal(own)) / spread,
                "acceleration_ratio": float(acceleration / acceleration_real),
                "coverage": float(metrics.coverage(across, own_real, neighbours=min(5, count - 1))),
                "energy": float(metrics.energy_distance(across, own, own_real)),
            }
        )
    return rows


def mean_scores(rows: Sequence[dict[str, float]]) -> dict[str, Any]:
    """Return the mean of each score over pairs, and the ranges of the diversity and acceleration ratios."""
    means: dict[str, Any] = {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}
    for name in ("diversity_ratio", "acceleration_ratio"):
        values = [row[name] for row in rows]
        means[f"{name}_range"] = [min(values), max(values)]
    return means


def second_halves(real: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Return the second half of each pair's real motions, to be scored by `pair_scores` as if generated."""
    return [curves[len(curves) // 2 :] for curves in real]


def sphere_norm_error(
    generator: generators.Generator,
    starts: start_poses.StartPoses,
    key: jax.Array,
    pairs: Sequence[tuple[int, int]],
    *,
    samples: int,
) -> float:
    """Return the largest deviation from 1 of the norms of generated points on the sphere of SRVFs."""
    worst = 0.0
    for pair, pair_key in zip(pairs, jax.random.split(key, len(pairs)), strict=True):
        worst = max(worst, float(_sphere_norm_error(generator, starts, jax.random.split(pair_key, samples), *pair)))
    return worst


@jax.jit
def _sphere_norm_error(
    generator: generators.Generator, starts: start_poses.StartPoses, keys: jax.Array, start: ArrayLike, end: ArrayLike
) -> jax.Array:
    def norm(key: jax.Array) -> jax.Array:
        pose_key, key = jax.random.split(key)
        pose = start_poses.sample(starts, pose_key, start)
        return sphere.norm(generators.sample(generator, key, start, end, pose).q)

    return jnp.max(jnp.abs(jax.vmap(norm)(keys) - 1))


def mean_distance(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the distance (K,) of each curve of a (K, T, L, 3) to the curve of the same index of b."""
    return np.linalg.norm(a - b, axis=-1).mean(axis=(1, 2))


def length(curves: np.ndarray) -> np.ndarray:
    """Return the length (K,) of the paths of all landmarks together."""
    return np.asarray(srvf.length(jnp.asarray(curves)))


def acceleration(curves: np.ndarray) -> np.ndarray:
    """Return the mean norm (K,) of the second differences in time."""
    return np.asarray(metrics.acceleration(jnp.asarray(curves)))


def end_norm(curves: np.ndarray) -> np.ndarray:
    """Return the Frobenius norm (K,) of the displacements in the last frame."""
    return np.linalg.norm(curves[:, -1], axis=(-2, -1))


def speed_profile(curves: np.ndarray) -> np.ndarray:
    """Return the speed at each step over the curve's mean speed, (K, T - 1)."""
    speed = np.linalg.norm(np.diff(curves, axis=1), axis=-1).mean(axis=-1)
    return speed / speed.mean(axis=1, keepdims=True)


def detour(curves: np.ndarray) -> np.ndarray:
    """Return the length of the path over the distance between its ends, (K,); 1 for a straight path."""
    steps = np.linalg.norm(np.diff(curves, axis=1), axis=(-2, -1)).sum(axis=1)
    return steps / np.linalg.norm(curves[:, -1] - curves[:, 0], axis=(-2, -1))


def displacement_at_half_path(curves: np.ndarray) -> np.ndarray:
    """Return the mean displacement of the landmarks from neutral, (K,), in the frame at half of the path length."""
    covered = np.cumsum(np.linalg.norm(np.diff(curves, axis=1), axis=(-2, -1)), axis=1)
    frame = 1 + np.argmin(np.abs(covered / covered[:, -1:] - 0.5), axis=1)
    return np.linalg.norm(curves[np.arange(len(curves)), frame], axis=-1).mean(axis=-1)


def ratio_of_means(measure: Callable[[np.ndarray], np.ndarray], a: np.ndarray, b: np.ndarray) -> float:
    """Return the mean of a measure over the curves a, divided by its mean over the curves b."""
    return float(np.mean(measure(a)) / np.mean(measure(b)))


def windowed_vertex_error(
    predicted: np.ndarray, true: np.ndarray, frames: np.ndarray, mask: np.ndarray, *, window: int
) -> np.ndarray:
    """Return the mean vertex distance per frame: frame by frame, and the least within a window (OT23, section 4.2.2).

    Args:
        predicted: (T, N, 3) meshes.
        true: (M, N, 3) meshes of some of the frames.
        frames: (M,) the numbers of those frames.
        mask: (N,) vertices that count.
        window: frames; the window holds half of them before and half of them after a frame.

    Returns:
        (2, M): the distance to the prediction of the same frame; the least distance to a prediction in the window.
    """
    half = window // 2
    errors = np.full((2, len(frames)), np.inf)
    predicted, true = predicted[:, mask], true[:, mask]
    for shift in range(-half, half + 1):
        inside = np.flatnonzero((frames + shift >= 0) & (frames + shift < len(predicted)))
        distance = np.linalg.norm(predicted[frames[inside] + shift] - true[inside], axis=-1).mean(axis=1)
        errors[1, inside] = np.minimum(errors[1, inside], distance)
        if shift == 0:
            errors[0, inside] = distance
    return errors
