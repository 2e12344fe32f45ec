"""Distribution of start poses: the peak poses from which a motion of a given label starts.

A generator of motions is conditioned on the face that the motion starts from; OT23 names this a limitation (section 5),
and uses one mean peak for everybody. Peaks vary between people, and not as a Gaussian: a mouth is drawn to the left or
to the right, never in between. So a peak is resampled from the training set, shrunk towards the mean and blurred such
that mean and covariance are kept (the smoothed bootstrap of Silverman & Young 1987).

Poses are (D,) as in `facejax.models.motion.tangent_pca`; K labels, of which 0 is neutral and has the single pose zero.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int

from facejax.models import pca

LIMIT = 2.5  # standard deviations from the mean to which poses are clipped
BLUR = 0.4  # standard deviation of the blur, in units of the label's own


class StartPoses(NamedTuple):
    """Peaks by label, at most N each; rows beyond a label's count are zero."""

    poses: Array  # (K, N, D)
    count: Array  # pyright: ignore[reportIncompatibleMethodOverride] (K,) float, number of peaks
    root: Array  # (K, D, D), a root of the label's covariance


def fit(poses: Float[np.ndarray, "M D"], labels: Int[np.ndarray, " M"], *, classes: int) -> StartPoses:
    """Fit the distribution to the poses of peaks with labels in 1..classes-1.

    Raises:
      ValueError: an expression has fewer than two peaks.
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
        # Not centred: poses are relative to their label's mean already if the chart was fitted to the same motions.
        table[label, : len(own)] = own
        roots[label] = pca.covariance_root(np.cov(own.T, bias=True))
    return StartPoses(*(jnp.asarray(x, jnp.float32) for x in (table, counts, roots)))


@jax.jit
def clip_to_distribution(
    params: StartPoses, pose: Float[Array | np.ndarray, " D"], label: ArrayLike
) -> Float[Array, " D"]:
    """Clip a pose to `LIMIT` standard deviations along each principal axis of the label's peaks.

    In a chain of transitions the end of each deviates slightly from a real peak. Components along axes without variance
    are removed, since they would accumulate into faces that the generator has never been trained on.
    """
    root, count = params.root[label], params.count[label]
    mean = jnp.sum(params.poses[label], axis=0) / count
    variance = jnp.sum(root**2, axis=0)
    used = variance > 1e-6 * jnp.max(variance)
    along = jnp.where(used, (pose - mean) @ root / jnp.where(used, variance, 1), 0)
    return mean + root @ jnp.clip(along, -LIMIT, LIMIT)


@jax.jit
def sample(params: StartPoses, key: Array, label: ArrayLike) -> Float[Array, " D"]:
    """Draw the pose of a peak; zero for the label neutral."""
    which_key, blur_key = jax.random.split(key)
    dtype = params.count.dtype
    return generate(
        params,
        jax.random.uniform(which_key, (), dtype),
        jax.random.normal(blur_key, params.poses.shape[2:], dtype),
        label,
    )


@jax.jit
def generate(
    params: StartPoses, choice: ArrayLike, blur: Float[Array | np.ndarray, " D"], label: ArrayLike
) -> Float[Array, " D"]:
    """Return the pose of the peak that a number in [0, 1) selects, blurred by standard normal noise (D,)."""
    count = params.count[label]
    which = jnp.minimum(jnp.floor(choice * count), count - 1).astype(jnp.int32)
    # Rows beyond the count are zero, so a plain sum gives the mean.
    mean = jnp.sum(params.poses[label], axis=0) / count
    drawn = mean + (1 - BLUR**2) ** 0.5 * (params.poses[label, which] - mean) + BLUR * (params.root[label] @ blur)
    return jnp.where(jnp.asarray(label) == 0, 0.0, drawn)
