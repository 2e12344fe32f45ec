"""VOCASET (Cudeiro et al. 2019): speech, 12 people, 60 frames a second, in metres and FLAME's topology.

    ROOT/data_verts.npy          (rows, 5023, 3), memory-mapped
    ROOT/subj_seq_to_idx.pkl     {subject: {"sentence01": {frame: row}}}
    ROOT/templates.pkl           {subject: (5023, 3)}, each at rest

The triangles lie in none of them: a mesh of the same topology (FLAME's sample, say) brings them.
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


def scan(root: str | os.PathLike, *, template: str | os.PathLike, rate: float = RATE, gaps: bool = False) -> Source:
    """The sentences of the people. Raises `SourceError`, naming file, person, sentence and frame.

    `template`: a mesh in the same topology, for its triangles.
    """
    root, template = Path(root), Path(template)
    paths = [root / name for name in FILES]
    if lacking := [path for path in paths if not path.is_file()]:
        raise SourceError(f"{lacking[0]}: no such file; expected {', '.join(FILES)}")
    try:
        vertices = npz.map_npy(paths[0])
        index, rests = (safe_pickle.read(path) for path in paths[1:])
    except (safe_pickle.PickleError, OSError) as error:
        raise SourceError(str(error)) from error
    except ValueError as error:
        raise SourceError(f"{paths[0]}: {error}") from error
    if vertices.ndim != 3 or vertices.shape[2] != 3:
        raise SourceError(f"{paths[0]}: expected (rows, N, 3), got {vertices.shape}")
    topology = folder_scan.read_mesh(template)
    if topology.faces is None or len(topology.vertices) != vertices.shape[1]:
        raise SourceError(
            f"{template}: expected a mesh of {vertices.shape[1]} vertices with triangles, as {FILES[0]} has, "
            f"got {len(topology.vertices)}"
        )
    people, takes, still, notes = [], [], [], []
    for name, sentences in sorted(_dict(index, paths[1]).items(), key=lambda row: base.natural_sort_key(str(row[0]))):
        still.append(_rest_of(rests, name, vertices.shape[1], paths[2]))
        for sentence, frames in sorted(
            _dict(sentences, paths[1], name).items(), key=lambda r: base.natural_sort_key(r[0])
        ):
            where = f"{paths[1]}: {name}/{sentence}"
            rows, odd = _rows(_dict(frames, paths[1], name, sentence), len(vertices), where, gaps)
            notes += odd
            take = RecordingInfo(
                len(people), base.label_from_name(sentence), f"{name}/{sentence}", Path(name) / sentence, (), len(rows)
            )
            takes.append((take, rows))
        people.append(Person(str(name), {}))
    table = {take.name: rows for take, rows in takes}
    return Source(
        "vocaset",
        root,
        tuple(people),
        tuple(take for take, _ in takes),
        functools.partial(_read, paths[0], table),
        functools.partial(_rest, paths[2], tuple(still)),
        tuple(paths),
        rate,
        faces=topology.faces,
        notes=tuple(notes),
    )


def _rows(frames: dict, count: int, where: str, gaps: bool) -> tuple[np.ndarray, list[str]]:
    """The rows (T,) of a sentence's frames, in their order, and what is odd."""
    try:
        pairs = sorted((int(frame), int(row)) for frame, row in frames.items())
    except (TypeError, ValueError) as error:
        raise SourceError(f"{where}: expected frames and rows, got {error}") from error
    numbers, rows = np.array(pairs).T
    if bad := [f"frame {n} is row {r}" for n, r in pairs if not 0 <= r < count]:
        raise SourceError(f"{where}: {bad[0]}, expected 0 to {count - 1}")
    wide = np.flatnonzero(np.diff(numbers) > 1)
    said = [f"{where}: frame {numbers[i] + 1} is missing" for i in wide]
    if said and not gaps:
        raise SourceError(f"{said[0]}; --gaps takes the frames as they are")
    return rows, said


def _rest_of(rests: Any, name: str, count: int, path: Path) -> np.ndarray:
    """A person's mesh at rest (N, 3)."""
    found = _dict(rests, path).get(name)
    if not isinstance(found, np.ndarray) or found.dtype.kind not in "fiu":
        raise SourceError(f"{path}: holds no template of {name}")
    if found.shape != (count, 3):
        raise SourceError(f"{path}: {name}: expected ({count}, 3) vertices, got {found.shape}")
    if len(bad := np.flatnonzero(~np.isfinite(found).all(axis=1))):
        raise SourceError(f"{path}: {name}: vertex {bad[0]} is not finite: {found[bad[0]].tolist()}")
    return found.astype(np.float64)


def _dict(value: Any, path: Path, *keys: str) -> dict:
    if not isinstance(value, dict) or not value:
        raise SourceError(f"{path}: {'/'.join(keys) or 'the whole'}: expected a dict with entries")
    return value


def _read(path: Path, table: dict[str, np.ndarray], take: RecordingInfo, which: Sequence[int] | None) -> Iterator[Frame]:
    vertices, rows = npz.map_npy(path), table[take.name]
    for i in range(len(rows)) if which is None else which:
        frame = np.asarray(vertices[rows[i]], np.float64)
        name = f"{path}: {take.name}: frame {i} (row {rows[i]})"
        bad = np.flatnonzero(~np.isfinite(frame).all(axis=1))
        if len(bad):
            raise SourceError(f"{name}: vertex {bad[0]} is not finite: {frame[bad[0]].tolist()}")
        yield name, meshes.Mesh(frame, None)


def _rest(path: Path, still: tuple[np.ndarray, ...], subject: int) -> Iterator[Frame]:
    yield f"{path}: person {subject}", meshes.Mesh(still[subject], None)
