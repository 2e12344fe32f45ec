"""Inference: from labels and a neutral face to landmarks and meshes.

    models = pipeline.load()
    face = pipeline.prepare(models, neutral)
    labels = models.labels.encode(["neutral", "high_smile", "neutral"])
    landmarks = pipeline.motion(models, key, labels, face)
    vertices = pipeline.vertices(models, face, landmarks)

`prepare`, `motion` and `vertices` are pure functions of pytrees, defined in `facejax.inference.pure_functions`: `jit`,
`vmap`, `grad`, `scan` and `shard_map` go through them in any order, with models and face as arguments. `landmarks` and
`meshes` do the same from names of labels and the vertices of a face, in one call each.

T frames, N vertices, L landmarks, S samples, K labels; millimetres. A neutral face is (N, 3) vertices in the models'
topology.
"""

from __future__ import annotations

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from facejax.inference import checks, composition
from facejax.inference.composition import Noise
from facejax.inference.pure_functions import (
    FRAMES,
    PreparedFace,
    lengths,
    motion,
    motion_from_noise,
    motion_on_timeline,
    neutral_landmarks,
    prepare,
    sample_noise,
    vertices,
)
from facejax.models import labels as label_names
from facejax.models.bundle import Face, Labels, Models, Provenance, load, save

__all__ = [
    "FRAMES",
    "RATE",
    "Face",
    "Labels",
    "Models",
    "Noise",
    "PreparedFace",
    "Provenance",
    "captions",
    "displacements",
    "durations",
    "landmarks",
    "lengths",
    "load",
    "meshes",
    "motion",
    "motion_from_noise",
    "motion_on_timeline",
    "neutral_landmarks",
    "prepare",
    "sample_noise",
    "save",
    "vertices",
]

RATE = 30.0  # frames per second of generated motions


def landmarks(
    models: Models,
    key: Array,
    labels: Sequence[str],
    neutral: Float[Array | np.ndarray, "N 3"],
    *,
    samples: int | None = None,
    frames: int | Sequence[int] = FRAMES,
    intensity: float = 1.0,
) -> Array:
    """Generate the landmark motion through `labels`: (T, L, 3), or (S, T, L, 3) with `samples`; mm.

    Args:
      labels: two or more names; otherwise as in `motion`.
      neutral: (N, 3) vertices; mm.
      frames, intensity: as in `motion`.

    Raises:
      ValueError: an unknown label, another vertex count, or an option out of range.
    """
    checks.check_intensity(intensity)
    rest = neutral_landmarks(models, neutral)
    unitless = displacements(models, key, labels, samples=1 if samples is None else samples, frames=frames)
    moved = rest + intensity * jnp.linalg.norm(rest - rest.mean(axis=0)) * unitless
    return moved if samples is not None else moved[0]


def displacements(
    models: Models, key: Array, labels: Sequence[str], *, samples: int, frames: int | Sequence[int] = FRAMES
) -> Array:
    """Generate displacements from neutral (S, T, L, 3), unitless: divided by the norm of the centred landmarks."""
    numbers = _encode(models, labels)
    each = lengths(len(labels) - 1, frames)
    return composition.compose(models.motion, models.starts, key, numbers.tolist(), samples=samples, frames=each)


def durations(models: Models, key: Array, labels: Sequence[str], *, rate: float = RATE) -> tuple[int, ...]:
    """Generate the natural number of frames of each transition at `rate` frames per second.

    Natural is what the training data has: in makehuman4d an onset is a random draw of 18 to 39 frames at 60 frames per
    second, not measured on people. The numbers belong to the first sample of the motion that `landmarks` generates
    from the same key; pass them as its `frames`. Raises `ValueError` for a rate that is not positive, and for unknown
    labels.
    """
    if not rate > 0:
        raise ValueError(f"rate must be above 0 frames per second, got {rate}")
    pairs = composition.label_pairs(_encode(models, labels))
    drawn = composition.draw(models.motion, models.starts, composition.sample_keys(key, 1), pairs)
    seconds = np.exp(np.asarray(drawn.log_seconds[0]))
    return tuple(max(2, 1 + round(float(x) * rate)) for x in seconds)


def meshes(
    models: Models,
    landmarks: Float[Array | np.ndarray, "... L 3"],
    neutral: Float[Array | np.ndarray, "N 3"],
    *,
    refined: bool = True,
    noise: float | None = 0.0,
) -> Array:
    """Decode landmarks (..., T, L, 3) of a face with neutral vertices (N, 3) to vertices (..., T, N, 3); mm.

    Prepares the face in every call: with several motions of one face, call `prepare` once and then `vertices`.

    Raises:
      ValueError: as `prepare` and `vertices`.
    """
    return vertices(models, prepare(models, neutral), landmarks, refined=refined, noise=noise)


def captions(labels: Sequence[str], *, frames: int | Sequence[int] = FRAMES) -> tuple[tuple[int, str], ...]:
    """Return (first frame, "neutral → high_smile") of each transition."""
    begins = np.cumsum([0] + [count - 1 for count in lengths(len(labels) - 1, frames)])
    pairs = zip(labels[:-1], labels[1:], strict=True)
    return tuple((int(begin), f"{start} → {end}") for begin, (start, end) in zip(begins, pairs, strict=False))


def _encode(models: Models, labels: Sequence[str]) -> np.ndarray:
    """Return the indices of two or more labels, no two in a row alike."""
    label_names.check_transitions(labels)
    return models.labels.encode(labels)
