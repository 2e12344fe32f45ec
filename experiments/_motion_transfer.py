"""The motion of one person's landmarks on another's face. OT23, 4.2.2.

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
    """One person's motion: landmarks of every frame, meshes of some."""

    name: str
    rest: np.ndarray  # (N, 3)
    landmarks: np.ndarray  # (T, L, 3) displacements from rest
    at: np.ndarray  # (M,) the frames whose meshes are known
    vertices: np.ndarray  # (M, N, 3)


def posed(recording: livelink.Recording, person: makehuman.Subject, index: np.ndarray) -> Take:
    """A MakeHuman person under a recording that is evenly sampled."""
    return of_skin(motion_sources.animate_person(recording, person)[:, : len(person.vertices)], person, index)


def of_skin(skin: np.ndarray, person: makehuman.Subject, index: np.ndarray) -> Take:
    """A MakeHuman person whose mesh is known in every frame (T, N, 3)."""
    return Take(person.name, person.vertices, (skin - person.vertices)[:, index], np.arange(len(skin)), skin)


def stored(data: dataset.Dataset, subject: int, label: str) -> Take | None:
    """A subject's first recording under a label of which there are meshes; None where there is none."""
    for sequence in data.sequences:
        if (sequence.subject, sequence.label) == (subject, label):
            take = of_sequence(data, sequence)
            if len(take.at):
                return take
    return None


def of_sequence(data: dataset.Dataset, sequence: dataset.Sequence) -> Take:
    """A recording of a dataset, with the meshes of it that were drawn."""
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


def onto(source: Take, target: Take, index: np.ndarray) -> np.ndarray:
    """The source's motion as displacements (T, L, 3) of the target's landmarks, through its SRVF, in its time.

    The motion may start anywhere, so displacements are what is carried: the first one scaled to the face, and the way
    from there on by its point on the sphere and its length.
    """
    sizes = [np.linalg.norm(take.rest[index] - take.rest[index].mean(axis=0)) for take in (source, target)]
    unitless = (_in_time(source.landmarks, len(target.landmarks)) / sizes[0]).astype(np.float32)
    q, log_length = srvf.encode(unitless)
    return np.asarray(srvf.decode(q, log_length, unitless[0])) * sizes[1]


def errors(made: np.ndarray, target: Take, mask: np.ndarray, window: int) -> np.ndarray:
    """(2, M): the mean distance of a mask's vertices (N,) in every frame whose mesh is known, of meshes (T, N, 3).

    Frame by frame, and the least of that within half a window of frames before and after.
    """
    half = window // 2
    found = np.full((2, len(target.at)), np.inf)
    made, true = made[:, mask], target.vertices[:, mask]
    for shift in range(-half, half + 1):
        inside = np.flatnonzero((target.at + shift >= 0) & (target.at + shift < len(made)))
        apart = np.linalg.norm(made[target.at[inside] + shift] - true[inside], axis=-1).mean(axis=1)
        found[1, inside] = np.minimum(found[1, inside], apart)
        if shift == 0:
            found[0, inside] = apart
    return found


def _in_time(curve: np.ndarray, frames: int) -> np.ndarray:
    """A curve (T, L, 3) in another number of frames, evenly."""
    if len(curve) == frames:
        return curve
    place = np.linspace(0, len(curve) - 1, frames)
    low = np.minimum(place.astype(int), len(curve) - 2)
    share = (place - low)[:, None, None]
    return curve[low] * (1 - share) + curve[low + 1] * share
