"""Vertex error of S2D-Dec on unseen people, against ridge regression and PCA-220, by realism level.

For each level of makehuman4d: fit to the 80 training subjects, evaluate on the 20 test subjects, from true landmarks
(OT23, 4.2). The linear maps choose their regularisation by cross-validation over training subjects. OT23's tables do
not include ridge regression, which is exact on level 0 by construction.

    python -m experiments.unseen_subjects --publish

Expected on level 3, head / face: ridge 0.0462 / 0.0652 mm, PCA-220 0.0481 / 0.0681, S2D-Dec 0.0958 / 0.1444 after
12,000 steps of batch 16 (14 epochs; OT23 trains 300). Time: 65 minutes of training on 2 cores of an Intel Xeon;
interrupted training resumes.
"""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path
from typing import Any

import jax
import matplotlib
import numpy as np

from experiments import _datasets, _run
from facejax.data import dataset
from facejax.data.mesh_subset import MeshSubset, of_split
from facejax.data.synthetic import makehuman4d, rig
from facejax.evaluation import vertex_error
from facejax.models.decoders import linear, s2d_dec
from facejax.training import metric_logger
from facejax.training.recipes import fit_linear, fit_s2d_dec

matplotlib.use("Agg")
import matplotlib.pyplot as plt

METHODS = ("ridge", "pca220", "s2d")


@dataclasses.dataclass(frozen=True)
class Config:
    out: Path = Path("runs/unseen_subjects")
    """Folder for checkpoints and results."""
    seed: int = 0
    """Seed of the decoders."""
    data: Path | None = None
    """Prepared dataset to use in place of makehuman4d and its levels."""
    levels: tuple[int, ...] = rig.LEVELS
    """Realism levels of makehuman4d, each 0 to 3."""
    subjects: int = 120
    """Number of subjects of makehuman4d."""
    meshes: int = 20_000
    """Number of meshes of makehuman4d."""
    steps: int = fit_s2d_dec.S2DDecPlan().steps
    """Number of training steps of S2D-Dec."""
    publish: bool = False
    """Also write the committed results in experiments/results."""


def run(config: Config) -> dict[str, Any]:
    """Evaluate all methods; one row per level, method and region."""
    begun = time.perf_counter()
    rows, levels = [], config.levels
    if config.data is not None:
        levels = (config.data.name,)
    for level in levels:
        data = _data(config, level)
        train, test = of_split(data, "train"), of_split(data, "test")
        regions = _datasets.region_masks(data)
        for name, model, options in (("ridge", linear.ridge, {}), ("pca220", linear.pca, {"components": 220})):
            params, alpha = fit_linear.fit_linear(model, train, **options)
            found = vertex_error.vertex_errors(lambda m, p=params: linear.apply(p, m), test, regions)
            rows += _rows(level, name, found, {"alpha_mm2": alpha})
        decode, training = _decoder(config, level, train)
        rows += _rows(level, "s2d", vertex_error.vertex_errors(decode, test, regions), training)
    made = _run.record(config, seconds=time.perf_counter() - begun, dataset=data.index["spec"])
    metrics = {"rows": rows}
    figure = _plot(config.out / "unseen_subjects.png", rows, levels)
    _run.finish("unseen_subjects", config, metrics, made=made, table=_table(rows, levels), figure=figure)
    return metrics


def _data(config: Config, level: int | str) -> dataset.Dataset:
    if config.data is not None:
        return dataset.open_meshes(config.data)
    return makehuman4d.prepare(makehuman4d.Spec(level, config.subjects, config.meshes))


def _named(level: int | str) -> str:
    return level if isinstance(level, str) else f"level {level}"


def _decoder(config: Config, level: int | str, train: MeshSubset):
    hierarchy = jax.device_put(_datasets.mesh_hierarchy(train.data))
    folder, plan = config.out / _named(level).replace(" ", ""), fit_s2d_dec.S2DDecPlan(steps=config.steps)
    params = fit_s2d_dec.fit(train, hierarchy, folder, plan=plan, seed=config.seed)
    seconds = sum(entry["seconds"] for entry in metric_logger.read(folder))
    about = {"steps": plan.steps, "train_seconds": round(seconds, 1)}
    return (lambda marks: s2d_dec.apply(params, hierarchy, marks)), about


def _rows(level: int | str, method: str, found: dict[str, Any], more: dict[str, Any]) -> list[dict[str, Any]]:
    return [{"level": level, "method": method, "region": region, **row, **more} for region, row in found.items()]


def _value(rows, level: int | str, method: str, region: str) -> float:
    return next(r["mean_mm"] for r in rows if (r["level"], r["method"], r["region"]) == (level, method, region))


def _table(rows, levels) -> str:
    body = []
    for level in levels:
        cells = [
            "{:.4f} / {:.4f}".format(*(_value(rows, level, method, region) for region in ("head", "face")))
            for method in METHODS
        ]
        body.append((_named(level), *cells))
    header = ("mean vertex error, mm: head / face", "ridge", "PCA-220", "S2D-Dec")
    return _run.markdown(header, body)


def _plot(path: Path, rows, levels) -> Path:
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.6), constrained_layout=True, sharey=True)
    colours = {"ridge": "#c46b4e", "pca220": "#5b8db8", "s2d": "#6a9a58"}
    for axis, region in zip(axes, ("head", "face"), strict=True):
        for i, method in enumerate(METHODS):
            values = [_value(rows, level, method, region) for level in levels]
            axis.bar(np.arange(len(levels)) + 0.26 * (i - 1), values, 0.26, label=method, color=colours[method])
        axis.set_xticks(range(len(levels)), [_named(level) for level in levels])
        axis.set_title(region)
    axes[0].set_ylabel("mean vertex error, mm")
    axes[0].legend(frameon=False)
    return _run.save_figure(figure, path)


if __name__ == "__main__":
    _run.main("unseen_subjects", Config, run)
