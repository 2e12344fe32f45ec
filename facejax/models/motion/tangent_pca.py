"""The tangent chart of a set of motions: what they fix once, before any network is trained.

Motions are points on the SRVF sphere; at a reference point p, log_p turns each into a tangent vector.

Vocabulary
  coordinates  (2 + R,) numbers for one motion: the standardised log-length and log-seconds, then the tangent
               vector's components along R orthonormal directions, whose span holds the motions up to a small
               residual. Euclidean distances and gradients in coordinates are those of the tangent vectors
               themselves, so that training can stay in coordinates from end to end.
  pose         (D,) numbers for the face that a motion starts from: standardised components of its displacement
               from neutral, less the mean start of its label. Zero is the mean peak, and neutral's only pose.
  start, end   label indices, 0 ... K - 1; 0 is neutral.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from facejax.geometry import sphere

MIN_PAIR_MOTIONS = 8  # motions of a pair below which its own spread is not trusted
RIDGE = 0.01  # of the regression on poses, in units of their unit variance per motion
SCALARS = 2  # log-length, log-seconds


class Motion(NamedTuple):
    """What a generator makes: a point on the sphere, how long the path is, and how long it takes."""

    q: jax.Array  # (..., T-1, L, 3)
    log_length: jax.Array  # (...), of the unitless path
    log_seconds: jax.Array  # (...)


class TangentPCA(NamedTuple):
    """Constants from the training set, never trained; K labels, R directions, D directions of poses."""

    p: jax.Array  # (T-1, L, 3), a point on the sphere
    basis: jax.Array  # (R, T-1, L, 3), Euclidean orthonormal, orthogonal to p, widest spread first
    mean: jax.Array  # (K, K, R), mean components of each (start, end)
    scale: jax.Array  # (K, K, R), deviation along each direction within each (start, end), poses accounted for
    scalar_mean: jax.Array  # (K, K, 2), mean log-length and log-seconds of each (start, end)
    scalar_std: jax.Array  # (2,), their deviations within a label pair
    gain: jax.Array  # (K, D, 2 + R), how coordinates of motions that start at a label follow the pose
    residual: jax.Array  # (), share of the training motions' squared norm outside the basis
    pose_mean: jax.Array  # (K, L, 3), mean displacement at which motions of a label start; zero for neutral
    pose_basis: jax.Array  # (D, L, 3), orthonormal
    pose_scale: jax.Array  # (D,), deviation of starts along each direction


def fit(
    p: np.ndarray,
    tangents: np.ndarray,
    motion: Motion,
    start: np.ndarray,
    end: np.ndarray,
    first: np.ndarray,
    *,
    labels: int,
    rank: int = 128,
    pose: int = 32,
) -> TangentPCA:
    """The chart of M training motions: p (T-1, L, 3), tangents log_p q (M, T-1, L, 3), first frames `first` (M, L, 3).

    Of `decode` the log-length and log-seconds (M,) are read; `start`, `end` are labels (M,) in 0..labels-1.
    The directions span the R principal ones of all tangent vectors, and are turned within that span so that
    the spread within label pairs is uncorrelated. Pairs without a motion get the sum of a start's and an
    end's effect as mean; pairs with fewer than 8 the spread of all.
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
    span = _principal_directions(flat, rank)
    span = np.linalg.qr((span - np.outer(span @ normal, normal)).T)[0].T.astype(np.float32)
    components = (flat @ span.T).astype(np.float64)
    outside = 1.0 - np.sum(components**2) / np.sum(np.square(flat, dtype=np.float64))
    mean = _pair_means(components, start, end, labels)
    within = components - mean[start, end]
    turn = np.linalg.eigh(within.T @ within / len(within))[1][:, ::-1]

    pose_mean, pose_basis, pose_scale = _poses(np.asarray(first, np.float64), start, labels, pose)
    poses = (first - pose_mean[start]).reshape(len(first), -1) @ pose_basis.T / pose_scale
    scalars = np.stack([motion.log_length, motion.log_seconds], axis=1).astype(np.float64)
    scalar_mean = _pair_means(scalars, start, end, labels)
    scalar_std = np.maximum(np.std(scalars - scalar_mean[start, end], axis=0), 1e-6)
    deviation = np.concatenate([(scalars - scalar_mean[start, end]) / scalar_std, within @ turn], axis=1)
    gain = _regression(poses, deviation, start, labels)
    left = deviation - np.einsum("md,mdr->mr", poses, gain[start])
    pooled = np.mean(left[:, SCALARS:] ** 2, axis=0)
    scale = _pair_spreads(left[:, SCALARS:], np.maximum(pooled, 1e-12 * pooled.max()), start, end, labels)
    basis = (turn.T @ span).reshape(-1, *shape)
    arrays = p, basis, mean @ turn, scale, scalar_mean, scalar_std, gain, outside
    poses = pose_mean, pose_basis.reshape(-1, *shape[1:]), pose_scale
    return TangentPCA(*(jnp.asarray(array, jnp.float32) for array in (*arrays, *poses)))


@jax.jit
def encode(chart: TangentPCA, tangent: jax.Array, log_length: jax.Array, log_seconds: jax.Array, start, end):
    """Coordinates (2 + R,) of a tangent at p (T-1, L, 3), less what the basis lacks, and two scalars ()."""
    scalars = (jnp.stack([log_length, log_seconds]) - chart.scalar_mean[start, end]) / chart.scalar_std
    return jnp.concatenate([scalars, jnp.tensordot(chart.basis, tangent, 3)])


@jax.jit
def decode(chart: TangentPCA, values: jax.Array, start, end) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Coordinates (2 + R,) -> the tangent vector at p (T-1, L, 3), exactly tangent, log-length and log-seconds ()."""
    tangent = sphere.project(chart.p, jnp.tensordot(values[SCALARS:], chart.basis, 1))
    log_length, log_seconds = chart.scalar_mean[start, end] + chart.scalar_std * values[:SCALARS]
    return tangent, log_length, log_seconds


@jax.jit
def encode_pose(chart: TangentPCA, displacement: jax.Array, start) -> jax.Array:
    """The pose (D,) of a displacement from neutral (L, 3) at which a motion of the label `start` starts."""
    inside = jnp.tensordot(chart.pose_basis, displacement - chart.pose_mean[start], 2) / chart.pose_scale
    return jnp.where(jnp.asarray(start) == 0, 0.0, inside)


@jax.jit
def decode_pose(chart: TangentPCA, pose: jax.Array, start) -> jax.Array:
    """The displacement (L, 3) of a pose (D,)."""
    return chart.pose_mean[start] + jnp.tensordot(pose * chart.pose_scale, chart.pose_basis, 1)


@jax.jit
def conditional_mean(chart: TangentPCA, start, end, pose: jax.Array) -> jax.Array:
    """The mean coordinates (2 + R,) of a pair's motions from a pose (D,), by linear regression."""
    return jnp.append(jnp.zeros(SCALARS), chart.mean[start, end]) + pose @ chart.gain[start]


@jax.jit
def conditional_std(chart: TangentPCA, start, end) -> jax.Array:
    """The deviation (2 + R,) of the coordinates of a pair about `conditional_mean`."""
    return jnp.append(jnp.ones(SCALARS), chart.scale[start, end])


def _poses(here: np.ndarray, start: np.ndarray, labels: int, directions: int):
    """Means (K, L, 3), principal directions (D, 3L) and deviations (D,) of first frames (M, L, 3)."""
    count = np.bincount(start, minlength=labels)
    mean = np.zeros((labels, *here.shape[1:]))
    np.add.at(mean, start, here)
    mean /= np.maximum(count, 1)[:, None, None]
    mean[0] = 0
    within = (here - mean[start])[np.asarray(start) > 0].reshape(-1, here[0].size)
    within = within if len(within) else np.zeros((1, here[0].size))
    values, vectors = np.linalg.eigh(within.T @ within / len(within))
    values, basis = values[::-1][:directions], vectors[:, ::-1][:, :directions].T
    return mean, basis, np.sqrt(np.maximum(values, 1e-12 * max(values[0], 1e-12)))


def _regression(poses: np.ndarray, deviation: np.ndarray, start: np.ndarray, labels: int) -> np.ndarray:
    """Ridge regression (K, D, C) of deviations (M, C) on poses (M, D), for each label of start."""
    gain = np.zeros((labels, poses.shape[1], deviation.shape[1]))
    for label in range(1, labels):
        own = start == label
        x, y = poses[own], deviation[own]
        gain[label] = np.linalg.solve(x.T @ x + (RIDGE * len(x) + 1e-9) * np.eye(x.shape[1]), x.T @ y)
    return gain


def _principal_directions(flat: np.ndarray, rank: int) -> np.ndarray:
    """The `rank` leading right singular vectors (rank, D) of (M, D), by subspace iteration.

    The full decomposition of 20,000 x 5,916 takes minutes; this takes ten thin products.
    """
    span = np.random.default_rng(0).standard_normal((flat.shape[1], min(rank + 32, *flat.shape)), np.float32)
    for _ in range(4):
        span = np.linalg.qr(flat.T @ (flat @ span))[0]
    values, turn = np.linalg.eigh(np.float64(flat @ span).T @ np.float64(flat @ span))
    return (span @ turn[:, np.argsort(-values)[:rank]]).T


def _pair_spreads(within: np.ndarray, pooled: np.ndarray, start, end, labels: int) -> np.ndarray:
    """Standard deviations (K, K, R) of components (M, R) about their pair's mean; the pooled variance where few.

    Pairs differ: along the direction that tells a mouth drawn left from one drawn right, only those with such a
    mouth spread at all, and one spread for all would give the others a motion that they never make.
    """
    pair = np.asarray(start) * labels + np.asarray(end)
    count = np.bincount(pair, minlength=labels**2)
    total = np.zeros((labels**2, within.shape[1]))
    np.add.at(total, pair, within**2)
    # The mean was fitted too: one degree of freedom less.
    own = total / np.maximum(count - 1, 1)[:, None]
    variance = np.where(count[:, None] >= MIN_PAIR_MOTIONS, np.maximum(own, 1e-6 * pooled), pooled)
    return np.sqrt(variance).reshape(labels, labels, -1)


def _pair_means(values: np.ndarray, start: np.ndarray, end: np.ndarray, labels: int) -> np.ndarray:
    """Mean of values (M, C) for each pair (K, K, C); absent pairs by least squares on start + end effects."""
    pair = np.asarray(start) * labels + np.asarray(end)
    count = np.bincount(pair, minlength=labels**2)
    total = np.zeros((labels**2, values.shape[1]))
    np.add.at(total, pair, values)
    seen = np.flatnonzero(count)
    means = total / np.maximum(count, 1)[:, None]
    which = np.eye(labels)
    design = np.concatenate([np.repeat(which, labels, 0), np.tile(which, (labels, 1))], axis=1)
    additive = design @ np.linalg.lstsq(design[seen], means[seen], rcond=None)[0]
    return np.where(count[:, None] > 0, means, additive).reshape(labels, labels, -1)
