"""What experiments on generated motion share: real motions of people that no generator has seen, and scores.

Two groups of people. Generators are chosen on "validation": the 20 validation subjects and 120 people of another
population (seed 2). What is published is measured on "test": the 20 test subjects and 120 people of a third (seed 3).
Their transitions are taken before any selection by prototypes, which narrows them: everybody's start meets
everybody's end. On a dataset of the user's own the groups are its splits alone, and the pairs all of its labels'.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from experiments import _datasets
from facejax import augment, metrics
from facejax.data import dataset, motions
from facejax.data.synthetic import makehuman4d
from facejax.geometry import sphere
from facejax.inference import composition, pipeline
from facejax.models.motion import generators, start_poses

GROUPS = {"validation": 2, "test": 3}  # a split of the dataset, and the seed of the population that joins it
FEWEST = 4  # people, and motions of a pair
Pair = tuple[int, int]
Names = tuple[str, str]


class Held(NamedTuple):
    """Real motions of held-out people, in millimetres of a mean face; one entry for each pair of labels."""

    pairs: list[Pair]
    names: list[Names]
    curves: list[np.ndarray]  # (M, T, L, 3) each: displacements from neutral
    seconds: list[np.ndarray]  # (M,) each
    reference: list[np.ndarray]  # (T, L, 3) each: the one held-out sample of OT23
    people: int
    scale: float  # millimetres per unit of a generated motion


@dataclasses.dataclass(frozen=True)
class People:
    """Options of an experiment on these groups."""

    data: Path | None = None
    """A prepared dataset (`facejax data prepare`) in place of makehuman4d; give models of it, too (`facejax fit`)."""
    level: int = 3
    """Realism of makehuman4d."""
    subjects: int = 120
    """Of makehuman4d."""
    meshes: int = 20_000
    """Of makehuman4d."""
    people: int = 120
    """Of the population that joins makehuman4d's validation or test subjects; 0: none."""
    publish: bool = False
    """Also write the figures that the README quotes."""


@dataclasses.dataclass(frozen=True)
class Options(People):
    """Options of an experiment that judges trained models on the test group."""

    seed: int = 0
    """Of everything that is drawn."""
    models: tuple[Path, ...] = ()
    """Weights to judge, the mean over them; by default the released ones, which know makehuman4d alone."""
    samples: int = 64
    """Generated motions of each pair, or of each chain."""


def models_of(config: Options) -> list[pipeline.Models]:
    """The models to judge, with the dataset's labels and landmarks. Raises `ValueError` for others."""
    found, data = [pipeline.load(path) for path in config.models or (None,)], data_of(config)
    for path, models in zip(config.models or ("the released models",), found, strict=True):
        fits(models, data, path)
    return found


def fits(models: pipeline.Models, data: dataset.Dataset, path: Path | str) -> None:
    """Raise `ValueError` for models that were made for other labels, triangles or landmarks than the dataset's."""
    mesh = models.face
    if models.labels != data.labels:
        raise ValueError(
            f"{path}: expected the labels of {data.path}, {', '.join(data.labels)}; got {', '.join(models.labels)}: "
            "`facejax fit --data` makes models of a dataset"
        )
    if not (np.array_equal(mesh.faces, data.faces) and np.array_equal(mesh.landmark_index, data.landmark_index)):
        raise ValueError(
            f"{path}: expected the triangles and landmarks of {data.path}: "
            "`facejax fit --data` makes models of a dataset"
        )


def data_of(config: People) -> dataset.Dataset:
    """The dataset that generators are trained on."""
    if config.data is not None:
        return dataset.open_dataset(config.data)
    return makehuman4d.prepare(makehuman4d.Spec(config.level, config.subjects, config.meshes))


def names_of(data: dataset.Dataset) -> tuple[Names, ...]:
    """The pairs that are judged: OT23's 39 on makehuman4d, else all that can be made of the labels."""
    if _datasets.is_makehuman(data):
        return makehuman4d.TABLE5_PAIRS
    return tuple(itertools.permutations(data.labels, 2))


def halves_of(config: People, group: str) -> motions.Motions:
    """Every half of a group's people."""
    data = data_of(config)
    if not len(data.subjects(group)):
        raise ValueError(f"{data.path}: nobody is in the {group} split")
    parts = [motions.halves(data, group)]
    if config.people and config.data is None:
        spec = makehuman4d.Spec(config.level, config.people, config.people, seed=GROUPS[group])
        others = makehuman4d.prepare(spec)
        for split in (split for split in dataset.SPLITS if len(others.subjects(split))):
            part = motions.halves(others, split)
            parts.append(part._replace(subject=part.subject + config.subjects))
    return motions.join(*parts)


def held(config: People, group: str, names: Sequence[Names]) -> Held:
    """Unselected transitions of a group's people: as many of each pair as there are people.

    Raises `ValueError` for fewer than four people or motions of a pair: one half is compared with the other.
    """
    data = data_of(config)
    labels = data.labels
    halves = halves_of(config, group)
    pairs = [(labels.index(a), labels.index(b)) for a, b in names]
    people = len(np.unique(halves.subject))
    if people < FEWEST:
        raise ValueError(f"{data.path}: expected {FEWEST} or more people in the {group} split, got {people}")
    onsets = halves.take(halves.start == 0)
    between = motions.interpolated_transitions(onsets, len(labels), per_pair=people, choice="spread", pairs=set(pairs), seed=1)
    found = motions.join(halves, *between)
    scale = float(np.mean(found.scale))
    curves = [scale * of_pair(found, pair) for pair in pairs]
    few = [" > ".join(name) for name, each in zip(names, curves, strict=True) if len(each) < FEWEST]
    if few:
        raise ValueError(f"{data.path}: expected {FEWEST} or more motions of every pair, not so of {', '.join(few)}")
    seconds = [found.seconds[(found.start == a) & (found.end == b)] for a, b in pairs]
    # Of the half that stands for "real", so that it is never compared with itself.
    halves = [np.zeros(len(c) // 2, int) for c in curves]
    one = [np.argmax(augment.sample_per_pair(half, half, seed=1)) for half in halves]
    reference = [c[i] for c, i in zip(curves, one, strict=True)]
    return Held(pairs, list(names), curves, seconds, reference, people, scale)


def seen(config: People, pairs: Sequence[Pair], scale: float, count: int) -> list[np.ndarray]:
    """`count` training motions of each pair in millimetres, unselected."""
    data = data_of(config)
    halves = motions.halves(data, "train")
    onsets = halves.take(halves.start == 0)
    between = motions.interpolated_transitions(onsets, len(data.labels), per_pair=count, choice="spread", pairs=set(pairs), seed=2)
    found = motions.join(halves, *between)
    return [scale * of_pair(found, pair)[:count] for pair in pairs]


def of_pair(found: motions.Motions, pair: Pair) -> np.ndarray:
    """The curves of one (start, end)."""
    return found.curves[(found.start == pair[0]) & (found.end == pair[1])]


def drawn(models: pipeline.Models, held: Held, *, samples: int, seed: int) -> list[np.ndarray]:
    """`samples` generated motions of each pair, in millimetres."""
    keys = jax.random.split(jax.random.key(seed), len(held.pairs))
    found = []
    for pair, key in zip(held.pairs, keys, strict=True):
        curves = composition.compose(models.motion, models.starts, key, pair, samples=samples)
        found.append(held.scale * np.asarray(curves))
    return found


def seconds(models: pipeline.Models, held: Held, *, samples: int, seed: int) -> list[np.ndarray]:
    """How long the motions of `drawn` take."""
    found = []
    for pair, key in zip(held.pairs, jax.random.split(jax.random.key(seed), len(held.pairs)), strict=True):
        keys, pairs = composition.sample_keys(key, samples), composition.label_pairs(pair)
        found.append(np.exp(np.asarray(composition.draw(models.motion, models.starts, keys, pairs).log_seconds[:, 0])))
    return found


def norm_error(models: pipeline.Models, pairs: Sequence[Pair], *, samples: int, seed: int) -> float:
    """How far the norms of generated points on the sphere are from 1, at most, over `samples` of each pair."""
    worst = 0.0
    for pair, key in zip(pairs, jax.random.split(jax.random.key(seed), len(pairs)), strict=True):
        worst = max(worst, float(_norm_error(models.motion, models.starts, jax.random.split(key, samples), *pair)))
    return worst


@jax.jit
def _norm_error(generator, beginnings, keys, start, end):
    def norm(key):
        pose_key, key = jax.random.split(key)
        return sphere.norm(
            generators.sample(generator, key, start, end, start_poses.sample(beginnings, pose_key, start)).q
        )

    return jax.numpy.max(jax.numpy.abs(jax.vmap(norm)(keys) - 1))


def scores(found: Sequence[np.ndarray], real: Held, train: Sequence[np.ndarray]) -> list[dict[str, float]]:
    """One row of figures for each pair: generated (or real) motions against held-out ones, at equal counts.

    Half of the real motions stand for "real"; the other half, scored in the place of generated ones, is the ceiling:
    `scores([c[len(c) // 2 :] for c in real.curves], real, train)`.
    """
    rows = []
    for mine, all_real, reference, known in zip(found, real.curves, real.reference, train, strict=True):
        count = min(len(mine), len(all_real) // 2)
        mine, truth = mine[:count], all_real[:count]
        across, own, own_real = (metrics.distances(a, b) for a, b in ((mine, truth), (mine, mine), (truth, truth)))
        spread = float(metrics.mean_off_diagonal(own_real))
        rows.append(
            {
                "specificity_mm": float(metrics.specificity(mine, reference)),
                "specificity_all_mm": float(np.mean(across)),
                "real_all_mm": spread,
                "davies_mm": float(np.mean(metrics.nearest_distance(mine, known))),
                "davies_real_mm": float(np.mean(metrics.nearest_distance(truth, known))),
                "diversity_ratio": float(metrics.mean_off_diagonal(own)) / spread,
                "acceleration_ratio": float(np.mean(metrics.acceleration(mine)) / np.mean(metrics.acceleration(truth))),
                "coverage": float(metrics.coverage(across, own_real, neighbours=min(5, count - 1))),
                "energy": float(metrics.energy_distance(across, own, own_real)),
            }
        )
    return rows


def mean_of(rows: Sequence[dict[str, float]]) -> dict[str, float]:
    """The mean of every figure over pairs, and the range of those whose extremes matter."""
    means = {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}
    for name in ("diversity_ratio", "acceleration_ratio"):
        values = [row[name] for row in rows]
        means[f"{name}_range"] = [min(values), max(values)]
    return means


def ceiling(real: Held) -> list[np.ndarray]:
    """The other half of the real motions, to be scored as if generated."""
    return [curves[len(curves) // 2 :] for curves in real.curves]
