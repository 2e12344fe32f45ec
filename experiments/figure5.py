"""Cumulative distribution of vertex errors of every method (OT23, figure 5).

    python -m experiments.table1 && python -m experiments.figure5 --publish

Reads the results of `experiments.table1` from its folder and computes the missing ones. Curves are given for the
whole head and for the face alone: a third of the head's vertices never moves, which raises every curve.

Expected, identity split, share of the head's vertices below 0.1 mm: ridge 86.4 %, residual decoder 96.4 %, S2D-Dec
74.4 %. Time: a few minutes on 2 cores; the recorded seconds are those of fitting.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

from experiments import _datasets, _mesh_eval, _run
from facejax.evaluation import vertex_error

matplotlib.use("Agg")
import matplotlib.pyplot as plt

METHODS = ("pca38", "pca220", "dl3dmm", "ridge", "rbf", "neural3dmm", "s2d", "gpmm", "s2d_residual")
SHOWN = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0)  # mm


@dataclasses.dataclass(frozen=True)
class Config(_mesh_eval.Options):
    out: Path = Path("runs/figure5")
    """Folder for the results."""
    runs: Path = Path("runs/table1")
    """Folder of the results of `experiments.table1`."""
    data: Path | None = None
    """Prepared dataset to use in place of makehuman4d."""
    level: int = 3
    """Realism level of makehuman4d, 0 to 3."""
    methods: tuple[str, ...] = METHODS
    """Methods to evaluate."""
    splits: tuple[str, ...] = ("expression", "identity")
    """Protocols to evaluate."""


def run(config: Config) -> dict[str, Any]:
    """Return the share of vertices below each distance, per split, region and method."""
    mode = config.mode
    _mesh_eval.check_methods(config.methods)
    data = _datasets.load(config.data, mode, level=config.level)
    regions, hierarchy = _datasets.region_masks(data), _datasets.mesh_hierarchy(data)
    curves, seconds = [], 0.0
    for split in config.splits:
        for name in config.methods:
            parts = [
                _mesh_eval.evaluate(
                    name,
                    case,
                    config.folder(config.runs),
                    _mesh_eval.training_options(case, mode, config.seed, hierarchy),
                    regions,
                )[0.0]
                for case in _datasets.cases(data, [split])
            ]
            seconds += sum(part.seconds for part in parts)
            shares = _mesh_eval.pool(parts).cumulative()
            for region, share in zip(regions, shares, strict=True):
                curves.append({"split": split, "method": name, "region": region, "share": share.round(5).tolist()})
    made = _run.record(config, seconds=seconds, dataset=data.index["spec"])
    metrics = {"mode": mode, "edges_mm": vertex_error.BIN_EDGES.round(6).tolist(), "curves": curves}
    figure = _plot(config.out / "figure5.png", curves, list(regions), config)
    _run.finish("figure5", config, metrics, made=made, table=_table(curves, regions, config), figure=figure)
    return metrics


def _share(curves, split: str, method: str, region: str) -> np.ndarray:
    key = (split, method, region)
    return np.array(next(c["share"] for c in curves if (c["split"], c["method"], c["region"]) == key))


def _table(curves, regions, config: Config) -> str:
    parts = []
    for split in config.splits:
        body = []
        for method in config.methods:
            cells = []
            for limit in SHOWN:
                both = [np.interp(np.log(limit), np.log(vertex_error.BIN_EDGES), _share(curves, split, method, region))
                        for region in regions]  # fmt: skip
                cells.append(" / ".join(f"{share:.1%}" for share in both))
            body.append((_mesh_eval.METHOD_NAMES[method], *cells))
        header = (f"{split} split, head / face", *(f"below {limit:g} mm" for limit in SHOWN))
        parts.append(_run.markdown(header, body))
    return "\n\n".join(parts)


def _plot(path: Path, curves, regions: list[str], config: Config) -> Path:
    rows, columns = len(config.splits), len(regions)
    figure, axes = plt.subplots(
        rows, columns, figsize=(5 * columns, 3.8 * rows), constrained_layout=True, squeeze=False
    )
    colours = dict(zip(config.methods, plt.colormaps["tab10"](np.arange(len(config.methods)) % 10), strict=True))
    for line, split in zip(axes, config.splits, strict=True):
        for axis, region in zip(line, regions, strict=True):
            for method in config.methods:
                style = "--" if method in ("ridge", "gpmm") else "-"
                axis.plot(vertex_error.BIN_EDGES, _share(curves, split, method, region), style, color=colours[method],
                          label=_mesh_eval.METHOD_NAMES[method])  # fmt: skip
            axis.set(xscale="log", xlim=(2e-3, 3), ylim=(0, 1), title=f"{split} split, {region}", xlabel="mm")
            axis.grid(alpha=0.3)
        line[0].set_ylabel("share of vertices nearer than")
    axes[0, 0].legend(frameon=False, fontsize=8)
    return _run.save_figure(figure, path)


if __name__ == "__main__":
    _run.main("figure5", Config, run)
