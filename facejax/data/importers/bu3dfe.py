"""BU-3DFE as registered: meshes called `F0001_AN01WH_F3D`, in any folders; 100 people, four strengths of six emotions.

F0001 is a woman, M0001 a man; AN, DI, FE, HA, SA, SU are anger to surprise, NE is neutral, 01 to 04 the strength. Each
emotion of a person becomes a recording of five frames: neutral, then the four. Only 57 people have a neutral mesh; the
others are left out, and named.
"""

from __future__ import annotations

import functools
import os
import re
from pathlib import Path

from facejax.data.importers import base, folder_scan
from facejax.data.importers.base import Person, RecordingInfo, Source, SourceError

EMOTIONS = {"AN": "angry", "DI": "disgust", "FE": "fear", "HA": "happy", "SA": "sad", "SU": "surprise"}
LANDMARKS = 66
_NAME = re.compile(r"([FM]\d{4})_(AN|DI|FE|HA|NE|SA|SU)(\d{2})[A-Z]{2}_F3D", re.IGNORECASE)
_SEX = {"F": "female", "M": "male"}


def scan(root: str | os.PathLike, *, rate: float = 30.0) -> Source:
    """The emotions of the people who have a neutral mesh. Raises `SourceError`, naming the file.

    `rate` is nominal: these are not recordings in time.
    """
    root = Path(root)
    found = _meshes(root)
    names = sorted({name for name, _, _ in found})
    kept = [name for name in names if any(key[:2] == (name, "NE") for key in found)]
    if not kept:
        raise SourceError(f"{root}: none of {len(names)} people has a neutral mesh (F0001_NE00WH_F3D)")
    notes, takes, neutral = [], [], []
    if left := [name for name in names if name not in kept]:
        notes.append(
            f"{len(left)} of {len(names)} people have no neutral mesh and are left out: {base.abbreviate_names(left)}"
        )
    missing, absent = [], []
    for subject, name in enumerate(kept):
        rest = next(path for key, path in sorted(found.items()) if key[:2] == (name, "NE"))
        neutral.append(rest)
        for code, label in EMOTIONS.items():
            levels = {key[2]: path for key, path in sorted(found.items()) if key[:2] == (name, code)}
            if not levels:
                absent.append(f"{name}/{label}")
            else:
                missing += [f"{name}_{code}{level:02d}" for level in range(1, 5) if level not in levels]
                frames = (rest, *levels.values())
                last = len(frames) - 1
                takes.append(
                    RecordingInfo(
                        subject, label, f"{name}/{label}", rest.parent, frames, len(frames), (0, last, last, last)
                    )
                )
    if missing:
        notes.append(
            f"{len(missing)} strengths are missing, their emotions have fewer frames: {base.abbreviate_names(missing)}"
        )
    if absent:
        notes.append(f"{len(absent)} emotions are missing: {base.abbreviate_names(absent)}")
    if not takes:
        raise SourceError(f"{root}: holds neutral meshes alone, expected emotions (F0001_AN01WH_F3D)")
    return Source(
        "bu3dfe",
        root,
        tuple(Person(name, {"sex": _SEX[name[0].upper()]}) for name in kept),
        tuple(takes),
        functools.partial(folder_scan.read_frames, rate),
        functools.partial(_rest, tuple(neutral)),
        tuple(sorted({*neutral, *(path for take in takes for path in take.frames)})),
        rate,
        notes=tuple(notes),
    )


def _meshes(root: Path) -> dict[tuple[str, str, int], Path]:
    """Person, code and strength of every mesh."""
    if not root.is_dir():
        raise SourceError(f"{root}: {'not a folder' if root.exists() else 'no such folder'}")
    found: dict[tuple[str, str, int], Path] = {}
    for path in sorted(root.rglob("*"), key=lambda p: base.natural_sort_key(p.as_posix())):
        match = _NAME.fullmatch(path.stem)
        if match is None or path.suffix.lower() not in folder_scan.MESH_SUFFIXES or not path.is_file():
            continue
        key = (match[1].upper(), match[2].upper(), int(match[3]))
        if key in found:
            raise SourceError(f"{path}: is {found[key]} already")
        found[key] = path
    if not found:
        raise SourceError(f"{root}: holds no meshes called F0001_AN01WH_F3D{{{', '.join(folder_scan.MESH_SUFFIXES)}}}")
    return found


def _rest(neutral: tuple[Path, ...], subject: int):
    yield str(neutral[subject]), folder_scan.read_mesh(neutral[subject])
