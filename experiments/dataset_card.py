"""What is in makehuman4d, and how far from linear is it?

Counts; a histogram of landmark speed; a contact sheet of 18 expressions on 5 subjects at the apex, and of one subject on all
four levels of realism; and per level, on held-out subjects and on held-out expressions, the vertex error of ridge
regression and PCA-220 from the same 68 landmarks. A linear map is exact on level 0 by construction: the ladder says
by how much it fails above.

    python -m experiments.dataset_card --publish

About 12 minutes on 2 cores, once the four levels are prepared (5 minutes more).
"""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from PIL import Image

from experiments import _run
from facejax import files, fitting
from facejax.data import assets, makehuman, makehuman4d, performance, rig, store
from facejax.io import props, render, scene
from facejax.models import linear

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402

SHOWN = (0, 3, 10, 22, 31)  # subjects on the contact sheet: women and men, 24 to 75 years old
PICTURE = (150, 188)


@dataclasses.dataclass(frozen=True)
class Config:
    out: Path = Path("runs/dataset_card")
    """Folder for the results."""
    seed: int = makehuman4d.SEED
    """Of the dataset."""
    levels: tuple[int, ...] = rig.LEVELS
    """Levels of realism to describe."""
    subjects: int = 120
    """Of the dataset."""
    meshes: int = 20_000
    """Of the dataset."""
    publish: bool = False
    """Also write the figures that the README quotes."""


def run(config: Config) -> dict[str, Any]:
    """Describe every level."""
    begun = time.perf_counter()
    levels, histogram = {}, None
    for level in config.levels:
        spec = makehuman4d.Spec(level, config.subjects, config.meshes, config.seed)
        data = makehuman4d.prepare(spec)
        levels[str(level)] = _counts(data) | _linear_errors(data)
        histogram = _speeds(data)
    config.out.mkdir(parents=True, exist_ok=True)
    figure = _plot(config.out / "dataset_card.png", levels, histogram)
    _sheet(config.out / "expressions.png", config)
    _ladder(config.out / "levels.png", config)
    if config.publish:
        for name in ("expressions", "levels"):
            with files.replacing(_run.RESULTS / f"dataset_card_{name}.png") as temporary:
                temporary.write_bytes((config.out / f"{name}.png").read_bytes())
    metrics = {"levels": levels, "speed_mm_per_s": _quantiles(histogram)}
    made = _run.record(config, seconds=time.perf_counter() - begun, dataset=data.index["spec"])
    _run.finish("dataset_card", config, metrics, made=made, table=_table(levels), figure=figure)
    return metrics


def _counts(data: store.Store) -> dict[str, Any]:
    direct = sum(">" in s.label for s in data.sequences)
    at, owner = data.meshes("test")
    moved = np.linalg.norm(data.vertices[at] - data.neutral[owner], axis=-1)
    mask = makehuman.template().face_mask
    return {
        "subjects": {split: len(data.subjects(split)) for split in store.SPLITS},
        "sequences": len(data.sequences) - direct,
        "direct_transitions": direct,
        "frames": len(data.landmarks),
        "meshes": {split: len(data.meshes(split)[0]) for split in store.SPLITS},
        "motion_mm": {"head": float(moved.mean()), "face": float(moved[:, mask].mean())},
        "motion_peak_mm": float(moved.max()),
    }


def _linear_errors(data: store.Store) -> dict[str, Any]:
    """Ridge and PCA-220, fitted to training subjects; to all expressions, or to all but three at a time."""
    mask = makehuman.template().face_mask
    names = _frame_labels(data)
    found: dict[str, Any] = {}
    for split in ("subjects", "expressions"):
        folds = [None] if split == "subjects" else [performance.COMA[i : i + 3] for i in range(0, 12, 3)]
        errors: dict[str, list] = {"ridge": [], "pca220": []}
        for held in folds:
            train = fitting.Meshes.of(data, "train", None if held is None else ~np.isin(names, held))
            test = fitting.Meshes.of(data, "test", None if held is None else np.isin(names, held))
            for name, model in (("ridge", linear.ridge), ("pca220", linear.pca)):
                params = linear.fit_tuned(model, train)
                errors[name].append(fitting.errors(lambda m, p=params, f=model: f.apply(p, m), test, mask))
        found[split] = {name: fitting.pooled(rows) for name, rows in errors.items()}
    return {"error_mm": found}
