"""Scaling: several devices against one, and large corpora.

    python -m benchmarks.scale [--json FILE] [--quick]

* `s2d_step_devices`, `lstm_step_devices`: a training step whose batch is sharded over the cores, each a device
  (`facejax.training.sharding.data_parallel`), against one device, which itself uses all cores for large products.
  `efficiency` is the speed-up divided by the number of devices.
* `corpus_devices`: motions of a corpus, likewise.
* `corpus_N`: a corpus of N motions with its index, written to the system's temporary folder.
* `corpus_1000000`: a million motions, extrapolated from the measured ones by the cost of one more motion.

Losses of the first steps and the motions are checked to be equal. Cost against size: motions of a corpus. About three
minutes, one with --quick.
"""

from __future__ import annotations

import dataclasses
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax

from benchmarks import _equal, _measure, _sheet, _work
from facejax import losses
from facejax.cli import runtime
from facejax.inference import corpus, pipeline
from facejax.mesh import hierarchy as mesh_hierarchy
from facejax.models import lstm
from facejax.models.decoders import s2d_dec
from facejax.training import loop, sharding, steps

SCAN = 5  # training steps in one call


@dataclasses.dataclass(frozen=True)
class Config(_measure.Options):
    """Options of the benchmark."""

    side: int = 71
    """Number of vertices along a side of the grid that S2D-Dec is trained on."""
    meshes: int = 16
    """Number of meshes of a batch."""
    frames: int = 135
    """Number of frames of a recording that an expression network is trained on."""
    recordings: int = 32
    """Number of recordings of a batch."""
    motions: int = 512
    """Number of motions of the corpus for the comparison of devices."""
    sequences: tuple[int, ...] = (100, 1_000, 10_000)
    """Numbers of motions of the corpora to write; --quick leaves out the last."""
    million: int = 1_000_000
    """Number of motions whose cost is extrapolated."""


def run(config: Config) -> _measure.Found:
    """Measure and return the rows."""
    repeats = 3 if config.quick else 9
    models = pipeline.load()
    rows = [_step("s2d_step_devices", *_meshes(config), 0, repeats)]
    rows += [_step("lstm_step_devices", *_recordings(config), 1, repeats), _drawn(models, config.motions, repeats)]
    counts = config.sequences[:-1] if config.quick else config.sequences
    written = [_written(models, count) for count in counts]
    keys = ("first_s", "min_s", "median_s")
    sizes = [
        {"name": "corpus", "axis": "motions", "size": row["motions"]} | {k: row[k] for k in keys} for row in written
    ]
    return [*rows, *written, _extrapolated(written, config.million)], [] if config.quick else sizes


def _meshes(config: Config):
    """Return loss, weights, batch and constants of S2D-Dec."""
    host = mesh_hierarchy.build(*_sheet.grid(config.side))
    params, hierarchy = s2d_dec.init(jax.random.key(0), host), jax.device_put(host)
    rng = np.random.default_rng(0)
    shapes = (config.meshes, 68, 3), (config.meshes, config.side**2, 3)
    batch = tuple(jnp.asarray(rng.normal(size=shape), jnp.float32) for shape in shapes)

    def loss(weights, key, batch, constants):
        scale, hierarchy = constants
        return losses.displacement_l1(s2d_dec.apply(s2d_dec.S2DDec(scale, weights), hierarchy, batch[0]), batch[1]), {}

    return loss, params.weights, batch, (params.scale, hierarchy)


def _recordings(config: Config):
    """Return loss, weights, batch (time first) and constants of an expression network."""
    weights = lstm.init(jax.random.key(0), 204)
    rng = np.random.default_rng(0)
    shape = (config.frames, config.recordings, 204)
    batch = tuple(jnp.asarray(rng.normal(size=shape), jnp.float32) for _ in range(2))

    def loss(weights, key, batch, constants):
        return jnp.mean(jnp.square(lstm.forward(weights, batch[0]) - batch[1])), {}

    return loss, weights, batch, ()


def _step(name: str, loss: Callable, weights, batch, constants, axis: int, repeats: int) -> _measure.Row:
    step = steps.supervised(loss, optax.adam(1e-3))
    shared = sharding.data_parallel(step, axis=axis)

    def onward(step: loop.Step) -> Callable:
        state = steps.init_supervised(weights, optax.adam(1e-3), jax.random.key(0))
        return _work.onward(step, state, batch, constants)

    sides = {"facejax": onward(_work.scanned(shared, SCAN)), "one device": onward(_work.scanned(step, SCAN))}
    _equal.check(*(side()["loss"] for side in sides.values()), tolerance=1e-5)
    calls, items = dict.fromkeys(sides, SCAN), batch[0].shape[axis]
    return _shared(
        _measure.row(name, sides, peers=["one device"], repeats=repeats, calls=calls, items=items, unit="samples")
    )


def _drawn(models: pipeline.Models, count: int, repeats: int) -> _measure.Row:
    def maker(devices: Sequence[jax.Device]) -> Callable:
        make = corpus.maker(models, corpus.Request(count), {"average": models.face.vertices}, devices=devices)
        return lambda: make(0, count)["landmarks"]

    sides = {"facejax": maker(jax.devices()), "one device": maker(jax.devices()[:1])}
    _equal.check(*(side() for side in sides.values()), tolerance=1e-6)
    row = _measure.row("corpus_devices", sides, peers=["one device"], repeats=repeats, items=count, unit="motions")
    return _shared(row)


def _shared(row: _measure.Row) -> _measure.Row:
    count = jax.device_count()
    return row | {"devices": count, "efficiency": row["ratio"] / count}


def _written(models: pipeline.Models, count: int) -> _measure.Row:
    """Write a corpus once; the program is compiled already."""
    neutrals = {"average": models.face.vertices}
    with tempfile.TemporaryDirectory() as folder:
        begun = time.perf_counter()
        found = corpus.generate(models, corpus.Request(count), neutrals, Path(folder) / "corpus")
        seconds = time.perf_counter() - begun
        size = sum(shard.bytes for shard in found.shards)
    times = dict.fromkeys(("first_s", "min_s", "median_s"), seconds)
    return _measure.lone(f"corpus_{count}", times, items=count, unit="motions", motions=count, megabytes=size / 1e6)


def _extrapolated(written: list[_measure.Row], count: int) -> _measure.Row:
    """Extrapolate from the two largest corpora that were measured."""
    less, more = written[-2:]
    rates = {key: (more[key] - less[key]) / (more["motions"] - less["motions"]) for key in ("median_s", "megabytes")}
    found = {key: more[key] + (count - more["motions"]) * rate for key, rate in rates.items()}
    times = dict.fromkeys(("first_s", "min_s", "median_s"), found["median_s"])
    about = {"motions": count, "megabytes": found["megabytes"], "simulated": True}
    return _measure.lone(f"corpus_{count}", times, items=count, unit="motions", **about)


if __name__ == "__main__":
    runtime.use_all_cores()
    _measure.main("scale", Config, run)
