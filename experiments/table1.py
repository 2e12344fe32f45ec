"""Landmarks to mesh, every method: mean vertex error on people, and on expressions, that were left out. OT23, Table 1.

    python -m experiments.table1 --publish

On makehuman4d, level 3: four folds over 100 people (`identity`), four over CoMA's twelve expressions (`expression`),
and 20 people that nothing was ever chosen on (`test`). True landmarks, all vertices of the head, and of the face
region alone, since a scalp that never moves flatters everybody. OT23's own figures stand beside: other data, other
errors. Every method chooses the weights of its priors by cross-validation within the training meshes, on what the
split leaves out.

Steps of training: S2D-Dec 12,000 of batch 16, Neural3DMM 3,000, the residual decoder 2,500. `--paper` trains all for
300 epochs; `--quick` is a look on a small dataset. A stopped run goes on. `--methods`, `--splits` and `--folds` pick;
two processes may work on different methods in one folder. Three hours of training on one core in all, those of the
linear methods 20 minutes of it; on two cores two processes halve it.
"""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

from experiments import _datasets, _mesh_eval, _run

matplotlib.use("Agg")
import matplotlib.pyplot as plt

METHODS = (
    "ridge", "pca220", "pca38", "pca220_mean", "dl3dmm", "rbf", "gpmm", "s2d_residual", "s2d", "neural3dmm",
)  # fmt: skip
SPLITS = ("identity", "expression", "test")
# OT23, Table 1, CoMA: mean and standard deviation in mm.
PAPER = {
    "pca220": {"expression": (0.76, 0.73), "identity": (0.80, 0.73)},
    "pca38": {"expression": (0.90, 0.84), "identity": (0.93, 0.82)},
    "dl3dmm": {"expression": (0.86, 0.80), "identity": (0.89, 0.79)},
    "neural3dmm": {"expression": (0.75, 0.85), "identity": (3.74, 2.34)},
    "s2d": {"expression": (0.52, 0.59), "identity": (0.55, 0.62)},
}


@dataclasses.dataclass(frozen=True)
class Config(_mesh_eval.Options):
    out: Path = Path("runs/table1")
    """Folder for checkpoints and results."""
    data: Path | None = None
    """A prepared dataset in place of makehuman4d."""
    level: int = 3
    """Realism of makehuman4d."""
    methods: tuple[str, ...] = METHODS
    """Which methods."""
    splits: tuple[str, ...] = SPLITS
    """Which protocols."""
    folds: int | None = None
    """Only the first so many folds of each."""


def run(config: Config) -> dict[str, Any]:
    """One row per method, split and region."""
    mode = config.mode
    _mesh_eval.check_methods(config.methods)
    data = _datasets.data_of(config.data, mode, level=config.level)
    regions, hierarchy = _datasets.regions_of(data), _datasets.hierarchy_of(data)
    results: dict[tuple[str, str], list] = {}
    found = [case for case in _datasets.cases(data, config.splits) if config.folds is None or case.fold < config.folds]
    if not found:
        raise ValueError(f"--folds {config.folds}: expected 1 or more")
    for case in found:
        for name in config.methods:
            begun = time.perf_counter()
            options = _mesh_eval.options_of(case, mode, config.seed, hierarchy)
            result = _mesh_eval.judge(name, case, config.folder(), options, regions)[0.0]
            results.setdefault((name, case.split), []).append(result)
            mean, face = (result.distances.mean_std(mask)[0] for mask in regions.values())
            print(f"{name} {case.name}: {mean:.4f} / {face:.4f} mm, {time.perf_counter() - begun:.0f} s", flush=True)
    rows = [row for key, parts in results.items() for row in _rows(*key, parts, regions)]
    seconds = sum(part.seconds for parts in results.values() for part in parts)
    made = _run.record(config, seconds=seconds, dataset=data.index["spec"])
    metrics = {"mode": mode, "data": data.index.get("name"), "rows": rows, "paper_mm": PAPER}
    figure = _plot(config.out / "table1.png", rows, config)
    _run.finish("table1", config, metrics, made=made, table=_table(rows, config), figure=figure)
    return metrics


def _rows(method: str, split: str, parts: list, regions: dict[str, np.ndarray]) -> list[dict[str, Any]]:
    pooled = _mesh_eval.pooled(parts)
    rows = []
    for region, mask in regions.items():
        mean, std = pooled.mean_std(mask)
        folds = [round(part.distances.mean_std(mask)[0], 5) for part in parts]
        row = {"method": method, "split": split, "mean_mm": mean, "std_mm": std, "region": region, "folds_mm": folds}
        row["train_seconds"] = round(sum(part.seconds for part in parts))
        rows.append(row | {"chosen": [part.about for part in parts]})
    return rows


def value(rows: list[dict[str, Any]], method: str, split: str, region: str, what: str = "mean_mm") -> float:
    """One figure of the table; NaN where it was not asked for."""
    key = (method, split, region)
    return next((r[what] for r in rows if (r["method"], r["split"], r["region"]) == key), np.nan)


def _table(rows, config: Config) -> str:
    header = ["mm, head / face"] + [f"{split} split" for split in config.splits]
    header += [f"OT23 on CoMA, {split}" for split in ("identity", "expression")] + ["training, min"]
    body = []
    for method in config.methods:
        cells = [_mesh_eval.NAMES[method]]
        for split in config.splits:
            cells.append(
                "{:.4f} ± {:.4f} / {:.4f}".format(
                    *(value(rows, method, split, "head", what) for what in ("mean_mm", "std_mm")),
                    value(rows, method, split, "face"),
                )
            )
        for split in ("identity", "expression"):
            cells.append("{:.2f} ± {:.2f}".format(*PAPER[method][split]) if method in PAPER else "")
        minutes = sum(r["train_seconds"] for r in rows if r["method"] == method and r["region"] == "head") / 60
        body.append([*cells, f"{minutes:.0f}"])
    return _run.markdown(header, body)


def _plot(path: Path, rows, config: Config) -> Path:
    figure, axes = plt.subplots(1, len(config.splits), figsize=(4.4 * len(config.splits), 4), constrained_layout=True,
                                squeeze=False)  # fmt: skip
    for axis, split in zip(axes[0], config.splits, strict=True):
        place = np.arange(len(config.methods))
        for i, (region, colour) in enumerate((("head", "#5b8db8"), ("face", "#c46b4e"))):
            values = [value(rows, method, split, region) for method in config.methods]
            bars = axis.barh(place + 0.4 * i, values, 0.4, label=region, color=colour)
            axis.bar_label(bars, [f"{v:.3f}" for v in values], fontsize=7, padding=2)
        axis.set_yticks(place + 0.2, [_mesh_eval.NAMES[m] for m in config.methods], fontsize=8)
        axis.invert_yaxis()
        axis.margins(x=0.18)
        axis.set(title=f"{split} split", xlabel="mean vertex error, mm")
    axes[0, 0].legend(frameon=False)
    return _mesh_eval.drawn(figure, path)


if __name__ == "__main__":
    _run.main("table1", Config, run)
