"""A store of recordings: every frame checked and written once, by all processors; stopped at any moment, it goes on.

Frames are read one at a time. What is done lies in a hidden folder beside the store until all is done. Something wrong
with the recordings takes it away again; an interruption, a process lost or a full disk leave it, and the same request
goes on there and comes to the same bytes. One order of vertices, the same triangles, one unit; y up, z forward.
T frames, N vertices, L landmarks.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from facejax.data import dataset
from facejax.data.importers import apex_detection, base, worker
from facejax.data.importers.base import Source, SourceError
from facejax.data.synthetic import makehuman4d
from facejax.io import atomic, landmarks
from facejax.landmarks import canonical_frame, schemes

VERSION = 1
SEED = 1
UNITS = {"mm": "millimetres", "cm": "centimetres", "m": "metres"}
SPREAD_RATIO_RANGE = (0.5, 2.0)  # of it: what a named unit may make of 68 landmarks
SIZE_RANGE_MM = (40.0, 5000.0)  # mm, of a whole mesh: a face, or all of a person
MAX_LANDMARK_DISTANCE = 0.05  # of the mesh's size, that a landmark may lie off its surface
MIN_LANDMARKS = 4  # landmarks: fewer span no space
MAX_MESHES = 20_000  # meshes that are stored
Progress = Callable[[int, int], None]


class Request(NamedTuple):
    """What is asked for besides the recordings."""

    landmarks: Path | None
    unit: str | None = None
    max_meshes: int = MAX_MESHES
    remove_head_motion: bool = False  # take the head's rigid motion out
    phases: Mapping[int, cuts.Cuts] = {}  # of takes, by number; the others are found


def prepare(
    recordings: Source,
    out: str | os.PathLike,
    request: Request,
    *,
    workers: int | None = None,
    progress: Progress | None = None,
) -> dataset.Dataset:
    """Read recordings into a new store at `out`, in millimetres; `index["notes"]` says what was assumed and is odd.

    Args:
      recordings: what a layout's `scan` found.
      request: `landmarks` is a file of 4 or more landmarks of the first subject's neutral mesh, as
        `facejax.io.landmarks` reads it; positions, and places on triangles, go to the nearest vertices. `unit`: "mm",
        "cm" or "m"; by default recognised by the size of the face. `most`: how many meshes are stored, drawn by a fixed
        seed; landmarks are stored of all frames.
      workers: processes; by default one for each processor where there is much to read.
      progress: called with (done, total) recordings.

    Raises:
      SourceError: `out` is there already, or something is wrong with the recordings; nothing is left then.
    """
    out, progress = Path(out), progress or (lambda done, total: None)
    check_request(recordings, out, request)
    if workers is not None and workers < 1:
        raise SourceError(f"workers: expected 1 or more, got {workers}")
    job, notes = _job(recordings, out, request)
    part = out.absolute().parent / f".{out.name}.part"
    try:
        _begin(part, job, _key(job, request))
        worker.import_all(job, workers, progress)
        _finish(job, notes, part / "store")
        os.replace(part / "store", out)
    except SourceError:
        shutil.rmtree(part, ignore_errors=True)
        raise
    shutil.rmtree(part)
    return dataset.open_dataset(out)


def check_request(recordings: Source, out: Path, request: Request) -> None:
    """Raise `SourceError` for what cannot be met, before an hour of reading."""
    if request.unit is not None and request.unit not in UNITS:
        raise SourceError(f"unit: expected {', '.join(UNITS)} or None, got {request.unit!r}")
    if not 0 < recordings.rate <= 1000:
        raise SourceError(f"rate: expected frames per second above 0, up to 1000, got {recordings.rate}")
    if request.most < 1:
        raise SourceError(f"most (--meshes): expected 1 mesh or more, got {request.most}")
    if recordings.landmarks_only and request.landmarks is not None:
        raise SourceError(f"{recordings.layout}: has no --landmarks, its frames are landmarks themselves")
    if request.landmarks is None and recordings.landmarks is None:
        raise SourceError(f"{recordings.layout}: its meshes need a file of landmarks")
    if os.path.lexists(out):
        raise SourceError(f"{out}: is there already; remove it, or name another folder")
    if out.resolve().is_relative_to(recordings.root.resolve()):
        raise SourceError(f"{out}: lies among the meshes in {recordings.root}; name a folder outside")
    above = next(folder for folder in out.absolute().parents if folder.exists())
    if not above.is_dir() or not os.access(above, os.W_OK | os.X_OK):
        raise SourceError(f"{out}: cannot be made, {above} is {'not writable' if above.is_dir() else 'not a folder'}")


def _job(found: Source, out: Path, request: Request) -> tuple[worker.Job, list[str]]:
    """All that is known before the recordings are read, and what was assumed."""
    shared = base.reference_mesh(found)
    index, apart = _landmarks(request.landmarks, found, shared)
    unit, scale = _unit(shared, index, request.unit or found.unit)
    notes = [f"read as {unit}: {shared.name} is {base.bounding_box_size(shared.vertices) * scale:.3g} mm in size"]
    if apart is not None:
        notes.append(
            f"{request.landmarks}: positions went to the nearest vertices, {apart * scale:.2g} mm away at most"
        )
    if shared_by := len(index) - len(np.unique(index)):
        notes.append(f"{request.landmarks}: {shared_by} of {len(index)} landmarks share a vertex with another")
    notes += _faceless(shared.vertices[index], request.landmarks)
    neutral = np.stack([worker.to_millimetres(base.neutral_vertices(found, i, shared), scale) for i in range(len(found.people))])
    starts = np.cumsum([0, *(take.count for take in found.takes)])
    most = 0 if found.landmarks_only else request.most
    drawn = np.sort(np.random.default_rng([SEED, 2**20]).permutation(int(starts[-1]))[:most])
    part = out.absolute().parent / f".{out.name}.part"
    hold = worker.stable_landmarks(index) if request.hold else None
    return worker.Job(found, shared, index, unit, scale, neutral, starts, drawn, part, hold, dict(request.cuts)), notes


def _key(job: worker.Job, request: Request) -> str:
    """What the bytes depend on."""
    found = job.source
    stats = [(path.as_posix(), path.stat().st_size, path.stat().st_mtime_ns) for path in found.files]
    rows = [take._replace(path="", frames=()) for take in found.takes]
    parts = [found.layout, found.rate, found.people, rows, stats, job.index.tolist(), job.scale]
    parts += [request.most, request.hold, sorted(request.cuts.items()), VERSION]
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()


def _begin(part: Path, job: worker.Job, key: str) -> None:
    """Make the folder of what is done, or go on in the one that is there, where it is of the same request."""
    mark = part / "request"
    if mark.exists() and mark.read_text() == key:
        return
    shutil.rmtree(part, ignore_errors=True)
    (part / "store").mkdir(parents=True)
    (part / "done").mkdir()
    shape = (len(job.drawn), *job.common.vertices.shape)
    np.lib.format.open_memmap(part / "store" / "vertices.npy", "w+", np.float32, shape).flush()
    with atomic.replace_file(mark) as temporary:
        temporary.write_text(key)


def _finish(job: worker.Job, notes: list[str], folder: Path) -> None:
    """The files of the store besides the meshes, which lie there."""
    found, people = job.source, job.source.people
    rows, count = int(job.starts[-1]), len(job.index)
    whole = {
        "faces": job.common.faces,
        "neutral": job.neutral,
        "drawn": job.drawn,
        "landmark_index": job.index,
    }
    for name, array in whole.items():
        np.save(folder / f"{name}.npy", array)
    curves = np.lib.format.open_memmap(folder / "landmarks.npy", "w+", np.float32, (rows, count, 3))
    sequences, said = [], []
    for number, take in enumerate(found.takes):
        done = worker.load_result(job, number)
        start = int(job.starts[number])
        curves[start : start + take.count] = done.curve
        timing = (*done.cuts, take.count / found.rate)
        sequences.append(dataset.Sequence(take.subject, take.label, start, take.count, *timing, name=take.name))
        said.append(done)
    curves.flush()
    splits = _splits(people)
    shapes = {name: array.shape for name, array in whole.items()} | {"landmarks": curves.shape}
    shapes["vertices"] = (len(job.drawn), *job.common.vertices.shape)
    sizes = {"subjects": len(people), "sequences": len(sequences), "frames": rows, "meshes": len(job.drawn)}
    sizes |= {"vertices": job.common.vertices.shape[0], "landmarks": count}
    index: dict[str, Any] = {
        "schema": dataset.SCHEMA,
        "name": found.layout,
        "version": VERSION,
        "spec": {
            "root": found.root.resolve().name,
            "unit": job.unit,
            "rate": found.rate,
            **sizes,
            "held": job.hold is not None,
            "cuts_sha256": hashlib.sha256(repr(sorted(job.cuts.items())).encode()).hexdigest() if job.cuts else None,
            "landmarks_sha256": hashlib.sha256(job.index.tobytes()).hexdigest(),
            "files_sha256": base.fingerprint(found),
        },
        "unit": "mm",
        "rate": found.rate,
        "labels": found.labels,
        "shapes": shapes,
        "hashes": {name: atomic.sha256(folder / f"{name}.npy") for name in shapes},
        "subjects": [{"name": who.name, "split": split} | who.about for who, split in zip(people, splits, strict=True)],
        "sequences": [sequence._asdict() for sequence in sequences],
        "notes": notes + worker.notes(job, said) + _lacking(people, splits) + list(found.notes),
    }
    (folder / "index.json").write_text(json.dumps(index))


def _landmarks(path: Path | None, found: Source, shared: base.ReferenceMesh) -> tuple[np.ndarray, float | None]:
    """Landmarks as vertices (L,); where the file gives places, how far from its vertex the farthest of them lies."""
    if path is None:
        return found.landmarks.astype(np.int32), None
    try:
        marks = landmarks.read(path, shared.vertices, shared.faces)
    except landmarks.LandmarkError as error:
        raise SourceError(str(error)) from error
    if len(marks.points) < MIN_LANDMARKS:
        raise SourceError(f"{path}: {len(marks.points)} landmarks, expected {MIN_LANDMARKS} or more")
    if marks.index is not None:
        return marks.index.astype(np.int32), None
    distance, nearest = cKDTree(shared.vertices).query(marks.points)
    if distance.max() > MAX_LANDMARK_DISTANCE * base.bounding_box_size(shared.vertices):
        worst = int(np.argmax(distance))
        raise SourceError(
            f"{path}: landmark {worst} lies {distance[worst]:.3g} off {shared.name}, which is "
            f"{base.bounding_box_size(shared.vertices):.3g} in size: another unit, or another mesh?"
        )
    return nearest.astype(np.int32), float(distance.max())


def _faceless(points: np.ndarray, path: Path | None) -> list[str]:
    """What to say of landmarks of a known scheme that do not look like a face."""
    known = canonical_frame.template68()
    try:
        there, here = schemes.common(len(known), len(points))
    except ValueError:
        return []
    try:
        canonical_frame.align_to_template(points[here], known[there])
    except ValueError as error:
        return [f"{path}: {error}; they are taken as they are"]
    return []


def _unit(shared: base.ReferenceMesh, index: np.ndarray, unit: str | None) -> tuple[str, float]:
    """The unit's name and its millimetres: as named, by 68 landmarks, or by the size of the whole mesh."""
    points, size = shared.vertices[index], base.bounding_box_size(shared.vertices)
    known = canonical_frame.template68()
    spread = canonical_frame.centred_norm(points) / canonical_frame.centred_norm(known) if len(index) == len(known) else None
    if unit is not None:
        scale = canonical_frame.UNITS[UNITS[unit]]
        fits = SIZE_RANGE_MM[0] < size * scale < SIZE_RANGE_MM[1] and (spread is None or SPREAD_RATIO_RANGE[0] < spread * scale < SPREAD_RATIO_RANGE[1])
        if not fits:
            raise SourceError(f"{shared.name}: {size * scale:.3g} mm in size, read as {UNITS[unit]}: another unit?")
        return UNITS[unit], scale
    try:
        scale, name = (
            canonical_frame.infer_head_unit(size, shared.name)
            if spread is None
            else canonical_frame.infer_unit(spread, shared.name)
        )
    except canonical_frame.FaceError as error:
        raise SourceError(f"{error}; or name the unit: {', '.join(UNITS)}") from error
    return name, scale


def _splits(people: tuple[base.Person, ...]) -> list[str]:
    """Each person's split: as a table says, else by their order."""
    count = len(people)
    return [
        who.about.get("split") or ("train" if count < 3 else makehuman4d.split_of(i, count))
        for i, who in enumerate(people)
    ]


def _lacking(people: tuple[base.Person, ...], splits: list[str]) -> list[str]:
    lacking = [split for split in dataset.SPLITS if split not in splits]
    told = any(who.about.get("split") for who in people)
    why = "as the table of people has it" if told else f"all splits need 4 subjects or more, got {len(splits)}"
    return [f"nobody serves {' and '.join(lacking)}: {why}"] if lacking else []
