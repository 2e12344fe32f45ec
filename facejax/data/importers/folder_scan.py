"""Registered 4D meshes in folders, one folder per subject.

    ROOT/SUBJECT/RECORDING/*.ply .obj .npy .npz    one mesh per frame, in natural order: frame2 before frame10
    ROOT/SUBJECT/RECORDING.npz                     or all frames: `vertices` (T, N, 3), optional `faces`
    ROOT/SUBJECT/neutral.ply .obj .npy .npz        the neutral face; else the first frame of the first recording

Other files are skipped. The label of a recording is its name without a trailing number.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np

from facejax.data.importers import base
from facejax.data.importers.base import Frame, Person, RecordingInfo, Source, SourceError
from facejax.io import meshes

MESH_SUFFIXES = (".ply", ".obj", ".npy", ".npz")
NEUTRAL_NAME = "neutral"
REST_OPTIONS = ("first", "mean")

Content = TypeVar("Content")


def scan(
    root: Path,
    *,
    layout: str = "folder",
    rate: float = 30.0,
    rest: str = "first",
    step: int | None = None,
    gaps: bool = False,
) -> Source:
    """List the recordings under a root without reading their frames.

    Args:
      root: the folder of the subjects' folders.
      layout: name of the dataset.
      rate: frames per second.
      rest: the neutral face of a subject without a neutral mesh: the "first" frame of the first recording, or the
        "mean" of the first frames of all.
      step: difference of consecutive frame numbers; None takes the smallest in the recording.
      gaps: allow missing frames, and note them.

    Raises:
      SourceError: naming the folder or file.
    """
    root = Path(root)
    if rest not in REST_OPTIONS:
        raise SourceError(f"rest: expected {' or '.join(REST_OPTIONS)}, got {rest!r}")
    people, neutral, recordings, stray, notes = [], [], [], [], []
    for index, folder in enumerate(list_folders(root, "SUBJECT/RECORDING/*.ply or SUBJECT/RECORDING.npz")):
        own, paths = {}, [p for p in list_entries(folder) if p.is_dir() or p.suffix.lower() in MESH_SUFFIXES]
        neutral_paths = [path for path in paths if not path.is_dir() and path.stem.lower() == NEUTRAL_NAME]
        if len(neutral_paths) > 1:
            names = f"{neutral_paths[0].name} and {neutral_paths[1].name}"
            raise SourceError(f"{folder}: two neutral meshes, {names}; expected one")
        for path in paths:
            if path in neutral_paths:
                continue
            if not path.is_dir() and path.suffix.lower() != ".npz":
                stray.append(path)
                continue
            recording = _recording(index, folder.name, path)
            notes += base.check_frame_numbers(recording.frame_paths, step=step, gaps=gaps)
            if (twin := own.setdefault(_normalised_name(path), recording)) is not recording:
                raise SourceError(f"{path}: duplicate recording {_normalised_name(path)!r}, also {twin.path.name}")
        if not own:
            raise SourceError(f"{folder}: contains no recordings; expected RECORDING/*.ply or RECORDING.npz")
        people.append(Person(folder.name, {}))
        neutral.append(neutral_paths[0] if neutral_paths else None)
        recordings += [own[name] for name in sorted(own, key=base.natural_sort_key)]
    steps = [base.frame_step(recording.frame_paths) for recording in recordings]
    usual = max(set(steps), key=steps.count)
    pairs = zip(recordings, steps, strict=True)
    if odd := [f"{one.name} ({number})" for one, number in pairs if one.frame_paths and number != usual]:
        notes.append(f"frame numbers increase by {usual}, except in: {base.abbreviate_names(odd)}")
    without = [person.name for person, path in zip(people, neutral, strict=True) if path is None]
    if without:
        used = "the first frame of the first recording" if rest == "first" else "the mean of the first frames"
        notes.append(f"no neutral mesh, used {used}: {base.abbreviate_names(without)}")
    if stray:
        names = [path.relative_to(root).as_posix() for path in stray]
        notes.append(f"skipped meshes outside recording folders: {base.abbreviate_names(names)}")
    neutral_files = tuple(path for path in neutral if path)
    return Source(
        layout,
        root,
        tuple(people),
        tuple(recordings),
        functools.partial(read_frames, rate),
        functools.partial(_neutral_frames, tuple(neutral), tuple(recordings), rate, rest),
        neutral_files + tuple(path for one in recordings for path in one.frame_paths or (one.path,)),
        rate,
        notes=tuple(notes),
    )


def read_frames(rate: float, recording: RecordingInfo, frames: Sequence[int] | None) -> Iterator[Frame]:
    """Yield the given frames of a recording, or all for None, each with a name for messages.

    Frames in files of their own are read one at a time.

    Raises:
      SourceError: a frame cannot be read or is not finite, or an NPZ has another frame rate than `rate`.
    """
    if recording.frame_paths:
        for path in recording.frame_paths if frames is None else [recording.frame_paths[i] for i in frames]:
            yield str(path), read_mesh(path)
        return
    path = recording.path
    vertices, faces, extra = _as_source_error(meshes.read_animation, path, bare=True)
    fps = extra.get("fps", rate)
    if not abs(fps - rate) <= 1e-3 * rate:
        raise SourceError(f"{path}: fps is {fps:g}, expected {rate:g}, the same for all recordings")
    for i in range(len(vertices)) if frames is None else frames:
        bad = np.flatnonzero(~np.isfinite(vertices[i]).all(axis=1))
        if len(bad):
            raise SourceError(f"{path}: frame {i}: vertex {bad[0]} is not finite: {vertices[i, bad[0]].tolist()}")
        yield f"{path}: frame {i}", meshes.Mesh(vertices[i].astype(np.float64), faces)


def read_mesh(path: Path) -> meshes.Mesh:
    """Read a mesh file. Raises `SourceError`."""
    return _as_source_error(meshes.read, path)


def list_folders(root: Path, expected: str) -> list[Path]:
    """Return the folders in a folder, in natural order. Raises `SourceError` where there are none."""
    if not root.is_dir():
        raise SourceError(f"{root}: {'not a folder' if root.exists() else 'no such folder'}")
    found = [path for path in list_entries(root) if path.is_dir()]
    if not found:
        raise SourceError(f"{root}: contains no folders; expected {expected}")
    return found


def list_entries(folder: Path) -> list[Path]:
    """Return the entries of a folder that are not hidden, in natural order. Raises `SourceError`."""
    try:
        return sorted(
            (p for p in folder.iterdir() if not p.name.startswith(".")), key=lambda p: base.natural_sort_key(p.name)
        )
    except OSError as error:
        raise SourceError(f"{folder}: cannot be read: {error.strerror or error}") from error


def _neutral_frames(
    neutral: tuple[Path | None, ...], recordings: tuple[RecordingInfo, ...], rate: float, rest: str, subject: int
) -> Iterator[Frame]:
    if (path := neutral[subject]) is not None:
        yield str(path), read_mesh(path)
        return
    own = [recording for recording in recordings if recording.subject == subject]
    for recording in own[:1] if rest == "first" else own:
        yield next(read_frames(rate, recording, [0]))


def _recording(subject: int, person: str, path: Path) -> RecordingInfo:
    name = _normalised_name(path)
    if name == NEUTRAL_NAME:
        raise SourceError(
            f"{path}: the neutral face must be one mesh, such as {NEUTRAL_NAME}.ply; rename the recording"
        )
    if ">" in path.name:  # marks direct transitions in datasets
        raise SourceError(f"{path}: the name of a recording must not contain '>'")
    frame_paths = _frame_paths(path)
    count = len(frame_paths) or _as_source_error(meshes.count_frames, path)
    full_name = f"{person}/{path.name if frame_paths else path.stem}"
    return RecordingInfo(subject, base.label_from_name(name), full_name, path, frame_paths, count)


def _normalised_name(path: Path) -> str:
    """Return a recording's name in lower case, with underscores for blanks and dashes."""
    return (path.name if path.is_dir() else path.stem).lower().replace(" ", "_").replace("-", "_")


def _frame_paths(path: Path) -> tuple[Path, ...]:
    """Return the frames in a folder; none for an NPZ."""
    if not path.is_dir():
        return ()
    found = tuple(p for p in list_entries(path) if p.is_file() and p.suffix.lower() in MESH_SUFFIXES)
    formats = sorted({p.suffix.lower() for p in found})
    if not found:
        raise SourceError(f"{path}: contains no frames; expected {', '.join(MESH_SUFFIXES)}")
    if len(formats) > 1:  # most likely every frame twice
        raise SourceError(f"{path}: frames in {' and '.join(formats)}, expected one format")
    return found


def _as_source_error(reader: Callable[..., Content], path: Path, **options: bool) -> Content:
    try:
        return reader(path, **options)
    except meshes.MeshError as error:
        raise SourceError(str(error)) from error
