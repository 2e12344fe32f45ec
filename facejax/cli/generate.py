"""`facejax generate`: animate a neutral face, or a scan of a head, through expressions; write a corpus of motions."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import jax
import numpy as np

from facejax.cli import checks, inputs, outputs, runtime
from facejax.cli.arguments import Generate
from facejax.data.synthetic import assets, makehuman
from facejax.inference import corpus, motion_sources, pipeline, scans


def run(command: Generate) -> None:
    """Write every sample in every format, or with --count a corpus."""
    if command.count is not None:
        return _run_corpus(command)
    assert command.end is not None  # ensured by `checks.check`
    bound = None
    if command.landmarks is None or command.face is None:
        neutral, notes = inputs.read_neutral(command.face, command.model)
    else:
        bound, notes = scans.bind_scan(scans.read(command.face, command.landmarks))
        neutral = bound.neutral
    files = generate(
        neutral, (command.start, command.end, *command.then), command.out, bound=bound, model=command.model,
        seed=command.seed, samples=command.samples, frames=command.frames, fps=command.fps,
        intensity=command.intensity, formats=command.formats,
    )  # fmt: skip
    outputs.report(files, [f"{command.face}: {note}" for note in notes])


def generate(
    neutral: np.ndarray,
    labels: Sequence[str],
    out: Path,
    *,
    bound: scans.BoundScan | None = None,
    model: Path | None = None,
    seed: int = 7,
    samples: int = 1,
    frames: int | Sequence[int] | str = pipeline.FRAMES,
    fps: float = 30.0,
    intensity: float = 1.0,
    formats: Sequence[str] = ("glb", "html", "webp"),
) -> list[Path]:
    """Animate a neutral face (N, 3) through labels and write every sample in every format; return the files.

    Args:
      bound: a scan that is bound to `neutral`; its own vertices are animated instead.
      frames: as of `pipeline.landmarks`, or "natural": the durations that are generated with the first sample.

    Raises:
      ValueError: an unknown label, too many frames, or a scan with models of another topology than MakeHuman's.
    """
    runtime.configure()
    models = pipeline.load(model)
    models.labels.encode(labels)
    if bound is not None and not np.array_equal(models.face.faces, assets.load().faces):
        raise ValueError(f"{model}: expected MakeHuman's topology, which scans are registered to")
    if isinstance(frames, str):
        if frames != motion_sources.NATURAL:
            raise ValueError(f"frames: expected a number or {motion_sources.NATURAL!r}, got {frames!r}")
        frames = pipeline.durations(models, jax.random.key(seed), labels, rate=fps)
    checks.check_total_frames(samples, pipeline.lengths(len(labels) - 1, frames))
    landmarks = pipeline.landmarks(
        models, jax.random.key(seed), labels, neutral, samples=samples, frames=frames, intensity=intensity
    )
    outputs.make_output_folder(out)
    face = pipeline.prepare(models, neutral)
    written, name = [], outputs.file_stem(labels) if bound is None else f"{bound.name}-{outputs.file_stem(labels)}"
    with outputs.progress("writing", samples * len(formats) + 1) as advance:
        for i, marks in enumerate(np.asarray(landmarks)):
            vertices = np.asarray(pipeline.vertices(models, face, marks))
            stem = name if samples == 1 else f"{name}-{i + 1}"
            if bound is None:
                scene = outputs.scene_of(models, neutral, vertices, marks, labels, frames)
            else:
                scene = scans.scene_of(models, bound, vertices, marks, labels, frames)
            for suffix in formats:
                written.append(outputs.save(out, stem, suffix, scene, fps))
                advance()
        path = out / f"{name}-landmarks.npz"
        written.append(outputs.save_landmarks(path, np.asarray(landmarks), labels, frames, fps))
        advance()
    return written


def _run_corpus(command: Generate) -> None:
    """Write what is missing of a corpus and print the path of its index."""
    assert command.count is not None and not isinstance(command.frames, str)  # ensured by `checks.check`
    if command.distributed:
        runtime.join_distributed()
    runtime.configure()
    labels = () if command.end is None else (command.start, command.end, *command.then)
    request = corpus.Request(
        command.count, labels, command.seed, command.frames, command.intensity, command.meshes, command.shard
    )
    models = pipeline.load(command.model)
    neutrals, notes = _faces(models, command.face, command.people, command.model)
    outputs.make_output_folder(command.out)
    with outputs.progress(command.out.name, None) as advance:
        found = corpus.generate(models, request, neutrals, command.out, progress=advance)
    outputs.report([found.path / "index.json"], notes)


def _faces(
    models: pipeline.Models, face: Path | None, people: int, model: Path | None
) -> tuple[dict[str, np.ndarray], list[str]]:
    """Return neutral faces (N, 3) by name, and notes on what was assumed."""
    if people:
        if not np.array_equal(models.face.faces, assets.load().faces):
            raise ValueError(f"{model}: expected MakeHuman's topology, which --people needs; leave out --people")
        return {who.name: who.vertices for who in map(makehuman.subject, range(people))}, []
    vertices, notes = inputs.read_neutral(face, model)
    return {"average" if face is None else face.stem: vertices}, [f"{face}: {note}" for note in notes]
