"""One expression network in training beside PyTorch's LSTM, six at once, and one that reads its own output.

    python -m benchmarks.lstm [--json FILE] [--quick] [--whole]

Seo & Luo 2021: three layers of 128 and a dense layer, 135 frames, batches of 5, Adam at 1e-3, masked mean squared
error; D = 204 numbers a frame (68 landmarks) and the paper's 249. Tasks:

* `forward`, `gradient`, `training step` of one network, from the same weights and data on both sides; `scanned` is
  the step within one call of ten, as the training loop has it. `minutes` is what 10,000 such steps take: the paper
  says 30 minutes on an i5. --whole really runs them, ours in scanned chunks of 100 as `facejax.training.run` does,
  PyTorch's in a loop, a chunk each in turns.
* `step of 6`: six networks by `facejax.steps.side_by_side`, one after another, under `vmap`, and by PyTorch.
* `follow`: forward and gradient of the network that reads its own output, beside the automatic gradient of its scan.

Outputs, gradients and the losses of the first steps are checked to be equal before anything is timed. `gflops` counts
the matrix products alone, as the architecture states them, at the fastest repeat; `of_peak` is its share of what the
fastest product of two square matrices reaches in the same run, by either library.

The peer is eager: torch.compile 2.13 does not look into `nn.LSTM` (a graph break leaves it as it is, and only the loss
would be compiled), and with its experimental `allow_rnn` the compiled program fails. On a machine that is busy with
other work PyTorch suffers by far more, from OpenMP threads that wait for one another: measure on a quiet one, or give
both a core, `taskset -c 1 python -m benchmarks.lstm --threads 1`. PyTorch comes with the extra `bench`; without it its
rows are left out. About three minutes, --whole about ten more.
"""

from __future__ import annotations

import dataclasses
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
import tyro

from benchmarks import _measure
from facejax import losses, steps, training
from facejax.models import lstm

try:
    import torch
except ImportError:
    torch = None

RATE, CHUNK, WHOLE = 1e-3, 100, 10_000
SCAN = 10  # steps in one call where they are scanned
REST = 0.02  # seconds between calls: OpenMP's threads spin on for a while when their work is done


@dataclasses.dataclass(frozen=True)
class Config:
    json: Path | None = None
    """Also write the rows here."""
    quick: bool = False
    """Fewer repeats, one size, one batch."""
    whole: bool = False
    """Really run 10,000 steps."""
    landmarks: tuple[int, ...] = (68, 83)
    """Sizes of the face; six networks and `follow` take the first."""
    batches: tuple[int, ...] = (5, 32)
    """Sequences of a step; --whole takes the first."""
    frames: int = 135
    """Of a sequence."""
    hidden: int = 128
    """Units of each of the three layers."""
    networks: int = 6
    """Expressions."""
    steps: int = WHOLE
    """Of --whole, whole hundreds."""
    threads: int = os.cpu_count() or 1
    """Of PyTorch; JAX takes the cores that the process may use."""
    square: int = 1024
    """Side of the matrices whose product is the peak."""


class Batch(NamedTuple):
    """Sequences, time first."""

    x: Any  # (T, B, D)
    target: Any  # (T, B, D)
    mask: Any  # (T, B) bool


class Measure(NamedTuple):
    """What all rows are measured with."""

    repeats: int
    peak: float  # GFLOP/s


def run(config: Config) -> list[dict]:
    """Rows of the table."""
    if torch is None:
        print('PyTorch is not here and its rows are left out: pip install ".[bench]" brings it.')
    else:
        torch.set_num_threads(config.threads)
    landmarks, batches = (x[:1] if config.quick else x for x in (config.landmarks, config.batches))
    rows = _square(config)
    measure = Measure(5 if config.quick else 25, max(row["gflops"] for row in rows))
    for count in landmarks:
        for batch in batches:
            rows += _one(config, 3 * count, batch, measure)
    for batch in batches:
        rows += _six(config, 3 * landmarks[0], batch, measure)
        rows += _follow(config, 3 * landmarks[0], batch, measure)
    if config.whole:
        rows += _whole(config, 3 * landmarks[0], batches[0])
    return rows


def _square(config: Config) -> list[dict]:
    """The fastest product of this machine, by either library."""
    a = np.random.default_rng(0).normal(size=(config.square, config.square)).astype(np.float32)
    ours, product = jnp.asarray(a), jax.jit(jnp.matmul)
    functions, about = {"facejax": lambda: product(ours, ours)}, {"facejax": f"jax {jax.__version__}, {_cores()} cores"}
    if torch is not None:
        theirs = torch.tensor(a)
        functions["torch"] = lambda: theirs @ theirs
        about["torch"] = f"torch {torch.__version__}, {config.threads} threads"
    rows = _rows(f"product of {config.square}", functions, 2e-9 * config.square**3, Measure(15, np.nan))
    for row in rows:
        load = f", load {os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else ""
        row["about"] = about[row["side"]] + load
        del row["of_peak"]
    return rows


def _one(config: Config, size: int, batch: int, measure: Measure) -> list[dict]:
    """One network: forward, gradient, training step."""
    data = _data(config, size, batch)
    weights = _weights(config, size, 0)
    slope = jax.jit(jax.grad(lambda weights, data: _loss(weights, None, data, ())[0]))
    advance = _jitted(_step())
    tasks = {
        "forward": {"facejax": lambda: lstm.forward(weights, data.x)},
        "gradient": {"facejax": lambda: slope(weights, data)},
        "training step": {
            "facejax": _steps(advance, _start(weights), data),
            "facejax, scanned": _steps(_jitted(_scanned(_step())), _start(weights), data),
        },
    }
    if torch is not None:
        peer, held = Peer(weights), _to_torch(data)
        calls = {"forward": peer.forward, "gradient": peer.gradient, "training step": peer.step}
        for task, call in calls.items():
            tasks[task]["torch"] = lambda call=call: call(held)
            if config.threads > 1:
                tasks[task]["torch, 1 thread"] = lambda call=call: _alone(call, held)
        _check_equal(lstm.forward(weights, data.x), peer.forward(held))
        _check_equal(slope(weights, data), Peer.as_weights(peer.gradient(held)))
        _check_steps([_steps(advance, _start(weights), data), lambda: peer.step(held)])
    forward, both, rows = _products(config, size, batch), _step_products(config, size, batch), []
    for (task, functions), gflop in zip(tasks.items(), (forward, both, both), strict=True):
        rows += _rows(task, functions, gflop, measure, numbers=size, batch=batch)
    for row in rows[-len(functions) :]:
        row["minutes"] = row["median_ms"] * WHOLE / 60e3
    return rows


def _six(config: Config, size: int, batch: int, measure: Measure) -> list[dict]:
    """A training step of several networks, each with data of its own."""
    count = config.networks
    names = [str(i) for i in range(count)]
    data = [_data(config, size, batch, seed=i) for i in range(count)]
    weights = [_weights(config, size, i) for i in range(count)]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *data)
    together = jax.tree.map(lambda *leaves: jnp.stack(leaves), *weights)
    single, turns = _jitted(_step()), _jitted(steps.side_by_side(_step(), names, range(count)))
    mapped = _jitted(jax.vmap(_step(), (0, 0, None)))

    def beside() -> Callable:
        state = steps.start_side_by_side(together, optax.adam(RATE), jax.random.key(0))
        step = _steps(turns, state, stacked, ((), ()))
        return lambda: _by_name(step(), names)

    def apart() -> Callable:
        each = [_steps(single, _start(mine), batch) for mine, batch in zip(weights, data, strict=True)]
        return lambda: [step()["loss"] for step in each]

    def batched() -> Callable:
        states = jax.tree.map(lambda *leaves: jnp.stack(leaves), *map(_start, weights))
        step = _steps(mapped, states, stacked)
        return lambda: step()["loss"]

    makers = {"facejax": beside, "facejax, one by one": apart, "facejax, vmap": batched}
    if torch is not None:

        def peers() -> Callable:
            each = [(Peer(mine), _to_torch(batch)) for mine, batch in zip(weights, data, strict=True)]
            return lambda: [peer.step(held) for peer, held in each]

        makers["torch"] = peers
    _check_steps([make() for make in makers.values()])
    functions = {name: make() for name, make in makers.items()}
    state = steps.start_side_by_side(together, optax.adam(RATE), jax.random.key(0))
    scanned = _jitted(_scanned(steps.side_by_side(_step(), names, range(count))))
    functions["facejax, scanned"] = _steps(scanned, state, stacked, ((), ()))
    gflop = count * _step_products(config, size, batch)
    return _rows(f"step of {count}", functions, gflop, measure, numbers=size, batch=batch)


def _follow(config: Config, size: int, batch: int, measure: Measure) -> list[dict]:
    """The network that reads its own output from the start."""
    data, weights = _data(config, size, batch), _weights(config, size, 0)
    given = jnp.zeros(data.mask.shape, bool).at[0].set(True)
    forms = {"facejax": lstm.follow, "facejax, automatic": jax.jit(_automatic)}

    def gradient(form: Callable) -> Callable:
        slope = jax.jit(jax.grad(lambda weights, data: _error(form(weights, data.x, given), data)))
        return lambda: slope(weights, data)

    tasks = {
        "follow": {name: lambda form=form: form(weights, data.x, given) for name, form in forms.items()},
        "follow, gradient": {name: gradient(form) for name, form in forms.items()},
    }
    forward, rows = _products(config, size, batch), []
    for (task, functions), gflop in zip(tasks.items(), (forward, 3 * forward), strict=True):
        _check_equal(*(function() for function in functions.values()))
        rows += _rows(task, functions, gflop, measure, numbers=size, batch=batch)
    return rows


def _automatic(weights: lstm.Weights, x: jax.Array, given: jax.Array) -> jax.Array:
    """`lstm.follow` as a scan of `lstm.step`, which JAX differentiates by itself."""

    def advance(carry, inputs):
        states, last = carry
        x, given = inputs
        states, out = lstm.step(weights, states, jnp.where(given[:, None], x, last))
        return (states, out), out

    return jax.lax.scan(advance, (lstm.start(weights, x.shape[1]), jnp.zeros_like(x[0])), (x, given))[1]


def _whole(config: Config, size: int, batch: int) -> list[dict]:
    """All steps of a training, a chunk of ours and a chunk of PyTorch's in turns; batches drawn from 80 sequences."""
    data, weights = _data(config, size, 80), _weights(config, size, 0)
    step, state = _step(), _start(weights)

    @jax.jit(donate_argnums=0)
    def advance(state, chosen, data):
        def one(state, which):
            return step(state, jax.tree.map(lambda leaf: leaf[:, which], data), ())

        return jax.lax.scan(one, state, chosen)

    def ours(chosen: np.ndarray) -> np.ndarray:
        nonlocal state
        state, metrics = advance(state, chosen, data)
        return np.asarray(metrics["loss"])

    sides = {"facejax": ours}
    if torch is not None:
        peer, held = Peer(weights), _to_torch(data)

        def theirs(chosen: np.ndarray) -> np.ndarray:
            rows = torch.from_numpy(chosen).long()
            found = [peer.step(Batch(*(array[:, which] for array in held))) for which in rows]
            return np.array([loss.item() for loss in found])

        sides["torch"] = theirs
    indices = training.epoch_indices(0, 80, batch)
    seconds, last = {name: [] for name in sides}, {}
    for first in range(0, config.steps, CHUNK):
        for name, side in sides.items():
            time.sleep(REST)
            begun = time.perf_counter()
            last[name] = side(indices(first, CHUNK))
            seconds[name].append(time.perf_counter() - begun)
    return [
        {
            "task": f"{config.steps:,} steps",
            "side": name,
            "numbers": size,
            "batch": batch,
            "first_s": each[0],
            "min_ms": 1e3 * min(each) / CHUNK,
            "median_ms": 1e3 * float(np.median(each)) / CHUNK,
            "over_facejax": sum(each) / sum(seconds["facejax"]),
            "minutes": sum(each) / 60,
            "about": f"loss {last[name].mean():.4f}",
        }
        for name, each in seconds.items()
    ]


class Peer:
    """The same network, loss and optimiser in PyTorch, eager, from the same weights.

    `nn.LSTM` has two biases and adds them. The second stays zero here: trained, it would double the bias's rate.
    """

    def __init__(self, weights: lstm.Weights):
        rows, dense = weights["layers"], weights["dense"]
        size, hidden = dense["kernel"].shape[1], dense["kernel"].shape[0]
        self.lstm, self.dense = torch.nn.LSTM(size, hidden, len(rows)), torch.nn.Linear(hidden, size)
        places = [getattr(self.lstm, name) for i in range(len(rows)) for name in _names(i)]
        places += [self.dense.weight, self.dense.bias]
        values = [row[name] for row in rows for name in ("input", "hidden", "bias")] + [dense["kernel"], dense["bias"]]
        with torch.no_grad():
            for place, value in zip(places, values, strict=True):
                place.copy_(torch.tensor(np.asarray(value).T))  # the gates' order is the same: i, f, g, o
            for i in range(len(rows)):
                getattr(self.lstm, f"bias_hh_l{i}").zero_().requires_grad_(False)
        self.trained = places
        self.optimiser = torch.optim.Adam(places, lr=RATE, fused=True)

    def forward(self, batch: Batch):
        with torch.no_grad():
            return self.dense(self.lstm(batch.x)[0])

    def gradient(self, batch: Batch):
        return torch.autograd.grad(self._loss(batch), self.trained)

    def step(self, batch: Batch):
        """The loss before the step."""
        self.optimiser.zero_grad()
        loss = self._loss(batch)
        loss.backward()
        self.optimiser.step()
        return loss.detach()

    def _loss(self, batch: Batch):
        error = torch.square(self.dense(self.lstm(batch.x)[0]) - batch.target).mean(-1)
        return (error * batch.mask).sum() / batch.mask.sum()

    @staticmethod
    def as_weights(found) -> lstm.Weights:
        """Tensors in the order of `trained` as a tree like ours."""
        *rows, kernel, bias = [array.numpy().T for array in found]
        layers = [dict(zip(("input", "hidden", "bias"), rows[i : i + 3], strict=True)) for i in range(0, len(rows), 3)]
        return {"layers": layers, "dense": {"kernel": kernel, "bias": bias}}


def _alone(function: Callable, batch: Batch):
    """A call with one thread: for small products, or on a busy machine, that can be the faster way."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        return function(batch)
    finally:
        torch.set_num_threads(before)


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _names(layer: int) -> tuple[str, str, str]:
    return f"weight_ih_l{layer}", f"weight_hh_l{layer}", f"bias_ih_l{layer}"


def _to_torch(batch: Batch) -> Batch:
    return Batch(*(torch.tensor(np.asarray(array)) for array in batch))


def _data(config: Config, size: int, count: int, *, seed: int = 0) -> Batch:
    """Sequences that go out and come back, each to somewhere of its own, at different lengths."""
    rng = np.random.default_rng(seed)
    length = rng.integers(config.frames // 2, config.frames, count)
    phase = np.minimum(np.arange(config.frames + 2)[:, None] / length, 1)
    way = np.diff(np.sin(np.pi * phase) ** 2, axis=0)[..., None] * rng.normal(size=(count, size))
    way = (way / np.sqrt(np.mean(way**2))).astype(np.float32)
    mask = np.arange(config.frames)[:, None] < length + 5
    return Batch(*map(jnp.asarray, (way[:-1], way[1:], mask)))


def _weights(config: Config, size: int, seed: int) -> lstm.Weights:
    return lstm.init(jax.random.key(seed), size, hidden=config.hidden)


def _error(made: jax.Array, batch: Batch) -> jax.Array:
    made, target = (array.reshape(*array.shape[:2], -1, 3) for array in (made, batch.target))
    return losses.next_step(made, target, batch.mask)


def _loss(weights: lstm.Weights, key, batch: Batch, constants):
    return _error(lstm.forward(weights, batch.x), batch), {}


def _step() -> training.Step:
    return steps.supervised(_loss, optax.adam(RATE))


def _start(weights: lstm.Weights) -> training.TrainState:
    return steps.start_supervised(weights, optax.adam(RATE), jax.random.key(0))


def _scanned(step: training.Step) -> training.Step:
    """SCAN steps on one batch."""

    def several(state, batch: Batch, constants):
        return jax.lax.scan(lambda state, _: step(state, batch, constants), state, length=SCAN)

    return several


def _jitted(step: training.Step) -> Callable:
    return jax.jit(step, donate_argnums=0)


def _steps(advance: Callable, state, batch: Batch, constants=()) -> Callable:
    """A function that goes one training step on with every call, and returns the metrics."""
    state = jax.tree.map(jnp.copy, state)  # what is donated is the copy

    def go() -> dict[str, jax.Array]:
        nonlocal state
        state, metrics = advance(state, batch, constants)
        return metrics

    return go


def _by_name(metrics: dict, names: list[str]) -> list:
    """The losses of several models; a single one has no name."""
    return [metrics[f"loss_{name}"] for name in names] if len(names) > 1 else [metrics["loss"]]


def _check_equal(ours, theirs) -> None:
    """A fast wrong answer is no answer: every array to 1e-4 of its largest entry."""
    for a, b in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        a, b = np.asarray(a), np.asarray(b)
        np.testing.assert_allclose(b, a, rtol=0, atol=1e-4 * np.abs(a).max())


def _check_steps(forms: list[Callable]) -> None:
    """The losses of three steps."""
    for _ in range(3):
        expected, *others = [np.array(jax.tree.leaves(form())) for form in forms]
        for other in others:
            _check_equal(expected, other.reshape(expected.shape))


def _products(config: Config, size: int, batch: int) -> float:
    """Billions of multiplications and additions in the matrix products of a forward pass."""
    widths = [size, config.hidden, config.hidden]
    each = sum((width + config.hidden) * 4 * config.hidden for width in widths) + config.hidden * size
    return 2e-9 * config.frames * batch * each


def _step_products(config: Config, size: int, batch: int) -> float:
    """The same of a gradient: two more products for each, but the first layer's inputs want no slope."""
    return 3 * _products(config, size, batch) - 2e-9 * config.frames * batch * size * 4 * config.hidden


def _rows(task: str, functions: dict[str, Callable], gflop: float, measure: Measure, **about: int) -> list[dict]:
    """Times of functions in turns, the first of them being what the others are compared with."""
    jax.clear_caches()  # the first call compiles again what was compiled for the checks
    rested = {}
    for name, function in functions.items():
        rested |= {name: function, f"{name}, rest": lambda: time.sleep(REST)}
    found = _measure.interleaved(rested, repeats=measure.repeats)
    for name in functions:
        if name.endswith("scanned"):
            found[name] |= {key: found[name][key] / SCAN for key in ("min_s", "median_s")}
    median = found["facejax"]["median_s"]
    return [
        {
            "task": task,
            "side": name,
            **about,
            "first_s": found[name]["first_s"],
            "min_ms": 1e3 * found[name]["min_s"],
            "median_ms": 1e3 * found[name]["median_s"],
            "over_facejax": found[name]["median_s"] / median,
            "gflops": gflop / found[name]["min_s"],
            "of_peak": gflop / found[name]["min_s"] / measure.peak,
        }
        for name in functions
    ]


if __name__ == "__main__":
    options = tyro.cli(Config, prog="python -m benchmarks.lstm", description=__doc__)
    _measure.report(run(options), options.json)
