"""Contents of makehuman4d, and the error of linear maps on it by realism level.

Counts, a histogram of landmark speed, a contact sheet of 18 expressions on 5 subjects at the apex and one of a
subject on all four realism levels; per level, on held-out subjects and on held-out expressions, the vertex error of
ridge regression and PCA-220 from the same 68 landmarks. A linear map is exact on held-out subjects of level 0 by
construction; its error on the other levels measures their nonlinearity.

    python -m experiments.dataset_card --publish

Expected, ridge on held-out subjects, head: 0.0000, 0.0004, 0.0411 and 0.0462 mm on levels 0 to 3. Time: 11 minutes on
2 cores of an Intel Xeon, once the four levels are prepared (5 minutes more).
"""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

from experiments import _datasets, _run
from facejax.data import dataset
from facejax.data.mesh_subset import of_split
from facejax.data.synthetic import expression_recipes, makehuman, makehuman4d, performance, rig
from facejax.evaluation import vertex_error
from facejax.inference import makehuman_portrait
from facejax.models.decoders import linear
from facejax.training.recipes import fit_linear
from facejax.viz import render

matplotlib.use("Agg")
import matplotlib.pyplot as plt

SHOWN = (0, 3, 10, 22, 31)  # subjects on the contact sheet: women and men, 24 to 75 years old
PICTURE = (150, 188)


@dataclasses.dataclass(frozen=True)
class Config:
    out: Path = Path("runs/dataset_card")
    """Folder for the results."""
    seed: int = makehuman4d.SEED
    """Seed of makehuman4d."""
    data: Path | None = None
    """A prepared dataset to describe in place of makehuman4d and its levels."""
    levels: tuple[int, ...] = rig.LEVELS
    """Realism levels to describe."""
    subjects: int = 120
    """Number of subjects of makehuman4d."""
    meshes: int = 20_000
    """Number of meshes of makehuman4d."""
    publish: bool = False
    """Also write the committed results in experiments/results."""


def run(config: Config) -> dict[str, Any]:
    """Describe every level and draw the sheets."""
    begun = time.perf_counter()
    levels, histogram = {}, None
    for level in config.levels if config.data is None else [config.data.name]:
        if config.data is None:
            data = makehuman4d.prepare(makehuman4d.Spec(level, config.subjects, config.meshes, config.seed))
        else:
            data = dataset.open_meshes(config.data)
        levels[str(level)] = _counts(data) | _linear_errors(data)
        histogram = _speeds(data)
    config.out.mkdir(parents=True, exist_ok=True)
    figure = _plot(config.out / "dataset_card.png", levels, histogram)
    if config.data is None:
        _sheet(config.out / "expressions.png", config)
        _levels_sheet(config.out / "levels.png", config)
    else:
        _peaks_sheet(config.out / "expressions.png", data)
    if config.publish and config.data is None:
        for name in ("expressions", "levels"):
            _run.publish_file(config.out / f"{name}.png", f"dataset_card_{name}.png")
    metrics = {"levels": levels, "speed_mm_per_s": _quantiles(histogram)}
    made = _run.record(config, seconds=time.perf_counter() - begun, dataset=data.index["spec"])
    _run.finish("dataset_card", config, metrics, made=made, table=_table(levels), figure=figure)
    return metrics


def _counts(data: dataset.Dataset) -> dict[str, Any]:
    direct = sum(">" in s.label for s in data.sequences)
    at, owner = data.meshes("test")
    moved = np.linalg.norm(data.vertices[at] - data.neutral[owner], axis=-1)
    mask = _datasets.region_masks(data)["face"]
    return {
        "subjects": {split: len(data.subjects(split)) for split in dataset.SPLITS},
        "sequences": len(data.sequences) - direct,
        "direct_transitions": direct,
        "frames": len(data.landmarks),
        "meshes": {split: len(data.meshes(split)[0]) for split in dataset.SPLITS},
        "motion_mm": {"head": float(moved.mean()), "face": float(moved[:, mask].mean())},
        "motion_peak_mm": float(moved.max()),
    }


def _linear_errors(data: dataset.Dataset) -> dict[str, Any]:
    """Return errors of ridge and PCA-220 on test subjects: on seen expressions, and on unseen ones in four folds."""
    regions = _datasets.region_masks(data)
    train, test = of_split(data, "train"), of_split(data, "test")
    splits = {"subjects": [(train, test)], "expressions": []}
    names = expression_recipes.COMA if _datasets.is_makehuman(data) else sorted(set(test.labels))
    for held in np.array_split(names, min(_datasets.FOLDS, len(names))):
        splits["expressions"].append((train.of_labels(held, without=True), test.of_labels(held)))
    found: dict[str, Any] = {}
    for split, folds in splits.items():
        rows: dict[str, list] = {"ridge": [], "pca220": []}
        for fit_on, judge_on in folds:
            for name, model, options in (("ridge", linear.ridge, {}), ("pca220", linear.pca, {"components": 220})):
                params, _ = fit_linear.fit_linear(model, fit_on, **options)
                rows[name].append(vertex_error.vertex_errors(lambda m, p=params: linear.apply(p, m), judge_on, regions))
        found[split] = {
            name: {region: float(np.mean([row[region]["mean_mm"] for row in of])) for region in regions}
            for name, of in rows.items()
        }
    return {"error_mm": found}


def _speeds(data: dataset.Dataset) -> np.ndarray:
    """Return the mean speed of the landmarks in mm/s, of every frame of every expression."""
    speeds = []
    for s in data.sequences:
        if ">" not in s.label:
            steps = np.diff(data.landmarks[s.start : s.start + s.frames], axis=0)
            speeds.append(np.linalg.norm(steps, axis=-1).mean(axis=-1) * data.index["rate"])
    return np.concatenate(speeds)


def _plot(path: Path, levels: dict[str, Any], speeds: np.ndarray) -> Path:
    figure, axes = plt.subplots(1, 3, figsize=(13, 3.8), constrained_layout=True)
    axes[0].hist(speeds, bins=np.linspace(0, np.quantile(speeds, 0.995), 60), color="#5b8db8")
    axes[0].set(xlabel="mean landmark speed, mm/s", ylabel="frames", yscale="log", title="How fast faces move")
    for axis, split in zip(axes[1:], ("subjects", "expressions"), strict=True):
        for name, colour in (("ridge", "#c46b4e"), ("pca220", "#5b8db8")):
            for region, style in (("head", "-"), ("face", "--")):
                values = [row["error_mm"][split][name][region] for row in levels.values()]
                axis.plot(list(levels), values, style, marker="o", color=colour, label=f"{name}, {region}")
        axis.set(xlabel="realism level", ylabel="mm", title=f"Linear maps on held-out {split}")
    axes[2].legend(frameon=False, fontsize=8)
    return _run.save_figure(figure, path)


def _sheet(path: Path, config: Config) -> None:
    """Render 18 expressions at the apex on five subjects."""
    rows = []
    for index in SHOWN:
        posed = rig.build(makehuman.subject(index, seed=config.seed), level=3)
        peaks = [performance.apex_weights(label, index, seed=config.seed) for label in expression_recipes.EXPRESSIONS]
        rows.append([_portrait(vertices) for vertices in rig.pose(posed, np.stack(peaks))])
    people = [makehuman.subject(i, seed=config.seed) for i in SHOWN]
    names = [f"{p.name}, {p.age:.0f}" for p in people]
    half = len(expression_recipes.EXPRESSIONS) // 2
    sheets = [
        render.contact_sheet(
            [row[part] for row in rows], row_labels=names, column_labels=list(expression_recipes.EXPRESSIONS[part])
        )
        for part in (slice(0, half), slice(half, None))
    ]
    render.save(path, np.concatenate(sheets))


def _peaks_sheet(path: Path, data: dataset.Dataset) -> None:
    """Render the mesh farthest from neutral of up to five people and nine labels of a dataset."""
    labels, at, faces = data.row_labels()[data.drawn], data.row_subjects()[data.drawn], np.asarray(data.faces)
    names, people = sorted(set(labels))[:9], np.unique(at)[:5]
    rows = []
    for person in people:
        rest, row = np.asarray(data.neutral[person]), []
        for name in names:
            mine = np.flatnonzero((at == person) & (labels == name))
            moved = np.linalg.norm(data.vertices[mine] - rest, axis=-1).mean(axis=-1)
            shown = data.vertices[mine[moved.argmax()]] if len(mine) else rest
            row.append(
                render.image(shown, faces, size=PICTURE, camera=render.fit_camera(rest * 1.08, size=PICTURE, turn=18))
            )
        rows.append(row)
    known = [data.index["subjects"][person]["name"] for person in people]
    render.save(path, render.contact_sheet(rows, row_labels=known, column_labels=names))


def _levels_sheet(path: Path, config: Config) -> None:
    """Render neutral and five expressions of one subject on every level."""
    labels = ("neutral", "high_smile", "disgust", "mouth_extreme", "eyebrow", "mouth_up")
    weights = np.stack([performance.apex_weights(label, SHOWN[2], seed=config.seed) for label in labels])
    person = makehuman.subject(SHOWN[2], seed=config.seed)
    rows = [[_portrait(v) for v in rig.pose(rig.build(person, level=level), weights)] for level in rig.LEVELS]
    names = [f"level {level}" for level in rig.LEVELS]
    render.save(path, render.contact_sheet(rows, row_labels=names, column_labels=list(labels)))


def _portrait(vertices: np.ndarray) -> np.ndarray:
    """Render a posed head (M, 3) with its own eyes and teeth."""
    shape = makehuman.template()
    camera = render.fit_camera(shape.vertices * 1.08, size=PICTURE, turn=18)
    skin, parts = vertices[None, : len(shape.vertices)], makehuman_portrait.parts(vertices[None])
    return render.frames(skin, shape.faces, size=PICTURE, camera=camera, extras=parts)[0]


def _quantiles(speeds: np.ndarray) -> dict[str, float]:
    return {f"{q:.0%}": float(np.quantile(speeds, q)) for q in (0.05, 0.25, 0.5, 0.75, 0.95, 1.0)}


def _table(levels: dict[str, Any]) -> str:
    header = ["level", "motion head / face"]
    header += [f"{name}, {split}" for split in ("subjects", "expressions") for name in ("ridge", "PCA-220")]
    rows = []
    for level, row in levels.items():
        cells = [level, "{head:.2f} / {face:.2f}".format(**row["motion_mm"])]
        for split in ("subjects", "expressions"):
            for name in ("ridge", "pca220"):
                cells.append("{head:.4f} / {face:.4f}".format(**row["error_mm"][split][name]))
        rows.append(cells)
    first = next(iter(levels.values()))
    head = (
        f"{sum(first['subjects'].values())} subjects ({first['subjects']}), {first['sequences']} sequences, "
        f"{first['direct_transitions']} direct transitions, {first['frames']} frames. "
        "Mean vertex error in mm over the head / the face region, test subjects:"
    )
    return f"{head}\n\n{_run.markdown(header, rows)}"


if __name__ == "__main__":
    _run.main("dataset_card", Config, run)
