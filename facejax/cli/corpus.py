"""`facejax generate --count`: write a corpus of motions of one face or of MakeHuman people."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from facejax.cli import inputs, outputs, runtime
from facejax.cli.arguments import Generate
from facejax.data.synthetic import assets, makehuman
from facejax.inference import corpus, pipeline


def run(command: Generate) -> None:
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
