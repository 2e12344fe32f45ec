"""Are generated transitions recognised as what they should be? OT23's classification test (4.3, Table 5).

A random forest of 300 trees sees 30 x 204 displacements from neutral. It is trained on the training subjects'
transitions of the 39 pairs of Table 5 (halves, and peak -> peak on geodesics) and judges 64 generated samples of
each pair. Beside it: real transitions of held-out subjects made the same way (the ceiling), and direct
performances, which do not follow geodesics.

    python -m experiments.classification --publish

About 3 minutes on 2 cores.
"""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np
from sklearn.ensemble import RandomForestClassifier

from experiments import _run
from facejax import fitting, pipeline
from facejax.data import makehuman4d, motions

PAPER = 0.924  # mean over the 39 rows of OT23's Table 5, on CoMA


@dataclasses.dataclass(frozen=True)
class Config:
    out: Path = Path("runs/classification")
    """Folder for the results."""
    seed: int = 0
    """Of the forest and the generator's noise."""
    level: int = 3
    """Realism of the dataset."""
    samples: int = 64
    """Generated transitions of each pair."""
    trees: int = 300
    """Size of the forest."""
    model: Path | None = None
    """Weights to judge in place of the released ones."""
    publish: bool = False
    """Also write the figures that the README quotes."""


def run(config: Config) -> dict[str, Any]:
    """Train the forest, generate, judge."""
    begun = time.perf_counter()
    data = makehuman4d.prepare(makehuman4d.Spec(level=config.level))
    models = pipeline.load(config.model)
    pairs = [(data.labels.index(a), data.labels.index(b)) for a, b in makehuman4d.PAIRS]
    train = _of(fitting.transitions(data, "train"), pairs)
    real = _of(_held_out(data), pairs)
    direct = _of(motions.join(*(motions.directs(data, split) for split in ("validation", "test"))), pairs)
    forest = RandomForestClassifier(config.trees, random_state=config.seed, n_jobs=2)
    forest.fit(_flat(train[0].curves), train[1])
    keys = jax.random.split(jax.random.key(config.seed), len(pairs))
    right = []
    for i, (names, key) in enumerate(zip(makehuman4d.PAIRS, keys, strict=True)):
        drawn = np.asarray(pipeline.displacements(models, key, names, samples=config.samples))
        right.append(float(np.mean(forest.predict(_flat(drawn)) == i)))
    metrics = {
        "accuracy_generated": float(np.mean(right)),
        "accuracy_real": _accuracy(forest, *real),
        "accuracy_direct": _accuracy(forest, *direct),
        "accuracy_paper_on_coma": PAPER,
        "per_transition": {f"{a}>{b}": score for (a, b), score in zip(makehuman4d.PAIRS, right, strict=True)},
    }
    made = _run.record(config, seconds=time.perf_counter() - begun, dataset=data.index["spec"])
    rows = [
        (f"generated, {config.samples} of each pair", metrics["accuracy_generated"]),
        ("real, held-out subjects, same construction (ceiling)", metrics["accuracy_real"]),
        ("real, held-out subjects, performed directly", metrics["accuracy_direct"]),
        ("OT23 on CoMA, generated (other data)", PAPER),
    ]
    table = _run.markdown(("39 transitions of Table 5", "accuracy"), rows)
    worst = sorted(metrics["per_transition"].items(), key=lambda item: item[1])[:6]
    table += "\n\nHardest: " + ", ".join(f"{name} {score:.0%}" for name, score in worst) + "."
    _run.finish("classification", config, metrics, made=made, table=table)
    return metrics


def _held_out(data) -> motions.Motions:
    parts = [fitting.transitions(data, split, per_pair=20) for split in ("validation", "test")]
    return motions.join(*parts)


def _of(found: motions.Motions, pairs: list[tuple[int, int]]) -> tuple[motions.Motions, np.ndarray]:
    """The motions of the given pairs, and which pair each is."""
    number = {pair: i for i, pair in enumerate(pairs)}
    which = np.array([number.get(pair, -1) for pair in zip(found.start.tolist(), found.end.tolist(), strict=True)])
    return found.take(which >= 0), which[which >= 0]


def _flat(curves: np.ndarray) -> np.ndarray:
    return curves.reshape(len(curves), -1)


def _accuracy(forest: RandomForestClassifier, found: motions.Motions, which: np.ndarray) -> float:
    return float(np.mean(forest.predict(_flat(found.curves)) == which))


if __name__ == "__main__":
    _run.main("classification", Config, run)
