"""Training of S2D-Dec on 20,000 meshes in a process of its own, to measure its peak memory.

    python -m benchmarks._training_memory

Started by `benchmarks.decoder`. Prints one line of JSON: seconds per step, the first chunk separately, and peak MB.
"""

from __future__ import annotations

import json
import statistics
import tempfile
from pathlib import Path

from benchmarks import _machine
from facejax.data import mesh_subset
from facejax.data.synthetic import makehuman, makehuman4d
from facejax.mesh import hierarchy as mesh_hierarchy
from facejax.training.recipes import fit_s2d_dec

CHUNK, CHUNKS = 50, 5  # steps per chunk of `fit_s2d_dec.fit`, number of chunks


def measure() -> dict[str, float]:
    """Train for some chunks of steps, with batches read from disk as in any training."""
    data = makehuman4d.prepare()
    everybody = mesh_subset.of_split(data, "train", "validation", "test")
    hierarchy = mesh_hierarchy.build(*makehuman.template()[:2])
    with tempfile.TemporaryDirectory() as folder:
        fit_s2d_dec.fit(everybody, hierarchy, folder, plan=fit_s2d_dec.S2DDecPlan(steps=CHUNK * CHUNKS))
        lines = Path(folder, "metrics.jsonl").read_text().splitlines()
    first, *steady = [json.loads(line)["seconds"] / CHUNK for line in lines]
    times = {"first_s": CHUNK * first, "min_s": min(steady), "median_s": statistics.median(steady)}
    return times | {"meshes": everybody.count, "memory_mb": _machine.peak_mb()}


if __name__ == "__main__":
    print(json.dumps(measure()))
