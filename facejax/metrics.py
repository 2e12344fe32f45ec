"""Metrics of meshes and motions, in the unit of their input.

Meshes are (..., N, 3), motions (..., T, L, 3). The distance of two motions is the Euclidean distance per
landmark, averaged over landmarks and frames. Specificity, diversity and their real-data ceilings follow
Otberdout et al. 2023, section 4.3, and Davies et al. 2002; compare them at equal counts and for the same label
pairs. In signatures `_` is a size that the function compares itself, for a message of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Real

from facejax.geometry import sphere
from facejax.geometry.sphere import AnyArray


class Error(NamedTuple):
    """Mean and standard deviation of the vertex distance, over `count` vertices x frames."""

    mean: jax.Array | np.float64
    std: jax.Array | np.float64
    count: jax.Array | np.float64  # pyright: ignore[reportIncompatibleMethodOverride]  a field, not tuple's method


@jax.jit
def vertex_distance(
    predicted: Float[AnyArray, "*lead N 3"], target: Float[AnyArray, "*lead _ 3"]
) -> Float[Array, "*lead N"]:
    """Return the Euclidean distance (..., N) of each vertex of predicted to target (..., N, 3)."""
    _check_same(predicted, target, 2)
    return _norm(predicted - target)


@jax.jit
def vertex_error(
    predicted: Float[AnyArray, "*lead N 3"],
    target: Float[AnyArray, "*lead _ 3"],
    mask: Bool[AnyArray, " _"] | Real[AnyArray, " _"] | None = None,
) -> Error:
    """Return mean and population standard deviation of `vertex_distance` over vertices, frames and leading axes.

    mask (N,), bool or weights, selects vertices (a face region, for example). An empty mask gives NaN. Use `pool` for
    data in parts.
    """
    distance = vertex_distance(predicted, target)
    if mask is not None and jnp.shape(mask) != distance.shape[-1:]:
        raise ValueError(f"mask: expected ({distance.shape[-1]},), got {jnp.shape(mask)}")
    weights = jnp.ones(distance.shape[-1], distance.dtype) if mask is None else jnp.asarray(mask, distance.dtype)
    share = weights / jnp.sum(weights)
    # Vertices first, frames after: a single float32 sum over 10^8 numbers would lose digits.
    mean = jnp.mean(distance @ share)
    std = sphere.safe_sqrt(jnp.mean((distance - mean) ** 2 @ share))
    return Error(mean, std, jnp.sum(weights) * (distance.size // distance.shape[-1]))


def pool(errors: Sequence[Error]) -> Error:
    """Combine the errors of parts (folds, batches) into the error over all of them, in float64 on the host."""
    if not errors:
        raise ValueError("errors: expected at least one, got none")
    mean, std, count = np.asarray([[float(x) for x in error] for error in errors]).T
    share = count / count.sum()
    centre = share @ mean
    return Error(centre, np.sqrt(share @ (std**2 + (mean - centre) ** 2)), count.sum())


@jax.jit
def speed(landmarks: Float[AnyArray, "... L 3"]) -> Float[Array, " ..."]:
    """Return the mean norm (...) of the first differences in time of landmarks (..., T, L, 3), per frame."""
    _check_motion(landmarks, 2)
    return jnp.mean(_norm(jnp.diff(landmarks, axis=-3)), axis=(-2, -1))


@jax.jit
def acceleration(landmarks: Float[AnyArray, "... L 3"]) -> Float[Array, " ..."]:
    """Return the mean norm (...) of the second differences in time of landmarks (..., T, L, 3), per frame squared.

    It measures jitter: noise of standard deviation s in every coordinate adds about 3.9 s (the mean norm of 3
    coordinates of standard deviation s sqrt 6).
    """
    _check_motion(landmarks, 3)
    return jnp.mean(_norm(jnp.diff(landmarks, n=2, axis=-3)), axis=(-2, -1))


@jax.jit
def peak_displacement(
    landmarks: Float[AnyArray, "*#lead T L 3"], neutral: Float[AnyArray, "*#lead _ 3"]
) -> Float[Array, "*lead"]:
    """Return the mean displacement (...) of landmarks (..., T, L, 3) from neutral (..., L, 3), largest over frames."""
    _check_motion(landmarks, 1)
    if jnp.shape(neutral)[-2:] != landmarks.shape[-2:]:
        raise ValueError(f"neutral: expected (..., {landmarks.shape[-2]}, 3), got {jnp.shape(neutral)}")
    return jnp.max(jnp.mean(_norm(landmarks - neutral[..., None, :, :]), axis=-1), axis=-1)


@jax.jit
def specificity(
    samples: Float[AnyArray, "*#lead K T L 3"], reference: Float[AnyArray, "*#lead _ L 3"]
) -> Float[Array, "*lead"]:
    """Return the mean distance (...) of samples (..., K, T, L, 3) to the one reference (..., T, L, 3), in its unit.

    The distance of two motions is the mean over frames and landmarks of the Euclidean distance.
    """
    _check_motion(samples, 1, axes=4)
    if jnp.shape(reference)[-3:] != samples.shape[-3:]:
        raise ValueError(f"reference: expected (..., {samples.shape[-3:]}), got {jnp.shape(reference)}")
    return jnp.mean(_norm(samples - reference[..., None, :, :, :]), axis=(-3, -2, -1))


@jax.jit
def distances(a: Float[AnyArray, "... T L 3"], b: Float[AnyArray, "... _ L 3"]) -> Float[Array, "K M"]:
    """Return the distance (K, M) of each motion of a (K, T, L, 3) to each of b (M, T, L, 3)."""
    _check_motion(a, 1, axes=4)
    _check_motion(b, 1, axes=4)
    if a.ndim != 4 or b.ndim != 4 or a.shape[1:] != b.shape[1:]:
        raise ValueError(f"expected (K, T, L, 3) and (M, T, L, 3), got {a.shape} and {b.shape}")
    return jax.lax.map(lambda one: _motion_distance(one, b), a)


@jax.jit
def mean_off_diagonal(own: Float[AnyArray, "K _"]) -> Float[Array, ""]:
    """Return the mean () of a square table (K, K), K >= 2, without its diagonal."""
    if own.ndim != 2 or own.shape[0] != own.shape[1] or len(own) < 2:
        raise ValueError(f"expected (K, K) with K >= 2, got {own.shape}")
    return (jnp.sum(own) - jnp.trace(own)) / (len(own) * (len(own) - 1))


@jax.jit(static_argnames=("neighbours",))
def coverage(across: Float[AnyArray, "K _"], real: Float[AnyArray, "M M"], *, neighbours: int = 5) -> Float[Array, ""]:
    """Return the fraction () of real motions near a generated one, from tables (K, M) and (M, M) of `distances`.

    Near: within the distance of the real motion's k-th real neighbour, k = `neighbours`. Naeem et al. 2020.
    """
    if across.shape[1:] != real.shape[:1] or not 0 < neighbours < len(real):
        raise ValueError(f"expected (K, M) and (M, M) with M > {neighbours}, got {across.shape} and {real.shape}")
    radius = jnp.sort(real, axis=1)[:, neighbours]  # entry 0 is the motion itself
    return jnp.mean(jnp.min(across, axis=0) < radius)


@jax.jit
def energy_distance(
    across: Float[AnyArray, "K M"], drawn: Float[AnyArray, "K K"], real: Float[AnyArray, "M M"]
) -> Float[Array, ""]:
    """Return the energy distance () of two sets of motions, from tables (K, M), (K, K) and (M, M) of `distances`.

    (2 E|X - Y| - E|X - X'| - E|Y - Y'|) / E|Y - Y'|; 0 for equal distributions. Szekely & Rizzo 2013. Unbiased: two
    samples of one distribution give 0 in the mean, and may give a negative value.
    """
    spread = mean_off_diagonal(real)
    return (2 * jnp.mean(across) - mean_off_diagonal(drawn) - spread) / spread


@jax.jit
def diversity(samples: Float[AnyArray, "... T L 3"]) -> Float[Array, " ..."]:
    """Return the mean distance (...) over all pairs of the samples (..., K, T, L, 3), K >= 2."""
    _check_motion(samples, 1, axes=4)
    count = samples.shape[-4]
    if count < 2:
        raise ValueError(f"samples: expected at least 2, got {count}")

    def to_all(sample: jax.Array) -> jax.Array:
        return jnp.sum(_motion_distance(sample[..., None, :, :, :], samples), axis=-1)

    # One sample at a time against all others: K times less memory than the table of differences.
    totals = jax.lax.map(to_all, jnp.moveaxis(samples, -4, 0))
    return jnp.sum(totals, axis=0) / (count * (count - 1))


@jax.jit(static_argnames=("chunk",))
def nearest_distance(
    samples: Float[AnyArray, "K T L 3"], training: Float[AnyArray, "M _ L 3"], *, chunk: int = 64
) -> Float[Array, " K"]:
    """Return the distance (K,) of each sample (K, T, L, 3) to the nearest of the training set (M, T, L, 3).

    Its mean is the specificity of Davies et al. 2002. Differences are formed for `chunk` training motions at
    a time: memory is chunk times that of one motion, whatever K and M.
    """
    _check_motion(samples, 1, axes=4)
    _check_motion(training, 1, axes=4)
    if samples.ndim != 4 or training.ndim != 4 or samples.shape[1:] != training.shape[1:]:
        raise ValueError(f"expected (K, T, L, 3) and (M, T, L, 3), got {samples.shape} and {training.shape}")
    if chunk < 1 or len(training) < 1:
        raise ValueError(f"expected chunk and M of at least 1, got {chunk} and {len(training)}")

    def to_nearest(sample: jax.Array) -> jax.Array:
        return jnp.min(jax.lax.map(lambda other: _motion_distance(sample, other), training, batch_size=chunk))

    return jax.lax.map(to_nearest, samples)


def _motion_distance(a: AnyArray, b: AnyArray) -> jax.Array:
    return jnp.mean(_norm(a - b), axis=(-2, -1))


def _norm(vectors: AnyArray) -> jax.Array:
    """Return the norm over the last axis, with gradient 0 at 0."""
    return sphere.safe_sqrt(jnp.sum(vectors**2, axis=-1))


def _check_same(a: AnyArray, b: AnyArray, axes: int) -> None:
    if jnp.shape(a) != jnp.shape(b) or jnp.ndim(a) < axes or jnp.shape(a)[-1] != 3:
        raise ValueError(f"expected two arrays (..., N, 3) of one shape, got {jnp.shape(a)} and {jnp.shape(b)}")


def _check_motion(motion: AnyArray, least: int, axes: int = 3) -> None:
    shape = jnp.shape(motion)
    if len(shape) < axes or shape[-1] != 3 or shape[-3] < least:
        form = "(..., T, L, 3)" if axes == 3 else "(..., K, T, L, 3)"
        raise ValueError(f"expected {form} with T >= {least}, got shape {shape}")
