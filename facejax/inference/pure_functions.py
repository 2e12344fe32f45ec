"""Inference as pure functions of pytrees: from label indices and a neutral face to landmarks and vertices.

    face = pipeline.prepare(models, neutral)
    landmarks = pipeline.motion(models, key, labels, face)
    vertices = pipeline.vertices(models, face, landmarks)

`jit`, `vmap`, `grad`, `scan` and `shard_map` go through them in any order, with models and face as arguments.
`facejax.inference.pipeline` has all of them under its own name, beside functions of names of labels.

T frames, N vertices, L landmarks, K labels; millimetres. A neutral face is (N, 3) vertices in the models' topology.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax.core import Tracer
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int

from facejax.inference import checks, composition
from facejax.inference.composition import Noise
from facejax.models.bundle import Models
from facejax.models.decoders import gpmm_residual, s2d_dec
from facejax.models.motion import generators

FRAMES = 30  # of a transition, as in the generator's training data


class PreparedFace(struct.PyTreeNode):
    """Everything that the models need of one neutral face, computed once by `prepare`."""

    neutral: Float[Array, "N 3"]  # mm
    landmarks: Float[Array, "L 3"]  # at rest, mm
    size: Float[Array, ""]  # norm of the centred landmarks, mm: the unit of generated displacements
    decoder: gpmm_residual.PreparedFace | None  # None for S2D-Dec, which does not use the face


def prepare(models: Models, neutral: Float[Array | np.ndarray, "N 3"]) -> PreparedFace:
    """Prepare a neutral face (N, 3), in mm, in the dtype of its vertices.

    Traceable and differentiable in the neutral face; `vmap` prepares many faces. With the GPMM it factorises a dense
    N x N system: about 100 MB of memory per face of 3,260 vertices.

    Raises:
      ValueError: another vertex count, or (outside of tracing) a size that is not a head's in millimetres.
    """
    neutral_landmarks(models, neutral)
    return _prepare(models, neutral)


@jax.jit
def _prepare(models: Models, neutral: Float[Array | np.ndarray, "N 3"]) -> PreparedFace:
    neutral = _floating(neutral)
    marks = neutral[jnp.asarray(models.face.landmark_index)]
    size = jnp.sqrt(jnp.sum((marks - marks.mean(axis=0)) ** 2))
    carried = isinstance(models.decoder, gpmm_residual.GPMMResidual)
    return PreparedFace(neutral, marks, size, gpmm_residual.prepare(models.decoder, neutral) if carried else None)


def motion(
    models: Models,
    key: Array,
    labels: Int[Array | np.ndarray, "*lead K"],
    face: PreparedFace,
    *,
    frames: int | Sequence[int] = FRAMES,
    intensity: ArrayLike = 1.0,
) -> Float[Array, "*lead T L 3"]:
    """Generate the landmark motion through label indices: (..., T, L, 3) in mm.

    Args:
      key: one key, which is split for leading axes of `labels`; or keys of those axes.
      labels: (..., K) indices, K >= 2, from `models.labels.encode`. A motion that does not start at neutral starts at a
        peak drawn from `models.starts`. Traced labels are not checked.
      frames: the length of every transition, or one for each; static. T = 1 + sum of (frames - 1), joints are not
        repeated. `durations` gives natural ones.
      intensity: scale of all displacements from neutral, 0 to 2; may be traced.

    Raises:
      ValueError: labels that are out of range or repeat, or an option out of range.
    """
    each = _check_motion(models, labels, frames, intensity)
    return _motion(models, key, labels, face, intensity, frames=each)


@partial(jax.jit, static_argnames="frames")
def _motion(
    models: Models,
    key: Array,
    labels: Array | np.ndarray,
    face: PreparedFace,
    intensity: ArrayLike,
    *,
    frames: tuple[int, ...],
) -> Array:
    noise = sample_noise(models, key, labels)
    return _motion_from_noise(models, noise, labels, face, intensity, frames=frames)


def motion_from_noise(
    models: Models,
    noise: Noise,
    labels: Int[Array | np.ndarray, "*lead K"],
    face: PreparedFace,
    *,
    frames: int | Sequence[int] = FRAMES,
    intensity: ArrayLike = 1.0,
) -> Float[Array, "*lead T L 3"]:
    """Return the landmark motion (..., T, L, 3) in mm that belongs to noise: `motion` without a key.

    Differentiable in the noise of the transitions, and exportable where random keys do not exist.

    Args:
      noise: of `sample_noise`, with the leading axes of `labels`.
      labels, frames, intensity: as in `motion`.

    Raises:
      ValueError: as `motion`, or noise of another shape.
    """
    each = _check_motion(models, labels, frames, intensity)
    lead, count = np.shape(labels)[:-1], np.shape(labels)[-1] - 1
    expected = (lead, (*lead, models.starts.poses.shape[2]), (*lead, count, generators.noise_size(models.motion)))
    if (found := tuple(np.shape(leaf) for leaf in noise)) != expected:
        raise ValueError(f"noise: expected arrays of shapes {expected}, got {found}; `sample_noise` draws it")
    return _motion_from_noise(models, noise, labels, face, intensity, frames=each)


def sample_noise(models: Models, key: Array, labels: Int[Array | np.ndarray, "*lead K"]) -> Noise:
    """Draw the noise of the motion that `motion` generates from the same key and labels."""
    lead, count = np.shape(labels)[:-1], np.shape(labels)[-1] - 1
    return _map_leading(
        lambda key: composition.sample_noise(models.motion, models.starts, key, count), lead, _keys(key, lead)
    )


@partial(jax.jit, static_argnames="frames")
def _motion_from_noise(
    models: Models,
    noise: Noise,
    labels: Array | np.ndarray,
    face: PreparedFace,
    intensity: ArrayLike,
    *,
    frames: tuple[int, ...],
) -> Array:
    drawn = len(models.motion.chart.p) + 1
    matrix = jnp.asarray(composition.timeline(frames, drawn=drawn), models.motion.chart.mean.dtype)
    return motion_on_timeline(models, noise, labels, face.landmarks, face.size, matrix, intensity)


@jax.jit
def motion_on_timeline(
    models: Models,
    noise: Noise,
    labels: Int[Array | np.ndarray, "*lead K"],
    rest: Float[Array | np.ndarray, "L 3"],
    size: Float[Array | np.ndarray, ""],
    timeline: Float[Array | np.ndarray, "F PT"],
    intensity: ArrayLike = 1.0,
) -> Float[Array, "*lead F L 3"]:
    """Return the landmark motion (..., F, L, 3) in mm of noise on a timeline: the formula of `motion_from_noise`.

    Every argument is an array, so that no length is static. Nothing is checked but shapes.

    Args:
      noise: of `sample_noise`, with the leading axes of `labels`.
      rest, size: `landmarks` (L, 3) and `size` () of a `PreparedFace`, in mm.
      timeline: (F, P T) of `composition.timeline`, for P = K - 1 transitions of T generated frames.
      intensity: one number, or one for each of the leading axes.

    Raises:
      ValueError: a timeline of another size.
    """

    def one(noise: Noise, labels: Array) -> Array:
        pairs = jnp.stack([labels[:-1], labels[1:]], axis=-1)
        curves = composition.generate(models.motion, models.starts, noise, pairs).curves[None]
        return composition.join(curves, timeline)[0]

    unitless = _map_leading(one, np.shape(labels)[:-1], noise, jnp.asarray(labels))
    scale = jnp.asarray(intensity)
    return rest + (scale if scale.ndim == 0 else scale[..., None, None, None]) * size * unitless


def vertices(
    models: Models,
    face: PreparedFace,
    landmarks: Float[Array | np.ndarray, "... L 3"],
    *,
    refined: bool = True,
    noise: ArrayLike | None = 0.0,
) -> Float[Array, "... N 3"]:
    """Decode landmarks (..., L, 3) of a prepared face to vertices (..., N, 3); mm.

    Args:
      refined: False returns the GPMM estimate without the residual decoder: much faster, little worse; static.
      noise: standard deviation of the landmarks in mm, such as a detector's; None estimates it; may be traced. See
        `gpmm_residual.apply`.

    Raises:
      ValueError: another landmark count, or `noise` for an S2D-Dec, which does not support it.
    """
    if landmarks.shape[-2:] != face.landmarks.shape[-2:]:
        raise ValueError(f"landmarks: expected (..., {face.landmarks.shape[-2]}, 3), got {landmarks.shape}")
    exact = isinstance(noise, float | int) and noise == 0
    if face.decoder is None and not exact:
        raise ValueError("noise is not supported by S2D-Dec; use a GPMM decoder (`models.decoders.gpmm_residual`)")
    if noise is not None and isinstance(noise, float | int) and not noise >= 0:
        raise ValueError(f"noise: expected 0 mm or more, got {noise}")
    if noise is None and not isinstance(landmarks, Tracer) and not np.isfinite(landmarks).all():
        raise ValueError("landmarks: expected finite numbers to estimate their noise from")
    return _vertices(models, face, landmarks, 0.0 if exact else noise, refined=refined, exact=exact)


@partial(jax.jit, static_argnames=("refined", "exact"))
def _vertices(
    models: Models,
    face: PreparedFace,
    landmarks: Array | np.ndarray,
    noise: ArrayLike | None,
    *,
    refined: bool,
    exact: bool,
) -> Array:
    moved = jnp.asarray(landmarks, face.neutral.dtype) - face.landmarks
    if isinstance(models.decoder, gpmm_residual.GPMMResidual):
        assert face.decoder is not None
        noise = 0.0 if exact else noise
        return face.neutral + gpmm_residual.apply(models.decoder, face.decoder, moved, refined=refined, noise=noise)
    return face.neutral + s2d_dec.apply(models.decoder, models.hierarchy, moved)


def lengths(transitions: int, frames: int | Sequence[int]) -> tuple[int, ...]:
    """Return the frames of each of some transitions. Raises `ValueError` for a wrong count or fewer than two frames."""
    values = np.asarray(frames)
    found: list[Any] = [values.item()] * transitions if values.ndim == 0 else values.tolist()
    if len(found) != transitions:
        raise ValueError(
            f"frames: expected one number, or {transitions} for {transitions} transitions, got {len(found)}"
        )
    if any(n != int(n) or n < 2 for n in found):
        raise ValueError(f"frames: expected whole numbers of 2 or more, got {frames}")
    return tuple(int(n) for n in found)


def neutral_landmarks(models: Models, neutral: Float[Array | np.ndarray, "N 3"]) -> Float[Array, "L 3"]:
    """Return the landmarks (L, 3) of a neutral face (N, 3); mm.

    Raises `ValueError` for another vertex count, or (outside of tracing) a size that is not a head's in millimetres.
    """
    expected = models.face.vertices.shape
    if np.shape(neutral) != expected:
        raise ValueError(f"neutral: expected vertices {expected} in the models' topology, got {np.shape(neutral)}")
    if not isinstance(neutral, Tracer) and not isinstance(models.face.vertices, Tracer):
        size, usual = (
            np.linalg.norm(np.ptp(np.asarray(x)[np.asarray(models.face.landmark_index)], axis=0))
            for x in (neutral, models.face.vertices)
        )
        if not usual / 3 < size < 3 * usual:
            raise ValueError(
                f"neutral: its landmarks span {size:.4g}, expected about {usual:.0f} mm: give vertices in millimetres"
            )
    return _floating(neutral)[jnp.asarray(models.face.landmark_index)]


def _check_motion(models: Models, labels: Any, frames: int | Sequence[int], intensity: Any) -> tuple[int, ...]:
    """Check what `motion` is given, as far as it is not traced; return the frames of each transition."""
    if not isinstance(labels, Tracer):
        numbers = np.asarray(labels)
        if numbers.ndim < 1 or numbers.dtype.kind not in "iu":
            raise ValueError(f"labels: expected indices (..., K), got {labels}; `models.labels.encode` converts names")
        for row in numbers.reshape(-1, numbers.shape[-1]):
            composition.label_pairs(row, classes=len(models.labels))
    if isinstance(intensity, float | int):
        checks.check_intensity(intensity)
    return lengths(np.shape(labels)[-1] - 1, frames)


def _keys(key: Array, lead: tuple[int, ...]) -> Array:
    """Return one key for each element of the leading axes."""
    if not jnp.issubdtype(key.dtype, jax.dtypes.prng_key):
        key = jax.random.wrap_key_data(key)
    return key if key.shape == lead else jax.random.split(key, lead)


def _map_leading(function: Callable[..., Any], lead: tuple[int, ...], *arguments: Any) -> Any:
    """Map a function over leading axes of its arguments, which all have them."""
    if not lead:
        return function(*arguments)
    flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[len(lead) :]), arguments)
    return jax.tree.map(lambda x: x.reshape(*lead, *x.shape[1:]), jax.vmap(function)(*flat))


def _floating(values: Array | np.ndarray) -> Array:
    """Return values in their own floating dtype; float32 for integers, and for float64 without x64."""
    return jnp.asarray(values, jnp.result_type(jnp.asarray(values), jnp.float32))
