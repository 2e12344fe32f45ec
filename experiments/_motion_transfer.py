"""Transfer of landmark motion from one person to another through the SRVF (OT23, section 4.2.2).

T frames, M of them with meshes, N vertices, L landmarks; millimetres.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from facejax.data import dataset
from facejax.data.synthetic import makehuman
from facejax.geometry import srvf
from facejax.inference import motion_sources
from facejax.io import livelink


class Take(NamedTuple):
    """The motion of one person: landmarks of every frame, meshes of some frames."""

    name: str
    rest: np.ndarray  # (N, 3)
    landmarks: np.ndarray  # (T, L, 3) displacements from rest
    at: np.ndarray  # (M,) numbers of the frames that have meshes
    vertices: np.ndarray  # (M, N, 3)


def from_recording(recording: livelink.Recording, person: makehuman.Subject, index: np.ndarray) -> Take:
    """Animate a MakeHuman person with an evenly sampled recording."""
    return from_meshes(motion_sources.animate_person(recording, person)[:, : len(person.vertices)], person, index)


def from_meshes(skin: np.ndarray, person: makehuman.Subject, index: np.ndarray) -> Take:
    """Return the take of a MakeHuman person from its mesh in every frame (T, N, 3)."""
    return Take(person.name, person.vertices, (skin - person.vertices)[:, index], np.arange(len(skin)), skin)


def find_recording(data: dataset.Dataset, subject: int, label: str) -> Take | None:
    """Return the subject's first recording with the label and with meshes; None where there is none."""
    for sequence in data.sequences:
        if (sequence.subject, sequence.label) == (subject, label):
            take = from_sequence(data, sequence)
            if len(take.at):
                return take
    return None


def from_sequence(data: dataset.Dataset, sequence: dataset.Sequence) -> Take:
    """Return a recording of a dataset with its meshes."""
    rest = np.asarray(data.neutral[sequence.subject])
    rows = slice(sequence.start, sequence.start + sequence.frames)
    first, last = np.searchsorted(data.drawn, [rows.start, rows.stop])
    return Take(
        data.index["subjects"][sequence.subject]["name"],
        rest,
        np.asarray(data.landmarks[rows]) - rest[data.landmark_index],
        data.drawn[first:last] - sequence.start,
        np.asarray(data.vertices[first:last]),
    )


def transfer(source: Take, target: Take, index: np.ndarray) -> np.ndarray:
    """Return the source's motion as landmark displacements (T, L, 3) of the target, at the target's number of frames.

    The motion may start at any pose. The displacements of the first frame are scaled by the ratio of face sizes; the
    motion from there on is reconstructed from its point on the sphere and its length.
    """
    sizes = [np.linalg.norm(take.rest[index] - take.rest[index].mean(axis=0)) for take in (source, target)]
    unitless = (_resample(source.landmarks, len(target.landmarks)) / sizes[0]).astype(np.float32)
    q, log_length = srvf.encode(unitless)
    return np.asarray(srvf.decode(q, log_length, unitless[0])) * sizes[1]


def _resample(curve: np.ndarray, frames: int) -> np.ndarray:
    """Resample a curve (T, L, 3) linearly to another number of frames."""
    if len(curve) == frames:
        return curve
    place = np.linspace(0, len(curve) - 1, frames)
    low = np.minimum(place.astype(int), len(curve) - 2)
    share = (place - low)[:, None, None]
    return curve[low] * (1 - share) + curve[low + 1] * share
