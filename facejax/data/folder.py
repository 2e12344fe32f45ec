"""A user's own registered 4D meshes, read from folders (`facejax.data.tree` shows how they lie) into a store.

One order of vertices, the same triangles, one unit; y up, z forward, heads held still. The files are gone through
twice, one frame or one NPZ at a time: once to check all before anything is written, once to write. In memory stay only
the landmarks, 0.8 kB a frame where there are 68. T frames, N vertices, L landmarks."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from facejax import files
from facejax.data import makehuman4d, store, tree
from facejax.data.tree import FolderError
from facejax.io import faces, landmarks, meshes

VERSION = 1
SEED = 1
UNITS = {"mm": "millimetres", "cm": "centimetres", "m": "metres"}
SPREAD = 446.2  # mm, the norm of MakeHuman's 68 centred landmarks; a constant, since the head itself is a download
APEX, REST = 0.95, 0.05  # of the largest displacement: the apex lies above, rest below
STILL = 1e-3  # mm, landmarks in the mean: what moves less is no recording of an expression
LEAST = 4  # landmarks: fewer span no space
Progress = Callable[[int, int], None]


class _Checked(NamedTuple):
    """A tree that can be written."""

    tree: tree.Tree
    common: tree.Common
    index: np.ndarray  # (L,) int32 landmarks as vertices
    unit: str
    scale: float  # millimetres of the unit
    rate: float
    sequences: list[store.Sequence]
    landmarks: np.ndarray  # (R, L, 3) float32 mm, all sequences one after the other
    notes: list[str]


def prepare(
    root: str | os.PathLike,
    out: str | os.PathLike,
    *,
    landmarks: str | os.PathLike,
    unit: str | None = None,
    rate: float = 30.0,
    most: int = 20_000,
    progress: Progress | None = None,
) -> store.Store:
    """Read the meshes under `root` into a new store at `out`, in millimetres; `index["notes"]` says what was assumed.

    Args:
      landmarks: file of 4 or more landmarks of the first subject's neutral mesh, as `facejax.io.landmarks` reads it;
        positions go to the nearest vertices.
      unit: "mm", "cm" or "m"; by default recognised by the size of the face.
      rate: frames per second.
      most: how many meshes are stored, drawn by a fixed seed; landmarks are stored of all frames.
      progress: called with (done, total); a sequence counts twice, when it is checked and when it is written.

    Raises:
      FolderError: `out` is there already, or something is wrong with the meshes; nothing is written then.
    """
    root, out, rate, progress = Path(root), Path(out), float(rate), progress or (lambda done, total: None)
    _check_request(root, out, unit, rate, most)
    checked = _check(root, Path(landmarks), unit, rate, progress)
    with files.replacing_folder(out) as temporary:
        _write(checked, temporary, most, progress)
    return store.open_store(out)


def events(curve: np.ndarray, rest: np.ndarray) -> tuple[int, int, int, int]:
    """Onset, start and end of the apex, and offset of landmarks (T, L, 3) about those at rest (L, 3), as frame numbers.

    By their mean displacement: the apex goes from the first to the last frame above 95 % of its maximum; the onset is
    the last frame before it below 5 %, or the first of all; the offset the first one after it, or the last of all.
    """
    energy = _energy(curve, rest)
    apex = np.flatnonzero(energy >= APEX * energy.max())
    quiet = np.flatnonzero(energy < REST * energy.max())
    before, after = quiet[quiet < apex[0]], quiet[quiet > apex[-1]]
    onset = before[-1] if len(before) else 0
    offset = after[0] if len(after) else len(energy) - 1
    return int(onset), int(apex[0]), int(apex[-1]), int(offset)


def _check_request(root: Path, out: Path, unit: str | None, rate: float, most: int) -> None:
    if unit is not None and unit not in UNITS:
        raise FolderError(f"unit: expected {', '.join(UNITS)} or None, got {unit!r}")
    if not 0 < rate <= 1000:
        raise FolderError(f"rate: expected frames per second above 0, up to 1000, got {rate}")
    if most < 1:
        raise FolderError(f"most: expected 1 mesh or more, got {most}")
    if os.path.lexists(out):
        raise FolderError(f"{out}: is there already; remove it, or name another folder")
    if out.resolve().is_relative_to(root.resolve()):
        raise FolderError(f"{out}: lies among the meshes in {root}; name a folder outside")
    # The files may take an hour to read: whether the result can be put there is better asked now.
    above = next(folder for folder in out.absolute().parents if folder.exists())
    if not above.is_dir() or not os.access(above, os.W_OK | os.X_OK):
        raise FolderError(f"{out}: cannot be made, {above} is {'not writable' if above.is_dir() else 'not a folder'}")


def _check(root: Path, marks: Path, unit: str | None, rate: float, progress: Progress) -> _Checked:
    """Read everything once."""
    found = tree.scan(root)
    common = tree.common(found, rate)
    index, apart = _landmarks(marks, common)
    unit, scale = _unit(common, index, unit)
    notes = [f"read as {unit}: {common.name} is {tree.size(common.vertices) * scale:.3g} mm in size"]
    if apart is not None:
        notes.append(f"{marks}: positions went to the nearest vertices, {apart * scale:.2g} mm away at most")
    if shared := len(index) - len(np.unique(index)):
        notes.append(f"{marks}: {shared} of {len(index)} landmarks share a vertex with another")
    neutral = [common.check(*tree.neutral(found, subject, rate))[index] for subject in range(len(found.names))]
    rest = _millimetres(np.stack(neutral), scale)
    sequences, curves, start, restless = [], [], 0, {"begin": [], "end": []}
    for done, take in enumerate(found.takes, 1):
        frames = [common.check(*frame)[index] for frame in tree.frames(take, rate)]
        if len(frames) < 2:
            raise FolderError(f"{take.path}: 1 frame, expected 2 or more")
        curve = _millimetres(np.stack(frames), scale)
        energy = _energy(curve, rest[take.subject])
        if energy.max() < STILL:
            raise FolderError(f"{take.path}: its landmarks never leave the face at rest, expected a motion")
        onset, *apex, offset = events(curve, rest[take.subject])
        for frame, which in zip((onset, offset), restless.values(), strict=True):
            if energy[frame] >= REST * energy.max():
                which.append(f"{found.names[take.subject]}/{take.label}")
        timing = (onset, *apex, offset, len(frames) / rate)
        sequences.append(store.Sequence(take.subject, take.label, start, len(frames), *timing))
        curves.append(curve)
        start += len(frames)
        progress(done, 2 * len(found.takes))
    for verb, which in restless.items():
        if which:
            notes.append(f"{len(which)} of {len(curves)} sequences do not {verb} at rest: {tree.some(which)}")
    lacking = [split for split in store.SPLITS if split not in _splits(len(found.names))]
    if lacking:
        few = f"all splits need 4 subjects or more, got {len(found.names)}"
        notes.append(f"nobody serves {' and '.join(lacking)}: {few}")
    notes += found.notes()
    return _Checked(found, common, index, unit, scale, rate, sequences, np.concatenate(curves), notes)


def _write(checked: _Checked, folder: Path, most: int, progress: Progress) -> None:
    """Read the meshes that were drawn once more, into the files of a store."""
    found, common, sequences = checked.tree, checked.common, checked.sequences
    rows, subjects, shape = len(checked.landmarks), len(found.names), common.vertices.shape
    drawn = np.sort(np.random.default_rng([SEED, 2**20]).permutation(rows)[:most])
    whole = {"faces": common.faces, "landmarks": checked.landmarks, "drawn": drawn, "landmark_index": checked.index}
    shapes = {name: array.shape for name, array in whole.items()}
    shapes |= {"neutral": (subjects, *shape), "vertices": (len(drawn), *shape)}
    for name, array in whole.items():
        np.save(folder / f"{name}.npy", array)
    neutral, vertices = (
        np.lib.format.open_memmap(folder / f"{name}.npy", "w+", np.float32, shapes[name])
        for name in ("neutral", "vertices")
    )
    for subject in range(subjects):
        neutral[subject] = _millimetres(common.check(*tree.neutral(found, subject, checked.rate)), checked.scale)
    for done, (take, sequence) in enumerate(zip(found.takes, sequences, strict=True), 1):
        low, high = np.searchsorted(drawn, [sequence.start, sequence.start + sequence.frames])
        if low < high:
            chosen = tree.frames(take, checked.rate, drawn[low:high] - sequence.start)
            for row, frame in zip(range(low, high), chosen, strict=True):
                vertices[row] = _millimetres(common.check(*frame), checked.scale)
        progress(len(sequences) + done, 2 * len(sequences))
    neutral.flush()
    vertices.flush()
    counts = {"subjects": subjects, "sequences": len(sequences), "frames": rows, "meshes": len(drawn)}
    counts |= {"vertices": shape[0], "landmarks": len(checked.index)}
    splits = _splits(subjects)
    index = {
        "schema": store.SCHEMA,
        "name": "folder",
        "version": VERSION,
        "spec": {
            "root": found.root.resolve().name,
            "unit": checked.unit,
            "rate": checked.rate,
            **counts,
            "landmarks_sha256": hashlib.sha256(checked.index.tobytes()).hexdigest(),
            "files_sha256": found.fingerprint(),
        },
        "unit": "mm",
        "rate": checked.rate,
        "labels": found.labels,
        "shapes": shapes,
        "hashes": {name: files.sha256(folder / f"{name}.npy") for name in shapes},
        "subjects": [{"name": name, "split": split} for name, split in zip(found.names, splits, strict=True)],
        "sequences": [sequence._asdict() for sequence in sequences],
        "notes": checked.notes,
    }
    (folder / "index.json").write_text(json.dumps(index))


def _landmarks(path: Path, common: tree.Common) -> tuple[np.ndarray, float | None]:
    """Landmarks as vertices (L,); where the file gives positions, how far from its vertex the farthest of them lies."""
    try:
        found = landmarks.read(path, common.vertices, common.faces)
    except landmarks.LandmarkError as error:
        raise FolderError(str(error)) from error
    if len(found.points) < LEAST:
        raise FolderError(f"{path}: {len(found.points)} landmarks, expected {LEAST} or more")
    if found.index is not None:
        return found.index.astype(np.int32), None
    distance, nearest = cKDTree(common.vertices).query(found.points)
    return nearest.astype(np.int32), float(distance.max())


def _unit(common: tree.Common, index: np.ndarray, unit: str | None) -> tuple[str, float]:
    """The unit's name and its millimetres: as named, by 68 landmarks, or by the size of the whole mesh."""
    if unit is not None:
        return UNITS[unit], faces.UNITS[UNITS[unit]]
    points = common.vertices[index]
    try:
        if len(index) == 68:
            scale, name = faces.unit_of(float(np.linalg.norm(points - points.mean(axis=0))) / SPREAD, common.name)
        else:
            scale, name = faces.unit_of_head(tree.size(common.vertices), common.name)
    except meshes.MeshError as error:
        raise FolderError(f"{error}; or name the unit: {', '.join(UNITS)}") from error
    return name, scale


def _splits(subjects: int) -> list[str]:
    return ["train" if subjects < 3 else makehuman4d.split_of(i, subjects) for i in range(subjects)]


def _energy(curve: np.ndarray, rest: np.ndarray) -> np.ndarray:
    """How far landmarks (T, L, 3) are from those at rest (L, 3) in the mean, (T,)."""
    return np.linalg.norm(curve - rest, axis=-1).mean(axis=-1)


def _millimetres(vertices: np.ndarray, scale: float) -> np.ndarray:
    return (vertices * scale).astype(np.float32)
