"""Everything that `facejax generate` needs, trained on one dataset: a store in, models out.

The generator of motion (`facejax.fit_motion`), the peaks that it starts from, and the way from landmarks to meshes
(`facejax.fit_residual`). The dataset has to hold recordings that go from neutral to an expression and back. Each stage
keeps checkpoints in its folder and goes on from there when called again.
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

MIN_TRAIN_SUBJECTS = 4  # training subjects, so that one fold of each cross-validation holds somebody


class Plans(NamedTuple):
    """How the two networks are trained."""

    motion: fit_motion.FlowPlan = fit_motion.FlowPlan()
    residual: fit_residual.ResidualPlan = fit_residual.ResidualPlan()


def fit(
    data: dataset.Dataset, folder: Path, *, plans: Plans = Plans(), seed: int = 0, mesh: Mesh | None = None
) -> bundle.Models:
    """Train on the training subjects of a store; `mesh` as in `training.run`.

    Raises `ValueError` where the store holds too little to learn from.
    """
    check(data)
    mean = np.asarray(data.neutral[data.subjects("train")], np.float64).mean(axis=0).astype(np.float32)
    faces, at = np.asarray(data.faces, np.int32), np.asarray(data.landmark_index, np.int32)
    hierarchy = mesh_hierarchy.build(mean, faces)
    known = motions.join(*transitions.all_pairs(data, "train", label_names=data.labels, per_pair=transitions.CHART_PER_PAIR))
    chart = transitions.fit_chart(known, labels=len(data.labels), rank=transitions.default_rank(known))
    examples = transitions.encode_examples(
        chart, transitions.all_pairs(data, "train", label_names=data.labels, per_pair=transitions.SPREAD_PER_PAIR)
    )
    generator = fit_motion.fit_flow(examples, chart, folder / "motion", plan=plans.motion, seed=seed, mesh=mesh)
    beginnings = transitions.fit_start_poses(chart, motions.halves(data, "train"))
    train = mesh_subset.of_split(data, "train")
    # As many components as the file will hold: the network refines the very answer that it will meet.
    base = fit_gpmm.fit(train, components=bundle.COMPONENTS)
    expander = fit_residual.fit(
        train, hierarchy, folder / "meshes", plan=plans.residual, seed=seed, base=base, mesh=mesh
    )
    return bundle.Models(
        labels=data.labels,
        face=bundle.Face(mean, faces, at, np.zeros(0, np.int32), rbf_weights.face_region(mean, faces, at)),
        motion=generator,
        starts=beginnings,
        hierarchy=hierarchy,
        decoder=expander,
        about={"data": data.index.get("name"), "spec": dict(data.index["spec"]), "seed": seed}
        | {"plans": {name: plan._asdict() for name, plan in plans._asdict().items()}},
    )


def check(data: dataset.Dataset) -> None:
    """Raise `ValueError` for a dataset that nothing can be learnt from, with what it lacks."""
    people = data.subjects("train")
    if len(data.vertices) == 0:
        raise ValueError(f"{data.path}: holds landmarks alone, expected meshes; `facejax.fit_motion` fits their motion")
    if len(people) < MIN_TRAIN_SUBJECTS:
        raise ValueError(f"{data.path}: {len(people)} training subjects, expected {MIN_TRAIN_SUBJECTS} or more")
    named = {s.label for s in data.sequences if s.subject in set(people.tolist()) and ">" not in s.label}
    lacking = [label for label in data.labels[1:] if label not in named]
    if lacking or len(data.labels) < 3:
        raise ValueError(
            f"{data.path}: expected training recordings of two or more expressions, and of every label; got "
            f"{len(named)}" + (f", none of {', '.join(lacking)}" if lacking else "")
        )
