"""BU-3DFE as registered: meshes called `F0001_AN01WH_F3D`, in any folders; 100 people, four strengths of six emotions.

F0001 is a woman, M0001 a man; AN, DI, FE, HA, SA, SU are anger to surprise, NE is neutral, 01 to 04 the strength. Each
emotion of a person becomes a recording of five frames: neutral, then the four strengths. Only 57 people have a neutral
mesh; the others are skipped and noted.
"""

from __future__ import annotations

import functools
import os
import re
from collections.abc import Iterator
from pathlib import Path

from facejax.data.importers import base, folder_scan
from facejax.data.importers.base import Frame, Person, RecordingInfo, Source, SourceError

EMOTIONS = {"AN": "angry", "DI": "disgust", "FE": "fear", "HA": "happy", "SA": "sad", "SU": "surprise"}
LANDMARKS = 66
_NAME = re.compile(r"([FM]\d{4})_(AN|DI|FE|HA|NE|SA|SU)(\d{2})[A-Z]{2}_F3D", re.IGNORECASE)
_SEX = {"F": "female", "M": "male"}


def scan(root: str | os.PathLike[str], *, rate: float = 30.0) -> Source:
    """List the emotions of the people who have a neutral mesh. `rate` is nominal: the frames are separate scans.

    Raises:
      SourceError: naming the file.
    """
    root = Path(root)
    found = _find_meshes(root)
    names = sorted({name for name, _, _ in found})
    kept = [name for name in names if any(key[:2] == (name, "NE") for key in found)]
    if not kept:
        raise SourceError(f"{root}: none of {len(names)} people has a neutral mesh (F0001_NE00WH_F3D)")
    notes, recordings, neutral = [], [], []
    if skipped := [name for name in names if name not in kept]:
        notes.append(
            f"skipped {len(skipped)} of {len(names)} people without a neutral mesh: {base.abbreviate_names(skipped)}"
        )
    missing_levels, missing_emotions = [], []
    for subject, name in enumerate(kept):
        rest = next(path for key, path in sorted(found.items()) if key[:2] == (name, "NE"))
        neutral.append(rest)
        for code, label in EMOTIONS.items():
            levels = {key[2]: path for key, path in sorted(found.items()) if key[:2] == (name, code)}
            if not levels:
                missing_emotions.append(f"{name}/{label}")
                continue
            missing_levels += [f"{name}_{code}{level:02d}" for level in range(1, 5) if level not in levels]
            frames = (rest, *levels.values())
            last = len(frames) - 1
            phases = (0, last, last, last)
            recordings.append(
                RecordingInfo(subject, label, f"{name}/{label}", rest.parent, frames, len(frames), phases)
            )
    if missing_levels:
        listed = base.abbreviate_names(missing_levels)
        notes.append(f"{len(missing_levels)} strengths are missing, their recordings have fewer frames: {listed}")
    if missing_emotions:
        notes.append(f"{len(missing_emotions)} emotions are missing: {base.abbreviate_names(missing_emotions)}")
    if not recordings:
        raise SourceError(f"{root}: contains only neutral meshes, expected emotions (F0001_AN01WH_F3D)")
    return Source(
        "bu3dfe",
        root,
        tuple(Person(name, {"sex": _SEX[name[0].upper()]}) for name in kept),
        tuple(recordings),
        functools.partial(folder_scan.read_frames, rate),
        functools.partial(_neutral_frames, tuple(neutral)),
        tuple(sorted({*neutral, *(path for recording in recordings for path in recording.frame_paths)})),
        rate,
        notes=tuple(notes),
    )


def _find_meshes(root: Path) -> dict[tuple[str, str, int], Path]:
    """Return the paths of all meshes by person, code and strength."""
    if not root.is_dir():
        raise SourceError(f"{root}: {'not a folder' if root.exists() else 'no such folder'}")
    found: dict[tuple[str, str, int], Path] = {}
    for path in sorted(root.rglob("*"), key=lambda p: base.natural_sort_key(p.as_posix())):
        match = _NAME.fullmatch(path.stem)
        if match is None or path.suffix.lower() not in folder_scan.MESH_SUFFIXES or not path.is_file():
            continue
        key = (match[1].upper(), match[2].upper(), int(match[3]))
        if key in found:
            raise SourceError(f"{path}: duplicate of {found[key]}")
        found[key] = path
    if not found:
        suffixes = ", ".join(folder_scan.MESH_SUFFIXES)
        raise SourceError(f"{root}: contains no meshes called F0001_AN01WH_F3D{{{suffixes}}}")
    return found


def _neutral_frames(neutral: tuple[Path, ...], subject: int) -> Iterator[Frame]:
    yield str(neutral[subject]), folder_scan.read_mesh(neutral[subject])
