"""Which generator of landmark motion? GAN, flow and the authors' GAN on the same data, over seeds.

Every variant is trained on the 80 training subjects of makehuman4d and scored on people that none has seen, against
other real people scored in the same way. The choice is made on validation people: of the variants that keep to the
bounds of `meets`, the one nearest to real motions in energy distance. Runs are kept in `out` and go on where they were
stopped; `--variants` and `--seeds` pick some, and the table shows all that are there.

    python -m experiments.generators --publish

About 3 hours on 2 cores, a quarter of an hour for each seed of the authors' GAN among them.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import time
from pathlib import Path
from typing import Any

import jax
import matplotlib
import numpy as np

from experiments import _motion_eval, _run, _transition_classifier
from facejax.data import motions, transitions
from facejax.inference import pipeline
from facejax.models.motion import flow_matching, motion3dgan_reference
from facejax.training import metric_logger
from facejax.training.recipes import fit_motion

matplotlib.use("Agg")
import matplotlib.pyplot as plt

# Where the motions come from, the generator, and what differs from its default plan.
VARIANTS = {
    "gaussian": ("everything", "gaussian", {}),
    "flow": ("everything", "flow", {}),
    "flow, prototypes": ("prototypes", "flow", {}),
    "gan": ("everything", "gan", {}),
    "gan, last weights": ("everything", "gan", {"average": False}),
    "gan, prototypes": ("prototypes", "gan", {}),
    "gan, alpha_2 = 10": ("everything", "gan", {"reconstruction": 10.0, "length": 10.0}),
    "reference / 8": ("prototypes", "reference", {}),
}
BOUNDS = {"accuracy": 0.03, "specificity": 1.1, "diversity": (0.8, 1.2), "acceleration": (0.8, 1.3)}


@dataclasses.dataclass(frozen=True)
class Config(_motion_eval.People):
    out: Path = Path("runs/generators")
    """Folder for checkpoints, weights and results."""
    seed: int = 0
    """Of the forest and of the noise that is drawn."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Of the trainings."""
    variants: tuple[str, ...] = tuple(VARIANTS)
    """What to train and score now."""
    flow_steps: int = fit_motion.FlowPlan().steps
    """Of the flow."""
    gan_steps: int = fit_motion.GanPlan().steps
    """Of the GAN."""
    reference_steps: int = 500
    """Of the authors' GAN, of which a sample costs as much as a batch of the others."""
    reference_batch: int = 16
    """Its samples in a step."""
    model: Path | None = None
    """Weights that lend the files of the generators their way to meshes; by default the released ones."""


def run(config: Config) -> dict[str, Any]:
    """Train what is missing, score it on validation people, choose."""
    begun = time.perf_counter()
    unknown = [name for name in config.variants if name not in VARIANTS]
    if unknown:
        raise ValueError(f"--variants: unknown {_quoted(unknown)}; there are {_quoted(VARIANTS)}")
    data = _motion_eval.data_of(config)
    lent = pipeline.load(config.model)
    _motion_eval.fits(lent, data, config.model or "the released models")
    examples = functools.cache(lambda source: _examples(data, source))
    judge = functools.cache(lambda: _judge(config))
    for name in config.variants:
        for seed in config.seeds[:1] if name == "gaussian" else config.seeds:
            path = weights_of(config.out, name, seed)
            score_path = path.with_suffix(".json")
            if not path.exists():
                _train(config, name, seed, data, examples, lent, path)
                score_path.unlink(missing_ok=True)
            if not score_path.exists():
                models = pipeline.load(path)
                row = judge()(models) | {"seconds": models.about["seconds"]}
                _run.write_text(score_path, json.dumps(row, indent=1) + "\n")
    found = {name: _scored(config.out, name) for name in VARIANTS if _scored(config.out, name)}
    table = {name: _over_seeds(rows) for name, rows in found.items()}
    real = judge()(None)
    metrics = {
        "chosen": chosen(table, real),
        "rule": "least mean energy distance on validation people, of the variants within the bounds",
        "bounds": BOUNDS,
        "validation": table,
        "real": real,
        "per_seed": found,
    }
    figure = _plot(config.out, table, real)
    made = _run.record(config, seconds=time.perf_counter() - begun, dataset=data.index["spec"])
    _run.finish(
        "generators",
        config,
        metrics,
        made=made,
        table=_table(table, real, len(_motion_eval.names_of(data))),
        figure=figure,
    )
    return metrics


def _quoted(names) -> str:
    return ", ".join(f'"{name}"' for name in names)


def weights_of(out: Path, name: str, seed: int) -> Path:
    """Where a variant's weights lie."""
    stem = "".join(c if c.isalnum() else "_" for c in name)
    return out / f"{stem}-{seed}.safetensors"


def meets(row: dict[str, Any], real: dict[str, Any]) -> bool:
    """Whether a variant keeps to the bounds that real motions set."""
    low, high = BOUNDS["diversity"]
    slow, fast = BOUNDS["acceleration"]
    return (
        row["accuracy"] >= real["accuracy"] - BOUNDS["accuracy"]
        and row["specificity_all_mm"] <= BOUNDS["specificity"] * row["real_all_mm"]
        and low <= row["diversity_ratio"] <= high
        and slow <= row["acceleration_ratio"] <= fast
    )


def chosen(table: dict[str, dict[str, Any]], real: dict[str, Any]) -> str:
    """The variant of least energy distance among those within the bounds; if none is, among all."""
    inside = [name for name, row in table.items() if meets(row, real)] or list(table)
    return min(inside, key=lambda name: table[name]["energy"])


def _examples(data, source: str) -> tuple[motions.Motions, Any, transitions.Examples]:
    """Motions to fit a chart on, the chart, and all motions in it."""
    labels = len(data.labels)
    if source == "prototypes":
        known = transitions.transitions(data, "train")
        chart = transitions.fit_chart(known, labels=labels, rank=transitions.default_rank(known))
        return known, chart, transitions.encode_examples(chart, [known])
    known = motions.join(*transitions.all_pairs(data, "train", per_pair=transitions.CHART_PER_PAIR))
    chart = transitions.fit_chart(known, labels=labels, rank=transitions.default_rank(known))
    return known, chart, transitions.encode_examples(chart, transitions.all_pairs(data, "train"))


def _train(config: Config, name: str, seed: int, data, examples, lent: pipeline.Models, path: Path) -> None:
    """Train one variant and write its weights."""
    source, kind, options = VARIANTS[name]
    known, chart, found = examples(source)
    # A variant that differs in what is made of a run shares the run.
    folder = weights_of(config.out, name.removesuffix(", last weights"), seed).with_suffix("")
    if kind == "gaussian":
        generator = flow_matching.init(
            jax.random.key(seed), chart, config=fit_motion.sized(flow_matching.Config(), chart)
        )
    elif kind == "flow":
        plan = fit_motion.FlowPlan(steps=config.flow_steps)
        generator = fit_motion.fit_flow(found, chart, folder, plan=plan, seed=seed)
    elif kind == "gan":
        average = options.get("average", True)
        terms = {name: value for name, value in options.items() if name != "average"}
        plan = fit_motion.GanPlan(steps=config.gan_steps, **terms)
        generator = fit_motion.fit_gan(found, chart, folder, plan=plan, seed=seed, average=average)
    else:
        plan = fit_motion.REFERENCE._replace(steps=config.reference_steps, batch=config.reference_batch)
        eighth = motion3dgan_reference.Config(width_divisor=8)
        generator = fit_motion.fit_reference(known, chart, folder, plan=plan, config=eighth, seed=seed)
    beginnings = transitions.fit_start_poses(chart, motions.halves(data, "train"))
    models = lent._replace(motion=generator, starts=beginnings)
    # Of the steps alone, over all runs that it took: compiling and preparing are the same for all.
    seconds = 0.0 if kind == "gaussian" else sum(row["seconds"] for row in metric_logger.read(folder))
    about = {"variant": name, "seed": seed, "seconds": seconds}
    pipeline.save(path, models._replace(about=models.about | about))


def _judge(config: Config):
    """A function from models, or None for real people, to the mean figures on validation people."""
    names = _motion_eval.names_of(_motion_eval.data_of(config))
    real = _motion_eval.held(config, "validation", names)
    train = _motion_eval.seen(config, real.pairs, real.scale, 3 * transitions.CHART_PER_PAIR)
    forest = _transition_classifier.forest(config, names)

    def judge(models: pipeline.Models | None) -> dict[str, Any]:
        found = _motion_eval.ceiling(real)
        if models is not None:
            count = max(len(curves) for curves in found)
            found = _motion_eval.drawn(models, real, samples=count, seed=config.seed)
        means = _motion_eval.mean_of(_motion_eval.scores(found, real, train))
        return means | {"accuracy": float(np.mean(_transition_classifier.recognised(forest, found, real.scale)))}

    return judge


def _scored(out: Path, name: str) -> list[dict[str, Any]]:
    paths = sorted(out.glob(weights_of(out, name, 0).name.replace("-0.safetensors", "-*.json")))
    return [json.loads(path.read_text()) for path in paths]


def _over_seeds(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Means over seeds, and the spread of the energy distance."""
    numbers = [name for name, value in rows[0].items() if not isinstance(value, list)]
    means = {name: float(np.mean([row[name] for row in rows])) for name in numbers}
    energies = [row["energy"] for row in rows]
    return means | {"seeds": len(rows), "energy_range": [min(energies), max(energies)]}


def _table(table: dict[str, dict[str, Any]], real: dict[str, Any], pairs: int) -> str:
    def row(name, r):
        return (
            name,
            f"{r['energy']:.3f}"
            + (f" ({r['energy_range'][0]:.3f} to {r['energy_range'][1]:.3f})" if "seeds" in r else ""),
            r["coverage"],
            r["specificity_all_mm"] / r["real_all_mm"],
            r["davies_mm"] / r["davies_real_mm"],
            r["diversity_ratio"],
            r["acceleration_ratio"],
            r["accuracy"],
            f"{r['seconds'] / 60:.1f}" if "seconds" in r else "",
            r.get("seeds", ""),
        )

    header = (
        f"validation people, {pairs} pairs", "energy distance", "coverage", "specificity / real",
        "nearest trained on / real", "diversity", "acceleration", "accuracy", "minutes", "seeds",
    )  # fmt: skip
    return _run.markdown(header, [*(row(name, r) for name, r in table.items()), row("other real people", real)])


def _plot(out: Path, table: dict[str, dict[str, Any]], real: dict[str, Any]) -> Path:
    figure, axes = plt.subplots(1, 3, figsize=(12, 0.45 * len(table) + 1.6), constrained_layout=True, sharey=True)
    for axis, field in zip(axes, ("energy", "coverage", "diversity_ratio"), strict=True):
        axis.barh(list(table), [row[field] for row in table.values()], color="#5b8db8")
        axis.axvline(real[field], color="k", linewidth=1, label="other real people")
        axis.set_xlabel(field.replace("_", " "))
    # The untrained Gaussian sets the scale; what is far beyond it is written.
    limit = 1.5 * table["gaussian"]["energy"] if "gaussian" in table else np.inf
    if max(row["energy"] for row in table.values()) > limit:
        axes[0].set_xlim(-0.05 * limit, limit)
    for place, row in enumerate(table.values()):
        if row["energy"] > limit:
            axes[0].text(0.97 * limit, place, f"{row['energy']:.1f} →", ha="right", va="center", color="w")
    axes[0].invert_yaxis()
    axes[0].legend(frameon=False)
    out.mkdir(parents=True, exist_ok=True)
    path = out / "generators.png"
    figure.savefig(path, dpi=110)
    plt.close(figure)
    return path


if __name__ == "__main__":
    _run.main("generators", Config, run)
