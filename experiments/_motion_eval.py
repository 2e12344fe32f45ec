"""Held-out real motions, generated motions and options of the experiments on motion generators.

There are two groups of held-out people. Generators are chosen on "validation": the 20 validation subjects and 120
people of another makehuman4d population (seed 2). Published results are on "test": the 20 test subjects and 120
people of a third population (seed 3). The real transitions are not selected by prototypes, which would narrow them:
every person's start pose is combined with every person's end pose. On other datasets the groups are the dataset's
splits alone, and all ordered pairs of its labels are evaluated.
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
from facejax import augment
from facejax.data import dataset, motions
from facejax.data.synthetic import makehuman4d
from facejax.inference import composition, pipeline

GROUPS = {"validation": 2, "test": 3}  # split of the dataset -> seed of the population that is added to it
MIN_COUNT = 4  # of people, and of motions per pair
LabelPair = tuple[int, int]
NamePair = tuple[str, str]


class HeldOut(NamedTuple):
    """Real motions of held-out people, in millimetres on a face of mean size; one list entry per pair of labels."""

    pairs: list[LabelPair]
    names: list[NamePair]
    curves: list[np.ndarray]  # (M, T, L, 3) each: displacements from neutral
    seconds: list[np.ndarray]  # (M,) each: durations
    reference: list[np.ndarray]  # (T, L, 3) each: the single held-out sample of OT23 4.3
    people: int
    scale: float  # millimetres per unit of a generated motion


@dataclasses.dataclass(frozen=True)
class DataOptions:
    """Dataset options of an experiment on held-out motions."""

    data: Path | None = None
    """Prepared dataset to use in place of makehuman4d; give models trained on it too (`facejax fit`)."""
    level: int = 3
    """Realism level of makehuman4d, 0 to 3."""
    subjects: int = 120
    """Number of subjects of makehuman4d."""
    meshes: int = 20_000
    """Number of meshes of makehuman4d."""
    people: int = 120
    """Size of the population added to makehuman4d's validation or test subjects; 0 adds none."""
    publish: bool = False
    """Also write the committed results in experiments/results."""


@dataclasses.dataclass(frozen=True)
class Options(DataOptions):
    """Options of an experiment that evaluates trained models on the test group."""

    seed: int = 0
    """Seed of all random draws."""
    models: tuple[Path, ...] = ()
    """Model files to average the scores over; by default the released models, trained on makehuman4d."""
    samples: int = 64
    """Number of generated motions per pair, or per chain."""


def load_models(config: Options) -> list[pipeline.Models]:
    """Load the models to evaluate and check that they match the dataset. Raises `ValueError` where they do not."""
    found, data = [pipeline.load(path) for path in config.models or (None,)], load_dataset(config)
    for path, models in zip(config.models or ("the released models",), found, strict=True):
        check_models(models, data, path)
    return found


def check_models(models: pipeline.Models, data: dataset.Dataset, path: Path | str) -> None:
    """Raise `ValueError` unless the models have the dataset's labels, triangles and landmark vertices."""
    mesh = models.face
    if models.labels != data.labels:
        raise ValueError(
            f"{path}: expected the labels of {data.path}, {', '.join(data.labels)}; got {', '.join(models.labels)}: "
            "`facejax fit --data` trains models on a dataset"
        )
    if not (np.array_equal(mesh.faces, data.faces) and np.array_equal(mesh.landmark_index, data.landmark_index)):
        raise ValueError(
            f"{path}: expected the triangles and landmarks of {data.path}: "
            "`facejax fit --data` trains models on a dataset"
        )


def load_dataset(config: DataOptions) -> dataset.Dataset:
    """Open the dataset of the options, else prepare makehuman4d."""
    if config.data is not None:
        return dataset.open_dataset(config.data)
    return makehuman4d.prepare(makehuman4d.Spec(config.level, config.subjects, config.meshes))


def name_pairs(data: dataset.Dataset) -> tuple[NamePair, ...]:
    """Return the pairs of labels to evaluate: the 39 of OT23 on makehuman4d, else all ordered pairs."""
    if _datasets.is_makehuman(data):
        return makehuman4d.TABLE5_PAIRS
    return tuple(itertools.permutations(data.labels, 2))


def group_halves(config: DataOptions, group: str) -> motions.Motions:
    """Return all motions from and to neutral of a group's people."""
    data = load_dataset(config)
    if not len(data.subjects(group)):
        raise ValueError(f"{data.path}: the {group} split has no subjects")
    parts = [motions.halves(data, group)]
    if config.people and config.data is None:
        spec = makehuman4d.Spec(config.level, config.people, config.people, seed=GROUPS[group])
        others = makehuman4d.prepare(spec)
        for split in (split for split in dataset.SPLITS if len(others.subjects(split))):
            part = motions.halves(others, split)
            parts.append(part._replace(subject=part.subject + config.subjects))
    return motions.join(*parts)


def held_out_motions(config: DataOptions, group: str, names: Sequence[NamePair]) -> HeldOut:
    """Return transitions of a group's people without selection, as many per pair as there are people.

    Raises:
        ValueError: for fewer than four people, or motions of a pair; one half is compared with the other.
    """
    data = load_dataset(config)
    labels = data.labels
    halves = group_halves(config, group)
    pairs = [(labels.index(a), labels.index(b)) for a, b in names]
    people = len(np.unique(halves.subject))
    if people < MIN_COUNT:
        raise ValueError(f"{data.path}: expected {MIN_COUNT} or more people in the {group} split, got {people}")
    onsets = halves.take(halves.start == 0)
    between = motions.interpolated_transitions(
        onsets, len(labels), per_pair=people, choice="spread", pairs=set(pairs), seed=1
    )
    found = motions.join(halves, *between)
    scale = float(np.mean(found.scale))
    curves = [scale * curves_of_pair(found, pair) for pair in pairs]
    few = [" > ".join(name) for name, each in zip(names, curves, strict=True) if len(each) < MIN_COUNT]
    if few:
        raise ValueError(f"{data.path}: expected {MIN_COUNT} or more motions of every pair, fewer of {', '.join(few)}")
    seconds = [found.seconds[(found.start == a) & (found.end == b)] for a, b in pairs]
    # From the first half, which serves as the real set, so that it is never compared with itself.
    halves = [np.zeros(len(c) // 2, int) for c in curves]
    one = [np.argmax(augment.sample_per_pair(half, half, seed=1)) for half in halves]
    reference = [c[i] for c, i in zip(curves, one, strict=True)]
    return HeldOut(pairs, list(names), curves, seconds, reference, people, scale)


def training_motions(config: DataOptions, pairs: Sequence[LabelPair], scale: float, count: int) -> list[np.ndarray]:
    """Return `count` training motions per pair in millimetres, without selection."""
    data = load_dataset(config)
    halves = motions.halves(data, "train")
    onsets = halves.take(halves.start == 0)
    between = motions.interpolated_transitions(
        onsets, len(data.labels), per_pair=count, choice="spread", pairs=set(pairs), seed=2
    )
    found = motions.join(halves, *between)
    return [scale * curves_of_pair(found, pair)[:count] for pair in pairs]


def curves_of_pair(found: motions.Motions, pair: LabelPair) -> np.ndarray:
    """Return the curves of one (start, end) pair."""
    return found.curves[(found.start == pair[0]) & (found.end == pair[1])]


def generate(models: pipeline.Models, held: HeldOut, *, samples: int, seed: int) -> list[np.ndarray]:
    """Generate `samples` motions of each pair, in millimetres."""
    keys = jax.random.split(jax.random.key(seed), len(held.pairs))
    found = []
    for pair, key in zip(held.pairs, keys, strict=True):
        curves = composition.compose(models.motion, models.starts, key, pair, samples=samples)
        found.append(held.scale * np.asarray(curves))
    return found


def generated_seconds(models: pipeline.Models, held: HeldOut, *, samples: int, seed: int) -> list[np.ndarray]:
    """Return the durations of the motions of `generate`."""
    found = []
    for pair, key in zip(held.pairs, jax.random.split(jax.random.key(seed), len(held.pairs)), strict=True):
        keys, pairs = composition.sample_keys(key, samples), composition.label_pairs(pair)
        found.append(np.exp(np.asarray(composition.draw(models.motion, models.starts, keys, pairs).log_seconds[:, 0])))
    return found
