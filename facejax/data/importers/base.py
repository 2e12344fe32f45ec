"""Recordings of registered faces, named but not read: what every layout on disk comes down to.

A *take* is one recording of one person. A *source* is all takes of a dataset, with functions that read a take frame by
frame; `facejax.data.ingest` makes a store of it. T frames, N vertices, F triangles.
"""

from __future__ import annotations

import dataclasses
import hashlib
import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from facejax.io import atomic, meshes

MAX_SIZE_RATIO = 3.0  # no mesh of a dataset is so many times as large as another: faces are not, but other units are

Frame = tuple[str, meshes.Mesh]  # the name for messages, and the mesh


class SourceError(atomic.FileError):
    """Recordings cannot be used; the message names the file or folder, what was expected and what is there."""


class Person(NamedTuple):
    """A subject; `about` says what is known, such as `sex`."""

    name: str
    about: dict[str, Any]


class RecordingInfo(NamedTuple):
    """One recording."""

    subject: int
    label: str
    name: str  # "F001/happy_01", for messages
    path: Path
    frames: tuple[Path, ...]  # one file a frame; none where one file holds all
    count: int
    cuts: tuple[int, int, int, int] | None = None  # onset, start and end of the apex, offset, where the layout knows


class Source(NamedTuple):
    """A dataset on disk. The functions can be sent to another process."""

    layout: str
    root: Path
    people: tuple[Person, ...]
    takes: tuple[RecordingInfo, ...]  # sorted by subject, then name
    read: Callable[[RecordingInfo, Sequence[int] | None], Iterator[Frame]]  # frames of some numbers, or all
    rest: Callable[[int], Iterator[Frame]]  # of a subject: meshes whose mean is the face at rest
    files: tuple[Path, ...]  # all that is read
    rate: float
    unit: str | None = None  # where the layout has one
    faces: np.ndarray | None = None  # (F, 3), where they lie in a file of their own
    landmarks: np.ndarray | None = None  # (L,) vertices, where the layout has them
    landmarks_only: bool = False  # frames are landmarks (L, 3), there are no meshes
    notes: tuple[str, ...] = ()

    @property
    def labels(self) -> tuple[str, ...]:
        """The expressions, neutral first, the others sorted."""
        return ("neutral", *sorted({take.label for take in self.takes}))


@dataclasses.dataclass
class ReferenceMesh:
    """What all meshes of a source share, as the first of them has it; the triangles as the first that has any."""

    name: str
    vertices: np.ndarray  # (N, 3)
    faces: np.ndarray | None = None  # (F, 3)
    faces_of: str = ""

    def check(self, name: str, mesh: meshes.Mesh) -> np.ndarray:
        """The vertices (N, 3) of a mesh. Raises `SourceError` where it is not like the others."""
        if len(mesh.vertices) != len(self.vertices):
            raise SourceError(
                f"{name}: {len(mesh.vertices)} vertices, expected {len(self.vertices)} as in {self.name}: "
                "meshes have to be registered"
            )
        if mesh.faces is not None:
            if self.faces is None:
                self.faces, self.faces_of = mesh.faces, name
            self._check_faces(name, mesh.faces)
        times = bounding_box_size(mesh.vertices) / bounding_box_size(self.vertices)
        if not 1 / MAX_SIZE_RATIO < times < MAX_SIZE_RATIO:
            raise SourceError(f"{name}: {times:.3g} times as large as {self.name}; expected one unit for all meshes")
        return mesh.vertices

    def _check_faces(self, name: str, faces: np.ndarray) -> None:
        if len(faces) != len(self.faces):
            raise SourceError(f"{name}: {len(faces)} triangles, expected {len(self.faces)} as in {self.faces_of}")
        other = np.flatnonzero((faces != self.faces).any(axis=1))
        if len(other):
            got, expected = (x[other[0]].tolist() for x in (faces, self.faces))
            raise SourceError(f"{name}: triangle {other[0]} is {got}, expected {expected} as in {self.faces_of}")


def reference_mesh(source: Source) -> ReferenceMesh:
    """What the meshes share, as the first subject at rest has it, and the first triangles there are.

    Raises `SourceError` where no mesh has any, or one of those before differs.
    """
    name, mesh = next(source.rest(0))
    if bounding_box_size(mesh.vertices) == 0:
        raise SourceError(f"{name}: all vertices lie at one point")
    found = ReferenceMesh(name, mesh.vertices, source.faces, str(source.root) if source.faces is not None else "")
    found.check(name, mesh)
    if source.landmarks_only:
        found.faces = np.zeros((0, 3), np.int32)
    rests = (next(source.rest(subject)) for subject in range(1, len(source.people)))
    for frames in (rests, *(source.read(take, None) for take in source.takes)):
        while found.faces is None and (following := next(frames, None)):
            found.check(*following)
    if found.faces is None:
        raise SourceError(f"{source.root}: no mesh has triangles; expected them in one file at least")
    return found


def neutral_vertices(source: Source, subject: int, shared: ReferenceMesh) -> np.ndarray:
    """A subject at rest (N, 3), in the source's unit: the mean of what `source.rest` gives."""
    found = [shared.check(*frame) for frame in source.rest(subject)]
    return found[0] if len(found) == 1 else np.mean(found, axis=0)


def fingerprint(source: Source) -> str:
    """SHA-256, in hexadecimal, of the sorted names and sizes of all files that are read."""
    rows = sorted((path.relative_to(source.root).as_posix(), path.stat().st_size) for path in source.files)
    text = "".join(f"{name}\t{size}\n" for name, size in rows)
    return hashlib.sha256(text.encode("utf-8", "surrogateescape")).hexdigest()


def bounding_box_size(vertices: np.ndarray) -> float:
    """The longest side of the box around vertices (N, 3)."""
    return float(np.ptp(vertices, axis=0).max())


def natural_sort_key(name: str) -> tuple:
    """A key that sorts numbers in names by their value, and letters without regard to case."""
    parts = re.split(r"(\d+)", name.lower())
    # Numbers stand at odd places. The name itself decides between "a1" and "a01".
    return tuple(int(part) if i % 2 else part for i, part in enumerate(parts)), name


def abbreviate_names(names: Sequence[str]) -> str:
    """Three names, and how many more there are."""
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")


def label_from_name(name: str) -> str:
    """The expression that a recording's name says: small letters, without a number at the end ("Happy_02": happy).

    A name that is nothing but numbers and marks stays (D3DFACS: "1+2").
    """
    label = re.sub(r"[\s-]", "_", name).lower()
    return re.sub(r"_\d+$", "", label) or label


def check_frame_numbers(paths: Sequence[Path], *, step: int | None = 1, gaps: bool = False) -> list[str]:
    """What is odd in the numbers at the end of frames' names: "frames 12 to 13 are missing".

    Args:
      paths: frames of one recording, sorted; names without a number are not looked at, if none has one.
      step: from one number to the next; None takes `frame_step`.
      gaps: say what is missing instead of raising.

    Raises:
      SourceError: two frames have one number, one has none, or one is missing.
    """
    numbers = [_number(path) for path in paths]
    if all(number is None for number in numbers):
        return []
    if None in numbers:
        raise SourceError(f"{paths[numbers.index(None)]}: has no frame number, unlike the others beside it")
    step, said = frame_step(paths) if step is None else step, []
    for number, following, path, other in zip(numbers, numbers[1:], paths, paths[1:], strict=False):
        if number == following:
            raise SourceError(f"{other}: frame {number} is {path.name} already")
        if following - number > step:
            first, last = number + step, following - step
            which = f"frame {first} is" if last <= first else f"frames {first} to {last} are"
            said.append(f"{path.parent}: {which} missing, after {path.name}")
    if said and not gaps:
        more = f" ({len(said)} gaps in all)" if len(said) > 1 else ""
        raise SourceError(f"{said[0]}{more}; --gaps takes the frames as they are")
    return said


def frame_step(paths: Sequence[Path]) -> int:
    """The smallest step between the numbers of frames in order; 1 where there are none."""
    numbers = [number for path in paths if (number := _number(path)) is not None]
    return max(1, min((b - a for a, b in zip(numbers, numbers[1:], strict=False)), default=1))


def _number(path: Path) -> int | None:
    match = re.search(r"(\d+)$", path.stem)
    return int(match[1]) if match else None
