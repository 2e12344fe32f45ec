"""Reading meshes: batches from a dataset, mesh files, and the preparation of a dataset from files.

    python -m benchmarks.data [--json FILE] [--quick]

* `mesh_batches_b16`: random batches of displacements as training reads them, from a dataset on disk.
* `read_ply`: a binary PLY of 5,023 vertices (CoMA's size) beside trimesh, `process=False`.
* `prepare_2000`: `facejax data prepare folder` on 2,000 such files with all cores, including the start of the process.

Files are synthetic and in the page cache. About a minute.
"""

from __future__ import annotations

import dataclasses
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import trimesh

from benchmarks import _equal, _measure, _sheet
from facejax import io
from facejax.data import dataset, mesh_subset
from facejax.data.synthetic import makehuman4d
from facejax.training.recipes import fit_s2d_dec

ROOT = Path(__file__).parents[1]


@dataclasses.dataclass(frozen=True)
class Config(_measure.Options):
    """Options of the benchmark."""

    vertices: int = 5023
    """Number of vertices of a mesh."""
    meshes: int = 2000
    """Number of files to prepare; --quick takes a tenth."""
    batch: int = 16
    """Number of meshes of a batch."""
    store: Path | None = None
    """Prepared dataset to read batches from; by default makehuman4d, prepared first if it is missing."""


def run(config: Config) -> _measure.Found:
    """Measure and return the rows."""
    rows, repeats = [], 5 if config.quick else 15
    data = makehuman4d.prepare() if config.store is None else dataset.open_dataset(config.store)
    everybody = mesh_subset.of_split(data, "train")
    read = fit_s2d_dec.mesh_batches(everybody, config.batch, 0)
    first = iter(range(0, 10**9, 10))
    sides = {"facejax": lambda: read(next(first), 10)}
    count = 10 * config.batch
    rows.append(_measure.row(f"mesh_batches_b{config.batch}", sides, repeats=repeats, items=count, unit="meshes"))
    with tempfile.TemporaryDirectory() as name:
        root = Path(name)
        files = _written(root / "raw", config)
        sides = {
            "facejax": lambda: io.load_mesh(files[0]).vertices,
            "trimesh": lambda: trimesh.load(files[0], process=False).vertices,
        }
        _equal.check(*(side() for side in sides.values()))
        rows.append(_measure.row("read_ply", sides, peers=["trimesh"], repeats=repeats, items=1, unit="meshes"))
        rows.append(_prepared(root, len(files)))
    return rows, []


def _written(root: Path, config: Config) -> list[Path]:
    """Write recordings of 50 frames, ten per subject, as binary PLY; return the files."""
    rng = np.random.default_rng(0)
    side = int(np.sqrt(config.vertices)) + 1
    vertices, faces = _sheet.grid(side)
    keep = (faces < config.vertices).all(axis=1)
    vertices, faces = vertices[: config.vertices], faces[keep]
    total = config.meshes // 10 if config.quick else config.meshes
    files = []
    for number in range(total):
        recording, frame = divmod(number, 50)
        path = root / f"s{recording // 10:02}" / f"smile{recording % 10}" / f"{frame:03}.ply"
        path.parent.mkdir(parents=True, exist_ok=True)
        moved = vertices + 0.1 * np.sin(np.pi * frame / 49) * rng.normal(size=vertices.shape)
        trimesh.Trimesh(moved, faces, process=False).export(path)
        files.append(path)
    return files


def _prepared(root: Path, count: int) -> _measure.Row:
    """Time the command in a process of its own; every call writes to a new folder."""
    np.savetxt(root / "landmarks.txt", np.linspace(0, 5000, 68).astype(int), fmt="%d")
    command = [sys.executable, "-c", "from facejax.cli.main import main; main()", "data", "prepare", "folder"]
    command += ["--root", root / "raw", "--landmarks", root / "landmarks.txt", "--unit", "mm"]
    calls = iter(range(10**9))

    def ours() -> None:
        out = root / f"store{next(calls)}"
        found = subprocess.run([*command, "--out", out], cwd=ROOT, capture_output=True, text=True)
        if found.returncode:
            raise RuntimeError(f"data prepare failed: {found.stderr}")

    return _measure.row(
        f"prepare_{count}", {"facejax": ours}, repeats=1 if count < 1000 else 3, items=count, unit="meshes"
    )


if __name__ == "__main__":
    _measure.main("data", Config, run)
