"""`facejax fit`: train models on a prepared dataset."""

from __future__ import annotations

import math
from pathlib import Path

import jax

from facejax.cli import outputs, runtime
from facejax.cli.arguments import Fit
from facejax.data import dataset
from facejax.evaluation import vertex_error
from facejax.inference import pipeline
from facejax.training import sharding
from facejax.training.recipes import fit_bundle, fit_motion, fit_residual


def run(command: Fit) -> None:
    """Train, write the models, and print their errors on held-out people and the file."""
    path, errors = fit(
        command.data, command.out, quick=command.quick, seed=command.seed, distributed=command.distributed
    )
    if errors:
        print("people held out: {head:.3f} mm over the mesh, {face:.3f} mm over the face".format(**errors))
    print(path)


def fit(
    data: Path, out: Path, *, quick: bool = False, seed: int = 0, distributed: bool = False
) -> tuple[Path, dict[str, float]]:
    """Train models on a dataset and write them; return the file, and mean vertex errors (mm) by region.

    Errors are those on people held out, empty where there are none. Checkpoints are kept in a folder beside `out`;
    a training that was interrupted resumes from there. With several devices each batch is sharded over them, with
    `distributed` over those of all processes of a job.

    Args:
      quick: train a few steps only, as a test of the set-up.

    Raises:
      ValueError: the dataset has too few people or meshes.
    """
    if distributed:
        runtime.join_distributed()
    runtime.configure()
    found = dataset.open_dataset(data)
    fit_bundle.check(found)
    outputs.make_output_folder(out.parent)
    plans = fit_bundle.Plans()
    if quick:
        plans = fit_bundle.Plans(fit_motion.FlowPlan(steps=200), fit_residual.ResidualPlan(steps=50))
    count = jax.device_count()
    if jax.process_count() == 1:  # the batch size must be a multiple of the number of devices
        count = math.gcd(count, plans.motion.batch, plans.residual.batch)
    device_mesh = sharding.data_mesh(jax.devices()[:count]) if count > 1 else None
    models = fit_bundle.fit(found, out.with_suffix(".training"), plans=plans, seed=seed, device_mesh=device_mesh)
    errors = vertex_error.model_errors(models, found)
    if sharding.is_primary():
        pipeline.save(out, models.replace(about=models.about | {"error_mm": errors}))
    sharding.barrier("the models are written")
    return out, errors
