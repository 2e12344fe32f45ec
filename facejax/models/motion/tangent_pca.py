"""Tangent PCA: the linear chart of a set of motions, fitted once before any network is trained.

Motions are points on the SRVF sphere; log_p at a reference point p maps each to a tangent vector, and PCA reduces the
tangent vectors to coordinates.

Vocabulary
  coordinates  (2 + R,) numbers for one motion: the standardised log-length and log-seconds, then the tangent
               vector's components along R orthonormal directions, whose span holds the motions up to a small
               residual. Euclidean distances and gradients in coordinates are those of the tangent vectors
               themselves, so that training can stay in coordinates from end to end.
  pose         (D,) numbers for the face that a motion starts from: standardised components of its displacement
               from neutral, less the mean start of its label. Zero is the mean peak, and neutral's only pose.
  start, end   label indices, 0 ... K - 1; 0 is neutral.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int

from facejax.geometry import sphere
from facejax.geometry.precision import HIGHEST
from facejax.models import pca

MIN_PAIR_MOTIONS = 8  # below this, a pair's own standard deviations are replaced by the pooled ones
RIDGE = 0.01  # of the regression on poses, per motion and unit variance
SCALARS = 2  # log-length, log-seconds


class Motion(NamedTuple):
    """The output of a generator: a point on the SRVF sphere, the path length and the duration."""

    q: Array  # (..., T-1, L, 3)
    log_length: Array  # (...), of the unitless path
    log_seconds: Array  # (...)


class TangentPCA(NamedTuple):
    """The chart, constant during training; K labels, R directions, D directions of poses."""

    p: Array  # (T-1, L, 3), a point on the sphere
    basis: Array  # (R, T-1, L, 3), Euclidean orthonormal, orthogonal to p, largest variance first
    mean: Array  # (K, K, R), mean components of each (start, end)
    scale: Array  # (K, K, R), standard deviation along each direction within each (start, end), given the pose
    scalar_mean: Array  # (K, K, 2), mean log-length and log-seconds of each (start, end)
    scalar_std: Array  # (2,), their standard deviations within a label pair
    gain: Array  # (K, D, 2 + R), regression of the coordinates on the pose, for each start label
    residual: Array  # (), share of the training motions' squared norm outside the basis
    pose_mean: Array  # (K, L, 3), mean displacement at which motions of a label start; zero for neutral
    pose_basis: Array  # (D, L, 3), orthonormal
    pose_scale: Array  # (D,), standard deviation of start displacements along each direction


def fit(
    p: Float[np.ndarray, "steps L 3"],
    tangents: Float[np.ndarray, "M ..."],  # looser than (M, steps, L, 3): other shapes get the error below
    motion: Motion,
    start: Int[np.ndarray, " M"],
    end: Int[np.ndarray, " M"],
    first: Float[np.ndarray, "M L 3"],
    *,
    labels: int,
    rank: int = 128,
    pose: int = 32,
) -> TangentPCA:
    """Fit the chart of M training motions.

    The directions span the leading R principal components of all tangent vectors, and are rotated within that span so
    that they are uncorrelated within label pairs. The mean of a pair without motions is the sum of a start and an end
    effect; pairs with fewer than `MIN_PAIR_MOTIONS` get the pooled standard deviation.

    Args:
      p: reference point on the sphere.
      tangents: log_p of the motions.
      motion: of which log-length and log-seconds (M,) are used.
      start, end: labels in 0..labels-1.
      first: first frames, as displacements from neutral.
      rank: R.
      pose: D.

    Raises:
      ValueError: wrong shapes, no more motions than `rank`, or values that are not finite.
    """
    shape = p.shape
    if p.ndim != 3 or tangents.shape[1:] != shape:
        raise ValueError(f"tangents must be (M, T-1, L, 3) at p (T-1, L, 3); got {tangents.shape} and {shape}")
    if len(tangents) <= rank:
        raise ValueError(f"rank {rank} needs more than {rank} motions; got {len(tangents)}")
    flat = np.asarray(tangents, np.float32).reshape(len(tangents), -1)
    normal = np.ravel(p) / np.linalg.norm(p)
    if not np.isfinite(flat).all():
        raise ValueError(f"motion {np.flatnonzero(~np.isfinite(flat).all(1))[0]} is not finite")
    span = pca.leading_components(flat, rank)
    span = np.linalg.qr((span - np.outer(span @ normal, normal)).T)[0].T.astype(np.float32)
    components = (flat @ span.T).astype(np.float64)
    outside = 1.0 - np.sum(components**2) / np.sum(np.square(flat, dtype=np.float64))
    mean = _pair_means(components, start, end, labels)
    within = components - mean[start, end]
    rotation = pca.from_covariance(within.T @ within / len(within))[1]

    pose_mean, pose_basis, pose_scale = _poses(np.asarray(first, np.float64), start, labels, pose)
    poses = (first - pose_mean[start]).reshape(len(first), -1) @ pose_basis.T / pose_scale
    scalars = np.stack([motion.log_length, motion.log_seconds], axis=1).astype(np.float64)
    scalar_mean = _pair_means(scalars, start, end, labels)
    scalar_std = np.maximum(np.std(scalars - scalar_mean[start, end], axis=0), 1e-6)
    deviation = np.concatenate([(scalars - scalar_mean[start, end]) / scalar_std, within @ rotation], axis=1)
    gain = _regression(poses, deviation, start, labels)
    residual = deviation - np.einsum("md,mdr->mr", poses, gain[start])
    pooled = np.mean(residual[:, SCALARS:] ** 2, axis=0)
    scale = _pair_std(residual[:, SCALARS:], np.maximum(pooled, 1e-12 * pooled.max()), start, end, labels)
    basis = (rotation.T @ span).reshape(-1, *shape)
    arrays = p, basis, mean @ rotation, scale, scalar_mean, scalar_std, gain, outside
    poses = pose_mean, pose_basis.reshape(-1, *shape[1:]), pose_scale
    return TangentPCA(*(jnp.asarray(array, jnp.float32) for array in (*arrays, *poses)))


@jax.jit
def encode(
    chart: TangentPCA,
    tangent: Float[Array | np.ndarray, "steps L 3"],
    log_length: ArrayLike,
    log_seconds: ArrayLike,
    start: ArrayLike,
    end: ArrayLike,
) -> Float[Array, " coordinates"]:
    """Return the coordinates (2 + R,) of a tangent vector at p projected onto the basis, and of two scalars ()."""
    scalars = (jnp.stack([log_length, log_seconds]) - chart.scalar_mean[start, end]) / chart.scalar_std
    return jnp.concatenate([scalars, jnp.tensordot(chart.basis, tangent, 3, precision=HIGHEST)])


@jax.jit
def decode(
    chart: TangentPCA, values: Float[Array | np.ndarray, " coordinates"], start: ArrayLike, end: ArrayLike
) -> tuple[Float[Array, "steps L 3"], Float[Array, ""], Float[Array, ""]]:
    """Return the tangent vector at p, made exactly tangent, log-length and log-seconds of coordinates (2 + R,)."""
    tangent = sphere.project(chart.p, jnp.tensordot(values[SCALARS:], chart.basis, 1, precision=HIGHEST))
    log_length, log_seconds = chart.scalar_mean[start, end] + chart.scalar_std * values[:SCALARS]
    return tangent, log_length, log_seconds


@jax.jit
def encode_pose(
    chart: TangentPCA, displacement: Float[Array | np.ndarray, "L 3"], start: ArrayLike
) -> Float[Array, " D"]:
    """Return the pose of a first frame, given as displacement from neutral; zero if its label `start` is neutral."""
    offset = displacement - chart.pose_mean[start]
    pose = jnp.tensordot(chart.pose_basis, offset, 2, precision=HIGHEST) / chart.pose_scale
    return jnp.where(jnp.asarray(start) == 0, 0.0, pose)


@jax.jit
def decode_pose(chart: TangentPCA, pose: Float[Array | np.ndarray, " D"], start: ArrayLike) -> Float[Array, "L 3"]:
    """Return the displacement from neutral of a pose."""
    return chart.pose_mean[start] + jnp.tensordot(pose * chart.pose_scale, chart.pose_basis, 1, precision=HIGHEST)


@jax.jit
def conditional_mean(
    chart: TangentPCA, start: ArrayLike, end: ArrayLike, pose: Float[Array | np.ndarray, " D"]
) -> Float[Array, " coordinates"]:
    """Return the mean coordinates (2 + R,) of a label pair's motions given the pose, by linear regression."""
    return jnp.append(jnp.zeros(SCALARS, chart.mean.dtype), chart.mean[start, end]) + pose @ chart.gain[start]


@jax.jit
def conditional_std(chart: TangentPCA, start: ArrayLike, end: ArrayLike) -> Float[Array, " coordinates"]:
    """Return the standard deviation (2 + R,) of the coordinates of a label pair about `conditional_mean`."""
    return jnp.append(jnp.ones(SCALARS, chart.scale.dtype), chart.scale[start, end])


def _poses(
    first: np.ndarray, start: np.ndarray, labels: int, directions: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return means (K, L, 3), principal directions (D, 3L) and standard deviations (D,) of first frames (M, L, 3)."""
    count = np.bincount(start, minlength=labels)
    mean = np.zeros((labels, *first.shape[1:]))
    np.add.at(mean, start, first)
    mean /= np.maximum(count, 1)[:, None, None]
    mean[0] = 0
    within = (first - mean[start])[np.asarray(start) > 0].reshape(-1, first[0].size)
    within = within if len(within) else np.zeros((1, first[0].size))
    values, vectors = pca.from_covariance(within.T @ within / len(within))
    values, basis = values[:directions], vectors[:, :directions].T
    return mean, basis, np.sqrt(np.maximum(values, 1e-12 * max(values[0], 1e-12)))


def _regression(poses: np.ndarray, deviation: np.ndarray, start: np.ndarray, labels: int) -> np.ndarray:
    """Return the ridge regression (K, D, C) of deviations (M, C) on poses (M, D), for each start label."""
    gain = np.zeros((labels, poses.shape[1], deviation.shape[1]))
    for label in range(1, labels):
        own = start == label
        x, y = poses[own], deviation[own]
        gain[label] = np.linalg.solve(x.T @ x + (RIDGE * len(x) + 1e-9) * np.eye(x.shape[1]), x.T @ y)
    return gain


def _pair_std(within: np.ndarray, pooled: np.ndarray, start: np.ndarray, end: np.ndarray, labels: int) -> np.ndarray:
    """Return standard deviations (K, K, R) of centred components (M, R) per label pair; pooled for rare pairs.

    Pairs differ: along the direction that separates a mouth drawn left from one drawn right, only pairs with such a
    mouth vary at all, and a pooled deviation would give the others motion that is absent from their data.
    """
    pair = np.asarray(start) * labels + np.asarray(end)
    count = np.bincount(pair, minlength=labels**2)
    total = np.zeros((labels**2, within.shape[1]))
    np.add.at(total, pair, within**2)
    # One degree of freedom is spent on the mean.
    own = total / np.maximum(count - 1, 1)[:, None]
    variance = np.where(count[:, None] >= MIN_PAIR_MOTIONS, np.maximum(own, 1e-6 * pooled), pooled)
    return np.sqrt(variance).reshape(labels, labels, -1)


def _pair_means(values: np.ndarray, start: np.ndarray, end: np.ndarray, labels: int) -> np.ndarray:
    """Return the mean (K, K, C) of values (M, C) per label pair; absent pairs from start + end effects."""
    pair = np.asarray(start) * labels + np.asarray(end)
    count = np.bincount(pair, minlength=labels**2)
    total = np.zeros((labels**2, values.shape[1]))
    np.add.at(total, pair, values)
    seen = np.flatnonzero(count)
    means = total / np.maximum(count, 1)[:, None]
    one_hot = np.eye(labels)
    design = np.concatenate([np.repeat(one_hot, labels, 0), np.tile(one_hot, (labels, 1))], axis=1)
    additive = design @ np.linalg.lstsq(design[seen], means[seen], rcond=None)[0]
    return np.where(count[:, None] > 0, means, additive).reshape(labels, labels, -1)
