"""How well do the expression networks of Seo and Luo 2021 move faces that they have never seen?

One LSTM for each of the six basic emotions, on makehuman4d. Three questions: the next frame, given all frames before
(one step); the rest of a sequence, given its first ten frames; and a whole sequence from the neutral face alone. Judged
against constant velocity and the mean sequence of the training subjects. The way of training is chosen on the
validation subjects, the final figures are those of the test subjects; 120 people more, drawn with a seed of their own,
join either, since 20 people have too few ways of doing things to tell one variant from another.

    python -m experiments.expression_lstm --publish

With `--data STORE` all of a dataset's expressions, and its own people alone. Every variant keeps its run in a folder
and goes on from there when it was stopped; `--release` puts the chosen one's weights into the package. Two hours on 2
cores for all variants; `--variants` names some.
"""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from experiments import _datasets, _lstm_report, _run
from facejax.cli import runtime
from facejax.data import dataset, sequences
from facejax.data.synthetic import expression_recipes, makehuman4d
from facejax.evaluation import expression_error
from facejax.inference import expressions
from facejax.io import atomic
from facejax.models import expression_lstm
from facejax.training import metric_logger
from facejax.training.recipes import fit_expression_lstm
from facejax.training.recipes.fit_expression_lstm import PAPER, ExpressionPlan

PACKAGED = Path(expressions.__file__).parent / "assets" / expressions.RELEASED
MORE = {"to choose": 2, "to judge": 3}  # seeds of populations that nothing is trained on
CHOICE, JUDGED = ("validation", "to choose"), ("test", "to judge")
WHOLE, MOTION = 1.02, (0.8, 1.3)  # what a network may miss from the neutral face over the mean, and how it must move


class Variant(NamedTuple):
    """One way of training the six networks."""

    plan: ExpressionPlan
    config: expression_lstm.Config = expression_lstm.Config()
    masked: bool = True
    mirror: bool = False  # everybody a second time, as in a mirror
    head: str = "none"  # "none": heads do not move; "kept" or "removed": on the dataset with head motion


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
    """Of the initial weights and the order of the data."""
    variants: tuple[str, ...] = tuple(VARIANTS)
    """Which ways of training; the best of them on validation subjects is judged on test subjects."""
    steps: int | None = None
    """Training steps in place of each variant's own."""
    data: Path | None = None
    """A prepared dataset in place of makehuman4d."""
    level: int = 3
    """Realism of makehuman4d."""
    subjects: int = 120
    """Of the dataset."""
    meshes: int = 20_000
    """Of the dataset."""
    release: bool = False
    """Put the chosen variant's weights into the package."""
    publish: bool = False
    """Also write the figures that the README quotes."""


def run(config: Config) -> dict[str, Any]:
    """Train every variant, choose one on people that it has not seen, judge it on others."""
    if config.release and config.data is not None:
        raise ValueError("--release puts networks of makehuman4d into the package: leave out --data")
    begun = time.perf_counter()
    nets = {name: train(config, name) for name in config.variants}
    table = {name: scores(config, VARIANTS[name], params, CHOICE) for name, params in nets.items()}
    seconds = {name: sum(entry["seconds"] for entry in metric_logger.read(folder(config, name))) for name in nets}
    name = chosen(table)
    variant, networks = VARIANTS[name], _networks(config, VARIANTS[name], nets[name])
    judged = scores(config, variant, nets[name], JUDGED)
    alone = scores(config, variant, nets[name], ("test",))
    metrics = {"chosen": name, "choice": table, "test": judged, "test_alone": alone, "train_seconds": seconds}
    made = _run.record(config, seconds=time.perf_counter() - begun, dataset=_dataset(config, variant).index["spec"])
    networks = networks._replace(about={"made": made, "variant": name, "plan": variant.plan._asdict(), "test": judged})
    for path in [config.out / expressions.RELEASED] + [PACKAGED] * config.release:
        expressions.save(path, networks)
    figure = _lstm_report.plot(config.out / "expression_lstm.png", judged)
    shown = expressions.load(config.out / expressions.RELEASED)
    _lstm_report.sheet(
        config.out / "sheet.png", shown, None if config.data is None else dataset.open_dataset(config.data)
    )
    if config.publish:
        with atomic.replace_file(_run.RESULTS / "expression_lstm_sheet.png") as temporary:
            temporary.write_bytes((config.out / "sheet.png").read_bytes())
    text = f"Chosen: {name}.\n\n{_lstm_report.test_table(judged)}\n\n{_lstm_report.variants_table(table, seconds)}"
    _run.finish("expression_lstm", config, metrics, made=made, table=text, figure=figure)
    return metrics


def chosen(table: dict[str, dict[str, dict[str, float]]]) -> str:
    """The variant that goes on best from a beginning, of those that keep to the bounds from the neutral face alone.

    Bounds hold for every emotion; where no variant keeps to them, of all. Heads that move are other data: left out.
    """

    def bound(name):
        ratios = [_lstm_report.ratios(row) for row in table[name].values()]
        still = all(MOTION[0] <= ratio[key] <= MOTION[1] for ratio in ratios for key in ("energy", "acceleration"))
        return still and all(ratio["whole"] <= WHOLE for ratio in ratios)

    names = [name for name in table if VARIANTS[name].head == "none"] or list(table)
    within = [name for name in names if bound(name)] or names
    return min(within, key=lambda name: np.mean([_lstm_report.ratios(row)["rest"] for row in table[name].values()]))


def train(config: Config, name: str) -> expression_lstm.ExpressionLSTM:
    """The stacked networks of a variant."""
    variant = VARIANTS[name]
    data = _dataset(config, variant)
    plan = variant.plan if config.steps is None else variant.plan._replace(steps=config.steps)
    learnt_from = recordings(config, variant, "train")
    return fit_expression_lstm.fit(
        sequences.join(learnt_from, sequences.mirror(learnt_from)) if variant.mirror else learnt_from,
        folder(config, name),
        labels={label: data.labels.index(label) for label in labels_of(data)},
        plan=plan,
        config=variant.config,
        masked=variant.masked,
        seed=config.seed,
    )


def recordings(config: Config, variant: Variant, split: str) -> sequences.Sequences:
    """The emotions of a split's subjects, or of a population in `MORE`; heads move as the variant wants them."""
    if split in MORE:
        spec = _spec(config, variant)._replace(meshes=min(config.meshes, config.subjects), seed=MORE[split])
        people = makehuman4d.prepare(spec)
        found = sequences.join(*(sequences.read(people, part, expression_recipes.EMOTIONS) for part in dataset.SPLITS))
    else:
        data = _dataset(config, variant)
        found = sequences.read(data, split, labels_of(data))
    return sequences.remove_head_motion(found) if variant.head == "removed" else found


def labels_of(data: dataset.Dataset) -> tuple[str, ...]:
    """What there is a network for: the six emotions, or all expressions of a dataset of the user's own."""
    return expression_recipes.EMOTIONS if _datasets.is_makehuman(data) else data.labels[1:]


def folder(config: Config, name: str) -> Path:
    """Where a variant's run is kept."""
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
    """`evaluation.expression_scores` of each emotion; all `splits` together, the first where heads move."""
    data = _dataset(config, variant)
    splits = splits if variant.head == "none" and config.data is None else splits[:1]
    train = recordings(config, variant, "train")
    held_out = sequences.join(*(recordings(config, variant, split) for split in splits))
    found = {}
    for i, label in enumerate(labels_of(data)):
        number = data.labels.index(label)
        parts = (held_out.take(held_out.label == number), train.take(train.label == number))
        network, start = fit_expression_lstm.network(params, i), variant.config.start
        found[label] = expression_error.expression_scores(network, *parts, start=start, prefix=_lstm_report.PREFIX)
    return found


def _networks(config: Config, variant: Variant, params: expression_lstm.ExpressionLSTM) -> expressions.Expressions:
    frames, data = recordings(config, variant, "train").curves.shape[1] + sequences.TAIL_FRAMES, _dataset(config, variant)
    return expressions.Expressions(labels_of(data), params, variant.config, float(data.index["rate"]), frames, {})


if __name__ == "__main__":
    runtime.use_all_cores()
    _run.main("expression_lstm", Config, run)
