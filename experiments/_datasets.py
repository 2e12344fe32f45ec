"""Who is trained on and judged in the experiments on landmarks -> mesh: the folds of each protocol, OT23's too."""

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

MOST = 20_000  # meshes of a case; more are thinned by a fixed draw
FOLDS = 4
QUICK = {"subjects": 24, "meshes": 1_200}  # of makehuman4d
Mode = Literal["quick", "default", "paper"]


class Case(NamedTuple):
    """One fold: what to fit to, what to judge on, and what is new in it."""

    split: str
    fold: int
    train: MeshSubset
    test: MeshSubset
    by: str  # "subjects" or "labels"

    @property
    def name(self) -> str:
        """The folder's name."""
        return f"{self.split}-{self.fold}"


def data_of(
    path: Path | None, mode: Mode, *, level: int = 3, noise: float = 0.0, seed: int = makehuman4d.SEED
) -> dataset.Dataset:
    """The user's store, or makehuman4d: a small one of 24 people for `quick`."""
    if path is not None:
        return dataset.open_meshes(path)
    size = QUICK if mode == "quick" else {}
    return makehuman4d.prepare(makehuman4d.Spec(level=level, noise=noise, seed=seed, **size))


def check_alike(a: dataset.Dataset, b: dataset.Dataset) -> None:
    """Raise `ValueError` for two datasets of other triangles or landmarks."""
    for name in ("faces", "landmark_index"):
        if not np.array_equal(getattr(a, name), getattr(b, name)):
            what = "triangles" if name == "faces" else "landmarks"
            raise ValueError(f"{a.path} and {b.path} have other {what}: both have to be in one topology")


def is_makehuman(data: dataset.Dataset) -> bool:
    """Whether the store holds the embedded dataset."""
    return data.index.get("name") == "makehuman4d"


def cases(data: dataset.Dataset, splits: Sequence[str]) -> list[Case]:
    """The folds of each protocol.

    `identity`: four folds over the sorted training and validation subjects. `expression`: four over the sorted names of
    CoMA's expressions, of the same people; other data: over all names. `test`: fitted to all those people, judged on
    the test subjects. Datasets of OT23 4.1 get the paper's splits, over all their people: CoMA these folds, D3DFACS,
    Florence 4D and BU-3DFE splits of their own.
    """
    known = [split for split in _with_people(data) if split != "test"]
    people = at_most(of_split(data, *known))
    name = data.index.get("name")
    everybody = people if name not in _PUBLISHED else at_most(of_split(data, *_with_people(data)))
    found = []
    for split in splits:
        if split == "test":
            found.append(Case("test", 0, people, at_most(of_split(data, "test")), "subjects"))
        elif split in ("identity", "expression"):
            found += _PUBLISHED.get(name, _four_folds)(everybody, split)
        else:
            raise ValueError(f"unknown split {split!r}, expected identity, expression or test")
    for case in found:
        if not case.train.count or not case.test.count:
            what = "fit to" if not case.train.count else "judge on"
            raise ValueError(
                f"{data.path}: the split by {case.split} leaves nothing to {what}: too few people, or names"
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
    """The last seven subjects train; the first eleven expressions of each are left out."""
    if split == "identity":
        return _one_fold(people, split, ~np.isin(people.owner, people.subjects[-7:]))
    return _one_fold(people, split, _first_of_each(people, 11))


def _florence(people: MeshSubset, split: str) -> list[Case]:
    """The last 30 women and 10 men, or the first two expressions of each, are left out."""
    if split == "expression":
        return _one_fold(people, split, _first_of_each(people, 2))
    sex = np.array([people.data.index["subjects"][i].get("sex", "") for i in people.subjects])
    if unknown := [people.data.index["subjects"][i]["name"] for i in people.subjects[~np.isin(sex, registry.SEXES)]]:
        raise ValueError(
            f"{people.data.path}: nothing says whether {unknown[0]} is female or male, by which Florence 4D is split: "
            "prepare it with --people"
        )
    held = np.concatenate([people.subjects[sex == "female"][-30:], people.subjects[sex == "male"][-10:]])
    return _one_fold(people, split, np.isin(people.owner, held))


def _bu3dfe(people: MeshSubset, split: str) -> list[Case]:
    """The first ten subjects, or anger and disgust, are left out."""
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


def at_most(meshes: MeshSubset) -> MeshSubset:
    """The meshes, or a fixed draw of 20,000 of them."""
    if meshes.count <= MOST:
        return meshes
    keep = np.sort(np.random.default_rng(0).permutation(meshes.count)[:MOST])
    return meshes.where(np.isin(np.arange(meshes.count), keep))


def regions_of(data: dataset.Dataset) -> dict[str, np.ndarray]:
    """The whole head, and the face: 25 mm along the surface about a landmark."""
    if is_makehuman(data):
        mask = makehuman.template().face_mask
    else:
        mask = rbf_weights.face_region(template_of(data), np.asarray(data.faces), np.asarray(data.landmark_index))
    return {"head": np.ones_like(mask), "face": mask}


def hierarchy_of(data: dataset.Dataset) -> hierarchy.Hierarchy:
    """The levels that spiral networks climb."""
    return hierarchy.build(template_of(data), np.asarray(data.faces), cache=cache.folder())


def template_of(data: dataset.Dataset) -> np.ndarray:
    """The face on which tables are made: makehuman4d's own, else the mean of the training subjects."""
    if is_makehuman(data):
        return makehuman.template().vertices
    return np.asarray(data.neutral[data.subjects("train")], np.float64).mean(axis=0)
