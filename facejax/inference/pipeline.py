"""Inference: from labels and a neutral face to landmarks and meshes.

    models = pipeline.load()
    landmarks = pipeline.landmarks(models, key, ["neutral", "high_smile", "neutral"], neutral)
    vertices = pipeline.meshes(models, landmarks, neutral)

T frames, N vertices, L landmarks, S samples; millimetres. A neutral face is (N, 3) vertices in the models' topology.
"""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from facejax.inference import checks, composition
from facejax.mesh.hierarchy import Hierarchy
from facejax.models.bundle import Face, Models, load, save
from facejax.models.decoders import gpmm_residual, s2d_dec

__all__ = [
    "FRAMES",
    "RATE",
    "Face",
    "Models",
    "captions",
    "displacements",
    "durations",
    "label_indices",
    "landmarks",
    "lengths",
    "load",
    "meshes",
    "neutral_landmarks",
    "save",
]

RATE = 30.0  # frames per second of generated motions
FRAMES = 30  # of a transition, as in the generator's training data


def landmarks(
    models: Models,
    key: jax.Array,
    labels: Sequence[str],
    neutral: np.ndarray | jax.Array,
    *,
    samples: int | None = None,
    frames: int | Sequence[int] = FRAMES,
    intensity: float = 1.0,
) -> jax.Array:
    """Generate the landmark motion through `labels`: (T, L, 3), or (S, T, L, 3) with `samples`; mm.

    Args:
      labels: two or more names; a motion that does not start at neutral starts at a peak drawn from `models.starts`.
      neutral: (N, 3) vertices; mm.
      frames: the length of every transition, or one for each; T = 1 + sum of (frames - 1), joints are not repeated.
        `durations` gives natural ones.
      intensity: scale of all displacements from neutral, 0 to 2.

    Raises:
      ValueError: an unknown label, another vertex count, or an option out of range.
    """
    checks.check_intensity(intensity)
    rest = neutral_landmarks(models, neutral)
    unitless = displacements(models, key, labels, samples=1 if samples is None else samples, frames=frames)
    moved = rest + intensity * jnp.linalg.norm(rest - rest.mean(axis=0)) * unitless
    return moved if samples is not None else moved[0]


def displacements(
    models: Models, key: jax.Array, labels: Sequence[str], *, samples: int, frames: int | Sequence[int] = FRAMES
) -> jax.Array:
    """Generate displacements from neutral (S, T, L, 3), unitless: divided by the norm of the centred landmarks."""
    numbers = _numbers(models, labels)
    each = lengths(labels, frames)
    return composition.compose(models.motion, models.starts, key, numbers, samples=samples, frames=each)


def durations(models: Models, key: jax.Array, labels: Sequence[str], *, rate: float = RATE) -> tuple[int, ...]:
    """Generate the natural number of frames of each transition at `rate` frames per second.

    Natural is what the training data has: in makehuman4d an onset is a random draw of 18 to 39 frames at 60 frames per
    second, not measured on people. The numbers belong to the first sample of the motion that `landmarks` generates
    from the same key; pass them as its `frames`. Raises `ValueError` for a rate that is not positive, and for unknown
    labels.
    """
    if not rate > 0:
        raise ValueError(f"rate must be above 0 frames per second, got {rate}")
    pairs = composition.label_pairs(_numbers(models, labels))
    drawn = composition.draw(models.motion, models.starts, composition.sample_keys(key, 1), pairs)
    seconds = np.exp(np.asarray(drawn.log_seconds[0]))
    return tuple(max(2, 1 + round(float(x) * rate)) for x in seconds)


def lengths(labels: Sequence[str], frames: int | Sequence[int]) -> tuple[int, ...]:
    """Return the frames of each transition. Raises `ValueError` for a wrong count or fewer than two frames."""
    count = len(labels) - 1
    values = np.asarray(frames)
    found = [values.item()] * count if values.ndim == 0 else values.tolist()
    if len(found) != count:
        raise ValueError(f"frames: expected one number, or {count} for {count} transitions, got {len(found)}")
    if any(n != int(n) or n < 2 for n in found):
        raise ValueError(f"frames: expected whole numbers of 2 or more, got {frames}")
    return tuple(int(n) for n in found)


def meshes(
    models: Models,
    landmarks: np.ndarray | jax.Array,
    neutral: np.ndarray | jax.Array,
    *,
    refined: bool = True,
    noise: float | None = 0.0,
) -> jax.Array:
    """Decode landmarks (..., T, L, 3) of a face with neutral vertices (N, 3) to vertices (..., T, N, 3); mm.

    Args:
      refined: False returns the GPMM estimate without the residual decoder: much faster, little worse.
      noise: standard deviation of the landmarks in mm, such as a detector's; None estimates it. See
        `gpmm_residual.apply`.

    Raises:
      ValueError: another vertex or landmark count, or `noise` for an S2D-Dec, which does not support it.
    """
    rest = neutral_landmarks(models, neutral)
    if landmarks.shape[-2:] != rest.shape:
        raise ValueError(f"landmarks: expected (..., {rest.shape[0]}, 3), got {landmarks.shape}")
    if isinstance(models.decoder, gpmm_residual.GPMMResidual):
        return jnp.asarray(neutral, jnp.float32) + gpmm_residual.apply(
            models.decoder, landmarks - rest, neutral, refined=refined, noise=noise
        )
    if noise != 0:
        raise ValueError("noise is not supported by S2D-Dec; use a GPMM decoder (`models.decoders.gpmm_residual`)")
    return _decode(models.decoder, models.hierarchy, landmarks - rest, jnp.asarray(neutral, jnp.float32))


def captions(labels: Sequence[str], *, frames: int | Sequence[int] = FRAMES) -> tuple[tuple[int, str], ...]:
    """Return (first frame, "neutral → high_smile") of each transition."""
    begins = np.cumsum([0] + [count - 1 for count in lengths(labels, frames)])
    pairs = zip(labels[:-1], labels[1:], strict=True)
    return tuple((int(begin), f"{start} → {end}") for begin, (start, end) in zip(begins, pairs, strict=False))


def neutral_landmarks(models: Models, neutral: np.ndarray | jax.Array) -> jax.Array:
    """Return the landmarks (L, 3) of a neutral face (N, 3); mm.

    Raises `ValueError` for another vertex count, or a size that is not a head's in millimetres.
    """
    expected = models.face.vertices.shape
    if np.shape(neutral) != expected:
        raise ValueError(f"neutral: expected vertices {expected} in the models' topology, got {np.shape(neutral)}")
    if not isinstance(neutral, Tracer):
        size, usual = (
            np.linalg.norm(np.ptp(np.asarray(x)[models.face.landmark_index], axis=0))
            for x in (neutral, models.face.vertices)
        )
        if not usual / 3 < size < 3 * usual:
            raise ValueError(
                f"neutral: its landmarks span {size:.4g}, expected about {usual:.0f} mm: give vertices in millimetres"
            )
    return jnp.asarray(neutral, jnp.float32)[models.face.landmark_index]


def label_indices(models: Models, labels: Sequence[str]) -> np.ndarray:
    """Return the indices (K,) of label names. Raises `ValueError` for an unknown name, with the closest ones."""
    checks.check_labels(labels, models.labels)
    return np.array([models.labels.index(name) for name in labels], np.int32)


def _numbers(models: Models, labels: Sequence[str]) -> list[int]:
    """Return the indices of two or more labels, no two in a row alike."""
    checks.check_transitions(labels)
    return label_indices(models, labels).tolist()


@jax.jit
def _decode(params: s2d_dec.S2DDec, hierarchy: Hierarchy, displacements: jax.Array, neutral: jax.Array) -> jax.Array:
    return neutral + s2d_dec.apply(params, hierarchy, displacements)
