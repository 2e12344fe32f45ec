"""Figures of `experiments.interpolation`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

from experiments import _interpolation_eval, _run
from facejax.data import dataset, motions
from facejax.evaluation import motion_metrics

matplotlib.use("Agg")
import matplotlib.pyplot as plt

COLOURS = {"sphere": "#c46b4e", "linear": "#5b8db8", "direct": "#444444"}
STYLES = {"even": ":", "minimum jerk": "--", "performed": "-"}
# Polylines through the 68 iBUG landmarks: jaw, brows, nose, eyes, lips; the last four are closed.
LINES = (range(17), range(17, 22), range(22, 27), range(27, 31), range(31, 36),
         (*range(36, 42), 36), (*range(42, 48), 42), (*range(48, 60), 48), (*range(60, 68), 60))  # fmt: skip
SHOWN = (("sphere", "even"), ("sphere", "performed"), ("linear", "performed"))
COLUMNS = (0, 5, 9, 12, 15, 18, 22, 29)


def plot(path: Path, metrics: dict[str, Any], direct: motions.Motions) -> Path:
    """Plot speed, distance to direct transitions and recognition from peak to peak, and ratios between onsets."""
    figure, axes = plt.subplots(2, 2, figsize=(13, 8.4), constrained_layout=True)
    _plot_speed(axes[0, 0], metrics["peaks"]["ways"], direct)
    names = [_interpolation_eval.variant_name(way) for way in _interpolation_eval.VARIANTS]
    look = {"color": [COLOURS[path] for path, _ in _interpolation_eval.VARIANTS]}
    bars = axes[0, 1].barh(names, [metrics["peaks"]["ways"][name]["distance_aligned_mm"] for name in names], **look)
    axes[0, 1].bar_label(bars, fmt="%.2f", padding=3)
    axes[0, 1].axvline(metrics["peaks"]["another_take"]["distance_aligned_mm"], color=COLOURS["direct"], linestyle="--")
    axes[0, 1].set(title="Peak to peak: mm from the direct one (line: another take)")
    bars = axes[1, 1].barh(names, [100 * metrics["recognition"][name] for name in names], **look)
    axes[1, 1].bar_label(bars, fmt="%.1f", padding=3)
    axes[1, 1].set(title="Direct transitions recognised after learning from each, %", xlim=(0, 112))
    for axis in axes[:, 1]:
        axis.invert_yaxis()
        axis.margins(x=0.12)
    _plot_onsets(axes[1, 0], metrics["onsets"])
    return _run.save_figure(figure, path)


def _plot_speed(axis, ways: dict[str, Any], direct: motions.Motions) -> None:
    profiles = motion_metrics.speed_profile(direct.curves)
    step = np.arange(profiles.shape[1]) + 0.5
    low, high = np.quantile(profiles, (0.1, 0.9), axis=0)
    axis.fill_between(step, low, high, color="0.88", label="direct, 80 % of transitions")
    axis.plot(step, profiles.mean(axis=0), color=COLOURS["direct"], linewidth=2.5, label="direct, mean")
    for path, pace in _interpolation_eval.VARIANTS:
        style = {
            "color": COLOURS[path],
            "linestyle": STYLES[pace],
            "label": _interpolation_eval.variant_name((path, pace)),
        }
        axis.plot(step, ways[_interpolation_eval.variant_name((path, pace))]["profile"], **style)
    axis.set(title="Peak to peak: speed over its mean", xlabel="frame", xlim=(0, step[-1] + 0.5), ylim=(0, None))
    axis.legend(frameon=False, fontsize=8)


def _plot_onsets(axis, onsets: dict[str, Any]) -> None:
    fields = {
        "length_ratio": "path\nlength",
        "peak_ratio": "peak",
        "acceleration_ratio": "acceler-\nation",
        "jitter_ratio": "acceler-\nation\n/ path",
    }
    kinds = ("same expression", "two expressions")
    place = np.arange(len(fields) * len(kinds)) + np.repeat((0, 0.5), len(fields))
    for shift, path in zip((-0.2, 0.2), _interpolation_eval.PATHS, strict=True):
        values = [onsets[kind][path][field] for kind in kinds for field in fields]
        bars = axis.bar(place + shift, np.array(values) - 1, 0.4, bottom=1, color=COLOURS[path], label=path)
        axis.bar_label(bars, [f"{value:.2f}" for value in values], fontsize=7, padding=2)
    axis.axhline(1, color="k", linewidth=0.8)
    axis.set_xticks(place, list(fields.values()) * len(kinds), fontsize=8)
    axis.set(title="Between onsets of two people, over the parents' mean", ylim=(0.8, 1.25))
    for k, kind in enumerate(kinds):
        axis.text(place[k * len(fields) : (k + 1) * len(fields)].mean(), 1.22, kind, ha="center")
    axis.legend(frameon=False, fontsize=8, loc="upper left", bbox_to_anchor=(0.1, 0.88))


def sheet(path: Path, data: dataset.Dataset, transitions, direct: motions.Motions) -> None:
    """Draw the landmarks of one transition in three variants and the direct one, after OT23, figure 4.

    The direct transition is drawn in grey behind the others. The transition is the one at the 90th percentile of the
    distance between the variant (sphere, performed) and the direct transition.
    """
    distance = np.linalg.norm(transitions["sphere", "performed"].curves - direct.curves, axis=-1).mean(axis=(1, 2))
    k = np.argsort(distance)[int(0.9 * len(distance))]
    rest = data.neutral[direct.subject[k], data.landmark_index]
    rows = {_interpolation_eval.variant_name(way): transitions[way].curves[k] for way in SHOWN} | {
        "direct": direct.curves[k]
    }
    seen = rest + direct.scale[k] * np.concatenate(list(rows.values()))
    low, high = seen.min(axis=(0, 1)) - 3, seen.max(axis=(0, 1)) + 3
    look = {"aspect": "equal", "xticks": [], "yticks": [], "xlim": (low[0], high[0]), "ylim": (low[1], high[1])}
    figure, axes = plt.subplots(len(rows), len(COLUMNS), figsize=(13, 7.4), constrained_layout=True)
    for line, (name, curve) in zip(axes, rows.items(), strict=True):
        for axis, frame in zip(line, COLUMNS, strict=True):
            if name != "direct":
                _face(axis, rest + direct.scale[k] * direct.curves[k, frame], color="0.72", linewidth=1.8)
            _face(axis, rest + direct.scale[k] * curve[frame], color=COLOURS[name.split(",")[0]], linewidth=1.1)
            axis.set(**look)
            axis.spines[:].set_visible(False)
        line[0].set_ylabel(name.replace(", ", "\n"))
    for axis, frame in zip(axes[0], COLUMNS, strict=True):
        axis.set_title(f"frame {frame}", fontsize=10)
    start, end = (data.labels[labels[k]].replace("_", " ") for labels in (direct.start, direct.end))
    figure.suptitle(
        f"{start} to {end}, one person (one transition in ten is farther off); grey: the direct one at the same frame"
    )
    _run.save_figure(figure, path)


def _face(axis, points: np.ndarray, **look) -> None:
    for line in LINES:
        axis.plot(*points[list(line), :2].T, **look)
