"""Vertex error of speech motion transferred from one person to others (OT23, Table 2).

    python -m experiments.table2 --recording take.csv --publish
    python -m experiments.table2 --data STORE --speech STORE

The recording is a CSV file of Epic's free iPhone app Live Link Face; any recording of speech will do. The committed
figures are of one MIT-licensed recording, `alex_rom_3.csv`, Copyright (c) 2021 Alexandre Donciu-Julin.

The recording animates one unseen person. The motion of that person's landmarks is encoded as an SRVF, applied to
other people's neutral landmarks, scaled to their size, and expanded to their meshes. The ground truth is how the same
recording moves those people's own rigs. The methods are fitted to makehuman4d's training and validation people in
CoMA's twelve expressions, which contain no speech. Five passages of the recording are used. OT23 takes for each frame
the least error within a window of 20 frames (here ten before and ten after), which lowers the error; the error frame
by frame stands beside it. The error from the person's own landmarks shows how much of it the transfer itself causes.

With `--speech`, a dataset in the topology of `--data`, the labels are sentences: the source person says one, and the
recordings of other people under the same label, resampled to its length, are the ground truth; VOCASET is one such
dataset. `--quick` uses small datasets and few steps, `--paper` trains for 300 epochs. Interrupted runs resume.

Expected, transferred frame by frame, head: PCA-220 0.286 mm, ridge 0.292, GPMM with estimated landmark noise ("noise
found") 0.287, GPMM and residual decoder 0.353, S2D-Dec 0.468. Time: 9 minutes on 2 cores of an AMD EPYC once the
networks are trained.
"""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

from experiments import _datasets, _mesh_eval, _motion_transfer, _run
from facejax.data import dataset
from facejax.data.mesh_subset import of_split
from facejax.data.synthetic import expression_recipes, makehuman
from facejax.evaluation import baselines, motion_metrics
from facejax.inference import motion_sources
from facejax.io import livelink

matplotlib.use("Agg")
import matplotlib.pyplot as plt

METHODS = ("pca220", "dl3dmm", "ridge", "rbf", "gpmm", "gpmm_found", "s2d_residual", "s2d", "neural3dmm")
WINDOW = 20  # frames
LEVEL = 3  # realism level of the training data
PAPER = {"pca220": 2.90, "dl3dmm": 2.73, "neural3dmm": 3.49, "s2d": 1.48}  # OT23, Table 2, VOCASET, mm


@dataclasses.dataclass(frozen=True)
class Config(_mesh_eval.Options):
    out: Path = Path("runs/table2")
    """Folder for checkpoints and results."""
    recording: Path | None = None
    """CSV file of a recording of speech by Epic's free iPhone app Live Link Face."""
    data: Path | None = None
    """Prepared dataset to train on, in place of makehuman4d."""
    speech: Path | None = None
    """Prepared dataset whose recordings are transferred from person to person, in place of --recording."""
    people: int = 11
    """Largest number of people that the motion is transferred to."""
    passages: int = 5
    """Number of passages, evenly spread over the recording; with --speech, of labels."""
    seconds: float = 4.0
    """Length of a passage in seconds."""
    methods: tuple[str, ...] = METHODS
    """Methods to evaluate."""


def run(config: Config) -> dict[str, Any]:
    """Evaluate all methods; one row per method and region."""
    if (config.recording is None) == (config.speech is None):
        raise ValueError(
            "expected --recording FILE.csv, a recording of speech by Epic's free iPhone app Live Link Face, "
            "or --speech STORE, a prepared dataset"
        )
    if config.people < 1 or config.passages < 1:
        raise ValueError(f"expected --people and --passages of 1 or more, got {config.people} and {config.passages}")
    mode = config.mode
    _mesh_eval.check_methods(config.methods)
    data = _datasets.load(config.data, mode, level=LEVEL)
    regions, hierarchy = _datasets.region_masks(data), _datasets.mesh_hierarchy(data)
    train = of_split(data, *(split for split in ("train", "validation") if len(data.subjects(split))))
    train = _datasets.limit_count(train.of_labels(expression_recipes.COMA) if _datasets.is_makehuman(data) else train)
    case = _datasets.Case("speech", 0, train, train, "labels")
    options = _mesh_eval.training_options(case, mode, config.seed, hierarchy)
    pairs = _of_recording(config, data) if config.speech is None else _of_dataset(config, data)
    rows, begun = [], time.perf_counter()
    for name in config.methods:
        fitted = _mesh_eval.fit_method(name, case, config.folder(), options)
        errors = {"transferred": {}, "own": {}}
        for source, target in pairs:
            marks = {
                "transferred": _motion_transfer.transfer(source, target, data.landmark_index),
                "own": target.landmarks,
            }
            for what, landmarks in marks.items():
                made = baselines.METHODS[name].apply(fitted, landmarks.astype(np.float32), target.rest)
                for region, mask in regions.items():
                    errors[what].setdefault(region, []).append(
                        motion_metrics.windowed_vertex_error(made, target.vertices, target.at, mask, window=WINDOW)
                    )
        for region in regions:
            row = {"method": name, "region": region}
            for what, found in errors.items():
                aligned, window = np.concatenate(found[region], axis=1).mean(axis=1)
                row |= {f"{what}_mm": float(aligned), f"{what}_window_mm": float(window)}
            rows.append(row)
        print(f"{name}: {rows[-len(regions)]}", flush=True)
    made = _run.record(config, seconds=time.perf_counter() - begun, dataset=data.index["spec"])
    of = (config.recording or config.speech).name
    metrics = {"mode": mode, "recording": of, "window": WINDOW, "rows": rows, "paper_mm": PAPER}
    figure = _plot(config.out / "table2.png", rows, config.methods)
    _run.finish("table2", config, metrics, made=made, table=_table(rows, config.methods), figure=figure)
    return metrics


def _of_recording(config: Config, data: dataset.Dataset) -> list[tuple[_motion_transfer.Take, _motion_transfer.Take]]:
    """Return (source, target) takes per passage and person: makehuman4d's test subjects, animated by rigs."""
    if not _datasets.is_makehuman(data):
        raise ValueError(f"--recording animates people of makehuman4d, which {config.data} does not hold: use --speech")
    source, *others = data.subjects("test").tolist()
    if not others:
        raise ValueError(f"{data.path}: expected two or more test subjects, got 1")
    length = float(livelink.read(config.recording).times[-1])
    if not 0.8 * length >= config.seconds > 0:
        raise ValueError(
            f"--seconds: expected at most 0.8 of the {length:.1f} s of the recording, got {config.seconds:g}"
        )
    begins = np.linspace(0.1 * length, 0.9 * length - config.seconds, config.passages)
    takes = [motion_sources.read_recording(config.recording, begin=float(b), seconds=config.seconds) for b in begins]
    faces = {i: makehuman.subject(i, seed=data.index["spec"]["seed"]) for i in (source, *others[: config.people])}
    moved = {
        i: [_motion_transfer.from_recording(take, face, data.landmark_index) for take in takes]
        for i, face in faces.items()
    }
    first = moved.pop(source)
    return [pair for of_one in moved.values() for pair in zip(first, of_one, strict=True)]


def _of_dataset(config: Config, data: dataset.Dataset) -> list[tuple[_motion_transfer.Take, _motion_transfer.Take]]:
    """Return (source, target) takes of every label and person of a dataset, of its test subjects if there are two."""
    talk = dataset.open_meshes(config.speech)
    _datasets.check_same_topology(talk, data)
    people = talk.subjects("test") if len(talk.subjects("test")) > 1 else np.arange(len(talk.neutral))
    named = talk.labels[1:]
    speakers = [
        who for who in people.tolist() if any(_motion_transfer.find_recording(talk, who, label) for label in named)
    ]
    if len(speakers) < 2:
        raise ValueError(f"{talk.path}: expected two or more people with recordings that have meshes")
    source, *others = speakers[: config.people + 1]
    labels = [label for label in named if _motion_transfer.find_recording(talk, source, label)][: config.passages]
    pairs = [
        (_motion_transfer.find_recording(talk, source, label), target)
        for label in labels
        for other in others
        if (target := _motion_transfer.find_recording(talk, other, label)) is not None
    ]
    if not pairs:
        raise ValueError(f"{talk.path}: expected two or more people with recordings of one label that have meshes")
    return pairs


def _value(rows, method: str, region: str, what: str) -> float:
    return next(r[what] for r in rows if (r["method"], r["region"]) == (method, region))


def _table(rows, methods_) -> str:
    kinds = ("transferred_mm", "transferred_window_mm", "own_mm")
    body = []
    for name in methods_:
        cells = [" / ".join(f"{_value(rows, name, region, kind):.3f}" for region in ("head", "face")) for kind in kinds]
        body.append((_mesh_eval.METHOD_NAMES[name], *cells, f"{PAPER[name]:.2f}" if name in PAPER else ""))
    header = ("mm, head / face", "transferred, frame by frame", f"least within {WINDOW} frames",
              "from the person's own landmarks", "OT23 on VOCASET, least within 20")  # fmt: skip
    return _run.markdown(header, body)


def _plot(path: Path, rows, methods_) -> Path:
    figure, axis = plt.subplots(figsize=(8, 3.6), constrained_layout=True)
    for i, (kind, label) in enumerate((("own_mm", "own landmarks"), ("transferred_mm", "transferred"))):
        values = [_value(rows, name, "face", kind) for name in methods_]
        axis.bar(np.arange(len(methods_)) + 0.4 * i - 0.2, values, 0.4, label=label)
    axis.set_xticks(range(len(methods_)), [_mesh_eval.METHOD_NAMES[name] for name in methods_], rotation=20, ha="right")
    axis.set_ylabel("mean vertex error of the face, mm")
    figure.legend(frameon=False, loc="outside right center")
    return _run.save_figure(figure, path)


if __name__ == "__main__":
    _run.main("table2", Config, run)
