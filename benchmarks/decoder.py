"""S2D-Dec against PyTorch: forward pass of a batch and of one frame, gradient, training step, and training memory.

    python -m benchmarks.decoder [--json FILE] [--quick]

The network of OT23 (`facejax.models.decoders.s2d_dec`) on a square grid of CoMA's size: 5,041 vertices, four
decimations by 4, spirals of 9, 9, 14, 15 and 15, channels 128, 64, 32, 32, 16, 3. Operations are counted as the paper
states them: a dense layer, then at every level the products of whole spirals on the finer mesh. facejax multiplies
before it upsamples, which needs a third of the operations of the whole decoder.

Implementations: `plain` is the direct form in JAX. `rows` and `sparse` are in PyTorch, eager and compiled. `sums` is
facejax's algorithm in PyTorch; it does not count as a peer for the ratio. The training step is that of
`facejax.training.recipes.fit_s2d_dec`, including loss and AdamW; facejax's is timed as ten steps in one call, as in
the training loop, and alone as `single`. Outputs, gradients and losses are checked to be equal first.

`s2d_training_20000_meshes` trains on the default dataset in a process of its own, to measure its peak memory; the
first run prepares the dataset in the user's cache. Cost against size: 1,000 to 100,000 vertices (one frame), batches
of 1 to 256. About four minutes, one with --quick.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import math
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from benchmarks import _equal, _measure, _sheet, _sizes, _torch, _work
from facejax import losses
from facejax.mesh import hierarchy
from facejax.mesh.hierarchy import Hierarchy
from facejax.models.decoders import s2d_dec
from facejax.training import loop, steps

ROOT = Path(__file__).parents[1]
PLAN = {"rate": 1e-3, "weight_decay": 5e-5}
SCAN = 10  # training steps in one call


@dataclasses.dataclass(frozen=True)
class Config(_measure.Options):
    """Options of the benchmark."""

    side: int = 71
    """Number of vertices along a side of the grid; 71 gives CoMA's size."""
    batch: int = 16
    """Batch size; that of OT23."""
    vertices: tuple[int, ...] = (1_000, 3_000, 10_000, 30_000, 100_000)
    """Numbers of vertices at which the cost of one frame is measured."""
    batches: tuple[int, ...] = (1, 4, 16, 64, 256)
    """Batch sizes at which the cost is measured."""
    threads: int | None = None
    """Number of PyTorch threads; by default one per core."""


class Problem(NamedTuple):
    """A decoder and its data."""

    params: s2d_dec.S2DDec
    hierarchy: Hierarchy
    marks: jax.Array  # (B, L, 3)
    target: jax.Array  # (B, N, 3)
    weights: jax.Array  # (N,)


def run(config: Config) -> _measure.Found:
    """Measure and return the rows."""
    with_torch, repeats = _torch.ready(config.threads), 7 if config.quick else 25
    problems = {batch: problem(config.side, batch) for batch in (config.batch, 1)}
    rows = [_forward(given, with_torch, repeats) for given in problems.values()]
    rows += [_gradient(given, with_torch, repeats) for given in problems.values()]
    rows.append(_step(problems[config.batch], with_torch, max(5, repeats // 2)))
    if config.quick:
        return rows, []
    rows.append(_training())
    return rows, _by_size(config)


def problem(side: int, batch: int) -> Problem:
    """Return a decoder and random data on a grid of side^2 vertices."""
    host = hierarchy.build(*_sheet.grid(side))
    rng = np.random.default_rng(0)
    marks, target, weights = (
        jnp.asarray(rng.normal(size=shape), jnp.float32) for shape in ((batch, 68, 3), (batch, side**2, 3), side**2)
    )
    return Problem(s2d_dec.init(jax.random.key(0), host), jax.device_put(host), marks, target, jnp.abs(weights))


def gflop(hierarchy: Hierarchy, *, batch: int, landmarks: int = 68) -> float:
    """Return the billions of operations of a forward pass, counted from the architecture."""
    channels = (*s2d_dec.CHANNELS, 3)
    levels = [*range(len(hierarchy.spirals))][::-1] + [0]
    convs = zip((hierarchy.spirals[level].size for level in levels), channels[:-1], channels[1:], strict=True)
    products = sum(reads * inward * outward for reads, inward, outward in convs)
    return 2e-9 * batch * (3 * landmarks * hierarchy.sizes[-1] * channels[0] + products)


def plain(params: s2d_dec.S2DDec, hierarchy: Hierarchy, displacements: jax.Array) -> jax.Array:
    """Direct implementation of `s2d_dec.apply`: (B, L, 3) -> (B, N, 3)."""
    scale, weights = params
    x = ((displacements - scale.landmark_mean) / scale.landmark_std).reshape(len(displacements), -1)
    x = x @ weights["dense"]["kernel"] + weights["dense"]["bias"]
    x = x.reshape(len(x), hierarchy.sizes[-1], -1)
    *climbs, last = weights["convs"]
    for level, conv in zip(range(len(climbs) - 1, -1, -1), climbs, strict=True):
        x = jnp.einsum("bvkc,vk->bvc", x[:, hierarchy.corners[level]], hierarchy.weights[level])
        x = jax.nn.elu(_plain_conv(x, hierarchy.spirals[level], conv))
    return scale.vertex_mean + scale.vertex_std * _plain_conv(x, hierarchy.spirals[0], last)


def _plain_conv(x: jax.Array, spirals: jax.Array, conv: dict[str, jax.Array]) -> jax.Array:
    x = jnp.concatenate([x, jnp.zeros_like(x[:, :1])], axis=1)
    kernel = conv["kernel"]
    return x[:, spirals].reshape(*x.shape[:1], len(spirals), -1) @ kernel.reshape(-1, kernel.shape[2]) + conv["bias"]


def _forward(given: Problem, with_torch: bool, repeats: int) -> _measure.Row:
    params, hierarchy, marks = given[:3]
    obvious = jax.jit(plain)
    sides = {
        "facejax": lambda: s2d_dec.apply(params, hierarchy, marks),
        "plain": lambda: obvious(params, hierarchy, marks),
    }
    _equal.check(sides["facejax"](), sides["plain"]())
    theirs = _peers(given, "inference") if with_torch else {}
    for way in theirs.values():
        _equal.check(sides["facejax"](), way())
    return _row("s2d_forward", given, sides, theirs, repeats, 1)


def _gradient(given: Problem, with_torch: bool, repeats: int) -> _measure.Row:
    def slope(apply: Callable) -> Callable:
        def loss(weights, params, hierarchy, marks, target):
            return jnp.mean(jnp.abs(apply(params._replace(weights=weights), hierarchy, marks) - target))

        found = jax.jit(jax.grad(loss))
        return lambda: found(given.params.weights, *given[:4])

    sides = {"facejax": slope(s2d_dec.apply), "plain": slope(plain)}
    theirs = _peers(given, "slopes") if with_torch else {}
    for way in (sides["plain"], *theirs.values()):
        # Relative to each array: the last kernel's gradient is a hundred times the first one's.
        _equal.check(jax.tree.leaves(sides["facejax"]()), jax.tree.leaves(way()), tolerance=1e-3)
    return _row("s2d_gradient", given, sides, theirs, repeats, 3)


def _step(given: Problem, with_torch: bool, repeats: int) -> _measure.Row:
    step, state = training_step(given)
    sides = {
        "facejax": stepped(_work.scanned(step, SCAN), state, given),
        "single": stepped(step, state, given),
    }
    theirs = _peers(given, "step") if with_torch else {}
    for name in theirs:
        peer, ours = _peer(given), stepped(step, state, given)
        call = peer.step(peer.forward(_way(name)), *_data(given, 3))
        for _ in range(3):
            _equal.check(ours()["loss"], call())
    return _row("s2d_train_step", given, sides, theirs, repeats, 3, calls={"facejax": SCAN})


def training_step(given: Problem) -> tuple[loop.Step, loop.TrainState]:
    """Return the training step of `fit_s2d_dec` and its initial state."""

    def loss(trained, key, batch, constants):
        scale, hierarchy, weights = constants
        predicted = s2d_dec.apply(s2d_dec.S2DDec(scale, trained), hierarchy, batch[0])
        return losses.s2d(predicted, batch[1], weights), {}

    optimiser = optax.adamw(PLAN["rate"], weight_decay=PLAN["weight_decay"])
    state = steps.init_supervised(given.params.weights, optimiser, jax.random.key(0))
    return steps.supervised(loss, optimiser), state


def stepped(step: loop.Step, state: loop.TrainState, given: Problem) -> Callable:
    """Return a function that advances the training by one call of the step."""
    constants = (given.params.scale, given.hierarchy, given.weights)
    return _work.onward(step, state, (given.marks, given.target), constants)


def _row(
    name: str, given: Problem, sides: dict, theirs: dict, repeats: int, passes: int, **options: Any
) -> _measure.Row:
    batch = len(given.marks)
    peers = [side for side in theirs if "sums" not in side]
    about = {"vertices": given.hierarchy.sizes[0], "batch": batch}
    cost = passes * gflop(given.hierarchy, batch=batch)
    return _measure.row(
        f"{name}_b{batch}", sides | theirs, peers=peers, repeats=repeats, gflop=cost, items=batch, unit="meshes",
        **about, **options,
    )  # fmt: skip


def _peer(given: Problem):
    from benchmarks import _decoder_torch

    return _decoder_torch.Peer(given.params, given.hierarchy, **PLAN)


def _data(given: Problem, count: int) -> list:
    return [_torch.tensor(array) for array in (given.marks, given.target, given.weights)[:count]]


def _way(side: str) -> str:
    """Return the implementation from a name such as `torch rows, compiled`."""
    return side.split()[1].rstrip(",")


def _peers(given: Problem, task: str) -> dict[str, Callable]:
    """Return PyTorch's three implementations of a task, and the two usual ones compiled."""
    from benchmarks import _decoder_torch

    count = {"inference": 1, "slopes": 2, "step": 3}[task]
    found, fused = {}, {}
    for way in _decoder_torch.WAYS:
        peer = _peer(given)
        found[f"torch {way}"] = _torch.waited(getattr(peer, task)(peer.forward(way), *_data(given, count)))
        if way != "sums":
            peer = _peer(given)
            call = getattr(peer, task)(_torch.torch.compile(peer.forward(way)), *_data(given, count))
            fused[f"torch {way}, compiled"] = call
    return found | _torch.compiled(fused)


def _training() -> _measure.Row:
    """Time training steps on 20,000 meshes in a process of its own."""
    command = [sys.executable, "-m", "benchmarks._training_memory"]
    printed = subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.PIPE).stdout
    found = json.loads(printed.splitlines()[-1])
    times = {key: found[key] for key in ("first_s", "min_s", "median_s")}
    return _measure.lone("s2d_training_20000_meshes", times, unit="steps", memory_mb=found["memory_mb"])


def _by_size(config: Config) -> list[dict]:
    def sized(side: int, batch: int) -> Callable:
        given = problem(side, batch)
        return functools.partial(s2d_dec.apply, *given[:3])

    along_vertices = [round(math.sqrt(count)) ** 2 for count in config.vertices]
    rows = _sizes.along("s2d_forward_b1", "vertices", along_vertices, lambda count: sized(math.isqrt(count), 1))
    return rows + _sizes.along("s2d_forward", "batch", config.batches, lambda count: sized(config.side, count))


if __name__ == "__main__":
    _measure.main("decoder", Config, run)
