"""Write animations in the requested formats; show progress on standard error; report files on standard output.

Every file is written atomically.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Protocol

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

from facejax import io
from facejax.inference import pipeline
from facejax.io import atomic, errors
from facejax.viz import eyes_teeth, video
from facejax.viz import scene as viz_scene
from facejax.viz.scene import Scene

VIDEO_FPS = 15.0  # frames per second of videos: half of the motion's, since rendering takes most of the time


def file_stem(labels: Sequence[str]) -> str:
    """Return the file name of a motion through labels; a long sequence is named by its first and last label."""
    whole = "_".join(labels)
    return whole if len(whole) <= 80 else f"{labels[0]}_{labels[-1]}_{len(labels) - 1}_transitions"


def make_output_folder(folder: Path) -> None:
    """Make a folder. Raises `ValueError` where it cannot be made or written to."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(f"{folder}: cannot be made ({error.strerror}); name another folder with --out") from error
    if not os.access(folder, os.W_OK | os.X_OK):
        raise ValueError(f"{folder}: not writable; name another folder with --out")


def report(files: Sequence[Path], notes: Sequence[str] = ()) -> None:
    """Print notes on what was assumed to standard error, and the paths of files to standard output."""
    for note in notes:
        print(errors.one_line(note), file=sys.stderr)
    print("\n".join(str(path) for path in files))


def scene_of(
    models: pipeline.Models,
    neutral: np.ndarray,
    vertices: np.ndarray,
    landmarks: np.ndarray,
    labels: Sequence[str],
    frames: int | Sequence[int],
) -> Scene:
    """Return a generated animation with eyes, teeth and captions.

    Args:
      neutral: (N, 3) vertices at rest; mm.
      vertices: (T, N, 3).
      landmarks: (T, L, 3).
      labels, frames: as of `pipeline.landmarks`.
    """
    rest = np.asarray(pipeline.neutral_landmarks(models, neutral))
    parts = eyes_teeth.parts(eyes_teeth.template(), rest, landmarks)
    captions = pipeline.captions(labels, frames=frames)
    return viz_scene.make(vertices, np.asarray(models.face.faces), captions=captions, landmarks=landmarks, extras=parts)


def save(out: Path, stem: str, suffix: str, scene: Scene, fps: float) -> Path:
    """Write a scene as `out/stem.suffix` ("ply" and "obj": a folder of frames); return the path."""
    path = out / f"{stem}.{suffix}"
    if suffix in ("ply", "obj"):
        path = out / f"{stem}-{suffix}"
        io.meshes.write_sequence(path, scene.vertices, scene.faces, format=suffix)
        return path
    if f".{suffix}" in video.FORMATS:
        every = max(1, round(fps / VIDEO_FPS))
        few = _subsample(scene, every)
        io.save(
            path, few.vertices, few.faces, fps=fps / every, title=stem,
            captions=few.captions, extras=few.extras, size=(256, 320),
        )  # fmt: skip
    elif suffix == "npz":
        io.save(path, scene.vertices, scene.faces, fps=fps, title=stem, landmarks=scene.landmarks)
    else:
        marks = scene.landmarks if suffix == "html" else None
        io.save(
            path, scene.vertices, scene.faces, fps=fps, title=stem,
            captions=scene.captions, extras=scene.extras, landmarks=marks,
        )  # fmt: skip
    return path


def save_all(out: Path, stem: str, formats: Sequence[str], scene: Scene, fps: float) -> list[Path]:
    """Write a scene in every format, and its landmarks (T, L, 3) as NPZ; return the paths."""
    make_output_folder(out)
    written = []
    with progress("writing", len(formats) + 1) as advance:
        for suffix in formats:
            written.append(save(out, stem, suffix, scene, fps))
            advance()
        path = out / f"{stem}-landmarks.npz"
        with atomic.replace_file(path) as temporary:
            np.savez(temporary, landmarks=np.asarray(scene.landmarks), fps=np.float64(fps))
        written.append(path)
        advance()
    return written


def save_landmarks(
    path: Path, landmarks: np.ndarray, labels: Sequence[str], frames: int | Sequence[int], fps: float
) -> Path:
    """Write an NPZ of landmarks (S, T, L, 3), labels, and the first frame of each transition; return the path."""
    starts = np.array([start for start, _ in pipeline.captions(labels, frames=frames)])
    with atomic.replace_file(path) as temporary:
        np.savez(
            temporary, landmarks=np.asarray(landmarks, np.float32), labels=np.array(labels),
            starts=starts, fps=np.float64(fps),
        )  # fmt: skip
    return path


def _subsample(scene: Scene, every: int) -> Scene:
    """Keep each `every`-th frame, and the last one: it is where the motion ends."""
    chosen = np.append(np.arange(0, len(scene.vertices) - 1, every), len(scene.vertices) - 1)
    parts = [p._replace(vertices=p.vertices[chosen]) if p.vertices.ndim == 3 else p for p in scene.extras]
    captions = tuple((-(-start // every), text) for start, text in scene.captions)
    return scene._replace(vertices=scene.vertices[chosen], captions=captions, extras=tuple(parts))


class Advance(Protocol):
    """The function that `progress` yields: without arguments it adds one step, with them it sets both numbers."""

    def __call__(self, done: int | None = None, total: int | None = None) -> None: ...


@contextmanager
def progress(name: str, total: int | None) -> Generator[Advance]:
    """Show a progress bar where standard error is a terminal.

    Yields a function: without arguments it adds one step; `advance(done, total)` sets both numbers.
    """
    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
    with Progress(*columns, console=console, disable=not console.is_terminal) as bar:
        task = bar.add_task(name, total=total)

        def advance(done: int | None = None, total: int | None = None) -> None:
            bar.update(task, advance=1) if done is None else bar.update(task, completed=done, total=total)

        yield advance
