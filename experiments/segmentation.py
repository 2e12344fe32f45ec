"""Automatic detection of onset, apex and offset in recordings, drawn for inspection.

    python -m experiments.segmentation --data runs/scans
    python -m experiments.segmentation --publish

Plots the mean distance of the landmarks from neutral in every recording, with the detected onset, apex and offset.
Where a detection is wrong, correct it in `cuts.csv` beside the picture and prepare the dataset again with it
(`facejax data prepare --cuts`). On makehuman4d, whose true cuts are known to the frame, their errors are measured;
these are the published figures.

Expected mean errors: onset 3.3 frames, apex start 2.8, apex end 3.6, offset 3.2. Time: 3 seconds on 2 cores of an AMD
EPYC, once the dataset is prepared.
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
from facejax.data.importers import apex_detection

matplotlib.use("Agg")
import matplotlib.pyplot as plt

COLUMNS, PANELS = 6, 60
COLOURS = {"onset": "#5b8db8", "apex_start": "#c46b4e", "apex_end": "#c46b4e", "offset": "#6a9a58"}


@dataclasses.dataclass(frozen=True)
class Config:
    out: Path = Path("runs/segmentation")
    """Folder for the results."""
    data: Path | None = None
    """Prepared dataset to use in place of makehuman4d."""
    level: int = 3
    """Realism level of makehuman4d, 0 to 3."""
    panels: int = PANELS
    """Number of recordings to draw, evenly spread over all."""
    seed: int = 0
    """Unused; recorded with the results."""
    quick: bool = False
    """Use a small dataset."""
    publish: bool = False
    """Also write the committed results in experiments/results."""


def run(config: Config) -> dict[str, Any]:
    """Detect and draw the cuts; return recordings per label and, on makehuman4d, the errors of the cuts."""
    if config.panels < 1:
        raise ValueError(f"panels: expected 1 or more, got {config.panels}")
    begun = time.perf_counter()
    data = _datasets.load(config.data, "quick" if config.quick else "default", level=config.level)
    known = _datasets.is_makehuman(data)
    takes = [take for take in data.sequences if ">" not in take.label]
    found = (
        [apex_detection.detect(*_curve(data, take)) for take in takes]
        if known
        else [apex_detection.Phases(*take[4:8]) for take in takes]
    )
    metrics: dict[str, Any] = {"recordings": len(takes), "labels": _counts(takes)}
    if known:
        metrics["errors"] = _errors(takes, found)
    config.out.mkdir(parents=True, exist_ok=True)
    figure = _plot(config.out / "segmentation.png", data, takes, found, known, config.panels)
    _run.write_text(config.out / "cuts.csv", _csv(data, takes, found))
    made = _run.record(config, seconds=time.perf_counter() - begun, dataset=data.index["spec"])
    _run.finish("segmentation", config, metrics, made=made, table=_table(metrics), figure=figure)
    return metrics


def _curve(data: dataset.Dataset, take: dataset.Sequence) -> tuple[np.ndarray, np.ndarray]:
    """Return the landmarks (T, L, 3) of a recording and those of the neutral face (L, 3)."""
    curve = np.asarray(data.landmarks[take.start : take.start + take.frames])
    return curve, data.neutral[take.subject][data.landmark_index]


def _csv(data: dataset.Dataset, takes, found) -> str:
    """Return the cuts as CSV for `facejax data prepare --cuts`."""
    rows = ["subject,recording," + ",".join(apex_detection.Phases._fields)]
    for take, cut in zip(takes, found, strict=True):
        name = take.name.rpartition("/")[2] or take.label
        rows.append(f"{data.index['subjects'][take.subject]['name']},{name}," + ",".join(map(str, cut)))
    return "\n".join(rows) + "\n"


def _counts(takes: list[dataset.Sequence]) -> dict[str, int]:
    labels, counts = np.unique([take.label for take in takes], return_counts=True)
    return dict(zip(labels.tolist(), counts.tolist(), strict=True))


def _errors(takes: list[dataset.Sequence], found: list[apex_detection.Phases]) -> list[dict[str, Any]]:
    """Return statistics of the differences in frames between detected and true cuts."""
    off = np.array(found) - np.array([take[4:8] for take in takes])
    return [
        {
            "cut": name,
            "mean_frames": float(np.abs(off[:, i]).mean()),
            "bias_frames": float(off[:, i].mean()),
            "within_3": float(np.mean(np.abs(off[:, i]) <= 3)),
            "worst_frames": int(np.abs(off[:, i]).max()),
        }
        for i, name in enumerate(apex_detection.Phases._fields)
    ]


def _table(metrics: dict[str, Any]) -> str:
    if "errors" not in metrics:
        return _run.markdown(["label", "recordings"], list(metrics["labels"].items()))
    header = ["cut", "off by, frames", "of that later", "within 3 frames", "worst"]
    body = [
        [
            row["cut"].replace("_", " "), f"{row['mean_frames']:.1f}", f"{row['bias_frames']:+.1f}",
            f"{row['within_3']:.0%}", row["worst_frames"],
        ]
        for row in metrics["errors"]
    ]  # fmt: skip
    return f"{metrics['recordings']} recordings:\n\n{_run.markdown(header, body)}"


def _plot(path: Path, data: dataset.Dataset, takes, found, known: bool, panels: int) -> Path:
    chosen = np.unique(np.linspace(0, len(takes) - 1, min(panels, len(takes))).round().astype(int))
    lines = -(-len(chosen) // COLUMNS)
    figure, axes = plt.subplots(
        lines, COLUMNS, figsize=(2.6 * COLUMNS, max(3.4, 1.7 * lines)), constrained_layout=True, squeeze=False
    )
    for axis in axes.ravel():
        axis.set_axis_off()
    for axis, i in zip(axes.ravel(), chosen, strict=False):
        take, moved = takes[i], apex_detection.mean_displacement(*_curve(data, takes[i]))
        axis.set_axis_on()
        axis.plot(moved, color="0.3", lw=1)
        for (name, colour), at in zip(COLOURS.items(), found[i], strict=True):
            axis.axvline(at, color=colour, lw=1.2, label=name)
        for at in take[4:8] if known else ():
            axis.plot([at], [0], "^", color="0.2", ms=4, clip_on=False)
        name = take.name or f"{data.index['subjects'][take.subject].get('name', take.subject)}/{take.label}"
        axis.set_title(name, fontsize=7)
        axis.tick_params(labelsize=6)
        axis.set_ylim(0)
    figure.supylabel("mm from rest, mean of the landmarks", fontsize=8)
    figure.supxlabel("frame; lines: onset, apex, offset" + ("; triangles: the performer's own" * known), fontsize=8)
    return _run.save_figure(figure, path, dpi=100)


if __name__ == "__main__":
    _run.main("segmentation", Config, run)
