"""Import of recordings into a dataset: every frame is checked and written once, by all processors, and can resume.

Frames are read one at a time. Unfinished work is kept in a hidden folder beside the dataset. An error in the recordings
removes it; an interruption, a lost process or a full disk keep it, and the same request then resumes there and gives
the same bytes. All meshes must share one vertex order, triangles and unit; y up, z forward. T frames, N vertices,
L landmarks.
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
from scipy import spatial

from facejax.data import dataset
from facejax.data.importers import apex_detection, base, worker
from facejax.data.importers.base import Source, SourceError
from facejax.data.synthetic import makehuman4d
from facejax.io import atomic, landmarks
from facejax.landmarks import canonical_frame, schemes

VERSION = 1
SEED = 1
UNITS = {"mm": "millimetres", "cm": "centimetres", "m": "metres"}
SPREAD_RATIO_RANGE = (0.5, 2.0)  # spread of 68 landmarks relative to the template, in a unit that the user names
SIZE_RANGE_MM = (40.0, 5000.0)  # of a whole mesh: from a face to a whole body
MAX_LANDMARK_DISTANCE = 0.05  # of a landmark from its vertex, relative to the size of the mesh
MIN_LANDMARKS = 4  # fewer do not span 3D space
MAX_MESHES = 20_000  # stored by default
Progress = Callable[[int, int], None]


class Request(NamedTuple):
    """Options of an import besides the recordings."""

    landmarks: Path | None
    unit: str | None = None
    max_meshes: int = MAX_MESHES
    remove_head_motion: bool = False
    phases: Mapping[int, apex_detection.Phases] = {}  # by number of recording; those of the others are detected


def prepare(
    source: Source,
    out: str | os.PathLike[str],
    request: Request,
    *,
    workers: int | None = None,
    progress: Progress | None = None,
) -> dataset.Dataset:
    """Import recordings into a new dataset at `out`, in millimetres; `index["notes"]` lists assumptions and oddities.

    Args:
      source: as returned by a layout's `scan`.
      out: the folder of the dataset; it must not exist.
      request: `landmarks` is a file of 4 or more landmarks of the first subject's neutral mesh, as read by
        `facejax.io.landmarks`; positions and barycentric landmarks are moved to the nearest vertices. `unit`: "mm",
        "cm" or "m"; by default inferred from the size of the face. `max_meshes`: number of meshes stored, a sample with
        a fixed seed; landmarks are stored for all frames.
      workers: processes; by default one per processor where there are many frames.
      progress: called with (done, total) recordings.

    Raises:
      SourceError: `out` exists, or the recordings or the request cannot be used; nothing is left at `out`.
    """
    out, progress = Path(out), progress or (lambda done, total: None)
    check_request(source, out, request)
    if workers is not None and workers < 1:
        raise SourceError(f"workers: expected 1 or more, got {workers}")
    job, notes = _job(source, out, request)
    try:
        _begin(job, _request_hash(job, request))
        worker.import_all(job, workers, progress)
        _finish(job, notes, job.part / "dataset")
        os.replace(job.part / "dataset", out)
    except SourceError:
        shutil.rmtree(job.part, ignore_errors=True)
        raise
    shutil.rmtree(job.part)
    return dataset.open_dataset(out)


def check_request(source: Source, out: Path, request: Request) -> None:
    """Raise `SourceError` for a request that cannot be fulfilled, before any frame is read."""
    if request.unit is not None and request.unit not in UNITS:
        raise SourceError(f"unit: expected {', '.join(UNITS)} or None, got {request.unit!r}")
    if not 0 < source.rate <= 1000:
        raise SourceError(f"rate: expected frames per second above 0, up to 1000, got {source.rate}")
    if request.max_meshes < 1:
        raise SourceError(f"max_meshes (--meshes): expected 1 or more, got {request.max_meshes}")
    if source.landmarks_only and request.landmarks is not None:
        raise SourceError(
            f"--landmarks is not supported by the {source.layout} importer: its frames consist of landmarks"
        )
    if request.landmarks is None and source.landmarks is None:
        raise SourceError(f"--landmarks is required by the {source.layout} importer")
    if os.path.lexists(out):
        raise SourceError(f"{out}: already exists; remove it, or name another folder")
    if out.resolve().is_relative_to(source.root.resolve()):
        raise SourceError(f"{out}: is inside the source folder {source.root}; name a folder outside")
    above = next(folder for folder in out.absolute().parents if folder.exists())
    if not above.is_dir() or not os.access(above, os.W_OK | os.X_OK):
        reason = "not writable" if above.is_dir() else "not a folder"
        raise SourceError(f"{out}: cannot be created, {above} is {reason}")


def _job(source: Source, out: Path, request: Request) -> tuple[worker.Job, list[str]]:
    """Return what is known before the recordings are read, and notes on assumptions."""
    reference = base.reference_mesh(source)
    index, distance = _landmark_vertices(request.landmarks, source, reference)
    unit, scale = _unit(reference, index, request.unit or source.unit)
    size = base.bounding_box_size(reference.vertices)
    notes = [f"read as {unit}: {reference.name} is {size * scale:.3g} mm in size"]
    if distance is not None:
        notes.append(
            f"{request.landmarks}: positions moved to the nearest vertices, by {distance * scale:.2g} mm or less"
        )
    if duplicates := len(index) - len(np.unique(index)):
        notes.append(f"{request.landmarks}: {duplicates} of {len(index)} landmarks share a vertex with another")
    notes += _landmark_notes(reference.vertices[index], request.landmarks)
    people = range(len(source.people))
    neutral = [worker.to_millimetres(base.neutral_vertices(source, i, reference), scale) for i in people]
    starts = np.cumsum([0, *(recording.num_frames for recording in source.recordings)])
    count = 0 if source.landmarks_only else request.max_meshes
    drawn = np.sort(np.random.default_rng([SEED, 2**20]).permutation(int(starts[-1]))[:count])
    part = out.absolute().parent / f".{out.name}.part"
    stable = worker.stable_landmarks(index) if request.remove_head_motion else None
    phases = dict(request.phases)
    job = worker.Job(source, reference, index, unit, scale, np.stack(neutral), starts, drawn, part, stable, phases)
    return job, notes


def _request_hash(job: worker.Job, request: Request) -> str:
    """Return a hash of everything that determines the dataset's bytes and the files of unfinished work."""
    source = job.source
    stats = [(path.as_posix(), path.stat().st_size, path.stat().st_mtime_ns) for path in source.files]
    rows = [(*one[:3], *one[5:]) for one in source.recordings]  # without paths
    parts = [source.layout, source.rate, source.people, rows, stats, job.landmark_index.tolist(), job.scale]
    parts += [request.max_meshes, request.remove_head_motion, sorted(request.phases.items()), VERSION]
    parts += [worker.Result._fields]
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()


def _begin(job: worker.Job, request_hash: str) -> None:
    """Create the folder of unfinished work, or keep that of the same request."""
    part = job.part
    mark = part / "request"
    if mark.exists() and mark.read_text() == request_hash:
        return
    shutil.rmtree(part, ignore_errors=True)
    (part / "dataset").mkdir(parents=True)
    (part / "done").mkdir()
    shape = (len(job.drawn), *job.reference.vertices.shape)
    np.lib.format.open_memmap(part / "dataset" / "vertices.npy", "w+", np.float32, shape).flush()
    with atomic.replace_file(mark) as temporary:
        temporary.write_text(request_hash)


def _finish(job: worker.Job, notes: list[str], folder: Path) -> None:
    """Write the files of the dataset besides the meshes, which are there already."""
    source, people = job.source, job.source.people
    rows, count = int(job.starts[-1]), len(job.landmark_index)
    arrays = {
        "faces": np.asarray(job.reference.faces),
        "neutral": job.neutral,
        "drawn": job.drawn,
        "landmark_index": job.landmark_index,
    }
    for name, array in arrays.items():
        np.save(folder / f"{name}.npy", array)
    curves = np.lib.format.open_memmap(folder / "landmarks.npy", "w+", np.float32, (rows, count, 3))
    sequences, results = [], []
    for number, recording in enumerate(source.recordings):
        result = worker.load_result(job, number)
        start, frames = int(job.starts[number]), recording.num_frames
        curves[start : start + frames] = result.curve
        owner, label, seconds = recording.subject, recording.label, frames / source.rate
        sequences.append(dataset.Sequence(owner, label, start, frames, *result.phases, seconds, recording.name))
        results.append(result)
    curves.flush()
    splits = _splits(people)
    shapes = {name: array.shape for name, array in arrays.items()} | {"landmarks": curves.shape}
    shapes["vertices"] = (len(job.drawn), *job.reference.vertices.shape)
    sizes = {"subjects": len(people), "sequences": len(sequences), "frames": rows, "meshes": len(job.drawn)}
    sizes |= {"vertices": job.reference.vertices.shape[0], "landmarks": count}
    phases = [[number, *phases] for number, phases in sorted(job.phases.items())]
    index: dict[str, Any] = {
        "schema": dataset.SCHEMA,
        "name": source.layout,
        "version": VERSION,
        "spec": {
            "root": source.root.resolve().name,
            "unit": job.unit,
            "rate": source.rate,
            **sizes,
            "held": job.stable is not None,
            "cuts_sha256": hashlib.sha256(json.dumps(phases).encode()).hexdigest() if phases else None,
            "landmarks_sha256": hashlib.sha256(job.landmark_index.tobytes()).hexdigest(),
            "files_sha256": base.fingerprint(source),
        },
        "unit": "mm",
        "rate": source.rate,
        "labels": source.labels,
        "shapes": shapes,
        "hashes": {name: atomic.sha256(folder / f"{name}.npy") for name in shapes},
        "subjects": [
            {"name": person.name, "split": split} | person.attributes
            for person, split in zip(people, splits, strict=True)
        ],
        "sequences": [sequence._asdict() for sequence in sequences],
        "notes": notes + worker.notes(job, results) + _empty_split_notes(people, splits) + list(source.notes),
    }
    (folder / "index.json").write_text(json.dumps(index))


def _landmark_vertices(
    path: Path | None, source: Source, reference: base.ReferenceMesh
) -> tuple[np.ndarray, float | None]:
    """Return landmarks as vertex indices (L,), and for a file of positions the largest distance to a vertex."""
    if path is None:
        return np.asarray(source.landmarks, np.int32), None
    try:
        found = landmarks.read(path, reference.vertices, reference.faces)
    except landmarks.LandmarkError as error:
        raise SourceError(str(error)) from error
    if len(found.points) < MIN_LANDMARKS:
        raise SourceError(f"{path}: {len(found.points)} landmarks, expected {MIN_LANDMARKS} or more")
    if found.index is not None:
        return found.index.astype(np.int32), None
    distance, nearest = spatial.KDTree(reference.vertices).query(found.points)
    size = base.bounding_box_size(reference.vertices)
    if distance.max() > MAX_LANDMARK_DISTANCE * size:
        worst = int(np.argmax(distance))
        raise SourceError(
            f"{path}: landmark {worst} is {distance[worst]:.3g} away from {reference.name}, whose size is {size:.3g}: "
            "another unit, or another mesh?"
        )
    return np.asarray(nearest, np.int32), float(distance.max())


def _landmark_notes(points: np.ndarray, path: Path | None) -> list[str]:
    """Note landmarks (L, 3) of a known scheme that are not arranged like those of a face."""
    template = canonical_frame.template68()
    try:
        in_template, in_points = schemes.common(len(template), len(points))
    except ValueError:
        return []
    try:
        canonical_frame.align_to_template(points[in_points], template[in_template])
    except ValueError as error:
        return [f"{path}: {error}; used without changes"]
    return []


def _unit(reference: base.ReferenceMesh, index: np.ndarray, unit: str | None) -> tuple[str, float]:
    """Return a unit's name and its millimetres: as given, or inferred from 68 landmarks or the size of the mesh."""
    name, size = reference.name, base.bounding_box_size(reference.vertices)
    template, spread = canonical_frame.template68(), None
    if len(index) == len(template):
        spread = canonical_frame.centred_norm(reference.vertices[index]) / canonical_frame.centred_norm(template)
    if unit is not None:
        scale = canonical_frame.UNITS[UNITS[unit]]
        fits = SIZE_RANGE_MM[0] < size * scale < SIZE_RANGE_MM[1]
        if not (fits and (spread is None or SPREAD_RATIO_RANGE[0] < spread * scale < SPREAD_RATIO_RANGE[1])):
            raise SourceError(f"{name}: {size * scale:.3g} mm in size, read as {UNITS[unit]}: another unit?")
        return UNITS[unit], scale
    try:
        scale, found = (
            canonical_frame.infer_head_unit(size, name) if spread is None else canonical_frame.infer_unit(spread, name)
        )
    except canonical_frame.FaceError as error:
        raise SourceError(f"{error}; or name the unit: {', '.join(UNITS)}") from error
    return found, scale


def _splits(people: tuple[base.Person, ...]) -> list[str]:
    """Return each person's split: that of the table of people, else by order."""
    count = len(people)
    by_order = [("train" if count < 3 else makehuman4d.split_of(i, count)) for i in range(count)]
    return [person.attributes.get("split") or split for person, split in zip(people, by_order, strict=True)]


def _empty_split_notes(people: tuple[base.Person, ...], splits: list[str]) -> list[str]:
    empty = [split for split in dataset.SPLITS if split not in splits]
    from_table = any(person.attributes.get("split") for person in people)
    reason = "as the table of people defines" if from_table else f"4 subjects or more are needed, got {len(splits)}"
    return [f"no subjects in the splits {' and '.join(empty)}: {reason}"] if empty else []
