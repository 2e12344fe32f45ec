"""The tangent chart of a set of motions: what they fix once, before any network is trained.

Motions are points on the SRVF sphere; at a reference point p, log_p turns each into a tangent vector.

Vocabulary
  coordinates  (R + 1,) numbers for one motion: the standardised log-length, then the tangent vector's
               components along R orthonormal directions, whose span holds the motions up to a small residual.
               Euclidean distances and gradients in coordinates are those of the tangent vectors themselves,
               so that training can stay in coordinates from end to end.
  start, end   label indices, 0 ... K - 1.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from facejax.geometry import sphere

FEW = 8  # motions of a pair below which its own spread is not trusted


class Chart(NamedTuple):
    """Constants from the training set, never trained; K labels, R directions."""

    p: jax.Array  # (T-1, L, 3), a point on the sphere
    basis: jax.Array  # (R, T-1, L, 3), Euclidean orthonormal, orthogonal to p, widest spread first
    scale: jax.Array  # (K, K, R), standard deviation along each direction within each (start, end)
    mean: jax.Array  # (K, K, R), mean components of each (start, end)
    length_mean: jax.Array  # (K, K), mean log-length of each (start, end)
    length_std: jax.Array  # (), standard deviation of the log-length within a label pair
    residual: jax.Array  # (), share of the training motions' squared norm outside the basis


def fit(
    p: np.ndarray,
    tangents: np.ndarray,
    log_length: np.ndarray,
    start: np.ndarray,
    end: np.ndarray,
    *,
    labels: int,
    rank: int = 128,
) -> Chart:
    """The chart of M training motions: p (T-1, L, 3), tangents log_p q (M, T-1, L, 3), the others (M,).

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
    mean = _pair_means(components, start, end, labels)
    within = components - mean[start, end]
    variance, turn = np.linalg.eigh(within.T @ within / len(within))
    variance, turn = variance[::-1], turn[:, ::-1]
    pooled = np.maximum(variance, 1e-12 * variance[0])
    scale = _pair_spreads(within @ turn, pooled, start, end, labels)
    length_mean = _pair_means(log_length[:, None], start, end, labels)[..., 0]
    length_std = np.std(log_length - length_mean[start, end])
    outside = 1.0 - np.sum(components**2) / np.sum(np.square(flat, dtype=np.float64))
    arrays = (p, (turn.T @ span).reshape(-1, *shape), scale, mean @ turn, length_mean, length_std, outside)
    return Chart(*(jnp.asarray(array, jnp.float32) for array in arrays))


@jax.jit
def coordinates(chart: Chart, tangent: jax.Array, log_length: jax.Array, start, end) -> jax.Array:
    """Coordinates (R + 1,) of a tangent at p (T-1, L, 3), less what the basis lacks, and a log-length ()."""
    standard = (log_length - chart.length_mean[start, end]) / chart.length_std
    return jnp.concatenate([standard[None], jnp.tensordot(chart.basis, tangent, 3)])


@jax.jit
def motion(chart: Chart, values: jax.Array, start, end) -> tuple[jax.Array, jax.Array]:
    """The tangent vector at p (T-1, L, 3), exactly tangent, and the log-length () of coordinates (R + 1,)."""
    tangent = sphere.project(chart.p, jnp.tensordot(values[1:], chart.basis, 1))
    return tangent, chart.length_mean[start, end] + chart.length_std * values[0]


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
    variance = np.where(count[:, None] >= FEW, np.maximum(own, 1e-6 * pooled), pooled)
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
