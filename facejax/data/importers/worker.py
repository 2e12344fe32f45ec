"""Recordings read, checked and written one after the other, by one process or several.

Each recording that is done leaves a file, so that it is not read again. T frames, N vertices, L landmarks.
"""

from __future__ import annotations

import concurrent.futures
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

MIN_PARALLEL_FRAMES = 2_000  # frames, from which on other processes are worth their start


class Job(NamedTuple):
    """All that a recording is read with."""

    source: base.Source
    common: base.ReferenceMesh
    index: np.ndarray  # (L,) int32 landmarks as vertices
    unit: str  # its name
    scale: float  # its millimetres
    neutral: np.ndarray  # (S, N, 3) float32 mm
    starts: np.ndarray  # of each recording's rows, and their end
    drawn: np.ndarray  # (G,) rows whose meshes are kept
    part: Path  # the folder of what is done
    hold: np.ndarray | None  # landmarks that stay put in the head's own frame, to take its motion out
    cuts: dict[int, apex_detection.Phases]


class Result(NamedTuple):
    """A recording that was read."""

    curve: np.ndarray  # (T, L, 3) float32 mm
    cuts: apex_detection.Phases
    restless: tuple[bool, bool]  # does not begin, does not end at rest
    visits: int  # how often it goes to an expression and comes home
    jumps: list[int]


def import_all(job: Job, workers: int | None, progress: Callable[[int, int], None]) -> None:
    """Do what is not done yet. Raises `SourceError` of the first recording in order that has something wrong."""
    total = len(job.source.takes)
    todo = [number for number in range(total) if not _path(job, number).exists()]
    frames = sum(job.source.takes[number].count for number in todo)
    workers = workers or (min(os.cpu_count() or 1, len(todo)) if frames > MIN_PARALLEL_FRAMES else 1)
    if workers <= 1:
        for done, number in enumerate(todo, 1):
            import_recording(job, number)
            progress(total - len(todo) + done, total)
        return
    # Spawned, not forked: a fork of a process whose libraries run threads can hang.
    context = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(workers, context, _start, (job,)) as pool:
        try:
            for done, _ in enumerate(pool.map(_do, todo), 1):
                progress(total - len(todo) + done, total)
        except BaseException:
            pool.shutdown(wait=True, cancel_futures=True)
            raise


def import_recording(job: Job, number: int) -> None:
    """Read and check a recording, write its drawn meshes into the store, and leave the rest in a file."""
    take, start = job.source.takes[number], int(job.starts[number])
    if take.count < 2:
        raise SourceError(f"{take.path}: 1 frame, expected 2 or more")
    rest = job.neutral[take.subject]
    curve = np.empty((take.count, len(job.index), 3), np.float32)
    low, high = np.searchsorted(job.drawn, [start, start + take.count])
    place = dict(zip((job.drawn[low:high] - start).tolist(), range(low, high), strict=True))
    kept = np.lib.format.open_memmap(job.part / "store" / "vertices.npy", "r+") if place else None
    read = -1
    for read, frame in enumerate(job.source.read(take, None)):
        if read >= take.count:
            break
        vertices = to_millimetres(job.common.check(*frame), job.scale)
        if job.hold is not None:
            vertices = _held(vertices, rest, job.index[job.hold])
        curve[read] = vertices[job.index]
        if read in place:
            kept[place[read]] = vertices
    if read + 1 != take.count:
        raise SourceError(f"{take.path}: has changed, expected {take.count} frames")
    if kept is not None:
        kept.flush()
    marks = rest[job.index]
    if apex_detection.mean_displacement(curve, marks).max() < apex_detection.MIN_MOTION_MM:
        raise SourceError(f"{take.path}: its landmarks never leave the face at rest, expected a motion")
    cut = job.cuts.get(number) or take.cuts or apex_detection.detect(curve, marks)
    restless = apex_detection.not_at_rest(curve, marks, apex_detection.Phases(*cut))
    with atomic.replace_file(_path(job, number)) as temporary:
        visits = apex_detection.count_returns(curve, marks)
        jumps = np.array(apex_detection.detect_jumps(curve), np.int64)
        np.savez(temporary, curve=curve, cuts=cut, restless=restless, visits=visits, jumps=jumps)


def load_result(job: Job, number: int) -> Result:
    """What `import_recording` left."""
    with np.load(_path(job, number), allow_pickle=False) as found:
        cut = apex_detection.Phases(*found["cuts"].tolist())
        restless, visits = tuple(found["restless"].tolist()), int(found["visits"])
        return Result(found["curve"], cut, restless, visits, found["jumps"].tolist())


def notes(job: Job, done: list[Result]) -> list[str]:
    """What is odd in the recordings."""
    said, names = [], [take.name for take in job.source.takes]
    for i, verb in enumerate(("begin", "end")):
        which = [name for name, one in zip(names, done, strict=True) if one.restless[i]]
        if which:
            said.append(
                f"{len(which)} of {len(names)} recordings do not {verb} at rest: {base.abbreviate_names(which)}"
            )
    several = [name for name, one in zip(names, done, strict=True) if one.visits > 1]
    if several:
        said.append(
            f"{len(several)} of {len(names)} recordings come home more than once, as if they held several expressions: "
            f"{base.abbreviate_names(several)}"
        )
    jumps = [f"{name} frame {frame}" for name, one in zip(names, done, strict=True) for frame in one.jumps]
    if jumps:
        said.append(f"the landmarks jump at {base.abbreviate_names(jumps)}")
    return said


def stable_landmarks(index: np.ndarray) -> np.ndarray:
    """Which of L landmarks stay put in the head's own frame. Raises `SourceError` where the scheme is unknown."""
    try:
        return np.asarray(schemes.by_count(len(index)).stable)
    except ValueError as error:
        raise SourceError(f"to hold heads still, landmarks of a known scheme are needed: {error}") from error


def to_millimetres(vertices: np.ndarray, scale: float) -> np.ndarray:
    """float32, in mm."""
    return (vertices * scale).astype(np.float32)


def _held(vertices: np.ndarray, rest: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Vertices (N, 3) turned and moved so that those at `at` lie as near as can be to where they rest."""
    rotation, from_, to = host.procrustes(vertices[at], rest[at])
    return ((vertices - from_) @ rotation.T + to).astype(np.float32)


def _path(job: Job, number: int) -> Path:
    return job.part / "done" / f"{number:06d}.npz"


_JOB: Job | None = None  # of this process


def _start(job: Job) -> None:
    global _JOB
    _JOB = job
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent is told, and lets recordings come to their end
    threading.Thread(target=_follow, daemon=True).start()


def _follow() -> None:
    """End with the parent, however that ends."""
    multiprocessing.parent_process().join()
    os._exit(1)


def _do(number: int) -> None:
    import_recording(_JOB, number)
