"""makehuman4d: a free synthetic dataset of 4D expressions on MakeHuman heads.

Version 1: 120 subjects (80 train, 20 validation, 20 test), 18 expressions each, neutral -> apex -> neutral, and for
validation and test subjects the direct transitions between the expressions of OT23's Table 5. Four levels of
realism (`facejax.data.synthetic.rig`). Landmarks of every frame; meshes of a fixed sample of 20,000 frames. The same
seed gives the same bytes on one machine. Any change that alters a number requires version 2.

T frames, N skin vertices.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from facejax.data import dataset
from facejax.data.synthetic import assets, expression_recipes, makehuman, noise, performance, rig
from facejax.io import atomic, cache

VERSION = 1
SEED = 1
CHUNK = 256  # frames posed at a time; bounds the memory to about 60 MB
NECK = np.array([0.0, -95.0, -30.0], np.float32)  # pivot of the head's rotation

# OT23, Table 5: the 39 transitions of the paper's evaluation.
TABLE5 = {
    "bareteeth": ("high_smile", "lips_back", "lips_up"),
    "cheeks_in": ("mouth_down", "mouth_extreme", "mouth_middle"),
    "eyebrow": ("mouth_open", "mouth_side", "mouth_up"),
    "high_smile": ("neutral", "bareteeth", "cheeks_in"),
    "lips_back": ("eyebrow", "high_smile", "lips_up"),
    "lips_up": ("mouth_down", "mouth_extreme", "lips_back"),
    "mouth_down": ("mouth_middle", "mouth_open", "mouth_side"),
    "mouth_extreme": ("mouth_up", "neutral", "bareteeth"),
    "mouth_middle": ("cheeks_in", "eyebrow", "high_smile"),
    "mouth_open": ("lips_back", "lips_up", "mouth_down"),
    "mouth_side": ("mouth_extreme", "mouth_middle", "mouth_open"),
    "mouth_up": ("mouth_side", "neutral", "bareteeth"),
    "neutral": ("bareteeth", "cheeks_in", "eyebrow"),
}
TABLE5_PAIRS = tuple((start, end) for start, ends in TABLE5.items() for end in ends)


class Spec(NamedTuple):
    """Parameters that determine the bytes of a dataset."""

    level: int = 3
    subjects: int = 120
    meshes: int = 20_000
    seed: int = SEED
    head_motion: bool = False
    noise: float = 0.0  # registration noise, root mean square in mm

    @property
    def name(self) -> str:
        """The dataset's folder name."""
        motion = "-headmotion" if self.head_motion else ""
        noisy = f"-noise{self.noise:g}" if self.noise else ""
        size = f"{self.subjects}x{self.meshes}"
        return f"makehuman4d-v{VERSION}-level{self.level}-{size}-seed{self.seed}{motion}{noisy}"


def prepare(
    spec: Spec = Spec(), *, folder: Path | None = None, progress: Callable[[int, int], None] | None = None
) -> dataset.Dataset:
    """Open the dataset; generate it first if it does not exist, which takes minutes.

    Args:
      spec: what to generate.
      folder: where the dataset's own folder is, or is created; by default the cache.
      progress: called with (done, total) subjects.
    """
    path = Path(folder or cache.folder()) / spec.name
    if not (path / "index.json").exists():
        _generate(spec, path, progress or (lambda done, total: None))
    return dataset.open_dataset(path)


def split_of(index: int, subjects: int) -> str:
    """Return the split of a subject: the first two thirds train, the next sixth validates, the last sixth tests."""
    return "train" if index < subjects * 2 // 3 else "validation" if index < subjects * 5 // 6 else "test"


def _plan(spec: Spec) -> tuple[list[dataset.Sequence], list[np.ndarray], list[np.ndarray]]:
    """Return all sequences with their unit weights (T, U) and head rotations (T, 3)."""
    sequences, weights, rotations, start = [], [], [], 0
    for index in range(spec.subjects):
        takes = [(label, performance.perform(label, index, seed=spec.seed)) for label in expression_recipes.EXPRESSIONS]
        if split_of(index, spec.subjects) != "train":
            takes += [(f"{a}>{b}", _direct(a, b, index, spec.seed)) for a, b in TABLE5_PAIRS if "neutral" not in (a, b)]
        for label, take in takes:
            marks = (take.onset, take.apex_start, take.apex_end, take.offset)
            sequences.append(dataset.Sequence(index, label, start, len(take.weights), *marks, take.duration))
            weights.append(take.weights)
            rotations.append(take.head)
            start += len(take.weights)
    return sequences, weights, rotations


def _direct(start: str, end: str, index: int, seed: int) -> performance.Performance:
    weights = performance.perform_direct(start, end, index, seed=seed)
    last = len(weights) - 1
    duration = len(weights) / performance.STORED_RATE
    return performance.Performance(weights, np.zeros((len(weights), 3), np.float32), 0, last, last, last, duration)


def _generate(spec: Spec, path: Path, progress: Callable[[int, int], None]) -> None:
    loaded = assets.load()
    sequences, weights, rotations = _plan(spec)
    first = np.array([s.start for s in sequences] + [sequences[-1].start + sequences[-1].frames])
    expressions = np.concatenate([np.arange(s.start, s.start + s.frames) for s in sequences if ">" not in s.label])
    draw = np.random.default_rng([spec.seed, 2**20]).permutation(expressions)[: spec.meshes]
    drawn = np.sort(draw)
    shapes = {
        "faces": loaded.faces.shape,
        "neutral": (spec.subjects, loaded.skin, 3),
        "landmarks": (int(first[-1]), len(loaded.landmarks), 3),
        "vertices": (len(drawn), loaded.skin, 3),
        "drawn": drawn.shape,
        "landmark_index": loaded.landmarks.shape,
    }
    people = []
    with atomic.replace_folder(path) as temporary:

        def array(name: str) -> np.memmap:
            return np.lib.format.open_memmap(temporary / f"{name}.npy", "w+", np.float32, shapes[name])

        neutral, landmarks, vertices = array("neutral"), array("landmarks"), array("vertices")
        for index in range(spec.subjects):
            person = makehuman.subject(index, seed=spec.seed)
            neutral[index] = person.vertices
            mine = [i for i, s in enumerate(sequences) if s.subject == index]
            moves = np.concatenate([weights[i] for i in mine])
            head = np.concatenate([rotations[i] for i in mine])
            posed = rig.build(person, level=spec.level)
            for low in range(0, len(moves), CHUNK):
                skin = rig.pose(posed, moves[low : low + CHUNK])[:, : loaded.skin]
                if spec.head_motion:
                    skin = rotate_head(skin, head[low : low + CHUNK])
                row = first[mine[0]] + low
                if spec.noise:
                    rng = np.random.default_rng([spec.seed, 2**21, row])
                    skin = skin + noise.field(len(skin), rng, sigma=spec.noise)
                landmarks[row : row + len(skin)] = skin[:, loaded.landmarks]
                a, b = np.searchsorted(drawn, [row, row + len(skin)])
                vertices[a:b] = skin[drawn[a:b] - row]
            people.append(
                {
                    "name": person.name,
                    "split": split_of(index, spec.subjects),
                    "age": person.age,
                    "gender": person.gender,
                    "ethnicity": person.ethnicity.tolist(),
                }
            )
            progress(index + 1, spec.subjects)
        for mapped in (neutral, landmarks, vertices):
            mapped.flush()
        np.save(temporary / "faces.npy", loaded.faces)
        np.save(temporary / "drawn.npy", drawn)
        np.save(temporary / "landmark_index.npy", loaded.landmarks)
        index = {
            "schema": dataset.SCHEMA,
            "name": "makehuman4d",
            "version": VERSION,
            "spec": spec._asdict(),
            "source": {"file": assets.WHEEL, "sha256": assets.WHEEL_SHA256},
            "unit": "mm",
            "rate": performance.STORED_RATE,
            "labels": expression_recipes.LABELS,
            "shapes": shapes,
            "hashes": {name: atomic.sha256(temporary / f"{name}.npy") for name in shapes},
            "subjects": people,
            "sequences": [s._asdict() for s in sequences],
        }
        (temporary / "index.json").write_text(json.dumps(index))


def rotate_head(vertices: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Rotate vertices (T, N, 3) about the neck by angles (T, 3): pitch (positive leans back), yaw, roll in radians."""
    pitch, yaw, roll = np.moveaxis(np.asarray(angles, np.float64), -1, 0)
    one, zero = np.ones_like(pitch), np.zeros_like(pitch)
    c, s = np.cos, np.sin

    def matrix(rows: list[list[np.ndarray]]) -> np.ndarray:
        return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)

    about_x = matrix([[one, zero, zero], [zero, c(pitch), s(pitch)], [zero, -s(pitch), c(pitch)]])
    about_y = matrix([[c(yaw), zero, s(yaw)], [zero, one, zero], [-s(yaw), zero, c(yaw)]])
    about_z = matrix([[c(roll), -s(roll), zero], [s(roll), c(roll), zero], [zero, zero, one]])
    rotation = (about_z @ about_y @ about_x).astype(np.float32)
    return (vertices - NECK) @ np.swapaxes(rotation, -1, -2) + NECK
