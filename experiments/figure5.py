"""How many vertices are how near to the truth: cumulative error curves. OT23, figure 5.

    python -m experiments.table1 && python -m experiments.figure5 --publish

Of the results of `experiments.table1`, whose folder is read; what is missing there is made. Over the whole head, and
over the face alone: a third of a head never moves, which lifts every curve.
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
    """Folder of `experiments.table1`."""
    data: Path | None = None
    """A prepared dataset in place of makehuman4d."""
    level: int = 3
    """Realism of makehuman4d."""
    methods: tuple[str, ...] = METHODS
    """Which methods."""
    splits: tuple[str, ...] = ("expression", "identity")
    """Which protocols."""


def run(config: Config) -> dict[str, Any]:
    """The share of vertices below each distance, per split, region and method."""
    mode = config.mode
    _mesh_eval.check_methods(config.methods)
    data = _datasets.data_of(config.data, mode, level=config.level)
    regions, hierarchy = _datasets.regions_of(data), _datasets.hierarchy_of(data)
    curves, seconds = [], 0.0
    for split in config.splits:
        for name in config.methods:
            parts = [
                _mesh_eval.judge(
                    name,
                    case,
                    config.folder(config.runs),
                    _mesh_eval.options_of(case, mode, config.seed, hierarchy),
                    regions,
                )[0.0]
                for case in _datasets.cases(data, [split])
            ]
            seconds += sum(part.seconds for part in parts)
            shares = _mesh_eval.pooled(parts).cumulative()
            for region, share in zip(regions, shares, strict=True):
                curves.append({"split": split, "method": name, "region": region, "share": share.round(5).tolist()})
    made = _run.record(config, seconds=seconds, dataset=data.index["spec"])
    metrics = {"mode": mode, "edges_mm": vertex_error.EDGES.round(6).tolist(), "curves": curves}
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
                both = [np.interp(np.log(limit), np.log(vertex_error.EDGES), _share(curves, split, method, region))
                        for region in regions]  # fmt: skip
                cells.append(" / ".join(f"{share:.1%}" for share in both))
            body.append((_mesh_eval.NAMES[method], *cells))
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
                axis.plot(vertex_error.EDGES, _share(curves, split, method, region), style, color=colours[method],
                          label=_mesh_eval.NAMES[method])  # fmt: skip
            axis.set(xscale="log", xlim=(2e-3, 3), ylim=(0, 1), title=f"{split} split, {region}", xlabel="mm")
            axis.grid(alpha=0.3)
        line[0].set_ylabel("share of vertices nearer than")
    axes[0, 0].legend(frameon=False, fontsize=8)
    return _mesh_eval.drawn(figure, path)


if __name__ == "__main__":
    _run.main("figure5", Config, run)
