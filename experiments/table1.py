"""Mean vertex error of every landmark-to-mesh method on held-out people and expressions (OT23, Table 1).

    python -m experiments.table1 --publish

Protocols on makehuman4d, level 3: `identity`, four folds over 100 people; `expression`, four folds over CoMA's twelve
expressions; `test`, 20 people not used for any choice. Landmarks are the true ones. Errors are given over all
vertices of the head and over the face region alone, since vertices of the scalp that never move lower the mean of
every method. OT23's figures stand beside them, on other data. Each method chooses the weights of its priors by
cross-validation within the training meshes, over people or expressions as the protocol does.

Training steps by default: S2D-Dec 12,000 of batch 16 (12 to 23 epochs), Neural3DMM 3,000, residual decoder 2,500;
`--paper` trains each for 300 epochs, `--quick` uses a small dataset and few steps. `--methods`, `--splits` and
`--folds` select; two processes may evaluate different methods in one folder; interrupted runs resume.

Expected on the test people, head: ridge 0.0449 mm, PCA-220 0.0471, GPMM ("carried GPMM") 0.0220, residual decoder
0.0205, S2D-Dec 0.0951; S2D-Dec with `--paper` 0.0586. The residual decoder's error is 0.22x that of S2D-Dec after 12
to 23 epochs and 0.35x that of S2D-Dec after 300; it also sees the neutral mesh, which S2D-Dec does not. The GPMM's
factor over ridge (0.49x) favours the GPMM: levels 2 and 3 create expressions with the deformation transfer that it
uses itself (see `experiments.nonlinearity`). Neural3DMM is undertrained here: its error is 1.31 mm on people of its
training set (expression split). Time: 3 hours of training on one core of an AMD EPYC, 20 minutes of them for the
linear methods; two processes on two cores halve it. S2D-Dec with `--paper`: 4 to 8 minutes per fold on an H200.
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
    """Prepared dataset to use in place of makehuman4d."""
    level: int = 3
    """Realism level of makehuman4d, 0 to 3."""
    methods: tuple[str, ...] = METHODS
    """Methods to evaluate."""
    splits: tuple[str, ...] = SPLITS
    """Protocols to evaluate."""
    folds: int | None = None
    """Number of folds of each protocol to evaluate; by default all."""


def run(config: Config) -> dict[str, Any]:
    """Evaluate all methods; one row per method, split and region."""
    mode = config.mode
    _mesh_eval.check_methods(config.methods)
    data = _datasets.load(config.data, mode, level=config.level)
    regions, hierarchy = _datasets.region_masks(data), _datasets.mesh_hierarchy(data)
    results: dict[tuple[str, str], list] = {}
    found = [case for case in _datasets.cases(data, config.splits) if config.folds is None or case.fold < config.folds]
    if not found:
        raise ValueError(f"--folds {config.folds}: expected 1 or more")
    for case in found:
        for name in config.methods:
            begun = time.perf_counter()
            options = _mesh_eval.training_options(case, mode, config.seed, hierarchy)
            result = _mesh_eval.evaluate(name, case, config.folder(), options, regions)[0.0]
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
    pooled = _mesh_eval.pool(parts)
    rows = []
    for region, mask in regions.items():
        mean, std = pooled.mean_std(mask)
        folds = [round(part.distances.mean_std(mask)[0], 5) for part in parts]
        row = {"method": method, "split": split, "mean_mm": mean, "std_mm": std, "region": region, "folds_mm": folds}
        row["train_seconds"] = round(sum(part.seconds for part in parts))
        rows.append(row | {"chosen": [part.about for part in parts]})
    return rows


def value(rows: list[dict[str, Any]], method: str, split: str, region: str, what: str = "mean_mm") -> float:
    """Return one figure of the table; NaN for a method or split that was not evaluated."""
    key = (method, split, region)
    return next((r[what] for r in rows if (r["method"], r["split"], r["region"]) == key), np.nan)


def _table(rows, config: Config) -> str:
    header = ["mm, head / face"] + [f"{split} split" for split in config.splits]
    header += [f"OT23 on CoMA, {split}" for split in ("identity", "expression")] + ["training, min"]
    body = []
    for method in config.methods:
        cells = [_mesh_eval.METHOD_NAMES[method]]
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
        axis.set_yticks(place + 0.2, [_mesh_eval.METHOD_NAMES[m] for m in config.methods], fontsize=8)
        axis.invert_yaxis()
        axis.margins(x=0.18)
        axis.set(title=f"{split} split", xlabel="mean vertex error, mm")
    axes[0, 0].legend(frameon=False)
    return _run.save_figure(figure, path)


if __name__ == "__main__":
    _run.main("table1", Config, run)
