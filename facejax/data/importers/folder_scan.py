"""Registered 4D meshes in folders, one for each subject: found, and read one frame at a time.

    ROOT/SUBJECT/RECORDING/*.ply .obj .npy .npz    one mesh a frame, in natural order: frame2 before frame10
    ROOT/SUBJECT/RECORDING.npz                     or all frames: `vertices` (T, N, 3), and `faces` if there are any
    ROOT/SUBJECT/neutral.ply .obj .npy .npz        the face at rest; else the first frame of the first recording

What else lies there is passed over. A recording's expression is its name without a number at the end."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from facejax.data.importers import base
from facejax.data.importers.base import Frame, Person, RecordingInfo, Source, SourceError
from facejax.io import meshes

MESH_SUFFIXES = (".ply", ".obj", ".npy", ".npz")
NEUTRAL_NAME = "neutral"
REST_OPTIONS = ("first", "mean")


def scan(
    root: Path,
    *,
    layout: str = "folder",
    rate: float = 30.0,
    rest: str = "first",
    step: int | None = None,
    gaps: bool = False,
) -> Source:
    """Find the meshes under a root, without reading them.

    Args:
      layout: the dataset's name.
      rate: frames per second.
      rest: whose neutral mesh is missing is at rest in the "first" frame of the first recording, or in the "mean" of
        the first frames of all.
      step: from one frame's number to the next; None takes the smallest in the recording.
      gaps: missing frames are said, not refused.

    Raises:
      SourceError: naming the folder that is amiss.
    """
    root = Path(root)
    if rest not in REST_OPTIONS:
        raise SourceError(f"rest: expected {' or '.join(REST_OPTIONS)}, got {rest!r}")
    people, neutral, takes, stray, notes = [], [], [], [], []
    for index, folder in enumerate(list_folders(root, "SUBJECT/RECORDING/*.ply or SUBJECT/RECORDING.npz")):
        own, there = {}, [p for p in list_entries(folder) if p.is_dir() or p.suffix.lower() in MESH_SUFFIXES]
        still = [path for path in there if not path.is_dir() and path.stem.lower() == NEUTRAL_NAME]
        if len(still) > 1:
            raise SourceError(f"{folder}: {still[0].name} and {still[1].name}, expected one face at rest")
        for path in there:
            if path in still:
                continue
            if not path.is_dir() and path.suffix.lower() != ".npz":
                stray.append(path)
                continue
            take = _take(index, folder.name, path)
            notes += base.check_frame_numbers(take.frames, step=step, gaps=gaps)
            if (twin := own.setdefault(_plain(path), take)) is not take:
                raise SourceError(f"{path}: the recording {_plain(path)!r} is {twin.path.name} already")
        if not own:
            raise SourceError(f"{folder}: holds no recordings; expected RECORDING/*.ply or RECORDING.npz")
        people.append(Person(folder.name, {}))
        neutral.append(still[0] if still else None)
        takes += [own[name] for name in sorted(own, key=base.natural_sort_key)]
    steps = [base.frame_step(take.frames) for take in takes]
    usual = max(set(steps), key=steps.count)
    if odd := [f"{t.name} ({n})" for t, n in zip(takes, steps, strict=True) if t.frames and n != usual]:
        notes.append(f"frames are numbered in steps of {usual}, but elsewhere: {base.abbreviate_names(odd)}")
    without = [person.name for person, path in zip(people, neutral, strict=True) if path is None]
    if without:
        first = "the first frame of the first recording" if rest == "first" else "the mean of the first frames"
        notes.append(f"no neutral mesh, at rest in {first}: {base.abbreviate_names(without)}")
    if stray:
        names = [path.relative_to(root).as_posix() for path in stray]
        notes.append(f"passed over, as meshes outside the folders of recordings: {base.abbreviate_names(names)}")
    return Source(
        layout,
        root,
        tuple(people),
        tuple(takes),
        functools.partial(read_frames, rate),
        functools.partial(_rest, tuple(neutral), tuple(takes), rate, rest),
        tuple(path for path in neutral if path) + tuple(p for take in takes for p in take.frames or (take.path,)),
        rate,
        notes=tuple(notes),
    )


def read_frames(rate: float, take: RecordingInfo, which: Sequence[int] | None) -> Iterator[Frame]:
    """Each frame of a recording, or those of some numbers, with its name for messages; of a folder one at a time.

    Raises `SourceError` where a frame cannot be read or is not finite, or an NPZ says another `rate`.
    """
    if take.frames:
        for path in take.frames if which is None else [take.frames[i] for i in which]:
            yield str(path), read_mesh(path)
        return
    vertices, faces, extra = _told(meshes.read_animation, take.path, bare=True)
    if not abs(extra.get("fps", rate) - rate) <= 1e-3 * rate:
        raise SourceError(f"{take.path}: fps is {extra['fps']:g}, expected {rate:g}: one rate for all")
    for i in range(len(vertices)) if which is None else which:
        bad = np.flatnonzero(~np.isfinite(vertices[i]).all(axis=1))
        if len(bad):
            raise SourceError(f"{take.path}: frame {i}: vertex {bad[0]} is not finite: {vertices[i, bad[0]].tolist()}")
        yield f"{take.path}: frame {i}", meshes.Mesh(vertices[i].astype(np.float64), faces)


def read_mesh(path: Path) -> meshes.Mesh:
    """A mesh of a file. Raises `SourceError`."""
    return _told(meshes.read, path)


def list_folders(root: Path, expected: str) -> list[Path]:
    """The folders in a folder, in natural order. Raises `SourceError` where there are none."""
    if not root.is_dir():
        raise SourceError(f"{root}: {'not a folder' if root.exists() else 'no such folder'}")
    found = [path for path in list_entries(root) if path.is_dir()]
    if not found:
        raise SourceError(f"{root}: holds no folders; expected {expected}")
    return found


def list_entries(folder: Path) -> list[Path]:
    """What lies in a folder and is not hidden, in natural order. Raises `SourceError`."""
    try:
        return sorted(
            (p for p in folder.iterdir() if not p.name.startswith(".")), key=lambda p: base.natural_sort_key(p.name)
        )
    except OSError as error:
        raise SourceError(f"{folder}: cannot be read: {error.strerror or error}") from error


def _rest(neutral: tuple[Path | None, ...], takes: tuple[RecordingInfo, ...], rate: float, rest: str, subject: int):
    if (path := neutral[subject]) is not None:
        yield str(path), read_mesh(path)
        return
    own = [take for take in takes if take.subject == subject]
    for take in own[:1] if rest == "first" else own:
        yield next(read_frames(rate, take, [0]))


def _take(subject: int, name: str, path: Path) -> RecordingInfo:
    if _plain(path) == NEUTRAL_NAME:
        raise SourceError(f"{path}: the face at rest is one mesh, {NEUTRAL_NAME}.ply say; give a recording another name")
    if ">" in path.name:  # the mark of a direct transition in a store
        raise SourceError(f"{path}: a recording's name cannot hold '>'")
    label = base.label_from_name(_plain(path))
    frames = _frames_of(path)
    count = len(frames) or _told(meshes.count_frames, path)
    return RecordingInfo(subject, label, f"{name}/{path.name if frames else path.stem}", path, frames, count)


def _plain(path: Path) -> str:
    """A recording's name without regard to case and kind of dash."""
    return (path.name if path.is_dir() else path.stem).lower().replace(" ", "_").replace("-", "_")


def _frames_of(path: Path) -> tuple[Path, ...]:
    """The frames in a folder; none of an NPZ."""
    if not path.is_dir():
        return ()
    found = tuple(p for p in list_entries(path) if p.is_file() and p.suffix.lower() in MESH_SUFFIXES)
    kinds = sorted({p.suffix.lower() for p in found})
    if not found:
        raise SourceError(f"{path}: holds no frames; expected {', '.join(MESH_SUFFIXES)}")
    if len(kinds) > 1:  # most likely every frame twice
        raise SourceError(f"{path}: frames in {' and '.join(kinds)}, expected one format")
    return found


def _told(reader, path: Path, **options):
    try:
        return reader(path, **options)
    except meshes.MeshError as error:
        raise SourceError(str(error)) from error
