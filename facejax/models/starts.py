"""Where a motion starts when only the expression is known: a Gaussian over peaks, given how far the motion goes.

Motion3DGAN gives a motion from A to B, not the face that it starts from; OT23 names this as its limit (section 5).
Taking A's mean peak is wrong where people differ: a mouth drawn to the left ends elsewhere than one drawn to the
right. Let the peaks of A and B be independent Gaussians S and E. The motion's travel is d = E - S, and given d

    S | d  ~  N(m_A - C_A (C_A + C_B)^-1 (d - m_B + m_A),  C_A - C_A (C_A + C_B)^-1 C_A).

Neutral has no spread: a motion that starts there starts at zero, one that ends there starts at exactly -d.

Displacements from neutral are (L, 3), unitless; K labels, D directions that span the peaks.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

# Share of the mean variance added to a label's spread, so that the sum of two can be inverted.
FLOOR = 1e-6


class Params(NamedTuple):
    """Peaks by label, in a common basis."""

    mean: jax.Array  # (K, L, 3); zero for neutral
    basis: jax.Array  # (D, L, 3), orthonormal
    covariance: jax.Array  # (K, D, D); zero for neutral


def fit(peaks: np.ndarray, labels: np.ndarray, *, classes: int, directions: int = 40) -> Params:
    """From peak displacements (M, L, 3) with labels (M,) in 1..classes-1; label 0 is neutral.

    Raises `ValueError` where an expression has fewer than two peaks.
    """
    peaks, labels = np.asarray(peaks, np.float64), np.asarray(labels)
    counts = np.bincount(labels, minlength=classes)
    if counts[1:].min() < 2:
        raise ValueError(f"every expression needs two peaks or more, got {counts[1:].tolist()}")
    shape = peaks.shape[1:]
    flat = peaks.reshape(len(peaks), -1)
    mean = np.zeros((classes, flat.shape[1]))
    np.add.at(mean, labels, flat)
    mean[1:] /= counts[1:, None]
    mean[0] = 0
    within = flat - mean[labels]
    basis = np.linalg.svd(within, full_matrices=False)[2][:directions]
    spread = within @ basis.T
    covariance = np.zeros((classes, len(basis), len(basis)))
    for label in range(1, classes):
        own = spread[labels == label]
        covariance[label] = own.T @ own / len(own)
    return Params(
        *(jnp.asarray(x, jnp.float32) for x in (mean.reshape(classes, *shape), basis.reshape(-1, *shape), covariance))
    )


@jax.jit
def sample(params: Params, key: jax.Array, travel: jax.Array, start, end) -> jax.Array:
    """Draw a start (L, 3) for a motion between two labels that travels (L, 3) from its first frame to its last."""
    here, there = params.covariance[start], params.covariance[end]
    excess = travel - (params.mean[end] - params.mean[start])
    found = jnp.tensordot(params.basis, excess, 2)
    floor = FLOOR * jnp.trace(params.covariance.mean(axis=0)) / len(found) * jnp.eye(len(found))
    gain = jnp.linalg.solve(here + there + floor, here).T
    noise = jax.random.normal(key, found.shape)
    # The root of the remaining covariance; rounding may leave tiny negative eigenvalues.
    left = here - gain @ here
    known = (jnp.asarray(start) == 0) | (jnp.asarray(end) == 0)
    # Where nothing is left to guess all eigenvalues are 0, and the gradient of `eigh` would be NaN.
    left = jnp.where(known, jnp.diag(1.0 + jnp.arange(len(found))), (left + left.T) / 2)
    values, vectors = jnp.linalg.eigh(left)
    drawn = -gain @ found + vectors @ (jnp.sqrt(jnp.maximum(values, 0.0)) * noise)
    inside = params.mean[start] + jnp.tensordot(drawn, params.basis, 1)
    # What the basis does not span is known exactly in the one case where nothing is left to guess.
    return jnp.where(jnp.asarray(start) == 0, 0.0, jnp.where(jnp.asarray(end) == 0, -travel, inside))
