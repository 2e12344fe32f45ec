"""From labels to meshes: compiled, in a new process, and in a new process with a warm compilation cache.

    python -m benchmarks.pipeline [--json FILE] [--quick]

* `labels_to_meshes_b16`, `_b1`: 16 requests and one request of 30 meshes of 3,260 vertices, by the released models.
* `_linear`: by the GPMM estimate alone (`refined=False`); `_s2d`: by S2D-Dec on the same mesh hierarchy.
* `new_face`: the one-off cost of a new face.
* `fresh_process_*`: from the first import to 30 meshes, with an empty and with a warm compilation cache; once each.

There is no peer: no other library does this. Cost against size: 1 to 256 requests. About a minute.
"""

from __future__ import annotations

import dataclasses
import functools
import os
import subprocess
import sys
import tempfile
import time

import jax

from benchmarks import _measure, _sizes
from facejax.inference import pipeline
from facejax.models.decoders import s2d_dec

LABELS, FRAMES = ["neutral", "high_smile"], 30
FRESH = """
import jax
from facejax.cli import runtime
from facejax.inference import pipeline
runtime.configure()
models = pipeline.load()
landmarks = pipeline.landmarks(models, jax.random.key(0), ["neutral", "high_smile"], models.face.vertices)
jax.block_until_ready(pipeline.meshes(models, landmarks, models.face.vertices))
"""


@dataclasses.dataclass(frozen=True)
class Config(_measure.Options):
    """Options of the benchmark."""

    requests: tuple[int, ...] = (16, 1)
    """Numbers of simultaneous requests."""
    along_requests: tuple[int, ...] = (1, 4, 16, 64, 256)
    """Numbers of requests at which the cost is measured; the first three of them for the released models."""


def run(config: Config) -> _measure.Found:
    """Measure and return the rows."""
    models = pipeline.load()
    spiral = models.replace(decoder=s2d_dec.init(jax.random.key(0), models.hierarchy))
    ways = {"": (models, {}), "_linear": (models, {"refined": False}), "_s2d": (spiral, {})}
    rows, repeats = [], 5 if config.quick else 15
    for way, (of, options) in ways.items():
        for samples in config.requests:
            sides = {"facejax": functools.partial(made, of, samples, **options)}
            count = samples * FRAMES
            name = f"labels_to_meshes{way}_b{samples}"
            rows.append(_measure.row(name, sides, repeats=repeats, items=count, unit="meshes"))
    neutral = models.face.vertices
    rows.append(_measure.row("new_face", {"facejax": lambda: pipeline.prepare(models, neutral)}, repeats=5))
    with tempfile.TemporaryDirectory() as folder:
        for name in ("fresh_process_empty_cache", "fresh_process_warm_cache"):
            seconds = _fresh(folder)
            times = dict.fromkeys(("first_s", "min_s", "median_s"), seconds)
            rows.append(_measure.lone(name, times, items=FRAMES, unit="meshes"))
    sizes = []
    for way, (of, options) in {} if config.quick else ways.items():
        along = config.along_requests if way else config.along_requests[:3]
        make = lambda count, of=of, options=options: functools.partial(made, of, count, **options)  # noqa: E731
        sizes += _sizes.along(f"labels_to_meshes{way}", "requests", along, make, repeats=3)
    return rows, sizes


def made(models: pipeline.Models, samples: int, **options: bool) -> jax.Array:
    """Generate motions of one pair of labels as meshes."""
    neutral = models.face.vertices
    landmarks = pipeline.landmarks(models, jax.random.key(0), LABELS, neutral, samples=samples)
    return pipeline.meshes(models, landmarks, neutral, **options)


def _fresh(folder: str) -> float:
    """Return the seconds from the first import to 30 meshes, in a new process."""
    environment = os.environ | {"FACEJAX_CACHE": folder}
    begun = time.perf_counter()
    subprocess.run([sys.executable, "-c", FRESH], env=environment, check=True, capture_output=True)
    return time.perf_counter() - begun


if __name__ == "__main__":
    _measure.main("pipeline", Config, run)
