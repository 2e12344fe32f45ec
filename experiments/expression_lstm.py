"""How well do the expression networks of Seo and Luo 2021 move faces that they have never seen?

One LSTM for each of the six basic emotions, on makehuman4d. Three questions: the next frame, given all frames before
(one step); the rest of a sequence, given its first ten frames; and a whole sequence from the neutral face alone. Judged
against constant velocity and the mean sequence of the training subjects. The way of training is chosen by a table over
validation subjects; the final figures are those of test subjects.

    python -m experiments.expression_lstm --publish

Every variant keeps its run in a folder and goes on from there when it was stopped; `--release` puts the chosen one's
weights into the package. Two hours on 2 cores for all variants; `--variants` names some.
"""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from PIL import Image

from experiments import _run
from facejax import animation, evaluation, expressions, files, fit_expressions, journal
from facejax.data import makehuman, makehuman4d, performance, sequences, store
from facejax.fit_expressions import PAPER, ExpressionPlan
from facejax.io import dress, render
from facejax.models import sequence

matplotlib.use("Agg")
import matplotlib.pyplot as plt

PREFIX = 10  # true frames that are given
PACKAGED = Path(expressions.__file__).parent / "assets" / expressions.RELEASED
SHOWN, FRAMES, PICTURE = 107, 8, (170, 212)  # a test subject, pictures of a sequence, pixels
WHOLE, MOTION = 1.02, (0.8, 1.3)  # what a network may miss from the neutral face over the mean, and how it must move


class Variant(NamedTuple):
    """One way of training the six networks."""

    plan: ExpressionPlan
    config: sequence.Config = sequence.Config()
    masked: bool = True
    mirror: bool = False  # everybody a second time, as in a mirror
    head: str = "none"  # "none": heads do not move; "kept" or "removed": on the dataset with head motion


STEPS = 3_000
SHORT = PAPER._replace(steps=STEPS, final_rate=0.0)
PLAIN = sequence.Config(carry=0.0)  # the paper's network
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
    "ours, neutral start": Variant(ENERGY, sequence.Config(start="neutral")),
    "ours, noise": Variant(NOISE),
    "ours, noise, mirror": Variant(NOISE._replace(steps=4_000), mirror=True),
    "ours, PCA-32": Variant(ENERGY, sequence.Config(components=32)),
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
    level: int = 3
    """Realism of the dataset."""
    subjects: int = 120
    """Of the dataset."""
    meshes: int = 20_000
    """Of the dataset."""
    release: bool = False
    """Put the chosen variant's weights into the package."""
    publish: bool = False
    """Also write the figures that the README quotes."""


def run(config: Config) -> dict[str, Any]:
    """Train every variant, choose one on validation subjects, judge it on test subjects."""
    begun = time.perf_counter()
    nets = {name: train(config, name) for name in config.variants}
    table = {name: scores(config, VARIANTS[name], params, "validation") for name, params in nets.items()}
    seconds = {name: sum(entry["seconds"] for entry in journal.read(folder(config, name))) for name in nets}
    name = chosen(table)
    variant, networks = VARIANTS[name], _networks(config, VARIANTS[name], nets[name])
    judged = scores(config, variant, nets[name], "test")
    metrics = {"chosen": name, "validation": table, "test": judged, "train_seconds": seconds}
    made = _run.record(config, seconds=time.perf_counter() - begun, dataset=_dataset(config, variant).index["spec"])
    networks = networks._replace(about={"made": made, "variant": name, "plan": variant.plan._asdict(), "test": judged})
    for path in [config.out / expressions.RELEASED] + [PACKAGED] * config.release:
        expressions.save(path, networks)
    figure = _plot(config.out / "expression_lstm.png", judged)
    _sheet(config.out / "sheet.png", expressions.load(config.out / expressions.RELEASED))
    if config.publish:
        with files.replacing(_run.RESULTS / "expression_lstm_sheet.png") as temporary:
            temporary.write_bytes((config.out / "sheet.png").read_bytes())
    text = f"Chosen: {name}.\n\n{_test_table(judged)}\n\n{_variants_table(table, seconds)}"
    _run.finish("expression_lstm", config, metrics, made=made, table=text, figure=figure)
    return metrics


def chosen(table: dict[str, dict[str, dict[str, float]]]) -> str:
    """The variant that goes on best from a beginning, of those that keep to the bounds from the neutral face alone.

    Bounds hold for every emotion; where no variant keeps to them, of all. Heads that move are other data: left out.
    """

    def bound(name):
        ratios = [_ratios(row) for row in table[name].values()]
        still = all(MOTION[0] <= ratio[key] <= MOTION[1] for ratio in ratios for key in ("energy", "acceleration"))
        return still and all(ratio["whole"] <= WHOLE for ratio in ratios)

    names = [name for name in table if VARIANTS[name].head == "none"] or list(table)
    within = [name for name in names if bound(name)] or names
    return min(within, key=lambda name: np.mean([_ratios(row)["rest"] for row in table[name].values()]))


def train(config: Config, name: str) -> sequence.Params:
    """The stacked networks of a variant."""
    variant = VARIANTS[name]
    data = _dataset(config, variant)
    plan = variant.plan if config.steps is None else variant.plan._replace(steps=config.steps)
    learnt_from = recordings(config, variant, "train")
    return fit_expressions.fit(
        sequences.join(learnt_from, sequences.mirrored(learnt_from)) if variant.mirror else learnt_from,
        folder(config, name),
        labels={label: data.labels.index(label) for label in performance.EMOTIONS},
        plan=plan,
        config=variant.config,
        masked=variant.masked,
        seed=config.seed,
    )


def recordings(config: Config, variant: Variant, split: str) -> sequences.Sequences:
    """The six emotions of a split's subjects, heads moving as the variant wants them."""
    found = sequences.read(_dataset(config, variant), split, performance.EMOTIONS)
    return sequences.without_head_motion(found) if variant.head == "removed" else found


def folder(config: Config, name: str) -> Path:
    """Where a variant's run is kept."""
    return config.out / name.replace(", ", "-").replace(" ", "-")


def _dataset(config: Config, variant: Variant) -> store.Store:
    spec = makehuman4d.Spec(config.level, config.subjects, config.meshes, head_motion=variant.head != "none")
    return makehuman4d.prepare(spec)


def scores(config: Config, variant: Variant, params: sequence.Params, split: str) -> dict[str, dict[str, float]]:
    """`evaluation.expression_scores` of each emotion on a split's subjects."""
    data = _dataset(config, variant)
    train, held_out = (recordings(config, variant, which) for which in ("train", split))
    found = {}
    for i, label in enumerate(performance.EMOTIONS):
        number = data.labels.index(label)
        parts = (held_out.take(held_out.label == number), train.take(train.label == number))
        network, start = fit_expressions.network(params, i), variant.config.start
        found[label] = evaluation.expression_scores(network, *parts, start=start, prefix=PREFIX)
    return found


def _networks(config: Config, variant: Variant, params: sequence.Params) -> expressions.Expressions:
    frames = recordings(config, variant, "train").curves.shape[1] + sequences.TAIL
    return expressions.Expressions(performance.EMOTIONS, params, variant.config, 30.0, frames, {})


def _ratios(row: dict[str, float]) -> dict[str, float]:
    """What is asked of the networks, each against its strongest rival."""
    return {
        "next": row["next_network"] / min(row["next_velocity"], row["next_mean"]),
        "rest": row["rest_network"] / min(row["rest_velocity"], row["rest_mean"], row["rest_mean_steps"]),
        "whole": row["whole_network"] / row["whole_mean"],
        "energy": row["energy"],
        "acceleration": row["acceleration"],
    }


def _variants_table(table, seconds) -> str:
    rows = []
    for name, found in table.items():
        ratios = [_ratios(row) for row in found.values()]
        means = [float(np.mean([ratio[key] for ratio in ratios])) for key in ("next", "rest", "whole")]
        spans = ["{:.2f} to {:.2f}".format(*_span([r[key] for r in ratios])) for key in ("energy", "acceleration")]
        rows.append((name, *means, f"{max(ratio['whole'] for ratio in ratios):.3f}", *spans, f"{seconds[name]:.0f}"))
    header = (
        "validation subjects, mean of six emotions", "next frame", f"after {PREFIX} frames", "from neutral",
        "the worst emotion", "energy", "acceleration", "training, s",
    )  # fmt: skip
    note = (
        "Errors over those of the strongest of constant velocity and the mean sequence; motion over that of recordings."
    )
    return f"{note}\n\n{_run.markdown(header, rows)}"


def _test_table(judged) -> str:
    rows = []
    for label, row in judged.items():
        rows.append(
            (
                label,
                *("{next_network:.3f} / {next_velocity:.3f} / {next_mean:.3f}".format(**row),),
                "{rest_network:.2f} / {rest_velocity:.2f} / {rest_mean:.2f} / {rest_mean_steps:.2f}".format(**row),
                "{whole_network:.3f} / {whole_mean:.3f} = {ratio:.3f}".format(**row, ratio=_ratios(row)["whole"]),
                "{energy:.2f} ({energy_mean:.2f})".format(**row),
                "{acceleration:.2f} ({acceleration_mean:.2f})".format(**row),
            )
        )
    header = (
        "test subjects, mm", "next frame: network / velocity / mean",
        f"after {PREFIX} frames: network / velocity / mean / mean steps", "from neutral: network / mean",
        "energy over real (the mean's)", "acceleration",
    )  # fmt: skip
    return _run.markdown(header, rows)


def _span(values) -> tuple[float, float]:
    return min(values), max(values)


def _plot(path: Path, judged) -> Path:
    figure, axes = plt.subplots(1, 3, figsize=(13, 3.8), constrained_layout=True)
    colours = ("#6a9a58", "#c46b4e", "#5b8db8", "#9a86b0")
    kinds = (
        (f"after {PREFIX} true frames", ("rest_network", "rest_velocity", "rest_mean", "rest_mean_steps")),
        ("from the neutral face", ("whole_network", "whole_mean")),
    )
    for axis, (title, fields) in zip(axes, kinds, strict=False):
        for i, field in enumerate(fields):
            place = np.arange(len(judged)) + 0.8 / len(fields) * (i - (len(fields) - 1) / 2)
            name = field.split("_", 1)[1].replace("_", " ")
            axis.bar(place, [r[field] for r in judged.values()], 0.8 / len(fields), label=name, color=colours[i])
        axis.set_xticks(range(len(judged)), list(judged), rotation=30)
        axis.set_title(title)
        axis.set_ylabel("landmark error, mm")
        axis.legend(frameon=False)
    axes[0].set_ylim(0, 1.3 * max(r["rest_mean"] for r in judged.values()))
    for i, field in enumerate(("energy", "acceleration")):
        axes[2].bar(np.arange(len(judged)) + 0.4 * (i - 0.5), [r[field] for r in judged.values()], 0.4, label=field)
        means = [r[f"{field}_mean"] for r in judged.values()]
        axes[2].plot(np.arange(len(judged)) + 0.4 * (i - 0.5), means, "k_", label="the mean's" if i == 0 else None)
    axes[2].axhspan(0.8, 1.3, color="#88aa66", alpha=0.2)
    axes[2].set_xticks(range(len(judged)), list(judged), rotation=30)
    axes[2].set_title("motion from the neutral face, over real")
    axes[2].legend(frameon=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    plt.close(figure)
    return path


def _sheet(path: Path, networks: expressions.Expressions) -> None:
    """Each network's own expression on one unseen face, by radial basis functions; SL21, Fig. 5."""
    shape, person = makehuman.template(), makehuman.subject(SHOWN)
    template = shape.vertices[shape.landmarks]
    face = animation.prepare(person.vertices, shape.faces, person.vertices[shape.landmarks], template)
    teeth, rows = dress.Props(template, *makehuman.template_props()), []
    camera = render.aim(face.vertices, size=PICTURE, turn=15)
    for label in networks.labels:
        curve = np.asarray(expressions.displacements(networks, label, face.landmarks))
        chosen = curve[np.linspace(0, len(curve) - 1, FRAMES).round().astype(int)]
        marks = np.asarray(animation.landmarks_of(face, chosen))
        parts = dress.parts(teeth, face.landmarks, marks)
        moved = np.asarray(animation.move(face, chosen))
        rows.append(render.frames(moved, face.faces, size=PICTURE, camera=camera, extras=parts))
    with files.replacing(path) as temporary:
        Image.fromarray(render.contact_sheet(rows, row_labels=list(networks.labels))).save(temporary)


if __name__ == "__main__":
    _run.main("expression_lstm", Config, run)
