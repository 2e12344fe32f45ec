"""Composed transitions, and motion carried from one face to another, as rendered meshes. OT23, figure 9.

    python -m experiments.figure9 --publish
    python -m experiments.figure9 --recording take.csv

Above, two chains of transitions on unseen people. Below, the motion of one unseen person on two others: of a
recording of Live Link Face where one is given, else a performance of makehuman4d; its landmarks go through their SRVF
to the other face's neutral landmarks, and from there to its mesh. The films lie beside the picture.
"""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np
from PIL import Image

from experiments import _run, _transferred
from facejax import drive, files, io, pipeline, results
from facejax.data import makehuman, makehuman4d, performance, rig
from facejax.io import dress, render

CHAINS = (
    ("neutral", "mouth_down", "mouth_side", "mouth_open", "lips_back", "neutral"),
    ("neutral", "eyebrow", "high_smile", "mouth_extreme", "bareteeth", "neutral"),
)
PERFORMED = ("happiness", "mouth_extreme")  # one after the other, where no recording is given
SHOWN = 10
PICTURE = (150, 188)


@dataclasses.dataclass(frozen=True)
class Config:
    out: Path = Path("runs/figure9")
    """Folder for the results."""
    seed: int = 7
    """Of the generated motion."""
    model: Path | None = None
    """Weights to use in place of the released ones."""
    people: tuple[int, ...] = (103, 108, 114)
    """MakeHuman people (100 to 119 are test subjects): the chains' two, who are also the targets, and the source."""
    recording: Path | None = None
    """A recording of Live Link Face (CSV)."""
    begin: float = 60.0
    """Seconds into the recording."""
    seconds: float = 5.0
    """How much of it."""
    publish: bool = False
    """Also write the picture that the README shows."""


def run(config: Config) -> dict[str, Any]:
    """The sheet, the films, and how far the transferred motion is from what the target's own rig does."""
    if len(config.people) != 3:
        raise ValueError(f"--people: expected three numbers, got {config.people}")
    begun, models = time.perf_counter(), pipeline.load(config.model)
    people = [makehuman.subject(i, seed=makehuman4d.SEED) for i in config.people]
    rows, labels, films = [], [], {}
    for i, (chain, person) in enumerate(zip(CHAINS, people, strict=False)):
        key = jax.random.fold_in(jax.random.key(config.seed), i)
        marks = np.asarray(pipeline.landmarks(models, key, chain, person.vertices))
        films[f"chain{i + 1}"] = person, np.asarray(pipeline.meshes(models, marks, person.vertices)), marks
        labels.append(", ".join(chain[1:-1]))
    source = people[2]
    moved = _source(config, source)
    films["source"] = source, moved, moved[:, models.face.landmark_index]
    labels.append("source")
    errors = []
    for i, person in enumerate(people[:2]):
        displaced = _transferred.transfer(moved, source.vertices, person.vertices, models.face.landmark_index)
        marks = person.vertices[models.face.landmark_index] + displaced
        vertices = np.asarray(pipeline.meshes(models, marks.astype(np.float32), person.vertices))
        films[f"transfer{i + 1}"] = person, vertices, marks
        labels.append(f"on {person.name}")
        true = _source(config, person)
        errors.append({"target": person.name, "mean_mm": float(np.linalg.norm(vertices - true, axis=-1).mean()),
                       "still_mm": float(np.linalg.norm(person.vertices - true, axis=-1).mean())})  # fmt: skip
    results.writable(config.out)
    for name, (person, vertices, marks) in films.items():
        extras = dress.parts(models.props, person.vertices[models.face.landmark_index], marks)
        io.save(config.out / f"{name}.glb", vertices, models.face.faces, extras=extras)
        rows.append(_pictures(models, person, vertices, extras))
    path = config.out / "figure9.png"
    with files.replacing(path) as temporary:
        Image.fromarray(render.contact_sheet(rows, row_labels=labels)).save(temporary)
    made = _run.record(config, seconds=time.perf_counter() - begun, dataset=models.about["made"]["dataset"])
    metrics = {"chains": CHAINS, "transfer": errors, "recording": config.recording and config.recording.name}
    body = [(e["target"], f"{e['mean_mm']:.3f}", f"{e['still_mm']:.3f}") for e in errors]
    table = _run.markdown(("motion of another person on", "off its own rig's motion, mm", "left still"), body)
    _run.finish("figure9", config, metrics, made=made, table=table, figure=path)
    return metrics


def _source(config: Config, person: makehuman.Subject) -> np.ndarray:
    """A person's skin (T, N, 3) under the recording, or as the source performs."""
    if config.recording is not None:
        take = drive.read_recording(config.recording, begin=config.begin, seconds=config.seconds)
        return drive.posed(take, person)[:, : len(person.vertices)]
    takes = [performance.perform(label, config.people[2], seed=makehuman4d.SEED).weights for label in PERFORMED]
    weights = np.concatenate(takes)
    return rig.pose(rig.build(person, level=drive.LEVEL), weights)[:, : len(person.vertices)]


def _pictures(models, person, vertices, extras) -> np.ndarray:
    shown = np.linspace(0, len(vertices) - 1, SHOWN).round().astype(int)
    parts = [part._replace(vertices=part.vertices[shown]) if part.vertices.ndim == 3 else part for part in extras]
    camera = render.aim(person.vertices * 1.08, size=PICTURE, turn=18)
    return render.frames(vertices[shown], models.face.faces, size=PICTURE, camera=camera, extras=parts)


if __name__ == "__main__":
    _run.main("figure9", Config, run)
