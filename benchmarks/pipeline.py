"""From labels to 30 meshes: once compiled, in a fresh process, and in a fresh process with a warm compilation cache.

    python -m benchmarks.pipeline [--json FILE]

About a minute.
"""

from __future__ import annotations

import dataclasses
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import jax
import tyro

from benchmarks import _measure
from facejax import pipeline

FRESH = """
import time
begun = time.perf_counter()
import jax
from facejax import pipeline, results
results.compile_cache()
models = pipeline.load()
landmarks = pipeline.landmarks(models, jax.random.key(0), ["neutral", "high_smile"], models.face.vertices)
jax.block_until_ready(pipeline.meshes(models, landmarks, models.face.vertices))
print(time.perf_counter() - begun)
"""


@dataclasses.dataclass(frozen=True)
class Config:
    json: Path | None = None
    """Also write the rows here."""
    quick: bool = False
    """Fewer repeats."""


def run(config: Config) -> list[dict]:
    """Rows of the table."""
    models = pipeline.load()
    neutral, labels = models.face.vertices, ["neutral", "high_smile"]

    def frames():
        landmarks = pipeline.landmarks(models, jax.random.key(0), labels, neutral)
        return pipeline.meshes(models, landmarks, neutral)

    def batch():
        landmarks = pipeline.landmarks(models, jax.random.key(0), labels, neutral, samples=16)
        return pipeline.meshes(models, landmarks, neutral)

    found = _measure.interleaved(
        {"labels_to_30_meshes": frames, "16_requests_of_30_meshes": batch}, repeats=5 if config.quick else 20
    )
    rows = [{"name": name, **times} for name, times in found.items()]
    for row, meshes in zip(rows, (30, 480), strict=True):
        row["meshes_per_s"] = meshes / row["median_s"]
    with tempfile.TemporaryDirectory() as folder:
        for name in ("fresh_process_empty_cache", "fresh_process_warm_cache"):
            rows.append({"name": name, "first_s": _fresh(folder)})
    return rows


def _fresh(folder: str) -> float:
    """Seconds from the first import to 30 meshes, in a new process."""
    environment = os.environ | {"FACEJAX_CACHE": folder}
    begun = time.perf_counter()
    subprocess.run([sys.executable, "-c", FRESH], env=environment, check=True, capture_output=True)
    return time.perf_counter() - begun


if __name__ == "__main__":
    options = tyro.cli(Config, prog="python -m benchmarks.pipeline", description=__doc__)
    _measure.report(run(options), options.json)
