"""Composed transitions, and motion transferred from one face to another, as rendered meshes (OT23, figure 9).

    python -m experiments.figure9 --publish
    python -m experiments.figure9 --recording take.csv
    python -m experiments.figure9 --data STORE --model MODEL

The upper rows show two chains of transitions on unseen people. The lower rows show the motion of one unseen person on
two others: a recording of Live Link Face where one is given, else a performance of makehuman4d. Its landmarks are
encoded as an SRVF, applied to the other face's neutral landmarks, and decoded to its mesh. With `--data`: three
people of a dataset, chains of its labels, and the first label under which all three have recordings. Animations are
written beside the picture as glTF.

Expected errors of the transferred motion: 0.388 and 0.308 mm, of 1.276 and 1.126 mm of motion. Time: 20 seconds on 2
cores of an AMD EPYC.
"""

from __future__ import annotations

import dataclasses
import itertools
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np

from experiments import _motion_eval, _motion_transfer, _run
from facejax import io
from facejax.cli import outputs
from facejax.data import dataset
from facejax.data.synthetic import makehuman, makehuman4d, performance, rig
from facejax.inference import motion_sources, pipeline
from facejax.viz import eyes_teeth, render

CHAINS = (
    ("neutral", "mouth_down", "mouth_side", "mouth_open", "lips_back", "neutral"),
    ("neutral", "eyebrow", "high_smile", "mouth_extreme", "bareteeth", "neutral"),
)
PEOPLE = (103, 108, 114)
PERFORMED = ("happiness", "mouth_extreme")  # played one after the other where no recording is given
SHOWN = 10
PICTURE = (150, 188)


@dataclasses.dataclass(frozen=True)
class Config:
    out: Path = Path("runs/figure9")
    """Folder for the results."""
    seed: int = 7
    """Seed of the generated motion."""
    model: Path | None = None
    """Model file to use in place of the released models."""
    data: Path | None = None
    """Prepared dataset that `--model` was trained on, to use in place of MakeHuman's people."""
    people: tuple[int, ...] = ()
    """Indices of three people: the two of the chains, who are also the targets, and the source. By default MakeHuman's
    test subjects 103, 108 and 114 (of 100 to 119), or the first three of the dataset's test, validation and training
    subjects."""
    recording: Path | None = None
    """CSV file of a recording by Epic's free iPhone app Live Link Face."""
    begin: float = 60.0
    """Start of the passage in seconds."""
    seconds: float = 5.0
    """Length of the passage in seconds."""
    publish: bool = False
    """Also write the committed results in experiments/results."""


def run(config: Config) -> dict[str, Any]:
    """Write the sheet and the animations; return the errors of the transferred motion against the target's own."""
    if config.data is not None and config.recording is not None:
        raise ValueError("--recording animates MakeHuman's people and --data uses its own: name one of them")
    begun, models = time.perf_counter(), pipeline.load(config.model)
    index = np.asarray(models.face.landmark_index)
    chains, takes = _stored(config, models) if config.data else (CHAINS, _performed(config, models))
    labels, films = [], {}
    for i, (chain, take) in enumerate(zip(chains, takes, strict=False)):
        key = jax.random.fold_in(jax.random.key(config.seed), i)
        marks = np.asarray(pipeline.landmarks(models, key, chain, take.rest))
        films[f"chain{i + 1}"] = take, np.asarray(pipeline.meshes(models, marks, take.rest)), marks
        labels.append(", ".join(chain[1:-1]))
    *targets, source = takes
    marks = source.rest[index] + source.landmarks
    if len(source.at) == len(marks):
        films["source"] = source, source.vertices, marks
    else:  # not every frame has a mesh
        films["source"] = source, np.asarray(pipeline.meshes(models, marks, source.rest)), marks
    labels.append("source")
    errors = []
    for i, take in enumerate(targets):
        marks = (take.rest[index] + _motion_transfer.transfer(source, take, index)).astype(np.float32)
        vertices = np.asarray(pipeline.meshes(models, marks, take.rest))
        films[f"transfer{i + 1}"] = take, vertices, marks
        labels.append(f"on {take.name}")
        still = np.broadcast_to(take.rest, vertices.shape)
        mean, at_rest = (float(_mean_distance(made[take.at], take.vertices)) for made in (vertices, still))
        errors.append({"target": take.name, "mean_mm": mean, "still_mm": at_rest})
    outputs.make_output_folder(config.out)
    rows = []
    for name, (take, vertices, marks) in films.items():
        extras = eyes_teeth.parts(eyes_teeth.template(), take.rest[index], marks)
        io.save(config.out / f"{name}.glb", vertices, models.face.faces, extras=extras)
        rows.append(_pictures(models, take.rest, vertices, extras))
    path = config.out / "figure9.png"
    render.save(path, render.contact_sheet(rows, row_labels=labels))
    made = _run.record(config, seconds=time.perf_counter() - begun, dataset=_dataset(models))
    metrics = {"chains": chains, "transfer": errors, "recording": config.recording and config.recording.name}
    body = [(e["target"], f"{e['mean_mm']:.3f}", f"{e['still_mm']:.3f}") for e in errors]
    table = _run.markdown(("motion of another person on", "off its own motion, mm", "left still"), body)
    _run.finish("figure9", config, metrics, made=made, table=table, figure=path)
    return metrics


def _mean_distance(a: np.ndarray, b: np.ndarray) -> float:
    return np.linalg.norm(a - b, axis=-1).mean(axis=1, dtype=np.float64).mean()


def _performed(config: Config, models: pipeline.Models) -> list[_motion_transfer.Take]:
    """Return the takes of three MakeHuman people, animated by the recording or by a performance of the third."""
    index = np.asarray(models.face.landmark_index)
    numbers = config.people or PEOPLE
    template, known = makehuman.template(), set(itertools.chain(*CHAINS))
    same = np.array_equal(template.faces, models.face.faces) and np.array_equal(template.landmarks, index)
    if not same or not known <= set(models.labels):
        raise ValueError(f"{config.model}: trained on another dataset than makehuman4d: give that dataset with --data")
    if len(numbers) != 3:
        raise ValueError(f"--people: expected three numbers, got {config.people}")
    people = [makehuman.subject(i, seed=makehuman4d.SEED) for i in numbers]
    if config.recording is not None:
        take = motion_sources.read_recording(config.recording, begin=config.begin, seconds=config.seconds)
        return [_motion_transfer.from_recording(take, person, index) for person in people]
    takes = [performance.perform(label, numbers[2], seed=makehuman4d.SEED).weights for label in PERFORMED]
    weights, found = np.concatenate(takes), []
    for person in people:
        skin = rig.pose(rig.build(person, level=motion_sources.LEVEL), weights)[:, : len(person.vertices)]
        found.append(_motion_transfer.from_meshes(skin, person, index))
    return found


def _stored(config: Config, models: pipeline.Models) -> tuple[list[tuple[str, ...]], list[_motion_transfer.Take]]:
    """Return two chains of a dataset's labels, and three people's takes of one label."""
    data = dataset.open_meshes(config.data)
    _motion_eval.check_models(models, data, config.model or "the released models")
    held = np.concatenate([data.subjects(split) for split in ("test", "validation", "train")])
    numbers = list(config.people or held[:3].tolist())
    if len(numbers) != 3 or not set(numbers) <= set(held.tolist()):
        raise ValueError(f"--people: expected three of {data.path}'s {len(held)} people, got {numbers}")
    for label in data.labels[1:]:
        takes = [_motion_transfer.find_recording(data, number, label) for number in numbers]
        if None not in takes:
            rng = np.random.default_rng(config.seed)
            names = [rng.permutation(data.labels[1:])[:4].tolist() for _ in CHAINS]
            return [(data.labels[0], *chain, data.labels[0]) for chain in names], takes
    raise ValueError(f"{data.path}: found no label with recordings and meshes of all people {numbers}")


def _dataset(models: pipeline.Models) -> dict[str, Any]:
    return models.about["made"]["dataset"] if "made" in models.about else models.about["spec"]


def _pictures(models, rest, vertices, extras) -> np.ndarray:
    shown = np.linspace(0, len(vertices) - 1, SHOWN).round().astype(int)
    parts = [part._replace(vertices=part.vertices[shown]) if part.vertices.ndim == 3 else part for part in extras]
    camera = render.fit_camera(rest * 1.08, size=PICTURE, turn=18)
    return render.frames(vertices[shown], models.face.faces, size=PICTURE, camera=camera, extras=parts)


if __name__ == "__main__":
    _run.main("figure9", Config, run)
