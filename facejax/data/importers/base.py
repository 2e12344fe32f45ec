"""The common form of every layout on disk: recordings of registered meshes, listed but not read.

A `Source` lists the recordings of a dataset, with functions that read them frame by frame;
`facejax.data.importers.ingest` turns it into a dataset. T frames, N vertices, F triangles, L landmarks.
"""

from __future__ import annotations

import dataclasses
import hashlib
import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from facejax.io import errors, meshes

MAX_SIZE_RATIO = 3.0  # between two meshes of a dataset: faces differ by less, units by more

Frame = tuple[str, meshes.Mesh]  # a name for messages, and the mesh


class SourceError(errors.FileError):
    """Recordings cannot be used; the message names the file or folder, what was expected and what was found."""


class Person(NamedTuple):
    """A subject and its known attributes, such as `sex`."""

    name: str
    attributes: dict[str, Any]


class RecordingInfo(NamedTuple):
    """Whose recording it is, its label, and where its frames are."""

    subject: int
    label: str
    name: str  # "F001/happy_01", for messages
    path: Path
    frame_paths: tuple[Path, ...]  # one file per frame; empty where one file holds all frames
    num_frames: int
    phases: tuple[int, int, int, int] | None = (
        None  # onset, apex start, apex end, offset, where the layout defines them
    )


class Source(NamedTuple):
    """A dataset on disk. The functions can be pickled for other processes."""

    layout: str
    root: Path
    people: tuple[Person, ...]
    recordings: tuple[RecordingInfo, ...]  # sorted by subject, then name
    read_frames: Callable[[RecordingInfo, Sequence[int] | None], Iterator[Frame]]  # the given frames, or all for None
    neutral_frames: Callable[[int], Iterator[Frame]]  # meshes whose mean is the neutral face of a subject
    files: tuple[Path, ...]  # all files that are read
    rate: float  # frames per second
    unit: str | None = None  # where the layout defines one
    faces: np.ndarray | None = None  # (F, 3), where they are stored in a file of their own
    landmarks: np.ndarray | None = None  # (L,) vertex indices, where the layout defines them
    landmarks_only: bool = False  # frames are landmarks (L, 3), there are no meshes
    notes: tuple[str, ...] = ()

    @property
    def labels(self) -> tuple[str, ...]:
        """The expression labels, neutral first, the others sorted."""
        return ("neutral", *sorted({recording.label for recording in self.recordings}))


@dataclasses.dataclass
class ReferenceMesh:
    """The first mesh of a source, with which all others must agree, and the first triangles that a file contains."""

    name: str
    vertices: np.ndarray  # (N, 3)
    faces: np.ndarray | None = None  # (F, 3)
    faces_name: str = ""  # of the file that contains them

    def check(self, name: str, mesh: meshes.Mesh) -> np.ndarray:
        """Return the vertices (N, 3) of a mesh.

        Raises:
          SourceError: the number of vertices, the triangles or the size differ from the reference.
        """
        if len(mesh.vertices) != len(self.vertices):
            raise SourceError(
                f"{name}: {len(mesh.vertices)} vertices, expected {len(self.vertices)} as in {self.name}: "
                "meshes must be registered"
            )
        if mesh.faces is not None:
            if self.faces is None:
                self.faces, self.faces_name = mesh.faces, name
            self._check_faces(name, mesh.faces, self.faces)
        ratio = bounding_box_size(mesh.vertices) / bounding_box_size(self.vertices)
        if not 1 / MAX_SIZE_RATIO < ratio < MAX_SIZE_RATIO:
            raise SourceError(f"{name}: {ratio:.3g} times as large as {self.name}; expected one unit for all meshes")
        return mesh.vertices

    def _check_faces(self, name: str, faces: np.ndarray, expected: np.ndarray) -> None:
        if len(faces) != len(expected):
            raise SourceError(f"{name}: {len(faces)} triangles, expected {len(expected)} as in {self.faces_name}")
        different = np.flatnonzero((faces != expected).any(axis=1))
        if len(different):
            first = different[0]
            raise SourceError(
                f"{name}: triangle {first} is {faces[first].tolist()}, expected {expected[first].tolist()} as in "
                f"{self.faces_name}"
            )


def reference_mesh(source: Source) -> ReferenceMesh:
    """Return the first subject's neutral mesh, with the first triangles found in the source.

    Raises:
      SourceError: no mesh has triangles, or a mesh read on the way differs from the first.
    """
    name, mesh = next(source.neutral_frames(0))
    if bounding_box_size(mesh.vertices) == 0:
        raise SourceError(f"{name}: all vertices lie at one point")
    reference = ReferenceMesh(name, mesh.vertices, source.faces, str(source.root) if source.faces is not None else "")
    reference.check(name, mesh)
    if source.landmarks_only:
        reference.faces = np.zeros((0, 3), np.int32)
    neutrals = (next(source.neutral_frames(subject)) for subject in range(1, len(source.people)))
    for frames in (neutrals, *(source.read_frames(recording, None) for recording in source.recordings)):
        while reference.faces is None and (frame := next(frames, None)):
            reference.check(*frame)
    if reference.faces is None:
        raise SourceError(f"{source.root}: no mesh has triangles; expected them in at least one file")
    return reference


def neutral_vertices(source: Source, subject: int, reference: ReferenceMesh) -> np.ndarray:
    """Return the neutral face of a subject (N, 3) in the source's unit: the mean of its `neutral_frames`."""
    found = [reference.check(*frame) for frame in source.neutral_frames(subject)]
    return found[0] if len(found) == 1 else np.mean(found, axis=0)


def fingerprint(source: Source) -> str:
    """Return the SHA-256, in hexadecimal, of the sorted names and sizes of all files of a source."""
    rows = sorted((path.relative_to(source.root).as_posix(), path.stat().st_size) for path in source.files)
    text = "".join(f"{name}\t{size}\n" for name, size in rows)
    return hashlib.sha256(text.encode("utf-8", "surrogateescape")).hexdigest()


def bounding_box_size(vertices: np.ndarray) -> float:
    """Return the longest side of the bounding box of vertices (N, 3)."""
    return float(np.ptp(vertices, axis=0).max())


def natural_sort_key(name: str) -> tuple[tuple[int | str, ...], str]:
    """Return a key that sorts numbers in names by value, and letters case-insensitively."""
    parts = re.split(r"(\d+)", name.lower())
    # Numbers are at odd positions. The name itself orders "a1" and "a01".
    return tuple(int(part) if i % 2 else part for i, part in enumerate(parts)), name


def abbreviate_names(names: Sequence[str]) -> str:
    """Return the first three names, and how many more there are."""
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")


def label_from_name(name: str) -> str:
    """Return the expression in a recording's name: lower case, without a trailing number ("Happy_02" -> "happy").

    A name without letters is kept (D3DFACS: "1+2").
    """
    label = re.sub(r"[\s-]", "_", name).lower()
    return re.sub(r"_\d+$", "", label) or label


def check_frame_numbers(paths: Sequence[Path], *, step: int | None = 1, gaps: bool = False) -> list[str]:
    """Check the numbers at the end of the frames' names, and return notes such as "frames 12 to 13 are missing".

    Args:
      paths: frames of one recording, sorted. Nothing is checked where no name ends in a number.
      step: difference of consecutive numbers; None takes `frame_step`.
      gaps: allow missing frames, and return notes on them.

    Raises:
      SourceError: two frames have the same number, one of them has none, or one is missing.
    """
    numbers = [_frame_number(path) for path in paths]
    if all(number is None for number in numbers):
        return []
    step, notes = frame_step(paths) if step is None else step, []
    previous = None
    for number, path in zip(numbers, paths, strict=True):
        if number is None:
            raise SourceError(f"{path}: name has no frame number, unlike other frames in the folder")
        if previous is not None:
            before, before_path = previous
            if number == before:
                raise SourceError(f"{path}: duplicate frame number {number}, also of {before_path.name}")
            if number - before > step:
                first, last = before + step, number - step
                which = f"frame {first} is" if last <= first else f"frames {first} to {last} are"
                notes.append(f"{path.parent}: {which} missing, after {before_path.name}")
        previous = number, path
    if notes and not gaps:
        more = f" ({len(notes)} gaps in all)" if len(notes) > 1 else ""
        raise SourceError(f"{notes[0]}{more}; use --gaps to import the existing frames")
    return notes


def frame_step(paths: Sequence[Path]) -> int:
    """Return the smallest difference of consecutive frame numbers; 1 where there are none."""
    numbers = [number for path in paths if (number := _frame_number(path)) is not None]
    return max(1, min((b - a for a, b in zip(numbers, numbers[1:], strict=False)), default=1))


def _frame_number(path: Path) -> int | None:
    match = re.search(r"(\d+)$", path.stem)
    return int(match[1]) if match else None
