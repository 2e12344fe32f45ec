"""4D datasets on disk: an index and memory-mapped arrays, which are never loaded whole.

    index.json      schema, name, version, labels, rate, subjects, sequences, hashes of the arrays and their sources
    faces.npy       (F, 3) int32        triangles, shared by all meshes
    neutral.npy     (S, N, 3) float32   neutral mesh of each subject
    landmarks.npy   (R, L, 3) float32   all frames of all sequences, concatenated
    vertices.npy    (G, N, 3) float32   meshes of the sampled frames
    drawn.npy       (G,) int64          rows of the sampled frames in landmarks.npy, ascending
    landmark_index.npy (L,) int32       vertex index of each landmark

Millimetres, y up, z forward.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from facejax.io import errors

SCHEMA = 1
MAX_INDEX_BYTES = 3 * 2**23  # parsed JSON takes up to thirty times as much memory
SPLITS = ("train", "validation", "test")


class DatasetError(errors.FileError):
    """A dataset is missing, incomplete or of another schema."""


class Sequence(NamedTuple):
    """One recording: rows `start` to `start + frames` of the landmarks."""

    subject: int
    label: str  # "high_smile", or "high_smile>mouth_open" for a direct transition
    start: int
    frames: int
    onset: int  # this and the next three: frame numbers within the sequence
    apex_start: int
    apex_end: int
    offset: int
    duration: float  # seconds
    name: str = ""  # of the recording in its source


class Dataset(NamedTuple):
    """An open dataset; the arrays are memory maps."""

    path: Path
    index: dict[str, Any]  # pyright: ignore[reportIncompatibleMethodOverride]
    sequences: tuple[Sequence, ...]
    faces: np.ndarray
    neutral: np.ndarray
    landmarks: np.ndarray
    vertices: np.ndarray
    drawn: np.ndarray
    landmark_index: np.ndarray

    @property
    def labels(self) -> tuple[str, ...]:
        """The expression labels, neutral first."""
        return tuple(self.index["labels"])

    def subjects(self, split: str) -> np.ndarray:
        """Return the indices of a split's subjects. Raises `DatasetError` for an unknown split."""
        if split not in SPLITS:
            raise DatasetError(f"unknown split {split!r}, expected one of {', '.join(SPLITS)}")
        return np.array([i for i, s in enumerate(self.index["subjects"]) if s["split"] == split], np.int64)

    def people(self) -> dict[str, list[str]]:
        """Return the names of each split's subjects."""
        return {split: [s["name"] for s in self.index["subjects"] if s["split"] == split] for split in SPLITS}

    def row_subjects(self) -> np.ndarray:
        """Return the subject of each landmark row, (R,)."""
        return np.repeat([s.subject for s in self.sequences], [s.frames for s in self.sequences])

    def row_labels(self) -> np.ndarray:
        """Return the label of each landmark row, (R,) strings."""
        return np.repeat([s.label for s in self.sequences], [s.frames for s in self.sequences])

    def meshes(self, split: str) -> tuple[np.ndarray, np.ndarray]:
        """Return the positions in `vertices` of a split's meshes, and the subject of each."""
        subject = self.row_subjects()[self.drawn]
        positions = np.flatnonzero(np.isin(subject, self.subjects(split)))
        return positions, subject[positions]


def open_dataset(path: Path) -> Dataset:
    """Open a dataset for reading.

    Raises:
      DatasetError: naming the file that is missing, damaged or inconsistent with the others.
    """
    path = Path(path)
    try:
        if (path / "index.json").stat().st_size > MAX_INDEX_BYTES:
            raise ValueError(f"more than {MAX_INDEX_BYTES} bytes")
        index = json.loads((path / "index.json").read_text())
    except (OSError, ValueError, RecursionError) as error:
        raise DatasetError(f"{path / 'index.json'} cannot be read ({error}): is this a prepared dataset?") from error
    if not isinstance(index, dict) or index.get("schema") != SCHEMA:
        found = index.get("schema") if isinstance(index, dict) else None
        raise DatasetError(f"{path}: schema {found}, expected {SCHEMA}: prepare the dataset again")
    arrays = {}
    for name in ("faces", "neutral", "landmarks", "vertices", "drawn", "landmark_index"):
        try:
            arrays[name] = np.load(path / f"{name}.npy", mmap_mode="r", allow_pickle=False)
        except (OSError, ValueError) as error:
            raise DatasetError(f"{path / name}.npy cannot be read ({error}): prepare the dataset again") from error
    try:
        for name, array in arrays.items():
            expected = index["shapes"][name]
            if list(array.shape) != expected:
                raise DatasetError(f"{path / name}.npy has shape {array.shape}, expected {tuple(expected)}")
        sequences = tuple(Sequence(**s) for s in index["sequences"])
        if not {"labels", "rate", "spec", "subjects"} <= set(index):
            raise KeyError("labels, rate, spec or subjects")
    except (KeyError, TypeError) as error:
        raise DatasetError(f"{path / 'index.json'} lacks {error}: prepare the dataset again") from error
    if problem := _find_inconsistency(index, sequences, arrays):
        raise DatasetError(f"{path / 'index.json'}: {problem}: prepare the dataset again")
    return Dataset(path, index, sequences, **arrays)


def open_meshes(path: Path) -> Dataset:
    """Open a dataset that has meshes. Raises `DatasetError` for one that has only landmarks, such as BU-4DFE."""
    data = open_dataset(path)
    if len(data.vertices) == 0:
        raise DatasetError(f"{path}: contains only landmarks, expected meshes")
    return data


def _find_inconsistency(
    index: dict[str, Any], sequences: tuple[Sequence, ...], arrays: dict[str, np.ndarray]
) -> str | None:
    """Describe the first entry of the index that has a wrong type or contradicts the arrays."""
    people, labels, rate = index["subjects"], index["labels"], index["rate"]
    if not (isinstance(labels, list) and labels and all(isinstance(label, str) for label in labels)):
        return "labels must be a list of strings"
    if not (isinstance(people, list) and all(map(_is_person, people))):
        return f"every subject must have a name and a split, one of {', '.join(SPLITS)}"
    if not isinstance(index["spec"], dict):
        return "spec must be an object"
    if isinstance(rate, bool) or not isinstance(rate, (int, float)) or not 0 < rate < np.inf:
        return f"rate must be a number above 0, got {str(rate)[:40]}"
    rows = 0
    for number, one in enumerate(sequences):
        integers = (one.subject, one.start, one.frames, one.onset, one.apex_start, one.apex_end, one.offset)
        if not all(type(value) is int for value in integers) or type(one.label) is not str:
            return f"sequence {number}: expected integers for subject, start, frames and phases, and a string label"
        if one.start != rows or one.frames < 1 or not 0 <= one.subject < len(people):
            return (
                f"sequence {number}: start {one.start}, frames {one.frames}, subject {one.subject}; "
                f"expected start {rows}, frames above 0, subject below {len(people)}"
            )
        rows += one.frames
    if rows != len(arrays["landmarks"]) or len(people) != len(arrays["neutral"]):
        return (
            f"{rows} frames and {len(people)} subjects in the index, but {len(arrays['landmarks'])} rows in "
            f"landmarks.npy and {len(arrays['neutral'])} in neutral.npy"
        )
    drawn, landmark_index, faces = arrays["drawn"], arrays["landmark_index"], arrays["faces"]
    count = arrays["neutral"].shape[1]
    for name, array, end in (
        ("drawn", drawn, rows),
        ("landmark_index", landmark_index, count),
        ("faces", faces, count),
    ):
        if array.dtype.kind not in "iu" or (array.size and not 0 <= array.min() <= array.max() < end):
            return f"{name}.npy must contain integers from 0 to {end - 1}"
    if len(drawn) != len(arrays["vertices"]):
        return f"drawn.npy has {len(drawn)} rows, but vertices.npy has {len(arrays['vertices'])} meshes"
    return None


def _is_person(entry: Any) -> bool:
    return isinstance(entry, dict) and isinstance(entry.get("name"), str) and entry.get("split") in SPLITS
