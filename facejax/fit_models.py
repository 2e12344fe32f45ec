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

from facejax import evaluation, fit_gpmm, fit_motion, fit_residual, motion_examples, pipeline
from facejax.data import makehuman, meshes, motions, store
from facejax.io import dress
from facejax.mesh import attachment, topology

FEWEST = 4  # training subjects, so that one fold of each cross-validation holds somebody


class Plans(NamedTuple):
    """How the two networks are trained."""

    motion: fit_motion.FlowPlan = fit_motion.FlowPlan()
    residual: fit_residual.Plan = fit_residual.Plan()


def fit(
    data: store.Store, folder: Path, *, plans: Plans = Plans(), seed: int = 0, mesh: Mesh | None = None
) -> pipeline.Models:
    """Train on the training subjects of a store; `mesh` as in `training.run`.

    Raises `ValueError` where the store holds too little to learn from.
    """
    check(data)
    mean = np.asarray(data.neutral[data.subjects("train")], np.float64).mean(axis=0).astype(np.float32)
    faces, at = np.asarray(data.faces, np.int32), np.asarray(data.landmark_index, np.int32)
    hierarchy = topology.build(mean, faces)
    known = motions.join(
        *motion_examples.everything(data, "train", names=data.labels, per_pair=motion_examples.CHARTED)
    )
    chart = motion_examples.chart_of(known, labels=len(data.labels), rank=motion_examples.rank_of(known))
    examples = motion_examples.examples_of(
        chart, motion_examples.everything(data, "train", names=data.labels, per_pair=motion_examples.SPREAD)
    )
    generator = fit_motion.fit_flow(examples, chart, folder / "motion", plan=plans.motion, seed=seed, mesh=mesh)
    beginnings = motion_examples.fit_starts(chart, motions.halves(data, "train"))
    train = meshes.of_split(data, "train")
    # As many components as the file will hold: the network refines the very answer that it will meet.
    base = fit_gpmm.fit(train, components=pipeline.COMPONENTS)
    expander = fit_residual.fit(
        train, hierarchy, folder / "meshes", plan=plans.residual, seed=seed, base=base, mesh=mesh
    )
    return pipeline.Models(
        labels=data.labels,
        face=pipeline.Face(mean, faces, at, np.zeros(0, np.int32), attachment.region(mean, faces, at)),
        props=props(),
        motion=generator,
        starts=beginnings,
        hierarchy=hierarchy,
        decoder=expander,
        about={"data": data.index.get("name"), "spec": dict(data.index["spec"]), "seed": seed}
        | {"plans": {name: plan._asdict() for name, plan in plans._asdict().items()}},
    )


def check(data: store.Store) -> None:
    """Raise `ValueError` for a dataset that nothing can be learnt from, with what it lacks."""
    people = data.subjects("train")
    if len(data.vertices) == 0:
        raise ValueError(f"{data.path}: holds landmarks alone, expected meshes; `facejax.fit_motion` fits their motion")
    if len(people) < FEWEST:
        raise ValueError(f"{data.path}: {len(people)} training subjects, expected {FEWEST} or more")
    named = {s.label for s in data.sequences if s.subject in set(people.tolist()) and ">" not in s.label}
    lacking = [label for label in data.labels[1:] if label not in named]
    if lacking or len(data.labels) < 3:
        raise ValueError(
            f"{data.path}: expected training recordings of two or more expressions, and of every label; got "
            f"{len(named)}" + (f", none of {', '.join(lacking)}" if lacking else "")
        )


def judge(models: pipeline.Models, data: store.Store, *splits: str) -> dict[str, float]:
    """Mean vertex error in mm by region on the people of splits, else on all held out; empty where nobody is."""
    held = [split for split in splits or ("validation", "test") if len(data.subjects(split))]
    if not held:
        return {}
    regions = {"head": np.ones(len(models.face.vertices), bool), "face": np.asarray(models.face.mask)}
    at = models.face.landmark_index
    found = evaluation.distances(
        lambda marks, rest: np.asarray(pipeline.meshes(models, rest[at] + marks, rest)),
        meshes.of_split(data, *held), regions,
    )  # fmt: skip
    return {name: found.mean_std(mask)[0] for name, mask in regions.items()}


def props() -> dress.Props:
    """The template's eyes and teeth, for pictures of faces that came without; used where there are 68 landmarks."""
    shape = makehuman.template()
    return dress.Props(shape.vertices[shape.landmarks], *makehuman.template_props())
