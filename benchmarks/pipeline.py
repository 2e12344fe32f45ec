"""From labels to meshes: compiled, in a new process, and in a new process with a warm compilation cache.

    python -m benchmarks.pipeline [--json FILE] [--quick]

* `labels_to_meshes_b16`, `_b1`: 16 requests and one request of 30 meshes of 3,260 vertices, by the released models, on
  a prepared face.
* `_linear`: by the GPMM estimate alone (`refined=False`); `_s2d`: by S2D-Dec on the same mesh hierarchy.
* `new_face`, `new_faces_b100`: preparing a face, and 100 faces one after another in one program.
* `sample_b64`, `_b1`: the landmarks of 64 motions and of one.
* `fresh_process_*`: from the first import to 30 meshes, with an empty and with a warm compilation cache; once each,
  with the process's peak of resident memory.

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
from collections.abc import Callable

import jax
import numpy as np

from benchmarks import _measure, _sizes
from facejax.inference import pipeline
from facejax.models.decoders import s2d_dec

LABELS, FRAMES = ["neutral", "high_smile"], 30
FRESH = """
import resource
import jax
from facejax.cli import runtime
from facejax.inference import pipeline
runtime.configure()
models = pipeline.load()
landmarks = pipeline.landmarks(models, jax.random.key(0), ["neutral", "high_smile"], models.face.vertices)
jax.block_until_ready(pipeline.meshes(models, landmarks, models.face.vertices))
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
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
            sides = {"facejax": requests(of, samples, **options)}
            count = samples * FRAMES
            name = f"labels_to_meshes{way}_b{samples}"
            rows.append(_measure.row(name, sides, repeats=repeats, items=count, unit="meshes"))
    neutral = models.face.vertices
    rows.append(_measure.row("new_face", {"facejax": lambda: pipeline.prepare(models, neutral)}, repeats=5))
    if not config.quick:
        faces = neutral + np.random.default_rng(0).normal(size=(100, 1, 3)).astype(np.float32)
        many = jax.jit(
            lambda models, faces: jax.lax.map(lambda face: pipeline.prepare(models, face).decoder.map, faces)
        )
        side = {"facejax": lambda: many(models, faces)}
        rows.append(_measure.row("new_faces_b100", side, repeats=1, items=100, unit="faces"))
    face = pipeline.prepare(models, neutral)
    for samples in (64, 1):
        labels = np.tile(models.labels.encode(LABELS), (samples, 1))
        side = {"facejax": functools.partial(pipeline.motion, models, jax.random.key(0), labels, face)}
        rows.append(_measure.row(f"sample_b{samples}", side, repeats=repeats, items=samples, unit="motions"))
    with tempfile.TemporaryDirectory() as folder:
        for name in ("fresh_process_empty_cache", "fresh_process_warm_cache"):
            seconds, memory = _fresh(folder)
            times = dict.fromkeys(("first_s", "min_s", "median_s"), seconds)
            rows.append(_measure.lone(name, times, items=FRAMES, unit="meshes", peak_rss_mb=memory))
    sizes = []
    for way, (of, options) in {} if config.quick else ways.items():
        along = config.along_requests if way else config.along_requests[:3]
        make = lambda count, of=of, options=options: requests(of, count, **options)  # noqa: E731
        sizes += _sizes.along(f"labels_to_meshes{way}", "requests", along, make, repeats=3)
    return rows, sizes


def requests(models: pipeline.Models, samples: int, **options: bool) -> Callable[[], jax.Array]:
    """Return a function that generates motions of one pair of labels as meshes, on a prepared face."""
    face = pipeline.prepare(models, models.face.vertices)
    labels = np.tile(models.labels.encode(LABELS), (samples, 1))

    def made() -> jax.Array:
        landmarks = pipeline.motion(models, jax.random.key(0), labels, face, frames=FRAMES)
        return pipeline.vertices(models, face, landmarks, **options)

    return made


def _fresh(folder: str) -> tuple[float, float]:
    """Return the seconds from the first import to 30 meshes in a new process, and its peak of memory in MB."""
    environment = os.environ | {"FACEJAX_CACHE": folder}
    begun = time.perf_counter()
    done = subprocess.run([sys.executable, "-c", FRESH], env=environment, check=True, capture_output=True, text=True)
    return time.perf_counter() - begun, int(done.stdout) / 1024


if __name__ == "__main__":
    _measure.main("pipeline", Config, run)
