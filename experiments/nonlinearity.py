"""Vertex errors of spiral decoders and linear maps by realism level, registration noise and landmark noise.

    python -m experiments.nonlinearity --publish

makehuman4d's levels 0 (exactly linear) to 3 (jaw, saturation, contact, wrinkles), without noise and with smooth
registration noise of 0.3 mm. Test landmarks are exact, or have noise of 0.5 and 1 mm as a detector would leave it.
Held-out people (80 for training, 20 for testing) and held-out expressions (the first of four folds). "GPMM, told" is
the GPMM with landmark noise sigma (mm) given, "GPMM, noise found" the one that estimates it. "floor" is the
irreducible error given the landmarks (`facejax.evaluation.noise_floor`), without and with knowledge of the person's
face.

`--quick` uses small datasets and few steps, `--paper` trains for 300 epochs. `--levels`, `--noises` and `--methods`
select; `--data` evaluates a prepared dataset in place of all levels. Interrupted runs resume.

Expected, held-out people, exact landmarks, GPMM over ridge on the head: 1.00x on levels 0 and 1, 0.26x on level 2,
0.49x on level 3, and 0.94x on level 3 with registration noise of 0.3 mm. Levels 2 and 3 create expressions with the
deformation transfer operator that the GPMM uses itself, which favours it. The residual decoder gains 7 % over the
GPMM on level 3. Time: 4.3 hours on 2 cores of an AMD EPYC, most of it for the networks.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import time
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

from experiments import _datasets, _mesh_eval, _run
from facejax.data.synthetic import rig
from facejax.evaluation import baselines, noise_floor, vertex_error
from facejax.models.decoders import gpmm, linear
from facejax.training.recipes import fit_s2d_dec

matplotlib.use("Agg")
import matplotlib.pyplot as plt

METHODS = ("ridge", "pca220", "rbf", "gpmm", "gpmm_found", "s2d_residual", "s2d")
LANDMARK_NOISE = (0.0, 0.5, 1.0)  # sigma, mm
COLOURS = {"ridge": "#c46b4e", "pca220": "#5b8db8", "rbf": "#999999", "gpmm": "#6a9a58", "told": "#9bc48a",
           "gpmm_found": "#d8a03c", "s2d_residual": "#222222", "s2d": "#b08cc0"}  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Config(_mesh_eval.Options):
    out: Path = Path("runs/nonlinearity")
    """Folder for checkpoints and results."""
    data: Path | None = None
    """Prepared dataset to use in place of makehuman4d and its levels."""
    levels: tuple[int, ...] = rig.LEVELS
    """Realism levels of makehuman4d, each 0 to 3."""
    noises: tuple[float, ...] = (0.0, 0.3)
    """Sigmas of the registration noise of the meshes, mm."""
    methods: tuple[str, ...] = METHODS
    """Methods to evaluate."""
    splits: tuple[str, ...] = ("test", "expression")
    """Protocols to evaluate: held-out people, held-out expressions."""
    steps: int = 6_000
    """Number of training steps of S2D-Dec."""


def run(config: Config) -> dict[str, Any]:
    """Evaluate all; one row per level, registration noise, landmark noise, split, method and region."""
    mode = config.mode
    _mesh_eval.check_methods(config.methods)
    rows, floors, seconds = [], [], 0.0
    if config.data is not None:
        config = dataclasses.replace(config, levels=(config.data.name,), noises=(0.0,))
    for noise, level in itertools.product(config.noises, config.levels):
        data = _datasets.load(config.data, mode, level=level, noise=noise)
        regions, hierarchy = _datasets.region_masks(data), _datasets.mesh_hierarchy(data)
        for split in config.splits:
            case = _datasets.cases(data, [split])[0]
            where = {"level": level, "noise_mm": noise, "split": split}
            plans = {} if mode != "default" else {"decoder": fit_s2d_dec.S2DDecPlan(steps=config.steps)}
            options = _mesh_eval.training_options(case, mode, config.seed, hierarchy, **plans)
            folder = config.folder() / f"level{level}-noise{noise:g}"
            for name in config.methods:
                begun = time.perf_counter()
                found = _mesh_eval.evaluate(name, case, folder, options, regions, noises=LANDMARK_NOISE)
                rows += _rows(where, name, found, regions)
                seconds += found[0.0].seconds
                shown = ", ".join(f"{r.distances.mean_std(regions['head'])[0]:.4f}" for r in found.values())
                print(f"{where} {name}: {shown} mm, {time.perf_counter() - begun:.0f} s", flush=True)
            told = _mesh_eval.cached(
                folder / "told" / case.name,
                _mesh_eval.cache_key("gpmm", case, options, LANDMARK_NOISE),
                LANDMARK_NOISE,
                functools.partial(_known_noise_and_floors, case, options, regions),
            )
            floors.append(where | told[0.0].about)
            told = {noise: result._replace(about={}) for noise, result in told.items()}
            rows += _rows(where, "told", told, regions)
    made = _run.record(config, seconds=seconds, dataset=data.index["spec"] | {"level": list(config.levels)})
    metrics = {"mode": mode, "rows": rows, "floor": floors}
    figure = _plot(config.out / "nonlinearity.png", rows, floors, config)
    table = _table(rows, floors, config)
    _run.finish("nonlinearity", config, metrics, made=made, table=table, figure=figure)
    return metrics


def _rows(where: dict[str, Any], name: str, found: dict, regions: dict[str, np.ndarray]) -> list[dict[str, Any]]:
    rows = []
    for landmark_noise, result in found.items():
        for region, mask in regions.items():
            mean, std = result.distances.mean_std(mask)
            row = {"method": name, "landmark_noise_mm": landmark_noise, "region": region}
            rows.append(where | row | {"mean_mm": mean, "std_mm": std, "chosen": result.about})
    return rows


def _known_noise_and_floors(case, options: baselines.Options, regions) -> dict[float, _mesh_eval.Result]:
    """Evaluate the GPMM with each landmark noise sigma given; the noise floors are the results' `about`."""
    fitted = _mesh_eval.fit_base(case, options)
    ridge = baselines.METHODS["ridge"].fit(case.train, Path(), options).params
    floors, told = _floors(case, fitted.params, ridge, regions), {}
    for noise in LANDMARK_NOISE:
        params = gpmm.with_landmark_noise(fitted.params, noise)
        distances = vertex_error.distances(
            lambda marks, rest, p=params: rest + np.asarray(linear.apply(gpmm.linear_map(p, rest), marks)),
            case.test, regions, noise=noise,
        )  # fmt: skip
        told[noise] = _mesh_eval.Result(distances, 0.0, floors)
    return told


def _floors(case, base: gpmm.GPMM, ridge: linear.LinearMap, regions: dict[str, np.ndarray]) -> dict[str, Any]:
    test = case.test.thin(max(1, case.test.count // 2_000))
    marks, vertices = (np.concatenate(part) for part in zip(*test, strict=True))
    recording = test.recordings
    alone = vertices - np.asarray(linear.apply(ridge, marks))
    with_face = np.empty_like(vertices)
    for subject in test.subjects:
        mine = test.owner == subject
        one = gpmm.linear_map(base, test.data.neutral[subject])
        with_face[mine] = vertices[mine] - np.asarray(linear.apply(one, marks[mine]))
    found = {
        "landmarks": noise_floor.estimate(alone, *noise_floor.nearest_pairs(marks, test.owner)),
        "landmarks and face": noise_floor.estimate(
            with_face, *noise_floor.nearest_pairs(marks, test.owner, recording=recording, within_groups=True)
        ),
    }
    return {
        name: {region: float(line[mask].mean()) for region, mask in regions.items()} for name, line in found.items()
    }


def _value(rows, **key) -> float:
    return next((r["mean_mm"] for r in rows if all(r[name] == wanted for name, wanted in key.items())), np.nan)


def _table(rows, floors, config: Config) -> str:
    names = (*config.methods, "told")
    parts = []
    for split in config.splits:
        body = []
        for noise in config.noises:
            for level in config.levels:
                for off in LANDMARK_NOISE:
                    key = {"level": level, "noise_mm": noise, "split": split, "landmark_noise_mm": off}
                    cells = [
                        "{:.4f} / {:.4f}".format(
                            *(_value(rows, method=name, region=region, **key) for region in ("head", "face"))
                        )
                        for name in names
                    ]
                    line = next(f for f in floors if (f["level"], f["noise_mm"], f["split"]) == (level, noise, split))
                    known = [f"{line[what]['head']:.4f}" for what in ("landmarks", "landmarks and face")]
                    body.append((f"{level}, {noise:g}, {off:g}", *cells, *(known if off == 0 else ("", ""))))
        header = ["level, registration noise, landmark noise"]
        header += [_mesh_eval.METHOD_NAMES.get(name, "GPMM, told") for name in names]
        header += ["floor: landmarks", "floor: with the face"]
        title = "Held-out people" if split == "test" else "Held-out expressions"
        parts.append(f"{title}, mean vertex error in mm, head / face:\n\n{_run.markdown(header, body)}")
    return "\n\n".join(parts)


def _plot(path: Path, rows, floors, config: Config) -> Path:
    size = (8.4 * len(config.noises), 4.2 * len(config.splits))
    places = range(len(config.levels))
    figure, axes = plt.subplots(
        len(config.splits), 2 * len(config.noises), figsize=size, constrained_layout=True, squeeze=False
    )
    for line, split in zip(axes, config.splits, strict=True):
        for i, noise in enumerate(config.noises):
            for j, off in enumerate((LANDMARK_NOISE[0], LANDMARK_NOISE[-1])):
                axis = line[2 * i + j]
                for name in (*config.methods, "told"):
                    values = [
                        _value(rows, level=level, noise_mm=noise, split=split, landmark_noise_mm=off, method=name,
                               region="face")
                        for level in config.levels
                    ]  # fmt: skip
                    label = _mesh_eval.METHOD_NAMES.get(name, "GPMM, told")
                    shown = {"label": label, "color": COLOURS.get(name)}
                    axis.plot(places, np.maximum(values, 1e-5), marker="o", ms=3, **shown)
                for what, style in (("landmarks", ":"), ("landmarks and face", "--")):
                    some = [f for f in floors if (f["noise_mm"], f["split"]) == (noise, split)]
                    values = [f[what]["face"] for f in sorted(some, key=lambda f: config.levels.index(f["level"]))]
                    axis.plot(places, np.maximum(values, 1e-5), style, color="0.5", label=f"floor: {what}")
                axis.set(title=f"{split}: registration noise {noise:g}, landmarks off by {off:g} mm", yscale="log",
                         xlabel="level of realism", xticks=places)  # fmt: skip
                axis.set_xticklabels(config.levels)
                axis.title.set_fontsize(8)
        line[0].set_ylabel("mean vertex error of the face, mm")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, frameon=False, fontsize=9, loc="outside right center")
    return _run.save_figure(figure, path)


if __name__ == "__main__":
    _run.main("nonlinearity", Config, run)
