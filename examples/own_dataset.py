"""Add a dataset importer and an experiment from outside the package.

    python examples/own_dataset.py --out runs/own

An importer is a function `scan(root) -> Source`: it names the people and recordings of a layout on disk, and how to
read them frame by frame. `ingest.prepare` checks them and writes a dataset, which everything in facejax takes; with
`registry.SCANS["bumps"] = scan` the layout can be prepared by name, too. An experiment is a frozen `Config` and a
function `run(config) -> metrics`. The layout of this example is ROOT/PERSON-LABEL.npy of all frames (T, N, 3) in mm.
"""

import dataclasses
import functools
import json
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import trimesh
import tyro

from facejax.data import mesh_subset
from facejax.data.importers import ingest
from facejax.data.importers.base import Frame, Person, RecordingInfo, Source, SourceError
from facejax.evaluation import vertex_error
from facejax.io import meshes
from facejax.models.decoders import linear

LANDMARKS = np.array([0, 20, 40, 61, 83, 99, 120, 140])
SPLITS = {"P0": "train", "P1": "train", "P2": "train", "P3": "validation", "P4": "test"}
BALL = trimesh.creation.icosphere(subdivisions=2, radius=80)


def write_recordings(root: Path, seed: int, frames: int = 12) -> None:
    """Write the recordings of five people: ellipsoids of 162 vertices, with a bump that comes and goes."""
    rng = np.random.default_rng(seed)
    for name in SPLITS:
        rest = BALL.vertices * rng.uniform(0.9, 1.1, 3)
        for label, centre in (("left", LANDMARKS[1]), ("right", LANDMARKS[5])):
            near = np.exp(-((np.linalg.norm(rest - rest[centre], axis=1) / 40) ** 2))
            strength = rng.uniform(5, 15) * np.sin(np.linspace(0, np.pi, frames)) ** 2
            np.save(root / f"{name}-{label}.npy", rest + strength[:, None, None] * near[:, None] * [0.0, 0.3, 1.0])


def scan(root: Path) -> Source:
    """Return the recordings of a folder. Raises `SourceError` for a person that is not in SPLITS."""
    recordings = []
    for path in sorted(root.glob("*-*.npy")):
        name, _, label = path.stem.partition("-")
        if name not in SPLITS:
            raise SourceError(f"{path}: unknown person {name!r}, expected one of {', '.join(SPLITS)}")
        count = len(np.load(path, mmap_mode="r"))
        recordings.append(RecordingInfo(list(SPLITS).index(name), label, path.stem, path, (), count))
    people = tuple(Person(name, {"split": split}) for name, split in SPLITS.items())
    first = {recording.subject: recording for recording in reversed(recordings)}
    files, rest = tuple(recording.path for recording in recordings), functools.partial(read_rest, first)
    options = {"unit": "mm", "faces": np.asarray(BALL.faces), "landmarks": LANDMARKS}
    return Source("bumps", root, people, tuple(recordings), read, rest, files, 30.0, **options)


def read(recording: RecordingInfo, which: Sequence[int] | None) -> Iterator[Frame]:
    """Yield the frames of a recording, or those of some indices, each with a name for error messages."""
    vertices = np.load(recording.path)
    for i in range(len(vertices)) if which is None else which:
        yield f"{recording.path}: frame {i}", meshes.Mesh(vertices[i], None)


def read_rest(first: dict[int, RecordingInfo], subject: int) -> Iterator[Frame]:
    """Yield the neutral mesh of a person: the first frame of the first recording."""
    yield from read(first[subject], [0])


@dataclasses.dataclass(frozen=True)
class Config:
    out: Path | None = None
    seed: int = 0
    alpha: float = 1e-3  # weight of the ridge prior


def run(config: Config) -> dict[str, float]:
    """Prepare the dataset, fit a linear decoder on its training split, and return the test errors in mm."""
    out = Path(tempfile.mkdtemp(prefix="own-")) if config.out is None else config.out
    (out / "recordings").mkdir(parents=True)
    write_recordings(out / "recordings", config.seed)
    data = ingest.prepare(scan(out / "recordings"), out / "dataset", ingest.Request(landmarks=None))
    print(f"{len(data.sequences)} recordings of {data.people()}, labels {', '.join(data.labels)}")

    params = linear.ridge.fit(mesh_subset.of_split(data, "train"), alpha=config.alpha)
    test, everywhere = mesh_subset.of_split(data, "test"), np.ones(len(BALL.vertices), bool)
    decoders = {
        "ridge_mm": lambda landmarks, neutral: neutral + np.asarray(linear.apply(params, landmarks)),
        "no_motion_mm": lambda landmarks, neutral: np.broadcast_to(neutral, (len(landmarks), *neutral.shape)),
    }
    found = {name: vertex_error.distances(apply, test, {"all": everywhere}) for name, apply in decoders.items()}
    metrics = {name: distances.mean_std(everywhere)[0] for name, distances in found.items()}
    (out / "metrics.json").write_text(json.dumps(metrics, indent=1))
    print(f"mean vertex error on unseen people: {metrics}; written to {out / 'metrics.json'}")
    return metrics


if __name__ == "__main__":
    run(tyro.cli(Config, description=__doc__))
