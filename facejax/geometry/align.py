"""Alignment of landmarks in space and time: centring, Procrustes, the unitless scale, resampling.

Landmarks are (..., L, 3), curves of them (..., T, L, 3), in any unit. Leading axes are free and broadcast.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Real

from facejax.geometry.precision import HIGHEST
from facejax.geometry.sphere import AnyArray, safe_sqrt


class Similarity(NamedTuple):
    """x -> scale * rotation @ x + translation."""

    rotation: Float[Array, "*lead 3 3"]  # orthonormal, determinant +1
    scale: Float[Array, "*lead"]  # positive; 1 in a rigid motion
    translation: Float[Array, "*lead 3"]


@jax.jit
def centre(points: Float[AnyArray, "*lead K 3"]) -> tuple[Float[Array, "*lead K 3"], Float[Array, "*lead 3"]]:
    """Return points (..., K, 3) minus their centroid, and the centroid (..., 3)."""
    _check_points(points, "points")
    centroid = jnp.mean(points, axis=-2)
    return jnp.asarray(points) - centroid[..., None, :], centroid


@jax.jit
def normalise(
    landmarks: Float[AnyArray, "*#lead T L 3"], neutral: Float[AnyArray, "*#lead L 3"]
) -> tuple[Float[Array, "*lead T L 3"], Float[Array, "*#lead"], Float[Array, "*#lead 3"]]:
    """Normalise a curve (..., T, L, 3) by the neutral landmarks (..., L, 3) of its subject.

    Subtracts the centroid (..., 3) of the *neutral* landmarks and divides by their centred Frobenius norm, the scale
    (...). One centroid and one scale serve all frames and sequences of a subject: with those of each frame an open jaw
    would shrink the head. Neutral landmarks that all coincide have scale 1.

    Returns:
      the unitless curve (..., T, L, 3), scale (...), centroid (..., 3).
    """
    _check_curve(landmarks, 1)
    _check_points(neutral, "neutral", landmarks.shape[-2])
    centred, centroid = centre(neutral)
    squared = jnp.sum(centred**2, axis=(-2, -1))
    scale = jnp.sqrt(jnp.where(squared > 0, squared, 1))
    return (landmarks - centroid[..., None, None, :]) / scale[..., None, None, None], scale, centroid


@jax.jit
def denormalise(
    unitless: Float[AnyArray, "*#lead T L 3"], scale: Real[ArrayLike, "*#lead"], centroid: Real[AnyArray, "*#lead 3"]
) -> Float[Array, "*lead T L 3"]:
    """Invert `normalise`: return the curve of unitless (..., T, L, 3), scale (...) and centroid (..., 3)."""
    _check_curve(unitless, 1)
    return jnp.asarray(unitless) * jnp.asarray(scale)[..., None, None, None] + jnp.asarray(centroid)[..., None, None, :]


@jax.jit(static_argnames=("scaling",))
def procrustes(
    source: Float[AnyArray, "*#lead K 3"], target: Float[AnyArray, "*#lead K 3"], *, scaling: bool = False
) -> Similarity:
    """Fit the rotation, translation and, with `scaling`, scale that align source (..., K, 3) with target (..., K, 3).

    Least squares over the K points, never a reflection (Kabsch 1976; scale after Umeyama 1991). Gradients are exact,
    also with equal singular values. Where the best rotation is not unique (collinear points, or a mirror image with a
    symmetry) one of them is returned, with gradient 0. `facejax.geometry.host.procrustes` is the NumPy form.
    """
    _check_points(source, "source")
    _check_points(target, "target", source.shape[-2])
    (from_, source_centroid), (to, target_centroid) = centre(source), centre(target)
    (from_, small), (to, large) = _unit(from_), _unit(to)
    covariance = jnp.einsum("...ki,...kj->...ij", to, from_, precision=HIGHEST)
    rotation = _rotation(covariance)
    spread = jnp.sum(from_**2, axis=(-2, -1)) + jnp.zeros(covariance.shape[:-2], covariance.dtype)
    overlap = jnp.sum(rotation * covariance, axis=(-2, -1))
    usable = spread > 0
    grown = overlap / jnp.where(usable, spread, 1) * (large / small)
    scale = jnp.where(usable, grown, 1) if scaling else jnp.ones_like(spread)
    turned = jnp.einsum("...ij,...j->...i", rotation, source_centroid, precision=HIGHEST)
    return Similarity(rotation, scale, target_centroid - scale[..., None] * turned)


@jax.jit
def apply(similarity: Similarity, points: Float[AnyArray, "... K 3"]) -> Float[Array, "... K 3"]:
    """Apply a similarity to points (..., K, 3)."""
    _check_points(points, "points")
    turned = jnp.einsum("...ij,...kj->...ki", similarity.rotation, points, precision=HIGHEST)
    return similarity.scale[..., None, None] * turned + similarity.translation[..., None, :]


@jax.jit(static_argnames=("frames", "by"))
def resample(
    curve: Float[AnyArray, "*lead T L 3"], *, frames: int, by: str = "time"
) -> Float[Array, "*lead {frames} L 3"]:
    """Resample a curve (..., T, L, 3) to (..., frames, L, 3) by linear interpolation.

    by="time": evenly spaced in time, which keeps the timing of onset and apex. by="arc": evenly spaced in arc length,
    which makes the speed constant. First and last frame are kept exactly; a constant curve is unchanged. Where a
    position falls on a frame, the gradient of "arc" is that of one of the two neighbouring segments.
    """
    _check_curve(curve, 2)
    if frames < 2:
        raise ValueError(f"frames: expected at least 2, got {frames}")
    if by == "time":
        places = np.linspace(0, curve.shape[-3] - 1, frames)
        index = np.floor(places).astype(np.int32)
        return _read(curve, jnp.asarray(index), jnp.asarray(places - index, curve.dtype))
    if by != "arc":
        raise ValueError(f'by: expected "time" or "arc", got {by!r}')
    flat = curve.reshape(*curve.shape[:-2], -1)
    steps = safe_sqrt(jnp.sum(_unit(jnp.diff(flat, axis=-2))[0] ** 2, axis=-1))
    covered = jnp.concatenate([jnp.zeros_like(steps[..., :1]), jnp.cumsum(steps, axis=-1)], axis=-1)
    wanted = covered[..., -1:] * jnp.linspace(0, 1, frames, dtype=curve.dtype)
    # The last frame not beyond the position: the segment after it has a length, except at the end of the curve.
    index = jnp.sum(covered[..., None, :] <= wanted[..., :, None], axis=-1) - 1
    # The ends are kept exactly, also where steps are below rounding.
    index = index.at[..., 0].set(0).at[..., -1].set(curve.shape[-3] - 1)
    before = jnp.take_along_axis(covered, index, axis=-1)
    after = jnp.take_along_axis(covered, jnp.minimum(index + 1, curve.shape[-3] - 1), axis=-1)
    inside = after > before
    return _read(curve, index, jnp.where(inside, (wanted - before) / jnp.where(inside, after - before, 1), 0))


@jax.jit
def interpolate(
    curve: Float[AnyArray, "*#lead T L 3"], positions: Real[AnyArray, "*#lead F"]
) -> Float[Array, "*lead F L 3"]:
    """Interpolate a curve (..., T, L, 3) at positions (..., F), in frames, clipped to [0, T-1]: (..., F, L, 3)."""
    _check_curve(curve, 1)
    positions = jnp.clip(jnp.asarray(positions, curve.dtype), 0, curve.shape[-3] - 1)
    index = jnp.floor(positions)
    return _read(curve, index.astype(jnp.int32), positions - index)


def _read(curve: AnyArray, index: jax.Array, weight: jax.Array) -> jax.Array:
    """Return curve[index] + weight * (curve[index + 1] - curve[index]) for index and weight (..., F)."""
    lead = jnp.broadcast_shapes(curve.shape[:-3], index.shape[:-1])
    curve = jnp.broadcast_to(curve, lead + curve.shape[-3:])
    index, weight = (jnp.broadcast_to(x, lead + x.shape[-1:])[..., None, None] for x in (index, weight))
    before = jnp.take_along_axis(curve, index, axis=-3)
    after = jnp.take_along_axis(curve, jnp.minimum(index + 1, curve.shape[-3] - 1), axis=-3)
    # Unlike (1 - w) a + w b, this form returns a exactly where a = b: a constant curve stays constant.
    return before + weight * (after - before)


def _unit(points: AnyArray) -> tuple[jax.Array, jax.Array]:
    """Divide arrays (..., K, D) by their largest entry (...), held constant: no square overflows or underflows.

    Functions that are independent of the size, or proportional to it, keep their values and gradients.
    """
    largest = jax.lax.stop_gradient(jnp.max(jnp.abs(points), axis=(-2, -1)))
    size = jnp.where(largest > jnp.finfo(largest.dtype).tiny, largest, 1)
    return jnp.asarray(points) / size[..., None, None], size


@jax.custom_jvp
def _rotation(matrix: jax.Array) -> jax.Array:
    """Return the rotation R (..., 3, 3) that maximises trace(R' M) for M (..., 3, 3)."""
    u, _, vt = jnp.linalg.svd(matrix)
    handed = jnp.sign(jnp.linalg.det(u) * jnp.linalg.det(vt))
    flip = jnp.stack([jnp.ones_like(handed), jnp.ones_like(handed), handed], axis=-1)
    return jnp.matmul(u * flip[..., None, :], vt, precision=HIGHEST)


@_rotation.defjvp
def _rotation_jvp(primals: tuple[jax.Array], tangents: tuple[jax.Array]) -> tuple[jax.Array, jax.Array]:
    # M = R S with S symmetric. With dR = R [w]x, the skew part of R' dM = [w]x S + dS gives
    # (trace(S) I - S) w = vee(R' dM - dM' R). Differentiating the SVD itself divides by differences of
    # singular values and is NaN where two of them are equal; this divides by their sums.
    (matrix,), (change,) = primals, tangents
    rotation = _rotation(matrix)
    stretch = jnp.einsum("...ki,...kj->...ij", rotation, matrix, precision=HIGHEST)
    stretch = (stretch + jnp.swapaxes(stretch, -1, -2)) / 2
    trace = jnp.trace(stretch, axis1=-2, axis2=-1)[..., None, None]
    eye = jnp.eye(3, dtype=matrix.dtype)
    system = trace * eye - stretch
    unique = jnp.linalg.det(system)[..., None, None] > jnp.finfo(matrix.dtype).eps * trace**3
    turned = jnp.einsum("...ki,...kj->...ij", rotation, change, precision=HIGHEST)
    skew = turned - jnp.swapaxes(turned, -1, -2)
    vector = jnp.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], axis=-1)[..., None]
    x, y, z = jnp.moveaxis(jnp.linalg.solve(jnp.where(unique, system, eye), vector)[..., 0], -1, 0)
    zero = jnp.zeros_like(x)
    cross = jnp.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(matrix.shape)
    return rotation, jnp.where(unique, rotation @ cross, 0)


def _check_points(points: AnyArray, name: str, count: int | None = None) -> None:
    shape = jnp.shape(points)
    if len(shape) < 2 or shape[-1] != 3 or (count is not None and shape[-2] != count):
        wanted = "(..., K, 3)" if count is None else f"(..., {count}, 3)"
        raise ValueError(f"{name}: expected {wanted}, got shape {shape}")
    if not jnp.issubdtype(jnp.result_type(points), jnp.floating):
        raise ValueError(f"{name}: expected a floating dtype, got {jnp.result_type(points)}")


def _check_curve(curve: AnyArray, least: int) -> None:
    shape = jnp.shape(curve)
    if len(shape) < 3 or shape[-3] < least:
        raise ValueError(f"expected a curve (..., T, L, 3) with T >= {least}, got shape {shape}")
    _check_points(curve, "curve")
