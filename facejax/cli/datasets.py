"""`facejax data`: prepare the synthetic dataset, write sample faces, or read a user's recordings into a dataset."""

from __future__ import annotations

from pathlib import Path

from facejax import io
from facejax.cli import outputs
from facejax.cli.arguments import Data, Prepare
from facejax.data.importers import registry
from facejax.data.synthetic import assets, makehuman, makehuman4d

FIRST_TEST_SUBJECT = 100


def run(command: Data) -> None:
    """Prepare a dataset and print its folder, or write sample faces and print their paths."""
    what = command.what
    if isinstance(what, Prepare):
        prepare(what)
    elif what.sample is not None:
        outputs.report(sample_faces(what.sample, what.count))
    else:
        spec = makehuman4d.Spec(level=what.level, head_motion=what.head_motion, noise=what.noise)
        outputs.report([make_synthetic(spec, folder=what.out)])


def prepare(command: Prepare) -> None:
    """Read a user's recordings into a dataset; print notes, the people of each split, and the folder."""
    with outputs.progress(command.out.name, None) as advance:
        made = registry.prepare(
            command.source, command.root, command.out, landmarks=command.landmarks, unit=command.unit,
            labels=command.labels, people=command.people, cuts=command.cuts, remove_head_motion=command.hold,
            max_meshes=command.meshes, workers=command.workers, progress=advance, rate=command.fps, rest=command.rest,
            gaps=command.gaps, template=command.template, actors=command.actors,
        )  # fmt: skip
    splits = [f"{split}: {', '.join(names)}" for split, names in made.people().items() if names]
    outputs.report([made.path], [*made.index["notes"], *splits])


def sample_faces(out: Path, count: int) -> list[Path]:
    """Write neutral faces of `count` MakeHuman test subjects as PLY files; return the paths."""
    topology = assets.load().faces
    people = [makehuman.subject(FIRST_TEST_SUBJECT + i) for i in range(count)]
    outputs.make_output_folder(out)
    paths = [out / f"{person.name}.ply" for person in people]
    for path, person in zip(paths, people, strict=True):
        io.save(path, person.vertices, topology)
    return paths


def make_synthetic(spec: makehuman4d.Spec, *, folder: Path | None = None) -> Path:
    """Generate a makehuman4d dataset unless it is there already; return its folder, by default in the user's cache."""
    if folder is not None:
        outputs.make_output_folder(folder)
    with outputs.progress(spec.name, spec.subjects) as advance:
        return makehuman4d.prepare(spec, folder=folder, progress=lambda done, total: advance(done)).path
