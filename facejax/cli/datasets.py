"""What the command line makes for use: corpora, datasets, models; progress on standard error."""

from __future__ import annotations

import math
from pathlib import Path

import jax
import numpy as np

from facejax import io
from facejax.cli import generate, outputs, runtime
from facejax.data import dataset
from facejax.data.synthetic import assets, makehuman, makehuman4d, noise
from facejax.evaluation import vertex_error
from facejax.inference import corpus, pipeline
from facejax.training import sharding

MOST_PEOPLE = 1000  # of whom a corpus may be


def generate_corpus(
    request: corpus.Request,
    out: Path,
    *,
    face: Path | None = None,
    people: int = 0,
    model: Path | None = None,
    distributed: bool = False,
) -> tuple[list[Path], tuple[str, ...]]:
    """Write a corpus of motions of one face or of so many MakeHuman people; its index, and what was assumed."""
    if distributed:
        runtime.join_distributed()
    runtime.configure()
    if not 0 <= people <= MOST_PEOPLE:
        raise ValueError(f"--people must lie in 0..{MOST_PEOPLE}, got {people}")
    models, notes = pipeline.load(model), ()
    if people:
        if not np.array_equal(models.face.faces, assets.load().faces):
            raise ValueError(f"{model}: is in another topology than MakeHuman's people; leave --people out")
        neutrals = {who.name: who.vertices for who in map(makehuman.subject, range(people))}
    else:
        vertices, notes = generate.read_neutral(face, model)
        neutrals = {"average" if face is None else face.stem: vertices}
    outputs.make_output_folder(out)
    with outputs.progress(out.name, None) as advance:
        found = corpus.generate(models, request, neutrals, out, progress=advance)
    return [found.path / "index.json"], tuple(f"{face}: {note}" for note in notes)


def sample_faces(out: Path, count: int) -> list[Path]:
    """Neutral faces of test subjects as PLY files."""
    if not 1 <= count <= 1000:
        raise ValueError(f"--count must lie in 1..1000, got {count}")
    topology = assets.load().faces
    people = [makehuman.subject(100 + i) for i in range(count)]
    outputs.make_output_folder(out)
    paths = [out / f"{person.name}.ply" for person in people]
    for path, person in zip(paths, people, strict=True):
        io.save(path, person.vertices, topology)
    return paths


def prepare(spec: makehuman4d.Spec, *, folder: Path | None = None) -> Path:
    """Make a makehuman4d, or find it made; returns its folder."""
    noise.check_sigma(spec.noise)
    if folder is not None:
        outputs.make_output_folder(folder)
    with outputs.progress(spec.name, spec.subjects) as advance:
        return makehuman4d.prepare(spec, folder=folder, progress=lambda done, total: advance(done)).path


def fit(
    data: Path, out: Path, *, quick: bool = False, seed: int = 0, distributed: bool = False
) -> tuple[Path, dict[str, float]]:
    """Train models on a store and write them; the file, and what is off on people held out (mm, by region).

    Checkpoints lie beside it, in a folder of its name; called again, a stopped training goes on there. `quick`: a few
    steps, to see that everything is in order. Several devices share each batch out, with `distributed` those of all
    processes of a job.
    """
    from facejax.training.recipes import fit_bundle, fit_motion, fit_residual

    if distributed:
        runtime.join_distributed()
    runtime.configure()
    found = dataset.open_dataset(data)
    fit_bundle.check(found)
    if out.suffix != ".safetensors":
        raise ValueError(f"--out {out}: expected a file that ends in .safetensors")
    outputs.make_output_folder(out.parent)
    plans = fit_bundle.Plans()
    if quick:
        plans = fit_bundle.Plans(fit_motion.FlowPlan(steps=200), fit_residual.ResidualPlan(steps=50))
    count = jax.device_count()
    if jax.process_count() == 1:  # no more devices than share every batch evenly
        count = math.gcd(count, plans.motion.batch, plans.residual.batch)
    mesh = sharding.data_mesh(jax.devices()[:count]) if count > 1 else None
    models = fit_bundle.fit(found, out.with_suffix(".training"), plans=plans, seed=seed, mesh=mesh)
    errors = vertex_error.of_models(models, found)
    if sharding.is_primary():
        pipeline.save(out, models._replace(about=models.about | {"error_mm": errors}))
    sharding.barrier("the models are written")
    return out, errors


def prepare_recordings(layout: str, root: Path, out: Path, **options) -> dataset.Dataset:
    """Read a user's recordings into a dataset (`facejax.data.layouts.prepare`), with a progress bar."""
    from facejax.data.importers import registry

    if (rate := options.get("rate")) is not None:
        outputs.check_rate(rate)
    with outputs.progress(out.name, None) as advance:
        return registry.prepare(layout, root, out, progress=advance, **options)
