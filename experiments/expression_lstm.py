"""Errors of the expression networks of Seo & Luo 2021 on unseen faces, and the choice of how to train them.

One LSTM for each of the six basic emotions, on makehuman4d. Three tasks: the next frame, given all frames before (one
step); the rest of a sequence, given its first ten frames; and a whole sequence from the neutral face alone. The
baselines are constant velocity and the mean sequence of the training subjects. The training variant is chosen on the
validation subjects, the final figures are those of the test subjects; 120 more people, drawn with a separate seed,
are added to either, since 20 people are too few to tell variants apart. The variant "paper" trains on true inputs for
10,000 steps at a constant rate (SL21: 10,000 epochs); the variants "truth" do so for 3,000 steps with a decaying
rate.

    python -m experiments.expression_lstm --publish

`--data STORE` uses all expressions of a dataset, and its own people alone. Every variant keeps its run in a folder
and resumes; `--release` puts the chosen variant's weights into the package; `--variants` selects.

Expected after ten frames, over the strongest baseline: 0.825 for the chosen variant "ours", 0.889 for "truth", means
of six emotions. Time: 2 hours of training on 2 cores of an AMD EPYC for the nine variants of the committed table.
"""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import facejax
from experiments import _datasets, _lstm_report, _run
from facejax.cli import runtime
from facejax.data import dataset, sequences
from facejax.data.synthetic import expression_recipes, makehuman4d
from facejax.evaluation import expression_error
from facejax.inference import expressions
from facejax.models import expression_lstm
from facejax.models.labels import Labels
from facejax.models.records import Provenance
from facejax.training import metric_logger
from facejax.training.recipes import fit_expression_lstm
from facejax.training.recipes.fit_expression_lstm import PAPER, ExpressionPlan

PACKAGED = Path(facejax.__file__).parent / "assets" / expressions.RELEASED
EXTRA_POPULATIONS = {"extra validation": 2, "extra test": 3}  # name -> seed; nothing is trained on them
VALIDATION, TEST = ("validation", "extra validation"), ("test", "extra test")
# Bounds of a network from the neutral face: error over the mean sequence's, motion over real motion.
MAX_WHOLE_RATIO, MOTION_BOUNDS = 1.02, (0.8, 1.3)


class Variant(NamedTuple):
    """A way of training the networks."""

    plan: ExpressionPlan
    config: expression_lstm.Config = expression_lstm.Config()
    masked: bool = True
    mirror: bool = False  # adds mirrored recordings
    head: str = "none"  # head motion: "none", or "kept" or "removed" on the dataset that has it


STEPS = 3_000
SHORT = PAPER._replace(steps=STEPS, final_rate=0.0)
PLAIN = expression_lstm.Config(carry=0.0)  # the paper's network
SWITCH = ExpressionPlan(steps=STEPS, noise=0.0, energy=0.0)
ENERGY = SWITCH._replace(energy=10.0)
NOISE = SWITCH._replace(energy=20.0, noise=0.2)
VARIANTS = {
    "paper": Variant(PAPER, PLAIN),
    "truth": Variant(SHORT, PLAIN),
    "truth, neutral start": Variant(SHORT, PLAIN._replace(start="neutral")),
    "truth, no mask": Variant(SHORT, PLAIN, masked=False),
    "truth, noise 0.5": Variant(SHORT._replace(noise=0.5), PLAIN),
    "truth, PCA-32": Variant(SHORT, PLAIN._replace(components=32)),
    "coin": Variant(SHORT._replace(feed="coin"), PLAIN),
    "switch": Variant(SHORT._replace(feed="switch"), PLAIN),
    "switch, path": Variant(SWITCH, PLAIN),
    "switch, path, energy": Variant(ENERGY, PLAIN),
    "ours": Variant(ENERGY),
    "ours, neutral start": Variant(ENERGY, expression_lstm.Config(start="neutral")),
    "ours, noise": Variant(NOISE),
    "ours, noise, mirror": Variant(NOISE._replace(steps=4_000), mirror=True),
    "ours, PCA-32": Variant(ENERGY, expression_lstm.Config(components=32)),
    "ours, head kept": Variant(ENERGY, head="kept"),
    "ours, head removed": Variant(ENERGY, head="removed"),
}


@dataclasses.dataclass(frozen=True)
class Config:
    out: Path = Path("runs/expression_lstm")
    """Folder for checkpoints and results."""
    seed: int = 0
    """Seed of the initial weights and the order of the data."""
    variants: tuple[str, ...] = tuple(VARIANTS)
    """Training variants; the best of them on validation subjects is evaluated on test subjects."""
    steps: int | None = None
    """Number of training steps, in place of each variant's own."""
    data: Path | None = None
    """Prepared dataset to use in place of makehuman4d."""
    level: int = 3
    """Realism level of makehuman4d, 0 to 3."""
    subjects: int = 120
    """Number of subjects of makehuman4d."""
    meshes: int = 20_000
    """Number of meshes of makehuman4d."""
    release: bool = False
    """Write the chosen variant's weights into the package."""
    publish: bool = False
    """Also write the committed results in experiments/results."""


def run(config: Config) -> dict[str, Any]:
    """Train every variant, choose one on validation people, evaluate it on test people."""
    if config.release and config.data is not None:
        raise ValueError("--release puts networks of makehuman4d into the package: leave out --data")
    begun = time.perf_counter()
    nets = {name: train(config, name) for name in config.variants}
    table = {name: scores(config, VARIANTS[name], params, VALIDATION) for name, params in nets.items()}
    seconds = {name: sum(entry["seconds"] for entry in metric_logger.read(run_folder(config, name))) for name in nets}
    name = choose(table)
    variant, networks = VARIANTS[name], _networks(config, VARIANTS[name], nets[name])
    judged = scores(config, variant, nets[name], TEST)
    alone = scores(config, variant, nets[name], ("test",))
    metrics = {"chosen": name, "choice": table, "test": judged, "test_alone": alone, "train_seconds": seconds}
    made = _run.record(config, seconds=time.perf_counter() - begun, dataset=_dataset(config, variant).index["spec"])
    about = {"made": made, "variant": name, "plan": variant.plan._asdict(), "test": judged}
    networks = networks.replace(about=Provenance(about))
    for path in [config.out / expressions.RELEASED] + [PACKAGED] * config.release:
        expressions.save(path, networks)
    figure = _lstm_report.plot(config.out / "expression_lstm.png", judged)
    shown = expressions.load(config.out / expressions.RELEASED)
    _lstm_report.sheet(
        config.out / "sheet.png", shown, None if config.data is None else dataset.open_dataset(config.data)
    )
    if config.publish:
        _run.publish_file(config.out / "sheet.png", "expression_lstm_sheet.png")
    text = f"Chosen: {name}.\n\n{_lstm_report.test_table(judged)}\n\n{_lstm_report.variants_table(table, seconds)}"
    _run.finish("expression_lstm", config, metrics, made=made, table=text, figure=figure)
    return metrics


def choose(table: dict[str, dict[str, dict[str, float]]]) -> str:
    """Return the variant with the least error after the given frames, among those within the bounds.

    The bounds hold for every expression, from the neutral face alone; if no variant is within them, all are candidates.
    Variants with head motion are trained on other data and left out.
    """

    def bound(name):
        ratios = [_lstm_report.error_ratios(row) for row in table[name].values()]
        still = all(
            MOTION_BOUNDS[0] <= ratio[key] <= MOTION_BOUNDS[1] for ratio in ratios for key in ("energy", "acceleration")
        )
        return still and all(ratio["whole"] <= MAX_WHOLE_RATIO for ratio in ratios)

    names = [name for name in table if VARIANTS[name].head == "none"] or list(table)
    within = [name for name in names if bound(name)] or names
    return min(
        within, key=lambda name: np.mean([_lstm_report.error_ratios(row)["rest"] for row in table[name].values()])
    )


def train(config: Config, name: str) -> expression_lstm.ExpressionLSTM:
    """Train a variant and return its stacked networks."""
    variant = VARIANTS[name]
    data = _dataset(config, variant)
    plan = variant.plan if config.steps is None else variant.plan._replace(steps=config.steps)
    learnt_from = recordings(config, variant, "train")
    return fit_expression_lstm.fit(
        sequences.join(learnt_from, sequences.mirror(learnt_from)) if variant.mirror else learnt_from,
        run_folder(config, name),
        labels={label: data.labels.index(label) for label in trained_labels(data)},
        plan=plan,
        config=variant.config,
        masked=variant.masked,
        seed=config.seed,
    )


def recordings(config: Config, variant: Variant, split: str) -> sequences.Sequences:
    """Return the recordings of a split's subjects or of an extra population, with or without head motion."""
    if split in EXTRA_POPULATIONS:
        spec = _spec(config, variant)._replace(
            meshes=min(config.meshes, config.subjects), seed=EXTRA_POPULATIONS[split]
        )
        people = makehuman4d.prepare(spec)
        found = sequences.join(*(sequences.read(people, part, expression_recipes.EMOTIONS) for part in dataset.SPLITS))
    else:
        data = _dataset(config, variant)
        found = sequences.read(data, split, trained_labels(data))
    return sequences.remove_head_motion(found) if variant.head == "removed" else found


def trained_labels(data: dataset.Dataset) -> tuple[str, ...]:
    """Return the labels that get a network: the six emotions on makehuman4d, else all expressions of the dataset."""
    return expression_recipes.EMOTIONS if _datasets.is_makehuman(data) else data.labels[1:]


def run_folder(config: Config, name: str) -> Path:
    """Return the folder of a variant's run."""
    return config.out / name.replace(", ", "-").replace(" ", "-")


def _spec(config: Config, variant: Variant) -> makehuman4d.Spec:
    return makehuman4d.Spec(config.level, config.subjects, config.meshes, head_motion=variant.head != "none")


def _dataset(config: Config, variant: Variant) -> dataset.Dataset:
    if config.data is not None:
        return dataset.open_dataset(config.data)
    return makehuman4d.prepare(_spec(config, variant))


def scores(
    config: Config, variant: Variant, params: expression_lstm.ExpressionLSTM, splits: tuple[str, ...]
) -> dict[str, dict]:
    """Return the scores per label on the splits together; with head motion on the first alone."""
    data = _dataset(config, variant)
    splits = splits if variant.head == "none" and config.data is None else splits[:1]
    train = recordings(config, variant, "train")
    held_out = sequences.join(*(recordings(config, variant, split) for split in splits))
    found = {}
    for i, label in enumerate(trained_labels(data)):
        number = data.labels.index(label)
        parts = (held_out.take(held_out.label == number), train.take(train.label == number))
        network, start = fit_expression_lstm.network(params, i), variant.config.start
        found[label] = expression_error.expression_scores(network, *parts, start=start, prefix=_lstm_report.PREFIX)
    return found


def _networks(config: Config, variant: Variant, params: expression_lstm.ExpressionLSTM) -> expressions.Expressions:
    frames, data = (
        recordings(config, variant, "train").curves.shape[1] + sequences.TAIL_FRAMES,
        _dataset(config, variant),
    )
    return expressions.Expressions(
        Labels(trained_labels(data)), params, variant.config, float(data.index["rate"]), frames
    )


if __name__ == "__main__":
    runtime.use_all_cores()
    _run.main("expression_lstm", Config, run)
