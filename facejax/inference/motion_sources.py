"""Sources of motion: an expression network, generated transitions between labels, or a recording.

Each returns a `Motion` of the template's 68 landmarks; `inference.retarget` applies it to a mesh.
T frames, L landmarks, M vertices of a posed MakeHuman head.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from facejax.data import blendshapes
from facejax.data.synthetic import makehuman, rig
from facejax.inference import expressions, pipeline
from facejax.io import livelink

NATURAL = "natural"  # `frames`: the durations that are generated with the motion
LEVEL = 3  # realism of the rig that plays recordings


class Motion(NamedTuple):
    """A landmark motion, ready to be applied to a face."""

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
    """Generate a motion with an expression network.

    Args:
      neutral: (68, 3) landmarks at rest, for networks that start from them; default: the average face's.
      frames: maximal length.
      whole: keep all frames, also those after the expression has ended.
      weights: file of networks; default: the released ones.

    Raises:
      ValueError: there is no network for the expression.
      WeightsError: the file cannot be used.
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
    """Generate a motion through two or more labels; `frames` as of `pipeline.landmarks`, or "natural".

    Raises `ValueError` as `pipeline.displacements` does.
    """
    models = pipeline.load(weights)
    if isinstance(frames, str):
        if frames != NATURAL:
            raise ValueError(f"frames: expected numbers or {NATURAL!r}, got {frames!r}")
        frames = pipeline.durations(models, jax.random.key(seed), labels)
    curve = pipeline.displacements(models, jax.random.key(seed), labels, samples=1, frames=frames)[0]
    return Motion(np.asarray(curve), "_".join(labels), pipeline.captions(labels, frames=frames), pipeline.RATE)


def from_recording(recording: livelink.Recording, *, name: str) -> Motion:
    """Return the landmark motion of the average face playing an evenly sampled recording (`blendshapes.resample`)."""
    person, marks = makehuman.average(), makehuman.template().landmarks
    rest = person.vertices[marks]
    scale = float(np.linalg.norm(rest - rest.mean(axis=0)))
    curve = (animate_person(recording, person)[:, marks] - rest) / scale
    return Motion(curve, name, ((0, name),), rate_of(recording), recording.notes)


def read_recording(
    path: Path, *, begin: float = 0.0, seconds: float = 10.0, rate: float = 30.0, at_rest: bool = True
) -> livelink.Recording:
    """Read a part of a Live Link Face recording, resampled to `rate` frames per second.

    Args:
      begin, seconds: start time and duration.
      at_rest: subtract the weights of the person's resting face.

    Raises:
      ValueError: a negative start, or no duration.
      RecordingError: a damaged file, or no frames at that time.
    """
    if not (seconds > 0 and begin >= 0):
        raise ValueError(f"expected begin of 0 or more and seconds above 0, got {begin:g} and {seconds:g}")
    whole = livelink.read(path)
    if at_rest:
        # Estimated from the whole recording: the selected part may contain no resting face.
        whole = blendshapes.subtract_rest(whole)
    even = blendshapes.resample(whole, rate=rate)
    length = float(even.times[-1])
    chosen = (even.times >= begin - 1e-9) & (even.times < begin + seconds - 1e-9)
    if chosen.sum() < 2:
        raise livelink.RecordingError(f"{path}: no frames at {begin:g} s; the recording ends at {length:.1f} s")
    notes = list(even.notes)
    if chosen.sum() < len(chosen):
        notes.append(f"used {chosen.sum() / rate:.1f} s of {length:.1f} s, from {begin:g} s on")
    times = even.times[chosen]
    gaps = tuple(gap for gap in even.gaps if times[0] <= gap[0] < times[-1])
    return livelink.Recording(even.weights[chosen], even.head[chosen], times - times[0], gaps, tuple(notes))


def animate_person(recording: livelink.Recording, person: makehuman.Subject, *, intensity: float = 1.0) -> np.ndarray:
    """Pose a MakeHuman person by the blendshape weights of an evenly sampled recording, times `intensity`.

    Returns vertices (T, M, 3) of skin, eyes and teeth; mm.
    """
    return rig.pose(rig.build(person, level=LEVEL), intensity * blendshapes.unit_weights(recording, rig.unit_names()))


def rate_of(recording: livelink.Recording) -> float:
    """Return the frames per second of an evenly sampled recording."""
    return float(1 / np.median(np.diff(recording.times)))
