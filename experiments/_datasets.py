"""Datasets and cross-validation folds of the experiments on landmarks to mesh, including the protocols of OT23 4.1.

A *case* is one fold of one protocol (`identity`, `expression` or `test`): training meshes and test meshes.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from facejax.data import dataset
from facejax.data.importers import registry
from facejax.data.mesh_subset import MeshSubset, of_split
from facejax.data.synthetic import expression_recipes, makehuman, makehuman4d
from facejax.io import cache
from facejax.mesh import hierarchy, rbf_weights

MAX_MESHES = 20_000  # of a case; larger sets are subsampled at random with a fixed seed
FOLDS = 4
QUICK = {"subjects": 24, "meshes": 1_200}  # size of makehuman4d with --quick
Mode = Literal["quick", "default", "paper"]


class Case(NamedTuple):
    """One fold of a protocol: the meshes to fit to and the meshes to evaluate on."""

    split: str
    fold: int
    train: MeshSubset
    test: MeshSubset
    by: str  # what the test set holds out: "subjects" or "labels"

    @property
    def name(self) -> str:
        """Return the name of the case's folder."""
        return f"{self.split}-{self.fold}"


def load(
    path: Path | None, mode: Mode, *, level: int = 3, noise: float = 0.0, seed: int = makehuman4d.SEED
) -> dataset.Dataset:
    """Open the dataset at `path`, else prepare makehuman4d, with 24 subjects in quick mode."""
    if path is not None:
        return dataset.open_meshes(path)
    size = QUICK if mode == "quick" else {}
    return makehuman4d.prepare(makehuman4d.Spec(level=level, noise=noise, seed=seed, **size))


def check_same_topology(a: dataset.Dataset, b: dataset.Dataset) -> None:
    """Raise `ValueError` unless two datasets have the same triangles and landmark vertices."""
    for name in ("faces", "landmark_index"):
        if not np.array_equal(getattr(a, name), getattr(b, name)):
            what = "triangles" if name == "faces" else "landmarks"
            raise ValueError(f"{a.path} and {b.path} have different {what}: both need the same mesh topology")


def is_makehuman(data: dataset.Dataset) -> bool:
    """Return whether the dataset is makehuman4d, the built-in one."""
    return data.index.get("name") == "makehuman4d"


def cases(data: dataset.Dataset, splits: Sequence[str]) -> list[Case]:
    """Return the cases of each protocol.

    `identity`: four folds over the sorted training and validation subjects. `expression`: four folds over the sorted
    expression labels of the same subjects, on makehuman4d those of CoMA. `test`: fit to all those subjects, evaluate on
    the test subjects. The datasets of OT23 4.1 use the paper's splits over all their subjects: CoMA the four folds,
    D3DFACS, Florence 4D and BU-3DFE a split each.

    Raises:
        ValueError: for an unknown protocol, or where a split leaves no training or no test meshes.
    """
    known = [split for split in _with_people(data) if split != "test"]
    people = limit_count(of_split(data, *known))
    name = data.index.get("name")
    everybody = people if name not in _PUBLISHED else limit_count(of_split(data, *_with_people(data)))
    found = []
    for split in splits:
        if split == "test":
            found.append(Case("test", 0, people, limit_count(of_split(data, "test")), "subjects"))
        elif split in ("identity", "expression"):
            found += _PUBLISHED.get(name, _four_folds)(everybody, split)
        else:
            raise ValueError(f"unknown split {split!r}, expected identity, expression or test")
    for case in found:
        if not case.train.count or not case.test.count:
            which = "training" if not case.train.count else "test"
            raise ValueError(
                f"{data.path}: the {case.split} split leaves no {which} meshes: too few subjects or expression labels"
            )
    return found


def _with_people(data: dataset.Dataset) -> list[str]:
    return [split for split in dataset.SPLITS if len(data.subjects(split))]


def _four_folds(people: MeshSubset, split: str) -> list[Case]:
    by = "subjects" if split == "identity" else "labels"
    if by == "labels" and is_makehuman(people.data):
        people = people.of_labels(expression_recipes.COMA)
    return [Case(split, i, fit, held, by) for i, (fit, held) in enumerate(people.folds(FOLDS, by=by))]


def _one_fold(people: MeshSubset, split: str, held: np.ndarray) -> list[Case]:
    return [Case(split, 0, people.where(~held), people.where(held), "subjects" if split == "identity" else "labels")]


def _d3dfacs(people: MeshSubset, split: str) -> list[Case]:
    """Train on the last seven subjects, or hold out the first eleven expressions of each subject."""
    if split == "identity":
        return _one_fold(people, split, ~np.isin(people.owner, people.subjects[-7:]))
    return _one_fold(people, split, _first_of_each(people, 11))


def _florence(people: MeshSubset, split: str) -> list[Case]:
    """Hold out the last 30 women and 10 men, or the first two expressions of each subject."""
    if split == "expression":
        return _one_fold(people, split, _first_of_each(people, 2))
    sex = np.array([people.data.index["subjects"][i].get("sex", "") for i in people.subjects])
    if unknown := [people.data.index["subjects"][i]["name"] for i in people.subjects[~np.isin(sex, registry.SEXES)]]:
        raise ValueError(
            f"{people.data.path}: subject {unknown[0]} has no sex (female or male), which the Florence 4D split needs: "
            "prepare the dataset with --people"
        )
    held = np.concatenate([people.subjects[sex == "female"][-30:], people.subjects[sex == "male"][-10:]])
    return _one_fold(people, split, np.isin(people.owner, held))


def _bu3dfe(people: MeshSubset, split: str) -> list[Case]:
    """Hold out the first ten subjects, or the expressions anger and disgust."""
    if split == "identity":
        return _one_fold(people, split, np.isin(people.owner, people.subjects[:10]))
    return _one_fold(people, split, np.isin(people.labels, ["angry", "anger", "disgust"]))


def _first_of_each(people: MeshSubset, count: int) -> np.ndarray:
    held = np.zeros(people.count, bool)
    for subject in people.subjects:
        mine = people.owner == subject
        held |= mine & np.isin(people.labels, np.unique(people.labels[mine])[:count])
    return held


_PUBLISHED = {"coma": _four_folds, "d3dfacs": _d3dfacs, "florence4d": _florence, "bu3dfe": _bu3dfe}


def limit_count(meshes: MeshSubset) -> MeshSubset:
    """Return the meshes, or a random subset of `MAX_MESHES` drawn with a fixed seed."""
    if meshes.count <= MAX_MESHES:
        return meshes
    keep = np.sort(np.random.default_rng(0).permutation(meshes.count)[:MAX_MESHES])
    return meshes.where(np.isin(np.arange(meshes.count), keep))


def region_masks(data: dataset.Dataset) -> dict[str, np.ndarray]:
    """Return vertex masks (N,) of the head (all vertices) and the face (within 25 mm geodesic of a landmark)."""
    if is_makehuman(data):
        mask = makehuman.template().face_mask
    else:
        mask = rbf_weights.face_region(template_vertices(data), np.asarray(data.faces), np.asarray(data.landmark_index))
    return {"head": np.ones_like(mask), "face": mask}


def mesh_hierarchy(data: dataset.Dataset) -> hierarchy.Hierarchy:
    """Return the mesh hierarchy for spiral networks on the dataset's template."""
    return hierarchy.build(template_vertices(data), np.asarray(data.faces), cache=cache.folder())


def template_vertices(data: dataset.Dataset) -> np.ndarray:
    """Return the vertices (N, 3) of MakeHuman's template, else the mean neutral face of the training subjects."""
    if is_makehuman(data):
        return makehuman.template().vertices
    return np.asarray(data.neutral[data.subjects("train")], np.float64).mean(axis=0)
