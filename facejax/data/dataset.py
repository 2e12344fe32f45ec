"""A 4D dataset on disk: an index and memory-mapped arrays, never held whole.

    index.json      schema, name, version, labels, rate, subjects, sequences, hashes of what the arrays were made from
    faces.npy       (F, 3) int32        the shared triangles
    neutral.npy     (S, N, 3) float32   each subject at rest
    landmarks.npy   (R, L, 3) float32   every frame of every sequence, one after the other
    vertices.npy    (G, N, 3) float32   meshes of the frames that were drawn
    drawn.npy       (G,) int64          their rows in landmarks.npy, rising
    landmark_index.npy (L,) int32       landmarks as vertices

Millimetres, y up, z forward.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from facejax.io import atomic

SCHEMA = 1
INDEX_BYTES = 3 * 2**23  # of an index: thirty times as many when it is read
SPLITS = ("train", "validation", "test")


class DatasetError(atomic.FileError):
    """A store is missing, incomplete or of another schema."""


class Sequence(NamedTuple):
    """One recording: rows `start` to `start + frames` of the landmarks."""

    subject: int
    label: str  # "high_smile", or "high_smile>mouth_open" for a direct transition
    start: int
    frames: int
    onset: int  # frame numbers within the sequence
    apex_start: int
    apex_end: int
    offset: int
    duration: float  # seconds
    name: str = ""  # the recording's own


class Dataset(NamedTuple):
    """An open dataset; the arrays are memory maps."""

    path: Path
    index: dict[str, Any]
    sequences: tuple[Sequence, ...]
    faces: np.ndarray
    neutral: np.ndarray
    landmarks: np.ndarray
    vertices: np.ndarray
    drawn: np.ndarray
    landmark_index: np.ndarray

    @property
    def labels(self) -> tuple[str, ...]:
        """The expression names, neutral first."""
        return tuple(self.index["labels"])

    def subjects(self, split: str) -> np.ndarray:
        """Indices of a split's subjects. Raises `DatasetError` for an unknown split."""
        if split not in SPLITS:
            raise DatasetError(f"unknown split {split!r}, expected one of {', '.join(SPLITS)}")
        return np.array([i for i, s in enumerate(self.index["subjects"]) if s["split"] == split], np.int64)

    def people(self) -> dict[str, list[str]]:
        """The names of each split's subjects."""
        return {split: [s["name"] for s in self.index["subjects"] if s["split"] == split] for split in SPLITS}

    def row_subjects(self) -> np.ndarray:
        """The subject of each landmark row, (R,)."""
        return np.repeat([s.subject for s in self.sequences], [s.frames for s in self.sequences])

    def row_labels(self) -> np.ndarray:
        """The label of each landmark row, (R,) strings."""
        return np.repeat([s.label for s in self.sequences], [s.frames for s in self.sequences])

    def meshes(self, split: str) -> tuple[np.ndarray, np.ndarray]:
        """Positions in `vertices` that belong to a split, and the subject of each."""
        owner = self.row_subjects()[self.drawn]
        at = np.flatnonzero(np.isin(owner, self.subjects(split)))
        return at, owner[at]


def open_dataset(path: Path) -> Dataset:
    """Open a dataset for reading. Raises `DatasetError`, naming the file."""
    path = Path(path)
    try:
        if (path / "index.json").stat().st_size > INDEX_BYTES:
            raise ValueError(f"more than {INDEX_BYTES} bytes")
        index = json.loads((path / "index.json").read_text())
    except (OSError, ValueError, RecursionError) as error:
        raise DatasetError(f"{path / 'index.json'} cannot be read ({error}): is this a prepared dataset?") from error
    if not isinstance(index, dict) or index.get("schema") != SCHEMA:
        found = index.get("schema") if isinstance(index, dict) else None
        raise DatasetError(f"{path}: schema {found}, expected {SCHEMA}: prepare the dataset anew")
    arrays = {}
    for name in ("faces", "neutral", "landmarks", "vertices", "drawn", "landmark_index"):
        try:
            arrays[name] = np.load(path / f"{name}.npy", mmap_mode="r", allow_pickle=False)
        except (OSError, ValueError) as error:
            raise DatasetError(f"{path / name}.npy cannot be read ({error}): prepare the dataset anew") from error
    try:
        for name, array in arrays.items():
            expected = index["shapes"][name]
            if list(array.shape) != expected:
                raise DatasetError(f"{path / name}.npy has shape {array.shape}, expected {tuple(expected)}")
        sequences = tuple(Sequence(**s) for s in index["sequences"])
        if not {"labels", "rate", "spec", "subjects"} <= set(index):
            raise KeyError("labels, rate, spec or subjects")
    except (KeyError, TypeError) as error:
        raise DatasetError(f"{path / 'index.json'} lacks {error}: prepare the dataset anew") from error
    if wrong := _wrong(index, sequences, arrays):
        raise DatasetError(f"{path / 'index.json'}: {wrong}: prepare the dataset anew")
    return Dataset(path, index, sequences, **arrays)


def _wrong(index: dict[str, Any], sequences: tuple[Sequence, ...], arrays: dict[str, np.ndarray]) -> str | None:
    """What in an index does not fit the arrays, or is of another kind than it should be."""
    people, labels, rate = index["subjects"], index["labels"], index["rate"]
    if not (isinstance(labels, list) and labels and all(isinstance(label, str) for label in labels)):
        return "labels must be names"
    if not (isinstance(people, list) and all(map(_is_person, people))):
        return f"every subject must have a name and a split of {', '.join(SPLITS)}"
    if not isinstance(index["spec"], dict):
        return "spec must be an object"
    if isinstance(rate, bool) or not isinstance(rate, (int, float)) or not 0 < rate < np.inf:
        return f"rate must be a number above 0, got {str(rate)[:40]}"
    rows = 0
    for number, one in enumerate(sequences):
        marks = (one.subject, one.start, one.frames, one.onset, one.apex_start, one.apex_end, one.offset)
        if not all(type(mark) is int for mark in marks) or not isinstance(one.label, str):
            return f"sequence {number} counts in other than whole numbers"
        if one.start != rows or one.frames < 1 or not 0 <= one.subject < len(people):
            return f"sequence {number} begins at row {one.start}, expected {rows}, of subject {one.subject}"
        rows += one.frames
    if rows != len(arrays["landmarks"]) or len(people) != len(arrays["neutral"]):
        return f"{rows} rows of {len(people)} subjects; there are {len(arrays['landmarks'])}, {len(arrays['neutral'])}"
    drawn, at, faces = arrays["drawn"], arrays["landmark_index"], arrays["faces"]
    for name, array, below in (("drawn", drawn, rows), ("landmark_index", at, None), ("faces", faces, None)):
        below = arrays["neutral"].shape[1] if below is None else below
        if array.dtype.kind not in "iu" or (array.size and not 0 <= array.min() <= array.max() < below):
            return f"{name}.npy must hold whole numbers from 0 to {below - 1}"
    if len(drawn) != len(arrays["vertices"]):
        return f"{len(drawn)} rows are drawn, of {len(arrays['vertices'])} meshes"
    return None


def open_meshes(path: Path) -> Dataset:
    """The same for what needs meshes. Raises `DatasetError` for a dataset that holds landmarks alone, as BU-4DFE does."""
    found = open_dataset(path)
    if len(found.vertices) == 0:
        raise DatasetError(f"{path}: holds landmarks alone, expected meshes")
    return found


def _is_person(who: Any) -> bool:
    return isinstance(who, dict) and isinstance(who.get("name"), str) and who.get("split") in SPLITS
