"""Where a motion starts when only the expression is known: a distribution of its peaks.

A generator of motions needs to know the face that the motion starts from; OT23 names this as its limit (section 5), and
takes one mean peak for everybody. People differ, and not as a Gaussian does: a mouth is drawn to the left or to the
right, never between. So a peak is drawn from those of the training set, pulled towards their mean and blurred by as
much, which keeps their mean and covariance (the smoothed bootstrap of Silverman & Young 1987).

Poses are (D,) as in `facejax.models.charts`; K labels, of which 0 is neutral and has the one pose zero.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

LIMIT = 2.5  # deviations from the mean beyond which no face of a label is taken to stand
BLUR = 0.4  # deviation of the blur, in units of the label's own deviation


class StartPoses(NamedTuple):
    """Peaks by label; rows beyond a label's count are zero."""

    poses: jax.Array  # (K, N, D)
    count: jax.Array  # (K,) float
    root: jax.Array  # (K, D, D), a root of the label's covariance


def fit(poses: np.ndarray, labels: np.ndarray, *, classes: int) -> StartPoses:
    """From the poses of peaks (M, D) with labels (M,) in 1..classes-1.

    Raises `ValueError` where an expression has fewer than two peaks.
    """
    poses, labels = np.asarray(poses, np.float64), np.asarray(labels)
    counts = np.bincount(labels, minlength=classes)
    if counts[1:].min() < 2:
        raise ValueError(f"every expression needs two peaks or more, got {counts[1:].tolist()}")
    counts[0] = 1
    table = np.zeros((classes, counts.max(), poses.shape[1]))
    roots = np.zeros((classes, poses.shape[1], poses.shape[1]))
    for label in range(1, classes):
        own = poses[labels == label]
        # Poses are less their label's mean already, so far as the same motions made the chart.
        table[label, : len(own)] = own
        values, vectors = np.linalg.eigh(np.cov(own.T, bias=True))
        roots[label] = vectors * np.sqrt(np.maximum(values, 0))
    return StartPoses(*(jnp.asarray(x, jnp.float32) for x in (table, counts, roots)))


@jax.jit
def clip_to_distribution(params: StartPoses, pose: jax.Array, label) -> jax.Array:
    """The pose (D,) brought to within `LIMIT` deviations along each principal axis of the label's peaks.

    A chain of transitions ends each one a little beside a real peak. What lies along axes that the label's peaks do not
    use at all would be carried on, and a network asked about faces that it has never seen.
    """
    root, count = params.root[label], params.count[label]
    mean = jnp.sum(params.poses[label], axis=0) / count
    variance = jnp.sum(root**2, axis=0)
    used = variance > 1e-6 * jnp.max(variance)
    along = jnp.where(used, (pose - mean) @ root / jnp.where(used, variance, 1), 0)
    return mean + root @ jnp.clip(along, -LIMIT, LIMIT)


@jax.jit
def sample(params: StartPoses, key: jax.Array, label) -> jax.Array:
    """Draw the pose (D,) of a peak; neutral's is zero."""
    which_key, blur_key = jax.random.split(key)
    count = params.count[label]
    which = jnp.minimum(jnp.floor(jax.random.uniform(which_key) * count), count - 1).astype(jnp.int32)
    # Rows beyond the count are zero, so a plain sum gives the mean.
    mean = jnp.sum(params.poses[label], axis=0) / count
    blur = params.root[label] @ jax.random.normal(blur_key, mean.shape)
    drawn = mean + jnp.sqrt(1 - BLUR**2) * (params.poses[label, which] - mean) + BLUR * blur
    return jnp.where(jnp.asarray(label) == 0, 0.0, drawn)
