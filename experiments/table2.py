"""Speech and free talk carried from one person to others: motion that no method was trained on. OT23, Table 2.

    python -m experiments.table2 --recording take.csv --publish

A recording of Live Link Face drives one unseen person; the motion of its landmarks is encoded as an SRVF, put on
other people's neutral landmarks, scaled to their size, and expanded to their meshes. The truth is how the same
recording moves those people's own rigs. Fitted to makehuman4d's training people and CoMA's twelve expressions: no
speech among them. Five passages of the recording. OT23 takes each frame's least error within a window of 20 frames,
which flatters; the error frame by frame stands beside it. What the transfer itself costs is told by the methods'
errors from the person's own landmarks.

`--quick` is a look; `--paper` trains for 300 epochs. A stopped run goes on.
"""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

from experiments import _cases, _dense, _run, _transferred
from facejax import drive, methods
from facejax.data import livelink, makehuman, makehuman4d, performance
from facejax.data.meshes import of_split

matplotlib.use("Agg")
import matplotlib.pyplot as plt

METHODS = ("pca220", "dl3dmm", "ridge", "rbf", "gpmm", "s2d_residual", "s2d", "neural3dmm")
WINDOW = 20  # frames
LEVEL = 3  # realism of what is learnt from
PAPER = {"pca220": 2.90, "dl3dmm": 2.73, "neural3dmm": 3.49, "s2d": 1.48}  # OT23, Table 2, VOCASET, mm


@dataclasses.dataclass(frozen=True)
class Config(_dense.Options):
    recording: Path = dataclasses.field(kw_only=True)
    """A recording of Live Link Face (CSV)."""
    out: Path = Path("runs/table2")
    """Folder for checkpoints and results."""
    people: int = 11
    """To how many people the motion is carried."""
    passages: int = 5
    """How many parts of the recording, spread over it."""
    seconds: float = 4.0
    """How long each is."""
    methods: tuple[str, ...] = METHODS
    """Which methods."""


def run(config: Config) -> dict[str, Any]:
    """One row per method and region."""
    mode = config.mode
    _dense.check_methods(config.methods)
    data = _cases.data_of(None, mode, level=LEVEL)
    regions, hierarchy = _cases.regions_of(data), _cases.hierarchy_of(data)
    train = _cases.at_most(of_split(data, "train", "validation").of_labels(performance.COMA))
    case = _cases.Case("speech", 0, train, train, "labels")
    options = _dense.options_of(case, mode, config.seed, hierarchy)
    source, *others = data.subjects("test")[: config.people + 1]
    if not 1 <= config.people <= len(data.subjects("test")) - 1:
        raise ValueError(
            f"--people: expected 1 to {len(data.subjects('test')) - 1} besides the source, got {config.people}"
        )
    takes = _passages(config)
    faces = {index: makehuman.subject(int(index), seed=makehuman4d.SEED) for index in (source, *others)}
    moved = {index: [_skin(take, faces[index]) for take in takes] for index in faces}
    rows, begun = [], time.perf_counter()
    for name in config.methods:
        fitted = _dense.fitted(name, case, config.folder(), options)
        errors = {"transferred": {}, "own": {}}
        for index in others:
            rest = faces[index].vertices
            for take, true in zip(moved[source], moved[index], strict=True):
                marks = {"transferred": _transferred.transfer(take, faces[source].vertices, rest, data.landmark_index),
                         "own": (true - rest)[:, data.landmark_index]}  # fmt: skip
                for what, landmarks in marks.items():
                    made = methods.METHODS[name].apply(fitted, landmarks.astype(np.float32), rest)
                    for region, mask in regions.items():
                        errors[what].setdefault(region, []).append(_errors(made[:, mask], true[:, mask]))
        for region in regions:
            row = {"method": name, "region": region}
            for what, found in errors.items():
                aligned, window = np.concatenate(found[region], axis=1).mean(axis=1)
                row |= {f"{what}_mm": float(aligned), f"{what}_window_mm": float(window)}
            rows.append(row)
        print(f"{name}: {rows[-len(regions)]}", flush=True)
    made = _run.record(config, seconds=time.perf_counter() - begun, dataset=data.index["spec"])
    metrics = {"mode": mode, "recording": config.recording.name, "window": WINDOW, "rows": rows, "paper_mm": PAPER}
    figure = _plot(config.out / "table2.png", rows, config.methods)
    _run.finish("table2", config, metrics, made=made, table=_table(rows, config.methods), figure=figure)
    return metrics


def _passages(config: Config) -> list[livelink.Recording]:
    length = float(livelink.read(config.recording).times[-1])
    begins = np.linspace(0.1 * length, 0.9 * length - config.seconds, config.passages)
    return [drive.read_recording(config.recording, begin=float(b), seconds=config.seconds) for b in begins]


def _skin(take: livelink.Recording, person: makehuman.Subject) -> np.ndarray:
    return drive.posed(take, person)[:, : len(person.vertices)]


def _errors(made: np.ndarray, true: np.ndarray) -> np.ndarray:
    """(2, T): each frame's mean vertex distance, and the least of that to the true frames of a window about it."""
    apart = np.stack([np.linalg.norm(made - np.roll(true, -shift, axis=0), axis=-1).mean(axis=1)
                      for shift in range(-WINDOW // 2, WINDOW // 2 + 1)])  # fmt: skip
    frames = np.arange(len(made))
    for i, shift in enumerate(range(-WINDOW // 2, WINDOW // 2 + 1)):
        outside = (frames + shift < 0) | (frames + shift >= len(made))
        apart[i, outside] = np.inf
    return np.stack([apart[WINDOW // 2], apart.min(axis=0)])


def _value(rows, method: str, region: str, what: str) -> float:
    return next(r[what] for r in rows if (r["method"], r["region"]) == (method, region))


def _table(rows, methods_) -> str:
    kinds = ("transferred_mm", "transferred_window_mm", "own_mm")
    body = []
    for name in methods_:
        cells = [" / ".join(f"{_value(rows, name, region, kind):.3f}" for region in ("head", "face")) for kind in kinds]
        body.append((_dense.NAMES[name], *cells, f"{PAPER[name]:.2f}" if name in PAPER else ""))
    header = ("mm, head / face", "transferred, frame by frame", f"least within {WINDOW} frames",
              "from the person's own landmarks", "OT23 on VOCASET, least within 20")  # fmt: skip
    return _run.markdown(header, body)


def _plot(path: Path, rows, methods_) -> Path:
    figure, axis = plt.subplots(figsize=(8, 3.6), constrained_layout=True)
    for i, (kind, label) in enumerate((("own_mm", "own landmarks"), ("transferred_mm", "transferred"))):
        values = [_value(rows, name, "face", kind) for name in methods_]
        axis.bar(np.arange(len(methods_)) + 0.4 * i - 0.2, values, 0.4, label=label)
    axis.set_xticks(range(len(methods_)), [_dense.NAMES[name] for name in methods_], rotation=20, ha="right")
    axis.set_ylabel("mean vertex error of the face, mm")
    axis.legend(frameon=False)
    return _dense.drawn(figure, path)


if __name__ == "__main__":
    _run.main("table2", Config, run)
