"""What moves a face: an expression network, transitions between labels, or a person's recording.

Each gives a `Motion` of the template's 68 landmarks, to be put on a mesh by `facejax.animation`.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from facejax.data.synthetic import makehuman, rig
from facejax.inference import expressions, pipeline
from facejax.io import livelink

NATURAL = "natural"  # as many frames as people take
LEVEL = 3  # of the rig that a recording drives


class Motion(NamedTuple):
    """T frames of L landmarks."""

    curve: np.ndarray  # (T, L, 3) displacements from neutral in the template's frame, unitless
    name: str  # for files
    captions: tuple[tuple[int, str], ...]  # (first frame, text)
    fps: float
    notes: tuple[str, ...] = ()  # what was assumed, one line each


def from_expression(
    label: str,
    neutral: np.ndarray | None = None,
    *,
    frames: int | None = None,
    whole: bool = False,
    weights: Path | None = None,
) -> Motion:
    """An expression network's own motion; `whole`: up to the last frame, though the expression is over before.

    `neutral` (68, 3): landmarks at rest, for networks that start from them; by default the average face's. Raises
    `ValueError` for an expression without a network, and `weights.WeightsError`.
    """
    networks = expressions.load(weights)
    stop = 0.0 if whole else expressions.STOP
    if neutral is None:
        head = pipeline.load().face
        neutral = head.vertices[head.landmark_index]
    curve = expressions.displacements(networks, label, neutral, frames=frames, stop=stop)
    return Motion(np.asarray(curve), label, ((0, label),), networks.rate)


def from_labels(
    labels: Sequence[str], *, seed: int = 7, frames: int | Sequence[int] | str = 30, weights: Path | None = None
) -> Motion:
    """A generated motion through two or more labels; `frames` as in `pipeline.landmarks`, or "natural".

    Raises as `pipeline.displacements`.
    """
    models = pipeline.load(weights)
    if frames == NATURAL:
        frames = pipeline.durations(models, jax.random.key(seed), labels)
    curve = pipeline.displacements(models, jax.random.key(seed), labels, samples=1, frames=frames)[0]
    return Motion(np.asarray(curve), "_".join(labels), pipeline.captions(labels, frames=frames), pipeline.RATE)


def from_recording(recording: livelink.Recording, *, name: str) -> Motion:
    """The motion of the average face under a recording that is evenly sampled (`livelink.resample`)."""
    person, marks = makehuman.average(), makehuman.template().landmarks
    rest = person.vertices[marks]
    scale = float(np.linalg.norm(rest - rest.mean(axis=0)))
    curve = (animate_person(recording, person)[:, marks] - rest) / scale
    return Motion(curve, name, ((0, name),), rate_of(recording), recording.notes)


def read_recording(
    path: Path, *, begin: float = 0.0, seconds: float = 10.0, rate: float = 30.0, at_rest: bool = True
) -> livelink.Recording:
    """A part of a Live Link Face recording, evenly sampled; with `at_rest`, relative to the person's own resting face.

    Raises `livelink.RecordingError` for a damaged file, and where nothing was recorded at that time.
    """
    if not (seconds > 0 and begin >= 0):
        raise ValueError(f"expected a beginning of 0 or later and more than 0 seconds, got {begin:g} and {seconds:g}")
    whole = livelink.read(path)
    if at_rest:
        # From the whole recording: a part of it may never rest.
        whole = livelink.subtract_rest(whole)
    even = livelink.resample(whole, rate=rate)
    length = float(even.times[-1])
    chosen = (even.times >= begin - 1e-9) & (even.times < begin + seconds - 1e-9)
    if chosen.sum() < 2:
        raise livelink.RecordingError(f"{path}: has nothing at {begin:g} s; it lasts {length:.1f} s")
    notes = list(even.notes)
    if chosen.sum() < len(chosen):
        notes.append(f"took {chosen.sum() / rate:.1f} s from {begin:g} s on, of {length:.1f} s")
    times = even.times[chosen]
    gaps = tuple(gap for gap in even.gaps if times[0] <= gap[0] < times[-1])
    return livelink.Recording(even.weights[chosen], even.head[chosen], times - times[0], gaps, tuple(notes))


def animate_person(recording: livelink.Recording, person: makehuman.Subject, *, intensity: float = 1.0) -> np.ndarray:
    """A MakeHuman person under an evenly sampled recording, by blendshapes: skin, eyes and teeth, (T, M, 3) mm.

    `intensity` scales the weights.
    """
    return rig.pose(rig.build(person, level=LEVEL), intensity * livelink.unit_weights(recording, rig.unit_names()))


def rate_of(recording: livelink.Recording) -> float:
    """Frames per second of an evenly sampled recording."""
    return float(1 / np.median(np.diff(recording.times)))
