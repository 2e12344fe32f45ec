"""Vertex error of methods trained on one population and evaluated on another (OT23, Table 3).

    python -m experiments.table3 --publish

Two MakeHuman populations: *A* is makehuman4d (seed 1, without noise). *B* has other people who perform differently
(seed 2) and smooth noise of 0.2 mm as registration leaves it, drawn anew for every frame. As in OT23, A to B is
evaluated on all of B, B to A on the test set of A. The noise of the ground truth cannot be predicted: a row gives the
distance that it alone moves vertices, and B is also evaluated against its noise-free meshes ("B, clean"). `--first`
and `--second` take two prepared datasets with one mesh topology instead, CoMA and Florence 4D for example.

`--quick` uses small datasets and few steps, `--paper` trains for 300 epochs. Interrupted runs resume.

Expected, head, A to B clean / B to A: ridge 0.0435 / 0.0530 mm, GPMM 0.0212 / 0.0375, residual decoder 0.0199 /
0.0322, S2D-Dec 0.0933 / 0.0953. Time: 75 minutes on 2 cores of an AMD EPYC.
"""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

from experiments import _datasets, _mesh_eval, _run
from facejax.data import dataset
from facejax.data.mesh_subset import MeshSubset, of_split
from facejax.evaluation import vertex_error

matplotlib.use("Agg")
import matplotlib.pyplot as plt

METHODS = ("pca220", "dl3dmm", "ridge", "rbf", "gpmm", "gpmm_found", "s2d_residual", "s2d")
NOISE = 0.2  # mm, of B
ALONE = "B's noise alone"
SEEDS = (1, 2)
LEVEL = 3  # realism level of both
# OT23, Table 3: mean and standard deviation in mm, trained on Florence 4D and evaluated on CoMA, and vice versa.
PAPER = {
    "pca220": ((1.81, 1.54), (0.64, 0.89)),
    "dl3dmm": ((2.09, 1.78), (0.72, 0.91)),
    "s2d": ((1.50, 1.84), (0.56, 0.76)),
}


@dataclasses.dataclass(frozen=True)
class Config(_mesh_eval.Options):
    out: Path = Path("runs/table3")
    """Folder for checkpoints and results."""
    first: Path | None = None
    """Prepared dataset to use in place of A; it needs the same mesh topology as B."""
    second: Path | None = None
    """Prepared dataset to use in place of B; it needs the same mesh topology as A."""
    methods: tuple[str, ...] = METHODS
    """Methods to evaluate."""


def run(config: Config) -> dict[str, Any]:
    """Evaluate all methods; one row per direction, method and region."""
    mode = config.mode
    _mesh_eval.check_methods(config.methods)
    a = _datasets.load(config.first, mode, level=LEVEL, seed=SEEDS[0])
    b = _datasets.load(config.second, mode, level=LEVEL, seed=SEEDS[1], noise=NOISE)
    _datasets.check_same_topology(a, b)
    regions, hierarchy = _datasets.region_masks(a), _datasets.mesh_hierarchy(a)
    directions = [("A to B", a, _everybody(b)), ("B to A", b, of_split(a, "test"))]
    if config.second is None:
        clean = _datasets.load(None, mode, level=LEVEL, seed=SEEDS[1])
        directions.insert(1, ("A to B, clean", a, _everybody(clean)))
    rows, seconds = [], 0.0
    for title, source, test in directions:
        case = _datasets.Case(
            title.replace(" ", "_").replace(",", ""), 0, _training(source), _datasets.limit_count(test), "subjects"
        )
        options = _mesh_eval.training_options(case, mode, config.seed, hierarchy)
        for name in config.methods:
            begun = time.perf_counter()
            # Evaluations of one direction share the trained networks.
            result = _mesh_eval.evaluate(name, case, config.folder(), options, regions, trained=title[0])[0.0]
            seconds += result.seconds
            for region, mask in regions.items():
                mean, std = result.distances.mean_std(mask)
                row = {"direction": title, "method": name, "region": region, "mean_mm": mean, "std_mm": std}
                rows.append(row | {"chosen": result.about})
            print(f"{title} {name}: {rows[-2]['mean_mm']:.4f} mm, {time.perf_counter() - begun:.0f} s", flush=True)
    if config.second is None:
        alone = _noise_alone(_datasets.limit_count(_everybody(b)), _datasets.limit_count(_everybody(clean)), regions)
        rows += [{"direction": "A to B", "method": ALONE, "region": region} | row for region, row in alone.items()]
    made = _run.record(config, seconds=seconds, dataset={"A": a.index["spec"], "B": b.index["spec"]})
    titles = [title for title, _, _ in directions]
    figure = _plot(config.out / "table3.png", rows, titles, config.methods)
    metrics = {"mode": mode, "rows": rows, "paper_mm": PAPER}
    _run.finish("table3", config, metrics, made=made, table=_table(rows, titles, config.methods), figure=figure)
    return metrics


def _noise_alone(noisy: MeshSubset, clean: MeshSubset, regions: dict[str, np.ndarray]) -> dict[str, dict[str, float]]:
    """Return the vertex distances between the meshes with and without noise."""
    pairs = ((true, made) for (_, made), (_, true) in zip(noisy, clean, strict=True))
    return vertex_error.vertex_errors(lambda moved: moved, pairs, regions)


def _everybody(data: dataset.Dataset) -> MeshSubset:
    return of_split(data, *(split for split in dataset.SPLITS if len(data.subjects(split))))


def _training(data: dataset.Dataset) -> MeshSubset:
    known = [split for split in ("train", "validation") if len(data.subjects(split))]
    return _datasets.limit_count(of_split(data, *known))


def _value(rows, direction: str, method: str, region: str, what: str = "mean_mm") -> float:
    key = (direction, method, region)
    return next((r[what] for r in rows if (r["direction"], r["method"], r["region"]) == key), np.nan)


def _table(rows, titles, methods) -> str:
    body = []
    for method in (*methods, *(row["method"] for row in rows if row["method"] == ALONE and row["region"] == "head")):
        cells = [
            "{:.4f} ± {:.4f} / {:.4f}".format(
                *(_value(rows, title, method, "head", what) for what in ("mean_mm", "std_mm")),
                _value(rows, title, method, "face"),
            )
            if not np.isnan(_value(rows, title, method, "head"))
            else ""
            for title in titles
        ]
        paper = ["{:.2f} ± {:.2f}".format(*figure) for figure in PAPER[method]] if method in PAPER else ["", ""]
        body.append((_mesh_eval.METHOD_NAMES.get(method, method), *cells, *paper))
    header = ("mm, head / face", *titles, "OT23: Florence 4D to CoMA", "OT23: CoMA to Florence 4D")
    return _run.markdown(header, body)


def _plot(path: Path, rows, titles, methods) -> Path:
    figure, axis = plt.subplots(figsize=(8, 3.8), constrained_layout=True)
    width = 0.8 / len(methods)
    for i, method in enumerate(methods):
        values = [_value(rows, title, method, "face") for title in titles]
        axis.bar(
            np.arange(len(titles)) + width * (i - len(methods) / 2 + 0.5),
            values,
            width,
            label=_mesh_eval.METHOD_NAMES[method],
        )
    axis.set_xticks(range(len(titles)), titles)
    axis.set_ylabel("mean vertex error of the face, mm")
    alone = _value(rows, titles[0], ALONE, "face")
    if not np.isnan(alone):
        axis.plot([-0.45, 0.45], [alone, alone], "k--", linewidth=1, label=ALONE)
    figure.legend(frameon=False, fontsize=8, loc="outside right center")
    return _run.save_figure(figure, path)


if __name__ == "__main__":
    _run.main("table3", Config, run)
