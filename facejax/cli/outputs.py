"""Animations made into files: which formats, where, and how the work shows itself.

Everything that can be wrong with a request is checked before the first file is written; every file appears whole.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

from facejax import io
from facejax.inference import pipeline
from facejax.io import atomic
from facejax.viz import eyes_teeth, video
from facejax.viz import scene as viz_scene
from facejax.viz.scene import Scene

FILM_RATE = 15.0  # frames per second of films: half the motion's, since drawing dominates the time


def check_formats(formats: Sequence[str]) -> None:
    """Raise, before any work is done, where a format cannot be written on this machine."""
    if not formats:
        raise ValueError("--formats: expected at least one")
    for suffix in formats:
        if f".{suffix}" in video.FORMATS:
            try:
                video.check(Path(f"film.{suffix}"))
            except ImportError as error:
                raise ValueError(f"--formats {suffix}: {error}") from error


def check_rate(fps: float) -> None:
    """Raise for frames per second that no player shows."""
    if not 0 < fps <= 1000:
        raise ValueError(f"--fps must lie above 0, up to 1000, got {fps}")


def file_stem(labels: Sequence[str]) -> str:
    """A file name for a motion through labels; a long chain is named by its ends."""
    whole = "_".join(labels)
    return whole if len(whole) <= 80 else f"{labels[0]}_{labels[-1]}_{len(labels) - 1}_transitions"


def make_output_folder(folder: Path) -> None:
    """Make a folder, or say in one line why files cannot be put there."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(f"{folder}: cannot be made ({error.strerror}); name another folder with --out") from error
    if not os.access(folder, os.W_OK | os.X_OK):
        raise ValueError(f"{folder}: not writable; name another folder with --out")


def scene_of(
    models: pipeline.Models, neutral: np.ndarray, vertices: np.ndarray, marks: np.ndarray, labels, frames
) -> Scene:
    """A generated animation with eyes, teeth and captions: neutral (N, 3), vertices (T, N, 3), marks (T, L, 3)."""
    rest = np.asarray(pipeline.neutral_landmarks(models, neutral))
    parts = eyes_teeth.parts(eyes_teeth.template(), rest, marks)
    captions = pipeline.captions(labels, frames=frames)
    return viz_scene.make(vertices, np.asarray(models.face.faces), captions=captions, landmarks=marks, extras=parts)


def save(out: Path, stem: str, suffix: str, scene: Scene, fps: float) -> Path:
    """Write a scene as `out/stem.suffix` ("ply" and "obj": a folder of frames); returns the path."""
    path, options = out / f"{stem}.{suffix}", {"captions": scene.captions, "extras": scene.extras}
    if suffix in ("ply", "obj"):
        path = out / f"{stem}-{suffix}"
        io.meshes.write_sequence(path, scene.vertices, scene.faces, format=suffix)
        return path
    if f".{suffix}" in video.FORMATS:
        every = max(1, round(fps / FILM_RATE))
        scene, fps = _thinned(scene, every), fps / every
        options = {"captions": scene.captions, "extras": scene.extras, "size": (256, 320)}
    elif suffix == "html":
        options["landmarks"] = scene.landmarks
    elif suffix == "npz":
        options = {"landmarks": scene.landmarks}
    io.save(path, scene.vertices, scene.faces, fps=fps, title=stem, **options)
    return path


def save_landmarks(path: Path, landmarks: np.ndarray, labels: Sequence[str], frames, fps: float) -> Path:
    """An NPZ of the landmarks (S, T, L, 3), the labels, and the first frame of each transition."""
    starts = np.array([start for start, _ in pipeline.captions(labels, frames=frames)])
    with atomic.replace_file(path) as temporary:
        np.savez(
            temporary, landmarks=np.asarray(landmarks, np.float32), labels=np.array(labels),
            starts=starts, fps=np.float64(fps),
        )  # fmt: skip
    return path


def _thinned(scene: Scene, every: int) -> Scene:
    # The last frame is where the motion was going: it stays.
    chosen = np.append(np.arange(0, len(scene.vertices) - 1, every), len(scene.vertices) - 1)
    parts = [p._replace(vertices=p.vertices[chosen]) if p.vertices.ndim == 3 else p for p in scene.extras]
    captions = tuple((-(-start // every), text) for start, text in scene.captions)
    return scene._replace(vertices=scene.vertices[chosen], captions=captions, extras=tuple(parts))


@contextmanager
def progress(name: str, total: int | None) -> Iterator:
    """A bar on a terminal; silent elsewhere. Called with nothing: one step more; else what is done, and of how much."""
    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
    with Progress(*columns, console=console, disable=not console.is_terminal) as bar:
        task = bar.add_task(name, total=total)

        def advance(done=None, total=None):
            bar.update(task, advance=1) if done is None else bar.update(task, completed=done, total=total)

        yield advance
