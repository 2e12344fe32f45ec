"""From labels to 30 meshes: once compiled, in a fresh process, and in a fresh process with a warm compilation cache.

    python -m benchmarks.pipeline [--json FILE]

As released, by the linear answer alone (`refined=False`), and by S2D-Dec of the same hierarchy. What a face that was
not seen before costs once is told apart. About a minute.
"""

from __future__ import annotations

import dataclasses
import functools
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
from facejax.models import decoder, gpmm

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

    spiral = models._replace(decoder=decoder.init(jax.random.key(0), models.hierarchy))

    def made(models, samples, **options):
        landmarks = pipeline.landmarks(models, jax.random.key(0), labels, neutral, samples=samples)
        return pipeline.meshes(models, landmarks, neutral, **options)

    ways = {"refined": (models, {}), "linear": (models, {"refined": False}), "s2d": (spiral, {})}
    calls = {
        f"{way}_{samples}x30_meshes": functools.partial(made, of, samples, **options)
        for way, (of, options) in ways.items()
        for samples in (1, 16)
    }
    calls["new_face"] = lambda: gpmm.on_face(models.decoder.base, neutral)
    found = _measure.interleaved(calls, repeats=5 if config.quick else 20)
    rows = [{"name": name, **times} for name, times in found.items()]
    for row in rows[:-1]:
        row["meshes_per_s"] = 30 * (16 if "_16x" in row["name"] else 1) / row["median_s"]
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
