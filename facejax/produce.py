"""What the command line does: files in, files out, progress on standard error.

Everything that can be wrong with a request is checked before the first file is written; every file appears whole.
"""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import jax
import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

from facejax import files, io, pipeline
from facejax.data import assets, cache, makehuman, makehuman4d
from facejax.io import dress, faces, film, render

DEMO_LABELS = ("neutral", "high_smile", "mouth_open", "neutral")
DEMO_SUBJECTS = (100, 107, 115)  # of the test split: no network has seen them
SHEET_FRAMES = 8
FILM_RATE = 15.0  # frames per second of films: half the motion's, since drawing dominates the time


def generate(
    neutral: np.ndarray,
    labels: Sequence[str],
    out: Path,
    *,
    model: Path | None = None,
    seed: int = 7,
    samples: int = 1,
    frames: int = 30,
    fps: float = 30.0,
    intensity: float = 1.0,
    formats: Sequence[str] = ("glb", "html", "webp"),
) -> list[Path]:
    """Animate a neutral face (N, 3) through labels, and write every sample in every format. Returns the files."""
    compile_cache()
    models = pipeline.load(model)
    pipeline.label_indices(models, labels)
    _check_formats(formats)
    landmarks = pipeline.landmarks(
        models, jax.random.key(seed), labels, neutral, samples=samples, frames=frames, intensity=intensity
    )
    _writable(out)
    written = []
    with _progress("writing", samples * len(formats) + 1) as advance:
        for i, marks in enumerate(np.asarray(landmarks)):
            vertices = np.asarray(pipeline.meshes(models, marks, neutral))
            stem = "_".join(labels) if samples == 1 else f"{'_'.join(labels)}-{i + 1}"
            scene = _scene(models, neutral, vertices, marks, labels, frames)
            for suffix in formats:
                written.append(_save(out, stem, suffix, scene, fps))
                advance()
        written.append(_save_landmarks(out, landmarks, labels, frames, fps))
        advance()
    return written


def demo(out: Path, *, seed: int = 7) -> Path:
    """Three unseen faces through `DEMO_LABELS`; returns the summary's path."""
    clock = _Clock()
    compile_cache()
    _writable(out)
    people = [makehuman.subject(i) for i in DEMO_SUBJECTS]
    clock.lap("MakeHuman's assets and three faces")
    models = pipeline.load()
    clock.lap("weights")
    keys = jax.random.split(jax.random.key(seed), len(people))
    rows, marks, names = [], [], [person.name for person in people]
    with _progress("demo", 3 * len(people) + 2) as advance:
        for person, key in zip(people, keys, strict=True):
            moved = pipeline.landmarks(models, key, DEMO_LABELS, person.vertices)
            vertices = np.asarray(jax.block_until_ready(pipeline.meshes(models, moved, person.vertices)))
            clock.lap("labels to meshes" if marks else "labels to meshes, first (compiles, or reads the cache)")
            marks.append(np.asarray(moved))
            scene = _scene(models, person.vertices, vertices, marks[-1], DEMO_LABELS, 30)
            for suffix in ("glb", "html", "webp"):
                _save(out, person.name, suffix, scene, pipeline.RATE)
                clock.lap(f"{suffix} files")
                advance()
            chosen = np.linspace(0, len(vertices) - 1, SHEET_FRAMES).round().astype(int)
            rows.append(_pictures(scene, chosen))
            clock.lap("contact sheet")
        labels = [f"frame {t + 1}" for t in chosen]
        _picture(out / "contact_sheet.png", render.contact_sheet(rows, row_labels=names, column_labels=labels))
        advance()
        _save_landmarks(out, np.stack(marks), DEMO_LABELS, 30, pipeline.RATE)
        advance()
    return _summary(out, names, clock)


def neutral_face(path: Path | None, model: Path | None = None) -> tuple[np.ndarray, tuple[str, ...]]:
    """A user's neutral face in the model's topology, or the average face; and what was assumed about it."""
    face = pipeline.load(model).face
    if path is None:
        return np.asarray(face.vertices), ()
    found = faces.read(
        path,
        faces.Topology(*(np.asarray(x) for x in (face.vertices, face.landmark_index, face.source_index))),
    )
    return found.vertices, found.notes


def labels(model: Path | None = None) -> tuple[str, ...]:
    """The labels that the model knows."""
    return pipeline.load(model).labels


def sample_faces(out: Path, count: int) -> list[Path]:
    """Neutral faces of test subjects as PLY files."""
    if not 1 <= count <= 1000:
        raise ValueError(f"--count must lie in 1..1000, got {count}")
    topology = assets.load().faces
    people = [makehuman.subject(100 + i) for i in range(count)]
    _writable(out)
    paths = [out / f"{person.name}.ply" for person in people]
    for path, person in zip(paths, people, strict=True):
        io.save(path, person.vertices, topology)
    return paths


def prepare(level: int, *, head_motion: bool = False, folder: Path | None = None) -> Path:
    """Make makehuman4d at one level, or find it made."""
    spec = makehuman4d.Spec(level=level, head_motion=head_motion)
    if folder is not None:
        _writable(folder)
    with _progress(spec.name, spec.subjects) as advance:
        return makehuman4d.prepare(spec, folder=folder, progress=lambda done, total: advance()).path


def view(path: Path, out: Path | None = None, *, fps: float | None = None) -> Path:
    """One HTML page for an animation or a mesh; returns its path."""
    if path.suffix.lower() == ".html":
        if not path.is_file():
            raise ValueError(f"{path}: no such file")
        return path
    vertices, triangles, extra = _animation(path)
    page = out or path.with_suffix(".html")
    _writable(page.parent)
    io.save(page, vertices, triangles, fps=fps or extra.pop("fps", 30.0), title=path.stem, **extra)
    return page


def compile_cache() -> None:
    """Keep compiled programs in the user's cache: the second start is then quick."""
    jax.config.update("jax_compilation_cache_dir", str(cache.folder() / "compiled"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)


def _animation(path: Path) -> tuple[np.ndarray, np.ndarray, dict]:
    if path.suffix.lower() != ".npz":
        mesh = io.load_mesh(path)
        if mesh.faces is None:
            raise ValueError(f"{path}: has no triangles, nothing to show")
        return mesh.vertices, mesh.faces, {}
    return io.meshes.read_animation(path)


def _check_formats(formats: Sequence[str]) -> None:
    if not formats:
        raise ValueError("--formats: expected at least one")
    for suffix in formats:
        if f".{suffix}" in film.FORMATS:
            film.check(Path(f"film.{suffix}"))


def _writable(folder: Path) -> None:
    """Make a folder, or say in one line why files cannot be put there."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(f"{folder}: cannot be made ({error.strerror}); name another folder with --out") from error
    if not os.access(folder, os.W_OK | os.X_OK):
        raise ValueError(f"{folder}: not writable; name another folder with --out")


def _scene(models, neutral, vertices, marks, labels, frames) -> io.scene.Scene:
    rest = np.asarray(pipeline.neutral_landmarks(models, neutral))
    parts = dress.parts(models.props, rest, marks) if models.props is not None else ()
    captions = pipeline.captions(labels, frames=frames)
    return io.scene.make(vertices, np.asarray(models.face.faces), captions=captions, landmarks=marks, extras=parts)


def _save(out: Path, stem: str, suffix: str, scene: io.scene.Scene, fps: float) -> Path:
    path, options = out / f"{stem}.{suffix}", {"captions": scene.captions, "extras": scene.extras}
    if suffix in ("ply", "obj"):
        path = out / f"{stem}-{suffix}"
        io.meshes.write_sequence(path, scene.vertices, scene.faces, format=suffix)
        return path
    if f".{suffix}" in film.FORMATS:
        every = max(1, round(fps / FILM_RATE))
        scene, fps = _thinned(scene, every), fps / every
        options = {"captions": scene.captions, "extras": scene.extras, "size": (256, 320)}
    elif suffix == "html":
        options["landmarks"] = scene.landmarks
    elif suffix == "npz":
        options = {"landmarks": scene.landmarks}
    io.save(path, scene.vertices, scene.faces, fps=fps, title=stem, **options)
    return path


def _thinned(scene: io.scene.Scene, every: int) -> io.scene.Scene:
    chosen = slice(None, None, every)
    parts = [p._replace(vertices=p.vertices[chosen]) if p.vertices.ndim == 3 else p for p in scene.extras]
    captions = tuple((start // every, text) for start, text in scene.captions)
    return scene._replace(vertices=scene.vertices[chosen], captions=captions, extras=tuple(parts))


def _pictures(scene: io.scene.Scene, chosen: np.ndarray) -> np.ndarray:
    parts = [p._replace(vertices=p.vertices[chosen]) if p.vertices.ndim == 3 else p for p in scene.extras]
    camera = render.aim(scene.vertices, size=(200, 250), turn=15)
    return render.frames(scene.vertices[chosen], scene.faces, size=(200, 250), camera=camera, extras=parts)


def _picture(path: Path, pixels: np.ndarray) -> None:
    from PIL import Image

    with files.replacing(path) as temporary:
        Image.fromarray(pixels).save(temporary)


def _save_landmarks(out: Path, landmarks, labels, frames, fps) -> Path:
    path = out / "landmarks.npz"
    starts = np.array([start for start, _ in pipeline.captions(labels, frames=frames)])
    with files.replacing(path) as temporary:
        np.savez(
            temporary, landmarks=np.asarray(landmarks, np.float32), labels=np.array(labels),
            starts=starts, fps=np.float64(fps),
        )  # fmt: skip
    return path


class _Clock:
    """Seconds by name, added up."""

    def __init__(self) -> None:
        self.begun = self.last = time.perf_counter()
        self.laps: dict[str, float] = {}

    def lap(self, name: str) -> None:
        now = time.perf_counter()
        self.laps[name] = self.laps.get(name, 0.0) + now - self.last
        self.last = now


def _summary(out: Path, names: Sequence[str], clock: _Clock) -> Path:
    rows = "\n".join(f"| {name} | {seconds:.2f} |" for name, seconds in clock.laps.items())
    lines = [
        "# facejax demo",
        "",
        f"{' → '.join(DEMO_LABELS)} on {len(names)} unseen faces ({', '.join(names)}), 88 frames each.",
        "",
        "* `NAME.glb` animated glTF, `NAME.html` viewer in one page, `NAME.webp` film",
        "* `contact_sheet.png` three faces by eight frames, `landmarks.npz` the generated landmarks",
        "",
        "| step | seconds |",
        "| --- | --- |",
        rows,
        f"| **all** | **{time.perf_counter() - clock.begun:.2f}** |",
        "",
        f"{os.cpu_count()} cores, {platform.machine()}, Python {platform.python_version()}, jax {jax.__version__}.",
        "",
    ]
    path = out / "summary.md"
    with files.replacing(path) as temporary:
        temporary.write_text("\n".join(lines))
    return path


@contextmanager
def _progress(name: str, total: int) -> Iterator:
    """A bar on a terminal; silent elsewhere."""
    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
    with Progress(*columns, console=console, disable=not console.is_terminal) as bar:
        task = bar.add_task(name, total=total)
        yield lambda: bar.advance(task)
