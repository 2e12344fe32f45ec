"""What the command line does to faces: files in, animations out, progress on standard error."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import jax
import numpy as np

from facejax import io
from facejax.cli import outputs, runtime
from facejax.data.synthetic import assets, makehuman
from facejax.inference import makehuman_portrait, motion_sources, pipeline, retarget, scans
from facejax.io import atomic, livelink, neutral_face
from facejax.landmarks import canonical_frame
from facejax.viz import eyes_teeth, scene
from facejax.viz.scene import Scene

MOST_FRAMES = 100_000  # of all samples together


def generate(
    neutral: np.ndarray,
    labels: Sequence[str],
    out: Path,
    *,
    worn: scans.BoundScan | None = None,
    model: Path | None = None,
    seed: int = 7,
    samples: int = 1,
    frames: int | Sequence[int] | str = pipeline.FRAMES,
    fps: float = 30.0,
    intensity: float = 1.0,
    formats: Sequence[str] = ("glb", "html", "webp"),
) -> list[Path]:
    """Animate a neutral face (N, 3) through labels, and write every sample in every format. Returns the files.

    `frames` as in `pipeline.landmarks`, or "natural": as long as people take, generated with the first sample. What is
    `worn` on this neutral face, a scan, is what moves.
    """
    runtime.configure()
    models = pipeline.load(model)
    pipeline.label_indices(models, labels)
    if worn is not None and not np.array_equal(models.face.faces, assets.load().faces):
        raise ValueError(f"{model}: is in another topology than MakeHuman's, which scans are registered to")
    outputs.check_formats(formats)
    outputs.check_rate(fps)
    if frames == motion_sources.NATURAL:
        frames = pipeline.durations(models, jax.random.key(seed), labels, rate=fps)
    if (total := samples * sum(pipeline.lengths(labels, frames))) > MOST_FRAMES:
        raise ValueError(f"{samples} samples have {total} frames, expected up to {MOST_FRAMES}: take fewer, or --count")
    landmarks = pipeline.landmarks(
        models, jax.random.key(seed), labels, neutral, samples=samples, frames=frames, intensity=intensity
    )
    outputs.make_output_folder(out)
    written, name = [], outputs.file_stem(labels) if worn is None else f"{worn.name}-{outputs.file_stem(labels)}"
    with outputs.progress("writing", samples * len(formats) + 1) as advance:
        for i, marks in enumerate(np.asarray(landmarks)):
            vertices = np.asarray(pipeline.meshes(models, marks, neutral))
            stem = name if samples == 1 else f"{name}-{i + 1}"
            if worn is None:
                scene = outputs.scene_of(models, neutral, vertices, marks, labels, frames)
            else:
                scene = scans.scene_of(models, worn, vertices, marks, labels, frames)
            for suffix in formats:
                written.append(outputs.save(out, stem, suffix, scene, fps))
                advance()
        written.append(outputs.save_landmarks(out / f"{name}-landmarks.npz", landmarks, labels, frames, fps))
        advance()
    return written


def read_neutral(path: Path | None, model: Path | None = None) -> tuple[np.ndarray, tuple[str, ...]]:
    """A user's neutral face in the model's topology, or the average face; and what was assumed about it."""
    face = pipeline.load(model).face
    if path is None:
        return np.asarray(face.vertices), ()
    found = neutral_face.read(
        path,
        canonical_frame.Topology(*(np.asarray(x) for x in (face.vertices, face.landmark_index, face.source_index))),
    )
    return found.vertices, found.notes


def labels(model: Path | None = None) -> tuple[str, ...]:
    """The labels that the model knows."""
    return pipeline.load(model).labels


def view(path: Path, out: Path | None = None, *, fps: float | None = None) -> Path:
    """One HTML page for an animation or a mesh; returns its path. `out` names the page, or a folder for it."""
    page = path.with_suffix(".html") if out is None else out / f"{path.stem}.html" if out.is_dir() else out
    if page.suffix.lower() != ".html":
        raise ValueError(f"{page}: the page's name must end in .html")
    if path.suffix.lower() == ".html":
        if not path.is_file():
            raise ValueError(f"{path}: no such file")
        if page != path:
            raise ValueError(f"{path} is a page already; leave --out away to open it")
        return path
    vertices, triangles, extra = _animation(path)
    stored = extra.pop("fps", 30.0)
    outputs.check_rate(stored if fps is None else fps)
    outputs.make_output_folder(page.parent)
    io.save(page, vertices, triangles, fps=stored if fps is None else fps, title=path.stem, **extra)
    return page


def _animation(path: Path) -> tuple[np.ndarray, np.ndarray, dict]:
    if path.suffix.lower() != ".npz":
        mesh = io.load_mesh(path)
        if mesh.faces is None:
            raise ValueError(f"{path}: has no triangles, nothing to show")
        return mesh.vertices, mesh.faces, {}
    return io.meshes.read_animation(path)


def animate(
    motion: motion_sources.Motion,
    out: Path,
    *,
    mesh: Path | None = None,
    landmarks: Path | None = None,
    person: makehuman.Subject | None = None,
    head: bool = False,
    intensity: float = 1.0,
    fps: float | None = None,
    formats: Sequence[str] = ("glb", "html", "webp"),
    **options,
) -> tuple[list[Path], tuple[str, ...]]:
    """Put a motion on a mesh with its landmarks, on a MakeHuman person or on the average face; the files, and what was
    assumed.

    `options` go to `animation.prepare` (pin, kernel, sigma, smoothing).
    """
    runtime.configure()
    outputs.check_formats(formats)
    rate = motion.fps if fps is None else fps
    outputs.check_rate(rate)
    models = pipeline.load()
    name = person.name if person else "average"
    if mesh is not None:
        name = mesh.stem
    vertices, triangles, marks = _mesh(models.face, mesh, landmarks, person)
    template = models.face.vertices[models.face.landmark_index]
    source = str(mesh or name) + (f" with {landmarks}" if landmarks else "")
    face = retarget.prepare(vertices, triangles, marks, template, name=source, **options)
    moved = np.asarray(retarget.animate(face, motion.curve, intensity=intensity, head=head))
    marks = np.asarray(retarget.landmarks_of(face, motion.curve, intensity=intensity))
    extras, notes = (), motion.notes + face.notes
    if len(face.landmarks) != eyes_teeth.IBUG:
        notes += (f"eyes and teeth are drawn for {eyes_teeth.IBUG} landmarks only",)
    elif eyes_teeth.has_eye_holes(face.vertices, face.faces, face.landmarks):
        extras = eyes_teeth.parts(eyes_teeth.template(), face.landmarks, marks)
    shot = scene.make(moved, face.faces, captions=motion.captions, landmarks=marks, extras=extras)
    return _write(out, f"{name}-{outputs.file_stem([motion.name])}", shot, rate, formats), notes


def play(
    recording: livelink.Recording,
    person: makehuman.Subject,
    name: str,
    out: Path,
    *,
    intensity: float = 1.0,
    fps: float | None = None,
    formats: Sequence[str] = ("glb", "html", "webp"),
) -> tuple[list[Path], tuple[str, ...]]:
    """A recording on a MakeHuman person, by its own blendshapes; the files, and what was assumed."""
    rate = motion_sources.rate_of(recording) if fps is None else fps
    outputs.check_formats(formats)
    outputs.check_rate(rate)
    retarget.check_intensity(intensity)
    shape = makehuman.template()
    posed = motion_sources.animate_person(recording, person, intensity=intensity)
    skin = posed[:, : len(shape.vertices)]
    parts, marks = makehuman_portrait.parts(posed), skin[:, shape.landmarks]
    shot = scene.make(skin, shape.faces, captions=((0, name),), landmarks=marks, extras=parts)
    return _write(out, f"{person.name}-{name}", shot, rate, formats), recording.notes


def _mesh(head: pipeline.Face, mesh: Path | None, landmarks: Path | None, person: makehuman.Subject | None):
    """Vertices, triangles and landmarks (L, 3) to be moved; `head` is the topology that needs no landmark file."""
    if mesh is None:
        vertices = head.vertices if person is None else person.vertices
        return vertices, head.faces, vertices[head.landmark_index]
    found = io.load_mesh(mesh)
    if found.faces is None:
        raise ValueError(f"{mesh}: has no triangles, nothing to move")
    if landmarks is not None:
        return found.vertices, found.faces, io.landmarks.read(landmarks, found.vertices, found.faces).points
    if len(found.vertices) != len(head.vertices):
        raise ValueError(
            f"{mesh}: --landmarks is missing; only MakeHuman's head, {len(head.vertices)} vertices, goes without"
        )
    return found.vertices, found.faces, found.vertices[head.landmark_index]


def _write(out: Path, stem: str, shot: Scene, rate: float, formats: Sequence[str]) -> list[Path]:
    outputs.make_output_folder(out)
    written = []
    with outputs.progress("writing", len(formats) + 1) as advance:
        for suffix in formats:
            written.append(outputs.save(out, stem, suffix, shot, rate))
            advance()
        path = out / f"{stem}-landmarks.npz"
        with atomic.replace_file(path) as temporary:
            np.savez(temporary, landmarks=shot.landmarks, fps=np.float64(rate))
        written.append(path)
        advance()
    return written
