"""The square-root velocity function (SRVF): a landmark curve as a point on the sphere and the log of its length.

A curve is (..., T, L, 3): T frames, evenly spaced in time over [0, 1], in any unit. Its steps are the T-1 (in
signatures, S) forward differences d, each taken as one vector of 3L numbers; its length is the sum of their norms. The
point

    q = v / sqrt|v|,   v = (T-1) d / length                                (Otberdout et al. 2023, eq. 1)

then has exactly unit norm on `facejax.geometry.sphere`, whatever T is, and the inverse, a running sum, is
exact. Normalising to unit length discards the amplitude: `encode` returns it beside q, as the natural log of the
length in the curve's own unit.

Constant curves. A curve shorter than 1e-12 has q = 0 and log_length = log 1e-12, and decodes to the constant
curve. q grows as the square root of a step, so it has no derivative where a step is zero: the gradient of
that step is 0 there, as is every gradient of a constant curve. Everywhere else gradients are exact.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Real

from facejax.geometry.precision import HIGHEST
from facejax.geometry.sphere import AnyArray, safe_sqrt

FLOOR = 1e-12
"""Length below which a curve counts as constant, in the curve's unit."""

BLOCK = 32  # steps


@jax.jit
def encode(curve: Float[AnyArray, "*lead T L 3"]) -> tuple[Float[Array, "*lead T-1 L 3"], Float[Array, "*lead"]]:
    """Encode a curve (..., T, L, 3) as its SRVF, a point q (..., T-1, L, 3) on the unit sphere, and log_length (...).

    Nothing is centred or scaled here (see `facejax.geometry.align.normalise`). Raises `ValueError` on fewer
    than two frames, on a last axis that is not 3, or on a dtype that is not floating.
    """
    _check(curve, "curve", "T", 2)
    flat = _flat(curve)
    steps = flat[..., 1:, :] - flat[..., :-1, :]
    # q does not depend on the scale of the steps, and the length is proportional to it. So both are computed
    # on steps divided by their largest entry, held constant: values and gradients are the same, and no square
    # overflows or underflows float32, whatever the unit.
    largest = lax.stop_gradient(jnp.max(jnp.abs(steps), axis=(-2, -1)))
    scale = jnp.where(largest > jnp.finfo(largest.dtype).tiny, largest, 1)
    steps = steps / scale[..., None, None]
    squared = jnp.sum(steps**2, axis=-1)
    # Below this a step is less than the rounding of the largest, and the powers of its gradient would
    # overflow.
    moved = squared > jnp.finfo(squared.dtype).tiny ** 0.5
    norms = safe_sqrt(jnp.where(moved, squared, 0))
    relative = jnp.sum(norms, axis=-1)
    moving = scale * relative > FLOOR
    relative = jnp.where(moving, relative, 1)
    kept = moved & moving[..., None]
    factor = jnp.sqrt(steps.shape[-2] / (jnp.where(kept, norms, 1) * relative[..., None]))
    q = (jnp.where(kept, factor, 0)[..., None] * steps).reshape(*steps.shape[:-1], *curve.shape[-2:])
    return q, jnp.where(moving, jnp.log(scale) + jnp.log(relative), jnp.log(FLOOR))


@jax.jit
def decode(
    q: Float[AnyArray, "*#lead S L 3"], log_length: Real[ArrayLike, "*#lead"], start: Real[AnyArray, "*#lead L 3"]
) -> Float[Array, "*lead S+1 L 3"]:
    """Decode q (..., T-1, L, 3), log_length (...) and start (..., L, 3) to a curve (..., T, L, 3) in the unit of start.

    The inverse of `encode`. Each step is length q|q| / (T-1); the curve's length is exp(log_length) where q
    is on the unit sphere, which is not checked. Raises `ValueError` on shapes that do not fit.
    """
    _check(q, "q", "T-1", 1)
    if jnp.shape(start)[-2:] != q.shape[-2:]:
        raise ValueError(f"start: expected (..., L, 3) with L = {q.shape[-2]}, got shape {jnp.shape(start)}")
    flat, pace = _flat(q), _pace(q, log_length)
    moved = _running(pace, flat).reshape(*flat.shape[:-2], flat.shape[-2] + 1, *q.shape[-2:])
    return jnp.asarray(start)[..., None, :, :] + moved


@jax.jit
def displacement(
    q: Float[AnyArray, "*#lead S L 3"], log_length: Real[ArrayLike, "*#lead"]
) -> Float[Array, "*lead S L 3"]:
    """Return the steps (..., T-1, L, 3) between frames, exp(log_length) q|q| / (T-1), for q (..., T-1, L, 3)."""
    _check(q, "q", "T-1", 1)
    return _pace(q, log_length)[..., None, None] * q


@jax.jit
def arc_length_fraction(q: Float[AnyArray, "*lead S L 3"]) -> Float[Array, "*lead S+1"]:
    """Return the fraction (..., T) of its arc length that the motion q (..., T-1, L, 3) has covered by each frame.

    Speed is |q|^2, so this is the time warp from constant speed to the motion. It runs from 0 to 1; for a constant
    motion it is 0 throughout.
    """
    _check(q, "q", "T-1", 1)
    speed = jnp.sum(q**2, axis=(-2, -1))
    total = jnp.sum(speed, axis=-1, keepdims=True)
    moving = total > 0
    # Rounding may take no fraction above 1, nor the last one off 1.
    share = jnp.minimum(jnp.cumsum(speed[..., :-1], axis=-1) / jnp.where(moving, total, 1), 1)
    return jnp.concatenate([jnp.zeros_like(total), share, jnp.where(moving, jnp.ones_like(total), 0)], axis=-1)


@jax.jit
def length(curve: Float[AnyArray, "*lead T L 3"]) -> Float[Array, "*lead"]:
    """Return the length (...) of a curve (..., T, L, 3) in its own unit: the sum of the norms of its (L, 3) steps."""
    _check(curve, "curve", "T", 2)
    return jnp.sum(safe_sqrt(jnp.sum(jnp.diff(curve, axis=-3) ** 2, axis=(-2, -1))), axis=-1)


def _check(array: AnyArray, name: str, axis: str, least: int) -> None:
    shape = jnp.shape(array)
    if len(shape) < 3 or shape[-1] != 3 or shape[-3] < least:
        raise ValueError(f"{name}: expected (..., {axis}, L, 3) with {axis} >= {least}, got shape {shape}")
    if not jnp.issubdtype(jnp.result_type(array), jnp.floating):
        raise ValueError(f"{name}: expected a floating dtype, got {jnp.result_type(array)}")


def _flat(curve: AnyArray) -> jax.Array:
    """Reshape (..., T, L, 3) to (..., T, 3 L): XLA's code for a CPU is slow where the last axis is short."""
    return jnp.reshape(curve, (*curve.shape[:-2], 3 * curve.shape[-2]))


def _pace(q: AnyArray, log_length: ArrayLike) -> jax.Array:
    """Return the factor (..., T-1) from q to its step, exp(log_length) |q| / (T-1)."""
    # q|q| is differentiable at 0, with derivative 0, and the safe root gives just that.
    norms = safe_sqrt(jnp.sum(_flat(q) ** 2, axis=-1))
    return jnp.exp(jnp.asarray(log_length))[..., None] * norms / q.shape[-3]


def _running(pace: jax.Array, q: jax.Array) -> jax.Array:
    """Return the sums (..., T, D) of the first 0, 1, ..., T-1 steps pace (..., T-1) times q (..., T-1, D).

    A product with a triangular matrix of ones, which takes a tenth of a cumulative sum's time on a CPU (1,000 motions
    of 30 frames: 2 ms instead of 22). Longer motions are summed in blocks.
    """
    count = q.shape[-2]
    if count <= BLOCK:
        earlier = jnp.tril(jnp.ones((count + 1, count), q.dtype), -1)
        return jnp.einsum("...ft,...td->...fd", earlier * pace[..., None, :], q, precision=HIGHEST)
    blocks = -(-count // BLOCK)
    spare = [(0, 0)] * (q.ndim - 2) + [(0, blocks * BLOCK - count)]
    q = jnp.pad(q, [*spare, (0, 0)]).reshape(*q.shape[:-2], blocks, BLOCK, q.shape[-1])
    pace = jnp.pad(pace, spare[-pace.ndim :]).reshape(*pace.shape[:-1], blocks, BLOCK)
    within = _running(pace, q)
    before = jnp.cumsum(within[..., -1:, :], axis=-3) - within[..., -1:, :]
    sums = (before + within[..., :-1, :]).reshape(*within.shape[:-3], blocks * BLOCK, within.shape[-1])
    end = before[..., -1, :, :] + within[..., -1, -1:, :]
    return jnp.concatenate([sums, end], axis=-2)[..., : count + 1, :]
