"""S2D-Dec beside PyTorch: forward of a batch and of one frame, gradient, training step, and the memory of a training.

    python -m benchmarks.decoder [--json FILE] [--quick]

The network of OT23 as `facejax.models.decoder` has it, on a square sheet of CoMA's size: 5,041 vertices, four
quarterings, spirals of 9, 9, 14, 15 and 15, channels 128, 64, 32, 32, 16, 3. Its operations are counted as the paper
states them: a dense layer, then at every level the products of whole spirals on the finer side. Ours, which multiplies
before it lifts, needs a third of those of a whole decoder.

Sides: `plain` is the obvious form in JAX. `rows` and `sparse` are PyTorch's, eager and compiled. `sums` is our own way
written in PyTorch; it is not among the peers that the ratio is taken to. A training step is that of
`facejax.fit_decoder`, loss and AdamW included; ours is timed in one call of ten, as the training loop has it, and
alone as `single`. Outputs, gradients and losses are checked to be equal first.

`s2d_training_20000_meshes` trains on the default dataset in a process of its own, whose peak of memory is shown; the
first run prepares the dataset in the user's cache. Costs against size: vertices 1,000 to 100,000 (one frame) and
batch 1 to 256. About four minutes, --quick one.
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
SCAN = 10  # steps in one call where they are scanned


@dataclasses.dataclass(frozen=True)
class Config(_measure.Options):
    """What to measure."""

    side: int = 71
    """Vertices along a side of the sheet; 71 has CoMA's size."""
    batch: int = 16
    """Samples of a batch: OT23's."""
    vertices: tuple[int, ...] = (1_000, 3_000, 10_000, 30_000, 100_000)
    """Along which the cost of one frame is measured."""
    batches: tuple[int, ...] = (1, 4, 16, 64, 256)
    """Along which the cost of a batch is measured."""
    threads: int | None = None
    """Of PyTorch, by default one for every core."""


class Problem(NamedTuple):
    """A decoder and data for it."""

    params: s2d_dec.S2DDec
    hierarchy: Hierarchy
    marks: jax.Array  # (B, L, 3)
    target: jax.Array  # (B, N, 3)
    weights: jax.Array  # (N,)


def run(config: Config) -> _measure.Found:
    """Rows of the tables."""
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
    """On a sheet of side^2 vertices."""
    host = hierarchy.build(*_sheet.grid(side))
    rng = np.random.default_rng(0)
    marks, target, weights = (
        jnp.asarray(rng.normal(size=shape), jnp.float32) for shape in ((batch, 68, 3), (batch, side**2, 3), side**2)
    )
    return Problem(s2d_dec.init(jax.random.key(0), host), jax.device_put(host), marks, target, jnp.abs(weights))


def gflop(hierarchy: Hierarchy, *, batch: int, landmarks: int = 68) -> float:
    """Billions of operations of a forward pass, as the architecture states them."""
    channels = (*s2d_dec.CHANNELS, 3)
    levels = [*range(len(hierarchy.spirals))][::-1] + [0]
    convs = zip((hierarchy.spirals[level].size for level in levels), channels[:-1], channels[1:], strict=True)
    products = sum(reads * inward * outward for reads, inward, outward in convs)
    return 2e-9 * batch * (3 * landmarks * hierarchy.sizes[-1] * channels[0] + products)


def plain(params: s2d_dec.S2DDec, hierarchy: Hierarchy, displacements: jax.Array) -> jax.Array:
    """`decoder.apply` as one would write it first: (B, L, 3) -> (B, N, 3)."""
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
        # Of its kind, each: a last kernel's slope is a hundred times one of the first.
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
    """The step of `facejax.fit_decoder`, and where it starts."""

    def loss(trained, key, batch, constants):
        scale, hierarchy, weights = constants
        predicted = s2d_dec.apply(s2d_dec.S2DDec(scale, trained), hierarchy, batch[0])
        return losses.s2d(predicted, batch[1], weights), {}

    optimiser = optax.adamw(PLAN["rate"], weight_decay=PLAN["weight_decay"])
    state = steps.init_supervised(given.params.weights, optimiser, jax.random.key(0))
    return steps.supervised(loss, optimiser), state


def stepped(step: loop.Step, state: loop.TrainState, given: Problem) -> Callable:
    """A function that goes on with every call."""
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
    """Of a side's name: `torch rows, compiled`."""
    return side.split()[1].rstrip(",")


def _peers(given: Problem, task: str) -> dict[str, Callable]:
    """PyTorch's three ways at a task, and the two usual ones compiled."""
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
    """A hundred steps of a training on 20,000 meshes, in a process of its own."""
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
