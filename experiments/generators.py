"""Comparison of motion generators on the same data over seeds: flow, GAN and their variants.

Every variant is trained on the 80 training subjects of makehuman4d and scored on validation people, beside other real
people scored in the same way. The chosen variant is the one of least energy distance to real motions among those
within the bounds of `within_bounds`. Runs are kept in `out` and resume; `--variants` and `--seeds` select what to
train.

    python -m experiments.generators --publish

`--variants "reference / 8"` also trains the GAN as its authors built it, at 1/8 of its width. It is left out by
default: 500 steps of batch 16 take a quarter of an hour per seed, and are too few to judge it, since its moving
average of the weights still holds 61 % of the random start (0.999^500).

Expected energy distance, mean of three seeds: flow 0.041, GAN 0.068, untrained Gaussian 0.110, other real people
-0.002. Time: 2 hours of training on 2 cores of an AMD EPYC.
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
from facejax.evaluation import motion_metrics
from facejax.inference import pipeline
from facejax.models.motion import flow_matching, motion3dgan_reference
from facejax.training import metric_logger
from facejax.training.recipes import fit_motion

matplotlib.use("Agg")
import matplotlib.pyplot as plt

# Variant -> training motions, kind of generator, changes to its default plan.
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
DEFAULT_VARIANTS = tuple(name for name in VARIANTS if name != "reference / 8")
BOUNDS = {"accuracy": 0.03, "specificity": 1.1, "diversity": (0.8, 1.2), "acceleration": (0.8, 1.3)}


@dataclasses.dataclass(frozen=True)
class Config(_motion_eval.DataOptions):
    out: Path = Path("runs/generators")
    """Folder for checkpoints, weights and results."""
    seed: int = 0
    """Seed of the forest and of the generators' noise."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds of the training runs."""
    variants: tuple[str, ...] = DEFAULT_VARIANTS
    """Variants to train and score."""
    flow_steps: int = fit_motion.FlowPlan().steps
    """Number of training steps of the flow."""
    gan_steps: int = fit_motion.GanPlan().steps
    """Number of training steps of the GAN."""
    reference_steps: int = 500
    """Number of training steps of the authors' GAN; one of its samples costs as much as a batch of the others."""
    reference_batch: int = 16
    """Batch size of the authors' GAN."""
    model: Path | None = None
    """Model file whose decoder is saved with the generators; by default the released models."""


def run(config: Config) -> dict[str, Any]:
    """Train missing variants, score them on validation people, and choose one."""
    begun = time.perf_counter()
    unknown = [name for name in config.variants if name not in VARIANTS]
    if unknown:
        raise ValueError(f"--variants: unknown {_quoted(unknown)}; there are {_quoted(VARIANTS)}")
    data = _motion_eval.load_dataset(config)
    lent = pipeline.load(config.model)
    _motion_eval.check_models(lent, data, config.model or "the released models")
    examples = functools.cache(lambda source: _examples(data, source))
    judge = functools.cache(lambda: _judge(config))
    for name in config.variants:
        for seed in config.seeds[:1] if name == "gaussian" else config.seeds:
            path = weights_path(config.out, name, seed)
            score_path = path.with_suffix(".json")
            if not path.exists():
                _train(config, name, seed, data, examples, lent, path)
                score_path.unlink(missing_ok=True)
            if not score_path.exists():
                models = pipeline.load(path)
                row = judge()(models) | {"seconds": models.about["seconds"]}
                _run.write_text(score_path, json.dumps(row, indent=1) + "\n")
    shown = [name for name in VARIANTS if name in (*DEFAULT_VARIANTS, *config.variants)]
    found = {name: rows for name in shown if (rows := _saved_scores(config.out, name))}
    table = {name: _over_seeds(rows) for name, rows in found.items()}
    real = judge()(None)
    metrics = {
        "chosen": choose(table, real),
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
        table=_table(table, real, len(_motion_eval.name_pairs(data))),
        figure=figure,
    )
    return metrics


def _quoted(names) -> str:
    return ", ".join(f'"{name}"' for name in names)


def weights_path(out: Path, name: str, seed: int) -> Path:
    """Return the path of a variant's model file."""
    stem = "".join(c if c.isalnum() else "_" for c in name)
    return out / f"{stem}-{seed}.safetensors"


def within_bounds(row: dict[str, Any], real: dict[str, Any]) -> bool:
    """Return whether a variant's scores are within the bounds relative to real motions."""
    low, high = BOUNDS["diversity"]
    slow, fast = BOUNDS["acceleration"]
    return (
        row["accuracy"] >= real["accuracy"] - BOUNDS["accuracy"]
        and row["specificity_all_mm"] <= BOUNDS["specificity"] * row["real_all_mm"]
        and low <= row["diversity_ratio"] <= high
        and slow <= row["acceleration_ratio"] <= fast
    )


def choose(table: dict[str, dict[str, Any]], real: dict[str, Any]) -> str:
    """Return the variant of least energy distance among those within the bounds, or among all if none is."""
    inside = [name for name, row in table.items() if within_bounds(row, real)] or list(table)
    return min(inside, key=lambda name: table[name]["energy"])


def _examples(data, source: str) -> tuple[motions.Motions, Any, transitions.Examples]:
    """Return the motions that the tangent PCA is fitted to, the PCA, and all training motions encoded by it."""
    labels = len(data.labels)
    if source == "prototypes":
        known = transitions.transitions(data, "train")
        chart = transitions.fit_chart(known, labels=labels, rank=transitions.default_rank(known))
        return known, chart, transitions.encode_examples(chart, [known])
    known = motions.join(*transitions.all_pairs(data, "train", per_pair=transitions.CHART_PER_PAIR))
    chart = transitions.fit_chart(known, labels=labels, rank=transitions.default_rank(known))
    return known, chart, transitions.encode_examples(chart, transitions.all_pairs(data, "train"))


def _train(config: Config, name: str, seed: int, data, examples, lent: pipeline.Models, path: Path) -> None:
    """Train one variant and write its model file."""
    source, kind, options = VARIANTS[name]
    known, chart, found = examples(source)
    # "gan, last weights" uses the training run of "gan".
    folder = weights_path(config.out, name.removesuffix(", last weights"), seed).with_suffix("")
    if kind == "gaussian":
        generator = flow_matching.init(
            jax.random.key(seed), chart, config=fit_motion.config_for_chart(flow_matching.Config(), chart)
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
    models = lent.replace(motion=generator, starts=beginnings)
    # Of the training steps alone, over all runs: compilation and preparation are the same for all variants.
    seconds = 0.0 if kind == "gaussian" else sum(row["seconds"] for row in metric_logger.read(folder))
    about = {"variant": name, "seed": seed, "seconds": seconds}
    pipeline.save(path, models.replace(about=models.about | about))


def _judge(config: Config):
    """Return a function from models, or None for real people, to their mean scores on validation people."""
    names = _motion_eval.name_pairs(_motion_eval.load_dataset(config))
    real = _motion_eval.held_out_motions(config, "validation", names)
    train = _motion_eval.training_motions(config, real.pairs, real.scale, 3 * transitions.CHART_PER_PAIR)
    forest = _transition_classifier.train_forest(config, names)

    def judge(models: pipeline.Models | None) -> dict[str, Any]:
        found = motion_metrics.second_halves(real.curves)
        if models is not None:
            count = max(len(curves) for curves in found)
            found = _motion_eval.generate(models, real, samples=count, seed=config.seed)
        means = motion_metrics.mean_scores(motion_metrics.pair_scores(found, real.curves, real.reference, train))
        return means | {"accuracy": float(np.mean(_transition_classifier.accuracy_per_pair(forest, found, real.scale)))}

    return judge


def _saved_scores(out: Path, name: str) -> list[dict[str, Any]]:
    paths = sorted(out.glob(weights_path(out, name, 0).name.replace("-0.safetensors", "-*.json")))
    return [json.loads(path.read_text()) for path in paths]


def _over_seeds(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the means over seeds, and the range of the energy distance."""
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
    # The untrained Gaussian sets the scale; bars beyond it are labelled with their value.
    limit = 1.5 * table["gaussian"]["energy"] if "gaussian" in table else np.inf
    if max(row["energy"] for row in table.values()) > limit:
        axes[0].set_xlim(-0.05 * limit, limit)
    for place, row in enumerate(table.values()):
        if row["energy"] > limit:
            axes[0].text(0.97 * limit, place, f"{row['energy']:.1f} →", ha="right", va="center", color="w")
    axes[0].invert_yaxis()
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper right", frameon=False)
    return _run.save_figure(figure, out / "generators.png")


if __name__ == "__main__":
    _run.main("generators", Config, run)
