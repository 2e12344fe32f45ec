"""Import of single recordings: read, check and write them, in one process or several.

Each recording that is done leaves a result file, so that an interrupted import resumes without reading it again.
T frames, N vertices, L landmarks, S subjects, G stored meshes.
"""

from __future__ import annotations

import concurrent.futures
import functools
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from facejax.data.importers import apex_detection, base
from facejax.data.importers.base import SourceError
from facejax.geometry import host
from facejax.io import atomic
from facejax.landmarks import schemes

MIN_PARALLEL_FRAMES = 2_000  # below, starting other processes takes longer than it saves


class Job(NamedTuple):
    """Everything that the import of a recording depends on."""

    source: base.Source
    reference: base.ReferenceMesh
    landmark_index: np.ndarray  # (L,) int32 vertex indices
    unit: str  # name of the source's unit
    scale: float  # millimetres per unit
    neutral: np.ndarray  # (S, N, 3) float32 mm
    starts: np.ndarray  # first row of each recording, and the number of rows
    drawn: np.ndarray  # (G,) rows whose meshes are stored
    part: Path  # folder of unfinished work
    stable: np.ndarray | None  # landmarks that hardly move relative to the skull, to remove head motion
    phases: dict[int, apex_detection.Phases]  # known ones, by number of recording


class Result(NamedTuple):
    """The part of an imported recording that is kept besides its meshes."""

    curve: np.ndarray  # (T, L, 3) float32 mm
    phases: apex_detection.Phases
    not_at_rest: tuple[bool, bool]  # does not begin, does not end at rest
    returns: int  # number of separate expressions
    jumps: list[int]  # frames that the landmarks jump to


def import_all(job: Job, workers: int | None, progress: Callable[[int, int], None]) -> None:
    """Import all recordings that are not done yet.

    Args:
      job: of all recordings.
      workers: processes; None takes one per processor where there are many frames.
      progress: called with (done, total) recordings.

    Raises:
      SourceError: of the first recording, in order, that cannot be used.
    """
    total = len(job.source.recordings)
    todo = [number for number in range(total) if not _result_path(job, number).exists()]
    frames = sum(job.source.recordings[number].num_frames for number in todo)
    workers = workers or (min(os.cpu_count() or 1, len(todo)) if frames > MIN_PARALLEL_FRAMES else 1)
    if workers <= 1:
        for done, number in enumerate(todo, 1):
            import_recording(job, number)
            progress(total - len(todo) + done, total)
        return
    # Spawned, not forked: a fork of a process whose libraries run threads can hang.
    context = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(workers, context, _start) as pool:
        try:
            for done, _ in enumerate(pool.map(functools.partial(import_recording, job), todo), 1):
                progress(total - len(todo) + done, total)
        except BaseException:
            pool.shutdown(wait=True, cancel_futures=True)
            raise


def import_recording(job: Job, number: int) -> None:
    """Read and check a recording, write its stored meshes into the dataset, and its `Result` into a file.

    Raises:
      SourceError: a frame cannot be used, the recording has one frame, or contains no motion.
    """
    recording, start = job.source.recordings[number], int(job.starts[number])
    if recording.num_frames < 2:
        raise SourceError(f"{recording.path}: 1 frame, expected 2 or more")
    neutral = job.neutral[recording.subject]
    curve = np.empty((recording.num_frames, len(job.landmark_index), 3), np.float32)
    low, high = np.searchsorted(job.drawn, [start, start + recording.num_frames])
    position = dict(zip((job.drawn[low:high] - start).tolist(), range(low, high), strict=True))
    stored = np.lib.format.open_memmap(job.part / "dataset" / "vertices.npy", "r+") if position else None
    count = 0
    for i, frame in enumerate(job.source.read_frames(recording, None)):
        count = i + 1
        if count > recording.num_frames:
            break
        vertices = to_millimetres(job.reference.check(*frame), job.scale)
        if job.stable is not None:
            vertices = _remove_rigid_motion(vertices, neutral, job.landmark_index[job.stable])
        curve[i] = vertices[job.landmark_index]
        if stored is not None and i in position:
            stored[position[i]] = vertices
    if count != recording.num_frames:
        raise SourceError(f"{recording.path}: changed during the import, expected {recording.num_frames} frames")
    if stored is not None:
        stored.flush()
    rest = neutral[job.landmark_index]
    if apex_detection.mean_displacement(curve, rest).max() < apex_detection.MIN_MOTION_MM:
        raise SourceError(f"{recording.path}: the recording contains no motion")
    known = job.phases.get(number) or recording.phases
    phases = apex_detection.Phases(*known) if known else apex_detection.detect(curve, rest)
    with atomic.replace_file(_result_path(job, number)) as temporary:
        np.savez(
            temporary,
            curve=curve,
            phases=phases,
            not_at_rest=apex_detection.not_at_rest(curve, rest, phases),
            returns=apex_detection.count_returns(curve, rest),
            jumps=np.array(apex_detection.detect_jumps(curve), np.int64),
        )


def load_result(job: Job, number: int) -> Result:
    """Load the result file that `import_recording` wrote."""
    with np.load(_result_path(job, number), allow_pickle=False) as file:
        phases = apex_detection.Phases(*file["phases"].tolist())
        begin, end = file["not_at_rest"].tolist()
        return Result(file["curve"], phases, (begin, end), int(file["returns"]), file["jumps"].tolist())


def notes(job: Job, results: list[Result]) -> list[str]:
    """Return notes on recordings that look unusual."""
    found, names = [], [recording.name for recording in job.source.recordings]
    for i, verb in enumerate(("begin", "end")):
        listed = [name for name, one in zip(names, results, strict=True) if one.not_at_rest[i]]
        if listed:
            found.append(
                f"{len(listed)} of {len(names)} recordings do not {verb} at rest: {base.abbreviate_names(listed)}"
            )
    several = [name for name, one in zip(names, results, strict=True) if one.returns > 1]
    if several:
        found.append(
            f"{len(several)} of {len(names)} recordings return to rest more than once, and may contain several "
            f"expressions: {base.abbreviate_names(several)}"
        )
    jumps = [f"{name} frame {frame}" for name, one in zip(names, results, strict=True) for frame in one.jumps]
    if jumps:
        found.append(f"the landmarks jump at {base.abbreviate_names(jumps)}")
    return found


def stable_landmarks(index: np.ndarray) -> np.ndarray:
    """Return which of L landmarks hardly move relative to the skull. Raises `SourceError` for an unknown scheme."""
    try:
        return np.asarray(schemes.by_count(len(index)).stable)
    except ValueError as error:
        raise SourceError(f"head motion (--hold) cannot be removed: {error}") from error


def to_millimetres(vertices: np.ndarray, scale: float) -> np.ndarray:
    """Return vertices in millimetres, float32."""
    return (vertices * scale).astype(np.float32)


def _remove_rigid_motion(vertices: np.ndarray, neutral: np.ndarray, index: np.ndarray) -> np.ndarray:
    """Align vertices (N, 3) rigidly so that those at `index` fit their neutral positions in the least squares sense."""
    rotation, source, target = host.procrustes(vertices[index], neutral[index])
    return ((vertices - source) @ rotation.T + target).astype(np.float32)


def _result_path(job: Job, number: int) -> Path:
    return job.part / "done" / f"{number:06d}.npz"


def _start() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles it, and lets running recordings finish
    threading.Thread(target=_exit_with_parent, daemon=True).start()


def _exit_with_parent() -> None:
    """Exit when the parent does, even if it is killed."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)
