"""BU-4DFE: `ROOT/F001/Angry/000.bnd`, 83 landmarks a frame and no registered meshes; 101 people x 6, 25 a second.

A .bnd holds a row `vertex x y z` for each landmark, in millimetres; the vertices are those of the raw scan. F001 is a
woman, M001 a man. The store holds landmarks alone, for generators of motion.
"""

from __future__ import annotations

import functools
import os
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from facejax.data.importers import base, folder_scan
from facejax.data.importers.base import Frame, Person, RecordingInfo, Source, SourceError
from facejax.io import landmarks, meshes

RATE = 25.0
LANDMARKS = 83
_NAME = re.compile(r"([FM])\d{3}", re.IGNORECASE)
_SEX = {"F": "female", "M": "male"}


def scan(root: str | os.PathLike, *, rate: float = RATE, rest: str = "first", gaps: bool = False) -> Source:
    """The recordings of the people. Raises `SourceError`, naming the file; options as in `tree.scan`."""
    root = Path(root)
    if rest not in folder_scan.REST_OPTIONS:
        raise SourceError(f"rest: expected {' or '.join(folder_scan.REST_OPTIONS)}, got {rest!r}")
    people, takes, notes = [], [], []
    for folder in folder_scan.list_folders(root, "F001/Angry/000.bnd"):
        match = _NAME.fullmatch(folder.name)
        if match is None:
            notes.append(f"passed over, as no person's folder (F001): {folder.name}")
            continue
        own = []
        for path in folder_scan.list_folders(folder, "Angry/000.bnd"):
            frames = tuple(p for p in folder_scan.list_entries(path) if p.suffix.lower() == ".bnd")
            if not frames:
                raise SourceError(f"{path}: holds no landmarks; expected 000.bnd and so on")
            notes += base.check_frame_numbers(frames, gaps=gaps)
            label = base.label_from_name(path.name)
            own.append(RecordingInfo(len(people), label, f"{folder.name}/{path.name}", path, frames, len(frames)))
        people.append(Person(folder.name, {"sex": _SEX[match[1].upper()]}))
        takes += own
    if not people:
        raise SourceError(f"{root}: holds no people's folders (F001 to F058, M001 to M043)")
    return Source(
        "bu4dfe",
        root,
        tuple(people),
        tuple(takes),
        read_frames,
        functools.partial(_rest, tuple(takes), rest),
        tuple(path for take in takes for path in take.frames),
        rate,
        unit="mm",
        landmarks=np.arange(LANDMARKS),
        landmarks_only=True,
        notes=tuple(notes),
    )


def read_frames(take: RecordingInfo, which: Sequence[int] | None) -> Iterator[Frame]:
    """Each frame's landmarks (83, 3). Raises `SourceError`, naming file and line."""
    for path in take.frames if which is None else [take.frames[i] for i in which]:
        try:
            found = landmarks.read(path)
        except landmarks.LandmarkError as error:
            raise SourceError(str(error)) from error
        if len(found.points) != LANDMARKS:
            raise SourceError(f"{path}: {len(found.points)} landmarks, expected {LANDMARKS}")
        yield str(path), meshes.Mesh(found.points, None)


def _rest(takes: tuple[RecordingInfo, ...], rest: str, subject: int) -> Iterator[Frame]:
    own = [take for take in takes if take.subject == subject]
    for take in own[:1] if rest == "first" else own:
        yield next(read_frames(take, [0]))
