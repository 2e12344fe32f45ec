"""`facejax animate`: put a motion on any mesh that has landmarks, or play a recording on a MakeHuman person."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from facejax import io
from facejax.cli import checks, outputs, runtime
from facejax.cli.arguments import Animate
from facejax.data.synthetic import makehuman
from facejax.inference import makehuman_portrait, motion_sources, pipeline, retarget
from facejax.inference.checks import check_intensity
from facejax.io import livelink
from facejax.viz import eyes_teeth, scene


def run(command: Animate) -> None:
    """Write the animation in every format."""
    person = None if command.person is None else makehuman.subject(command.person)
    if command.livelink is not None:
        recording = motion_sources.read_recording(
            command.livelink, begin=command.begin, seconds=command.seconds, at_rest=not command.keep_rest
        )
        if command.mesh is None:
            files, notes = play(
                recording, person or makehuman.average(), command.livelink.stem, command.out,
                intensity=command.intensity, fps=command.fps, formats=command.formats,
            )  # fmt: skip
            return outputs.report(files, notes)
        motion = motion_sources.from_recording(recording, name=command.livelink.stem)
    elif command.expression is not None:
        assert not isinstance(command.frames, str)  # ensured by `checks.check`
        motion = motion_sources.from_expression(
            command.expression, frames=command.frames, whole=command.whole, weights=command.model
        )
    else:
        assert command.end is not None
        labels = (command.start, command.end, *command.then)
        frames = pipeline.FRAMES if command.frames is None else command.frames
        motion = motion_sources.from_labels(labels, seed=command.seed, frames=frames, weights=command.model)
    options = {"pin": command.pin, "sigma": command.sigma, "smoothing": command.smoothing}
    options |= {} if command.kernel is None else {"kernel": command.kernel}
    files, notes = animate(
        motion, command.out, mesh=command.mesh, landmarks=command.landmarks, person=person, head=command.head,
        intensity=command.intensity, fps=command.fps, formats=command.formats, **options,
    )  # fmt: skip
    outputs.report(files, notes)


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
    **options: Any,
) -> tuple[list[Path], tuple[str, ...]]:
    """Retarget a motion to a mesh with its landmarks, to a MakeHuman person, or to the average face.

    `options` go to `retarget.prepare` (pin, kernel, sigma, smoothing). Return the files, and notes on what was assumed.
    """
    runtime.configure()
    rate = motion.fps if fps is None else fps
    checks.check_fps(rate)
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
    if len(face.landmarks) != eyes_teeth.LANDMARKS:
        notes += (f"eyes and teeth are drawn for {eyes_teeth.LANDMARKS} landmarks only",)
    elif eyes_teeth.has_eye_holes(face.vertices, face.faces, face.landmarks):
        extras = eyes_teeth.parts(eyes_teeth.template(), face.landmarks, marks)
    animation = scene.make(moved, face.faces, captions=motion.captions, landmarks=marks, extras=extras)
    return outputs.save_all(out, f"{name}-{outputs.file_stem([motion.name])}", formats, animation, rate), notes


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
    """Animate a MakeHuman person by a recording's blendshape weights; return the files and notes."""
    rate = motion_sources.rate_of(recording) if fps is None else fps
    checks.check_fps(rate)
    check_intensity(intensity)
    shape = makehuman.template()
    posed = motion_sources.animate_person(recording, person, intensity=intensity)
    skin = posed[:, : len(shape.vertices)]
    parts, marks = makehuman_portrait.parts(posed), skin[:, shape.landmarks]
    animation = scene.make(skin, shape.faces, captions=((0, name),), landmarks=marks, extras=parts)
    return outputs.save_all(out, f"{person.name}-{name}", formats, animation, rate), recording.notes


def _mesh(
    head: pipeline.Face, mesh: Path | None, landmarks: Path | None, person: makehuman.Subject | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return vertices, triangles and landmarks (L, 3) to animate; a mesh in the topology of `head` needs no file."""
    if mesh is None:
        vertices = head.vertices if person is None else person.vertices
        return vertices, head.faces, vertices[head.landmark_index]
    found = io.load_mesh(mesh)
    if found.faces is None:
        raise ValueError(f"{mesh}: has no triangles; expected a mesh with faces")
    if landmarks is not None:
        return found.vertices, found.faces, io.landmarks.read(landmarks, found.vertices, found.faces).points
    if len(found.vertices) != len(head.vertices):
        raise ValueError(
            f"{mesh}: --landmarks is missing; only MakeHuman's head of {len(head.vertices)} vertices does not need it, "
            f"got {len(found.vertices)} vertices"
        )
    return found.vertices, found.faces, found.vertices[head.landmark_index]
