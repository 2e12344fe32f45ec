"""Recordings of Live Link Face on MakeHuman's people: real motion in the free topology, for who has an iPhone.

    ROOT/EXPRESSION.csv  or  ROOT/PERFORMER/EXPRESSION_01.csv

Every performer plays every one of the first `actors` MakeHuman people that are theirs: performer k has people k, k + K,
k + 2 K of a population, K the number of performers, so that no face is shared.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from facejax.data.importers import base, folder_scan
from facejax.data.importers.base import Frame, Person, RecordingInfo, Source, SourceError
from facejax.data.synthetic import assets, makehuman, makehuman4d, rig
from facejax.io import livelink, meshes

CHUNK = 64  # frames posed at a time


def scan(root: str | os.PathLike, *, rate: float = 30.0, actors: int = 12, level: int = 3) -> Source:
    """Every recording on every person of its performer. Raises `SourceError`, naming the file and line.

    Args:
      root: the folder of the CSV files, or of the performers' folders.
      rate: frames per second that recordings are resampled to.
      actors: MakeHuman people in all, at least one a performer.
      level: realism of the faces, 0 to 3.
    """
    root = Path(root)
    performers = [folder for folder in folder_scan.list_entries(root) if folder.is_dir()] if root.is_dir() else []
    performers = [folder for folder in performers if _csv(folder)] or [root]
    recordings = [_csv(folder) for folder in performers]
    if not any(recordings):
        raise SourceError(f"{root}: holds no recordings; expected EXPRESSION.csv or PERFORMER/EXPRESSION.csv")
    if actors < len(performers):
        raise SourceError(f"actors: {actors}, expected {len(performers)} or more, one for each performer")
    counts = {path: len(_weights(path, rate)[0]) for paths in recordings for path in paths}
    notes = [f"{path}: {note}" for paths in recordings for path in paths for note in _weights(path, rate)[1]]
    takes = []
    for person in range(actors):
        for path in recordings[person % len(performers)]:
            name = f"{_name(performers, person, root)}/{path.stem}"
            takes.append(RecordingInfo(person, base.label_from_name(path.stem), name, path, (), counts[path]))
    loaded = assets.load()
    return Source(
        "livelink",
        root,
        tuple(
            Person(_name(performers, i, root), {"performer": performers[i % len(performers)].name})
            for i in range(actors)
        ),
        tuple(takes),
        functools.partial(_read, rate, level),
        _rest,
        tuple(counts),
        rate,
        unit="mm",
        faces=loaded.faces,
        landmarks=loaded.landmarks,
        notes=tuple(notes),
    )


def _name(performers: list[Path], person: int, root: Path) -> str:
    """Who plays whom: "anna-003"; without performers' folders "003"."""
    performer = performers[person % len(performers)]
    return f"{person:03d}" if performer == root else f"{performer.name}-{person:03d}"


def _csv(folder: Path) -> list[Path]:
    return [path for path in folder_scan.list_entries(folder) if path.suffix.lower() == ".csv"] if folder.is_dir() else []


@functools.lru_cache(maxsize=4)
def _weights(path: Path, rate: float) -> tuple[np.ndarray, tuple[str, ...]]:
    """The rig's weights (T, U) above the performer's resting face, evenly sampled, and what was assumed."""
    try:
        even = livelink.resample(livelink.subtract_rest(livelink.read(path)), rate=rate)
    except livelink.RecordingError as error:
        raise SourceError(str(error)) from error
    return livelink.unit_weights(even, rig.unit_names()), even.notes


@functools.lru_cache(maxsize=2)
def _rig(person: int, level: int) -> rig.Rig:
    return rig.build(makehuman.subject(person, seed=makehuman4d.SEED), level=level)


def _read(rate: float, level: int, take: RecordingInfo, which: Sequence[int] | None) -> Iterator[Frame]:
    weights, skin = _weights(take.path, rate)[0], assets.load().skin
    numbers = np.arange(len(weights)) if which is None else np.asarray(which)
    for low in range(0, len(numbers), CHUNK):
        some = numbers[low : low + CHUNK]
        posed = rig.pose(_rig(take.subject, level), weights[some])[:, :skin]
        for i, vertices in zip(some, posed, strict=True):
            yield f"{take.path}: frame {i}", meshes.Mesh(vertices.astype(np.float64), None)


def _rest(subject: int) -> Iterator[Frame]:
    person = makehuman.subject(subject, seed=makehuman4d.SEED)
    yield person.name, meshes.Mesh(person.vertices.astype(np.float64), None)
