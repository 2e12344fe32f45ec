"""Heat maps of each method's vertex errors on rendered faces (OT23, figure 6).

    python -m experiments.figure6 --publish

Uses the first identity fold of `experiments.table1` and the networks trained in its folder. For each face shown, the
frame with the largest displacement of its expression; white is no error, the darkest red `--high` millimetres or
more.

Expected mean errors on `high_smile`: ridge 0.075 mm, residual decoder 0.039, S2D-Dec 0.162. Time: 10 minutes on 2
cores of an AMD EPYC.
"""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path
from typing import Any

import numpy as np

from experiments import _datasets, _mesh_eval, _run
from facejax.evaluation import baselines
from facejax.viz import render

METHODS = ("pca220", "dl3dmm", "ridge", "rbf", "neural3dmm", "s2d", "gpmm", "s2d_residual")
SHOWN = ("high_smile", "mouth_extreme", "eyebrow", "mouth_side")  # each on a different person
HIGH = 0.4  # mm
PICTURE = (170, 214)


@dataclasses.dataclass(frozen=True)
class Config(_mesh_eval.Options):
    out: Path = Path("runs/figure6")
    """Folder for the results."""
    runs: Path = Path("runs/table1")
    """Folder of the results of `experiments.table1`."""
    data: Path | None = None
    """Prepared dataset to use in place of makehuman4d."""
    level: int = 3
    """Realism level of makehuman4d, 0 to 3."""
    methods: tuple[str, ...] = METHODS
    """Methods to evaluate."""
    high: float = HIGH
    """Error in mm that is drawn in the darkest red."""


def run(config: Config) -> dict[str, Any]:
    """Render one row per face, the true mesh and each method's; return mean and largest errors."""
    mode, begun = config.mode, time.perf_counter()
    _mesh_eval.check_methods(config.methods)
    data = _datasets.load(config.data, mode, level=config.level)
    case = _datasets.cases(data, ["identity"])[0]
    options = _mesh_eval.training_options(case, mode, config.seed, _datasets.mesh_hierarchy(data))
    chosen = _strongest(case.test)
    true = [_true(case.test, row) for row in chosen]
    columns = [[_face(data, vertices) for vertices in true]]
    rows = []
    for name in config.methods:
        fitted = _mesh_eval.fit_method(name, case, config.folder(config.runs), options)
        column = []
        for row, vertices in zip(chosen, true, strict=True):
            rest = np.asarray(data.neutral[case.test.owner[row]])
            marks = case.test.read(np.array([row]))[0]
            made = baselines.METHODS[name].apply(fitted, marks, rest)[0]
            error = np.linalg.norm(made - vertices, axis=-1)
            column.append(_face(data, made, render.heat_colours(error, high=config.high)))
            rows.append({"method": name, "label": str(case.test.labels[row]), "mean_mm": float(error.mean()),
                         "largest_mm": float(error.max())})  # fmt: skip
        columns.append(column)
    sheet = render.contact_sheet(
        [list(line) for line in zip(*columns, strict=True)],
        row_labels=[str(case.test.labels[row]) for row in chosen],
        column_labels=["true", *(_mesh_eval.METHOD_NAMES[name] for name in config.methods)],
    )
    path = config.out / "figure6.png"
    render.save(path, sheet)
    made = _run.record(config, seconds=time.perf_counter() - begun, dataset=data.index["spec"])
    metrics = {"mode": mode, "red_mm": config.high, "rows": rows}
    _run.finish("figure6", config, metrics, made=made, table=_table(rows, config), figure=path)
    return metrics


def _strongest(test) -> list[int]:
    """Return, per expression and of a different person each, the row of the mesh with the largest displacement."""
    moved = np.concatenate([np.linalg.norm(vertices, axis=-1).mean(axis=1) for _, vertices in test])
    labels = [label for label in SHOWN if label in test.labels] or list(np.unique(test.labels)[: len(SHOWN)])
    found = []
    for i, label in enumerate(labels):
        whose = test.subjects[i % len(test.subjects)]
        mine = np.flatnonzero((test.labels == label) & (test.owner == whose))
        mine = mine if len(mine) else np.flatnonzero(test.labels == label)
        found.append(int(mine[np.argmax(moved[mine])]))
    return found


def _true(test, row: int) -> np.ndarray:
    return test.read(np.array([row]))[1][0] + np.asarray(test.data.neutral[test.owner[row]])


def _face(data, vertices: np.ndarray, colours: np.ndarray | None = None) -> np.ndarray:
    camera = render.fit_camera(vertices * 1.05, size=PICTURE, turn=18)
    look = {} if colours is None else {"colours": colours}
    return render.image(vertices, np.asarray(data.faces), size=PICTURE, camera=camera, **look)


def _table(rows, config: Config) -> str:
    labels = list(dict.fromkeys(row["label"] for row in rows))
    body = []
    for name in config.methods:
        mine = {row["label"]: row for row in rows if row["method"] == name}
        cells = ["{mean_mm:.4f} / {largest_mm:.2f}".format(**mine[label]) for label in labels]
        body.append((_mesh_eval.METHOD_NAMES[name], *cells))
    return _run.markdown(("mm, mean / largest", *labels), body)


if __name__ == "__main__":
    _run.main("figure6", Config, run)
