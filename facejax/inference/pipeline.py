"""Inference composed: labels and a neutral face in, landmarks and meshes out.

    models = pipeline.load()
    landmarks = pipeline.landmarks(models, key, ["neutral", "high_smile", "neutral"], neutral)
    vertices = pipeline.meshes(models, landmarks, neutral)

Millimetres. A neutral face is (N, 3) vertices in the models' topology; T frames, L landmarks, S samples.
"""

from __future__ import annotations

import difflib
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from facejax.inference import composition
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

RATE = 30.0  # frames per second at which motions are played
FRAMES = 30  # of a transition, as the generator learnt them


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
    """Landmark motion through `labels`: (T, L, 3), or (S, T, L, 3) with `samples`.

    `frames` is the length of one transition, or one number for each; T = 1 + sum of (frames - 1), joints not repeated.
    `durations` gives natural ones. A motion that does not start at neutral starts at a peak drawn for it
    (`facejax.models.starts`), scaled to the face. `intensity` scales all displacements from neutral.

    Raises `ValueError` for an unknown label, a wrong vertex count, or options out of range.
    """
    if not 0 <= intensity <= 2:
        raise ValueError(f"intensity must lie in 0..2, got {intensity}")
    rest = neutral_landmarks(models, neutral)
    unitless = displacements(models, key, labels, samples=1 if samples is None else samples, frames=frames)
    moved = rest + intensity * jnp.linalg.norm(rest - rest.mean(axis=0)) * unitless
    return moved if samples is not None else moved[0]


def displacements(
    models: Models, key: jax.Array, labels: Sequence[str], *, samples: int, frames: int | Sequence[int] = FRAMES
) -> jax.Array:
    """Displacements from neutral (S, T, L, 3) through `labels`, unitless: divided by the face's landmark norm."""
    numbers = _numbers(models, labels)
    each = lengths(labels, frames)
    return composition.compose(models.motion, models.starts, key, numbers, samples=samples, frames=each)


def durations(models: Models, key: jax.Array, labels: Sequence[str], *, rate: float = RATE) -> tuple[int, ...]:
    """How many frames each transition takes at `rate` frames per second, as people perform it.

    Generated with the motion: give `landmarks` the same key, and these as its `frames`. Of several samples, the first.
    """
    if not rate > 0:
        raise ValueError(f"rate must be above 0 frames per second, got {rate}")
    pairs = composition.label_pairs(_numbers(models, labels))
    drawn = composition.draw(models.motion, models.starts, composition.sample_keys(key, 1), pairs)
    seconds = np.exp(np.asarray(drawn.log_seconds[0]))
    return tuple(max(2, 1 + round(float(x) * rate)) for x in seconds)


def lengths(labels: Sequence[str], frames: int | Sequence[int]) -> tuple[int, ...]:
    """One length for each transition. Raises `ValueError` for another number of them, or fewer than two frames."""
    count = len(labels) - 1
    found = (frames,) * count if np.ndim(frames) == 0 else tuple(frames)
    if len(found) != count:
        raise ValueError(f"frames: expected one number, or {count} for {count} transitions, got {len(found)}")
    if any(n != int(n) or n < 2 for n in found):
        raise ValueError(f"frames: expected whole numbers of 2 or more, got {frames}")
    return tuple(int(n) for n in found)


def meshes(
    models: Models,
    landmarks: jax.Array,
    neutral: np.ndarray | jax.Array,
    *,
    refined: bool = True,
    noise: float | None = 0.0,
) -> jax.Array:
    """Landmarks (..., T, L, 3) of a face and its neutral vertices (N, 3) -> vertices (..., T, N, 3).

    Without `refined` the linear answer alone, much faster and little worse; `noise` tells by how many mm landmarks are
    off, such as those of a detector; None finds it out. Both as in `expand.apply`; S2D-Dec refuses `noise`.
    """
    rest = neutral_landmarks(models, neutral)
    if landmarks.shape[-2:] != rest.shape:
        raise ValueError(f"landmarks: expected (..., {rest.shape[0]}, 3), got {landmarks.shape}")
    if isinstance(models.decoder, gpmm_residual.GPMMResidual):
        return jnp.asarray(neutral, jnp.float32) + gpmm_residual.apply(
            models.decoder, landmarks - rest, neutral, refined=refined, noise=noise
        )
    if noise != 0:
        raise ValueError("noise: S2D-Dec cannot be told of it; the best linear answer can (`facejax.expand`)")
    return _decode(models.decoder, models.hierarchy, landmarks - rest, jnp.asarray(neutral, jnp.float32))


def captions(labels: Sequence[str], *, frames: int | Sequence[int] = FRAMES) -> tuple[tuple[int, str], ...]:
    """(first frame, "neutral → high_smile") of each transition."""
    begins = np.cumsum([0] + [count - 1 for count in lengths(labels, frames)])
    pairs = zip(labels[:-1], labels[1:], strict=True)
    return tuple((int(begin), f"{start} → {end}") for begin, (start, end) in zip(begins, pairs, strict=False))


def neutral_landmarks(models: Models, neutral: np.ndarray | jax.Array) -> jax.Array:
    """The landmarks (L, 3) of a neutral face (N, 3).

    Raises `ValueError` for another vertex count, or a size that no head has in millimetres.
    """
    expected = models.face.vertices.shape
    if np.shape(neutral) != expected:
        raise ValueError(f"neutral: expected vertices {expected} in the models' topology, got {np.shape(neutral)}")
    if not isinstance(neutral, jax.core.Tracer):
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
    """Indices of label names. Raises `ValueError` with the nearest names for an unknown one."""
    _check_names(labels)
    for name in labels:
        if name not in models.labels:
            near = difflib.get_close_matches(name, models.labels, n=3, cutoff=0.4)
            hint = f"did you mean {', '.join(near)}?" if near else f"there are {', '.join(models.labels)}"
            raise ValueError(f"unknown label {name!r}: {hint}")
    return np.array([models.labels.index(name) for name in labels], np.int32)


def _check_names(labels: Sequence[str]) -> None:
    if isinstance(labels, str):
        raise ValueError(f"labels: expected a sequence of names, got the one name {labels!r}")


def _numbers(models: Models, labels: Sequence[str]) -> np.ndarray:
    _check_names(labels)
    for before, after in zip(labels[:-1], labels[1:], strict=True):
        if before == after:
            raise ValueError(f"labels: {before!r} follows itself; a transition needs two different labels")
    if len(labels) < 2:
        raise ValueError(f"labels: expected at least a start and an end, got {list(labels)}")
    return label_indices(models, labels)


@jax.jit
def _decode(params, hierarchy, displacements, neutral):
    return neutral + s2d_dec.apply(params, hierarchy, displacements)
