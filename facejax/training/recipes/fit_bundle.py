"""Fit all models of a model file to one dataset: the generator of motion, its start poses, and the mesh decoder.

The dataset must contain recordings from neutral to an expression and back. Each stage (`fit_motion`, `fit_residual`)
keeps checkpoints in its folder and resumes from them.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from jax.sharding import Mesh

from facejax.data import dataset, mesh_subset, motions, transitions
from facejax.mesh import hierarchy as mesh_hierarchy
from facejax.mesh import rbf_weights
from facejax.models import bundle
from facejax.training.recipes import fit_gpmm, fit_motion, fit_residual

MIN_TRAIN_SUBJECTS = 4  # one per cross-validation fold


class Plans(NamedTuple):
    """Training plans of the two networks."""

    motion: fit_motion.FlowPlan = fit_motion.FlowPlan()
    residual: fit_residual.ResidualPlan = fit_residual.ResidualPlan()


def fit(
    data: dataset.Dataset, folder: Path, *, plans: Plans = Plans(), seed: int = 0, device_mesh: Mesh | None = None
) -> bundle.Models:
    """Fit all models to the training subjects of a dataset; `device_mesh` as in `loop.run`.

    Raises:
      ValueError: as `check`.
    """
    check(data)
    mean = np.asarray(data.neutral[data.subjects("train")], np.float64).mean(axis=0).astype(np.float32)
    faces, at = np.asarray(data.faces, np.int32), np.asarray(data.landmark_index, np.int32)
    hierarchy = mesh_hierarchy.build(mean, faces)
    known = motions.join(
        *transitions.all_pairs(data, "train", label_names=data.labels, per_pair=transitions.CHART_PER_PAIR)
    )
    chart = transitions.fit_chart(known, labels=len(data.labels), rank=transitions.default_rank(known))
    examples = transitions.encode_examples(
        chart, transitions.all_pairs(data, "train", label_names=data.labels, per_pair=transitions.SPREAD_PER_PAIR)
    )
    generator = fit_motion.fit_flow(
        examples, chart, folder / "motion", plan=plans.motion, seed=seed, device_mesh=device_mesh
    )
    starts = transitions.fit_start_poses(chart, motions.halves(data, "train"))
    train = mesh_subset.of_split(data, "train")
    # As many components as a model file holds, so that the network is trained on the estimate that it will refine.
    base = fit_gpmm.fit(train, components=bundle.COMPONENTS)
    decoder = fit_residual.fit(
        train, hierarchy, folder / "meshes", plan=plans.residual, seed=seed, base=base, device_mesh=device_mesh
    )
    return bundle.Models(
        labels=bundle.Labels(data.labels),
        face=bundle.Face(mean, faces, at, np.zeros(0, np.int32), rbf_weights.face_region(mean, faces, at)),
        motion=generator,
        starts=starts,
        hierarchy=hierarchy,
        decoder=decoder,
        about=bundle.Provenance(
            {"data": data.index.get("name"), "spec": dict(data.index["spec"]), "seed": seed}
            | {"plans": {name: plan._asdict() for name, plan in plans._asdict().items()}}
        ),
    )


def check(data: dataset.Dataset) -> None:
    """Raise `ValueError` for a dataset without the meshes, subjects or recordings that training needs."""
    people = data.subjects("train")
    if len(data.vertices) == 0:
        raise ValueError(
            f"{data.path}: contains only landmarks, expected meshes (recipes.fit_motion trains on landmarks)"
        )
    if len(people) < MIN_TRAIN_SUBJECTS:
        raise ValueError(f"{data.path}: {len(people)} training subjects, expected {MIN_TRAIN_SUBJECTS} or more")
    named = {s.label for s in data.sequences if s.subject in set(people.tolist()) and ">" not in s.label}
    lacking = [label for label in data.labels[1:] if label not in named]
    if lacking or len(data.labels) < 3:
        raise ValueError(
            f"{data.path}: expected training recordings of two or more expressions, and of every label; got "
            f"{len(named)}" + (f", none of {', '.join(lacking)}" if lacking else "")
        )
