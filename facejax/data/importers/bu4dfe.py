"""BU-4DFE: `ROOT/F001/Angry/000.bnd`, 83 landmarks per frame, no registered meshes; 101 people x 6, 25 frames/s.

A .bnd file has a row `vertex x y z` for each landmark, in millimetres; vertices refer to the raw scan. F001 is a woman,
M001 a man. The dataset contains only landmarks, for motion generators.
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


def scan(root: str | os.PathLike[str], *, rate: float = RATE, rest: str = "first", gaps: bool = False) -> Source:
    """List the recordings; options as in `folder_scan.scan`. Raises `SourceError`, naming the file."""
    root = Path(root)
    if rest not in folder_scan.REST_OPTIONS:
        raise SourceError(f"rest: expected {' or '.join(folder_scan.REST_OPTIONS)}, got {rest!r}")
    people, recordings, notes = [], [], []
    for folder in folder_scan.list_folders(root, "F001/Angry/000.bnd"):
        match = _NAME.fullmatch(folder.name)
        if match is None:
            notes.append(f"skipped {folder.name}, not a subject's folder (F001)")
            continue
        own = []
        for path in folder_scan.list_folders(folder, "Angry/000.bnd"):
            frames = tuple(p for p in folder_scan.list_entries(path) if p.suffix.lower() == ".bnd")
            if not frames:
                raise SourceError(f"{path}: contains no landmarks; expected 000.bnd and so on")
            notes += base.check_frame_numbers(frames, gaps=gaps)
            label = base.label_from_name(path.name)
            own.append(RecordingInfo(len(people), label, f"{folder.name}/{path.name}", path, frames, len(frames)))
        people.append(Person(folder.name, {"sex": _SEX[match[1].upper()]}))
        recordings += own
    if not people:
        raise SourceError(f"{root}: contains no subjects' folders (F001 to F058, M001 to M043)")
    return Source(
        "bu4dfe",
        root,
        tuple(people),
        tuple(recordings),
        read_frames,
        functools.partial(_neutral_frames, tuple(recordings), rest),
        tuple(path for recording in recordings for path in recording.frame_paths),
        rate,
        unit="mm",
        landmarks=np.arange(LANDMARKS),
        landmarks_only=True,
        notes=tuple(notes),
    )


def read_frames(recording: RecordingInfo, frames: Sequence[int] | None) -> Iterator[Frame]:
    """Yield the landmarks (83, 3) of the given frames, or all for None. Raises `SourceError`, naming file and line."""
    for path in recording.frame_paths if frames is None else [recording.frame_paths[i] for i in frames]:
        try:
            found = landmarks.read(path)
        except landmarks.LandmarkError as error:
            raise SourceError(str(error)) from error
        if len(found.points) != LANDMARKS:
            raise SourceError(f"{path}: {len(found.points)} landmarks, expected {LANDMARKS}")
        yield str(path), meshes.Mesh(found.points, None)


def _neutral_frames(recordings: tuple[RecordingInfo, ...], rest: str, subject: int) -> Iterator[Frame]:
    own = [recording for recording in recordings if recording.subject == subject]
    for recording in own[:1] if rest == "first" else own:
        yield next(read_frames(recording, [0]))
