"""VOCASET (Cudeiro et al. 2019): speech, 12 people, 60 frames per second, in metres and FLAME's topology.

    ROOT/data_verts.npy          (rows, 5023, 3), memory-mapped
    ROOT/subj_seq_to_idx.pkl     {subject: {"sentence01": {frame: row}}}
    ROOT/templates.pkl           {subject: (5023, 3)}, neutral

None of them contains the triangles: they come from a mesh of the same topology, such as FLAME's sample.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from facejax.data.importers import base, folder_scan
from facejax.data.importers.base import Frame, Person, RecordingInfo, Source, SourceError
from facejax.io import meshes, npz, safe_pickle

RATE = 60.0
FILES = ("data_verts.npy", "subj_seq_to_idx.pkl", "templates.pkl")


def scan(
    root: str | os.PathLike[str], *, template: str | os.PathLike[str], rate: float = RATE, gaps: bool = False
) -> Source:
    """List the sentences. `template` is a mesh of the same topology, for its triangles.

    Raises:
      SourceError: naming file, person, sentence and frame.
    """
    root, template = Path(root), Path(template)
    paths = [root / name for name in FILES]
    if missing := [path for path in paths if not path.is_file()]:
        raise SourceError(f"{missing[0]}: no such file; expected {', '.join(FILES)}")
    try:
        vertices = npz.map_npy(paths[0])
        index, templates = (safe_pickle.read(path) for path in paths[1:])
    except (safe_pickle.PickleError, OSError) as error:
        raise SourceError(str(error)) from error
    except ValueError as error:
        raise SourceError(f"{paths[0]}: {error}") from error
    if vertices.ndim != 3 or vertices.shape[2] != 3:
        raise SourceError(f"{paths[0]}: expected shape (rows, N, 3), got {vertices.shape}")
    topology = folder_scan.read_mesh(template)
    if topology.faces is None or len(topology.vertices) != vertices.shape[1]:
        raise SourceError(
            f"{template}: expected a mesh with triangles and {vertices.shape[1]} vertices as in {FILES[0]}, "
            f"got {len(topology.vertices)} vertices"
        )
    people, recordings, rows_of, neutral, notes = [], [], {}, [], []
    for name, sentences in _sorted(_dict(index, paths[1])):
        neutral.append(_neutral(templates, name, vertices.shape[1], paths[2]))
        for sentence, frames in _sorted(_dict(sentences, paths[1], name)):
            location = f"{paths[1]}: {name}/{sentence}"
            rows, gap_notes = _rows(_dict(frames, paths[1], name, sentence), len(vertices), location, gaps)
            notes += gap_notes
            label, full_name = base.label_from_name(sentence), f"{name}/{sentence}"
            recordings.append(RecordingInfo(len(people), label, full_name, Path(name) / sentence, (), len(rows)))
            rows_of[full_name] = rows
        people.append(Person(str(name), {}))
    return Source(
        "vocaset",
        root,
        tuple(people),
        tuple(recordings),
        functools.partial(_read_frames, paths[0], rows_of),
        functools.partial(_neutral_frames, paths[2], tuple(neutral)),
        tuple(paths),
        rate,
        faces=topology.faces,
        notes=tuple(notes),
    )


def _rows(frames: dict[Any, Any], count: int, location: str, gaps: bool) -> tuple[np.ndarray, list[str]]:
    """Return the rows (T,) of a sentence in the order of its frames, and notes on missing frames."""
    try:
        pairs = sorted((int(frame), int(row)) for frame, row in frames.items())
    except (TypeError, ValueError) as error:
        raise SourceError(f"{location}: expected integer frames and rows, got {error}") from error
    numbers, rows = np.array(pairs).T
    if bad := [f"frame {n} has row {r}" for n, r in pairs if not 0 <= r < count]:
        raise SourceError(f"{location}: {bad[0]}, expected 0 to {count - 1}")
    notes = [f"{location}: frame {numbers[i] + 1} is missing" for i in np.flatnonzero(np.diff(numbers) > 1)]
    if notes and not gaps:
        raise SourceError(f"{notes[0]}; use --gaps to import the existing frames")
    return rows, notes


def _neutral(templates: Any, name: str, count: int, path: Path) -> np.ndarray:
    """Return a person's neutral mesh (N, 3)."""
    found = _dict(templates, path).get(name)
    if not isinstance(found, np.ndarray) or found.dtype.kind not in "fiu":
        raise SourceError(f"{path}: contains no template of {name}")
    if found.shape != (count, 3):
        raise SourceError(f"{path}: {name}: expected ({count}, 3) vertices, got {found.shape}")
    if len(bad := np.flatnonzero(~np.isfinite(found).all(axis=1))):
        raise SourceError(f"{path}: {name}: vertex {bad[0]} is not finite: {found[bad[0]].tolist()}")
    return found.astype(np.float64)


def _dict(value: Any, path: Path, *keys: str) -> dict[Any, Any]:
    if not isinstance(value, dict) or not value:
        raise SourceError(f"{path}: {'/'.join(map(str, keys)) or 'top level'}: expected a dict with entries")
    return value


def _sorted(entries: dict[Any, Any]) -> list[tuple[Any, Any]]:
    return sorted(entries.items(), key=lambda entry: base.natural_sort_key(str(entry[0])))


def _read_frames(
    path: Path, rows_of: dict[str, np.ndarray], recording: RecordingInfo, frames: Sequence[int] | None
) -> Iterator[Frame]:
    vertices, rows = npz.map_npy(path), rows_of[recording.name]
    for i in range(len(rows)) if frames is None else frames:
        frame = np.asarray(vertices[rows[i]], np.float64)
        name = f"{path}: {recording.name}: frame {i} (row {rows[i]})"
        bad = np.flatnonzero(~np.isfinite(frame).all(axis=1))
        if len(bad):
            raise SourceError(f"{name}: vertex {bad[0]} is not finite: {frame[bad[0]].tolist()}")
        yield name, meshes.Mesh(frame, None)


def _neutral_frames(path: Path, neutral: tuple[np.ndarray, ...], subject: int) -> Iterator[Frame]:
    yield f"{path}: person {subject}", meshes.Mesh(neutral[subject], None)
