"""Recordings of Live Link Face applied to MakeHuman people: captured motion in a free topology.

    ROOT/EXPRESSION.csv  or  ROOT/PERFORMER/EXPRESSION_01.csv

Every performer drives several of the first `actors` MakeHuman people: of K performers, performer k drives people k,
k + K, k + 2 K and so on, so that no face is shared. T frames, U units of the rig.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from facejax.data import blendshapes
from facejax.data.importers import base, folder_scan
from facejax.data.importers.base import Frame, Person, RecordingInfo, Source, SourceError
from facejax.data.synthetic import assets, makehuman, makehuman4d, rig
from facejax.io import livelink, meshes

CHUNK = 64  # frames posed at a time


def scan(root: str | os.PathLike[str], *, rate: float = 30.0, actors: int = 12, level: int = 3) -> Source:
    """List every recording on every person of its performer.

    Args:
      root: the folder of the CSV files, or of the performers' folders.
      rate: frames per second that recordings are resampled to.
      actors: number of MakeHuman people, at least one per performer.
      level: realism of the faces, 0 to 3.

    Raises:
      SourceError: naming the file and line.
    """
    root = Path(root)
    performers = [folder for folder in folder_scan.list_entries(root) if folder.is_dir()] if root.is_dir() else []
    performers = [folder for folder in performers if _csv_files(folder)] or [root]
    files = [_csv_files(folder) for folder in performers]
    if not any(files):
        raise SourceError(f"{root}: contains no recordings; expected EXPRESSION.csv or PERFORMER/EXPRESSION.csv")
    if actors < len(performers):
        raise SourceError(f"actors: {actors}, expected {len(performers)} or more, one for each performer")
    counts = {path: len(_weights(path, rate)[0]) for paths in files for path in paths}
    notes = [f"{path}: {note}" for paths in files for path in paths for note in _weights(path, rate)[1]]
    recordings = []
    for person in range(actors):
        for path in files[person % len(performers)]:
            name = f"{_person_name(performers, person, root)}/{path.stem}"
            label = base.label_from_name(path.stem)
            recordings.append(RecordingInfo(person, label, name, path, (), counts[path]))
    loaded = assets.load()
    return Source(
        "livelink",
        root,
        tuple(
            Person(_person_name(performers, i, root), {"performer": performers[i % len(performers)].name})
            for i in range(actors)
        ),
        tuple(recordings),
        functools.partial(_read_frames, rate, level),
        _neutral_frames,
        tuple(counts),
        rate,
        unit="mm",
        faces=loaded.faces,
        landmarks=loaded.landmarks,
        notes=tuple(notes),
    )


def _person_name(performers: list[Path], person: int, root: Path) -> str:
    """Return performer and person, such as "anna-003"; "003" where there are no performers' folders."""
    performer = performers[person % len(performers)]
    return f"{person:03d}" if performer == root else f"{performer.name}-{person:03d}"


def _csv_files(folder: Path) -> list[Path]:
    if not folder.is_dir():
        return []
    return [path for path in folder_scan.list_entries(folder) if path.suffix.lower() == ".csv"]


@functools.lru_cache(maxsize=4)
def _weights(path: Path, rate: float) -> tuple[np.ndarray, tuple[str, ...]]:
    """Return the rig's weights (T, U) above the performer's resting face, resampled, and notes on assumptions."""
    try:
        resampled = blendshapes.resample(blendshapes.subtract_rest(livelink.read(path)), rate=rate)
    except livelink.RecordingError as error:
        raise SourceError(str(error)) from error
    return blendshapes.unit_weights(resampled, rig.unit_names()), resampled.notes


@functools.lru_cache(maxsize=2)
def _rig(person: int, level: int) -> rig.Rig:
    return rig.build(makehuman.subject(person, seed=makehuman4d.SEED), level=level)


def _read_frames(rate: float, level: int, recording: RecordingInfo, frames: Sequence[int] | None) -> Iterator[Frame]:
    weights, skin = _weights(recording.path, rate)[0], assets.load().skin
    numbers = np.arange(len(weights)) if frames is None else np.asarray(frames)
    for low in range(0, len(numbers), CHUNK):
        part = numbers[low : low + CHUNK]
        posed = rig.pose(_rig(recording.subject, level), weights[part])[:, :skin]
        for i, vertices in zip(part, posed, strict=True):
            yield f"{recording.path}: frame {i}", meshes.Mesh(vertices.astype(np.float64), None)


def _neutral_frames(subject: int) -> Iterator[Frame]:
    person = makehuman.subject(subject, seed=makehuman4d.SEED)
    yield person.name, meshes.Mesh(person.vertices.astype(np.float64), None)
