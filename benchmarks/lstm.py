"""Expression networks against PyTorch's LSTM: one network, six at once, and one that feeds back its own output.

    python -m benchmarks.lstm [--json FILE] [--quick]

Seo & Luo 2021: three layers of 128 units and a dense layer, 135 frames, batches of 5 (and 32), Adam at 1e-3, masked
mean squared error; 204 numbers per frame: 68 landmarks.

* `lstm_forward`, `lstm_gradient`, `lstm_train_step` of one network, from the same weights and data on both sides.
  facejax's step is timed as ten steps in one call, as in the training loop, and alone as `single`. Its batch is sharded
  over the cores by `facejax.training.sharding.data_parallel` where it divides evenly; then `one device` is the step on
  one device.
* `lstm_train_step_x6`: six networks by `facejax.training.steps.vectorize_models`, sharded over the cores, also one
  after another and under `vmap`, against six steps of PyTorch.
* `lstm_follow`: the network that feeds back its own output, against automatic differentiation of its scan.

Outputs, gradients and the losses of the first steps are checked to be equal before anything is timed. Operations are
those of the matrix products, counted from the architecture. Cost against size: 10 to 1,000 frames, batches of 1 to 256
of a training step. The peer is eager, with one thread per core and with one thread (see `benchmarks._lstm_torch`); on a
busy machine its threads wait for one another. About three minutes, one with --quick.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from benchmarks import _equal, _measure, _sizes, _torch, _work
from facejax import losses
from facejax.cli import runtime
from facejax.models import lstm
from facejax.training import loop, sharding, steps

RATE = 1e-3
SCAN = 10  # training steps in one call


@dataclasses.dataclass(frozen=True)
class Config(_measure.Options):
    """Options of the benchmark."""

    landmarks: int = 68
    """Number of landmarks; SL21 uses 83."""
    batches: tuple[int, ...] = (5, 32)
    """Batch sizes."""
    frames: int = 135
    """Number of frames of a sequence."""
    hidden: int = 128
    """Number of units of each of the three layers."""
    networks: int = 6
    """Number of networks trained at once, one per expression."""
    along_frames: tuple[int, ...] = (10, 30, 100, 300, 1000)
    """Numbers of frames at which the cost is measured, with the first batch size."""
    along_batch: tuple[int, ...] = (1, 4, 16, 64, 256)
    """Batch sizes at which the cost is measured."""
    threads: int | None = None
    """Number of PyTorch threads, by default one per core; JAX uses the cores that the process may use."""


class Batch(NamedTuple):
    """Sequences, time first."""

    x: Any  # (T, B, D)
    target: Any  # (T, B, D)
    mask: Any  # (T, B) bool


def run(config: Config) -> _measure.Found:
    """Measure and return the rows."""
    with_torch, repeats = _torch.ready(config.threads), 7 if config.quick else 25
    rows = []
    for batch in config.batches:
        rows += _one(config, batch, with_torch, repeats)
    first = config.batches[0]
    rows += [_six(config, first, with_torch, repeats), *_follow(config, first, repeats)]
    return rows, [] if config.quick else _by_size(config)


def _one(config: Config, batch: int, with_torch: bool, repeats: int) -> list[_measure.Row]:
    """Time forward pass, gradient and training step of one network."""
    data, weights = _data(config, batch), _weights(config, 0)
    slope = jax.jit(jax.grad(lambda weights, data: _loss(weights, None, data, ())[0]))
    shared = _shared(batch)
    tasks = {
        "forward": {"facejax": lambda: lstm.forward(weights, data.x)},
        "gradient": {"facejax": lambda: slope(weights, data)},
        "train_step": {
            "facejax": _work.onward(_work.scanned(shared or _step(), SCAN), _start(weights), data, ()),
            "single": _work.onward(shared or _step(), _start(weights), data, ()),
        },
    }
    calls = {"facejax": SCAN}
    if shared:
        _check_steps([_work.onward(step, _start(weights), data, ()) for step in (_step(), shared)])
        tasks["train_step"]["one device"] = _work.onward(_work.scanned(_step(), SCAN), _start(weights), data, ())
        calls["one device"] = SCAN
    theirs: dict[str, dict[str, Callable]] = {task: {} for task in tasks}
    if with_torch:
        from benchmarks import _lstm_torch

        held = [_torch.tensor(array) for array in data]
        peer, fresh = _lstm_torch.Peer(weights), _lstm_torch.Peer(weights)
        _equal.check(lstm.forward(weights, data.x), peer.forward(held)())
        _equal.check(slope(weights, data), _lstm_torch.as_weights(peer.gradient(held)()))
        _check_steps([_work.onward(_step(), _start(weights), data, ()), fresh.step(held)])
        ways = {"forward": peer.forward, "gradient": peer.gradient, "train_step": peer.step}
        theirs = {task: _torch.threaded("torch", way(held)) for task, way in ways.items()}
    forward, both, rows = _products(config, batch), _step_products(config, batch), []
    for (task, sides), gflop in zip(tasks.items(), (forward, both, both), strict=True):
        several = calls if task == "train_step" else None
        options = {"repeats": repeats, "calls": several, "gflop": gflop, "items": batch, "unit": "sequences"}
        peers = theirs[task]
        rows.append(_measure.row(f"lstm_{task}_b{batch}", sides | peers, peers=list(peers), batch=batch, **options))
    return rows


def _six(config: Config, batch: int, with_torch: bool, repeats: int) -> _measure.Row:
    """Time a training step of several networks, each with its own data."""
    count = config.networks
    names = [str(i) for i in range(count)]
    data = [_data(config, batch, seed=i) for i in range(count)]
    weights = [_weights(config, i) for i in range(count)]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *data)
    together = jax.tree.map(lambda *leaves: jnp.stack(leaves), *weights)
    turns = steps.vectorize_models(_step(), names, range(count))

    def beside(step: loop.Step) -> Callable:
        state = steps.init_vectorized_models(together, optax.adam(RATE), jax.random.key(0))
        return _work.onward(step, state, stacked, ((), ()))

    def apart() -> Callable:
        each = [_work.onward(_step(), _start(mine), batch, ()) for mine, batch in zip(weights, data, strict=True)]
        return lambda: [step()["loss"] for step in each]

    def batched() -> Callable:
        states = jax.tree.map(lambda *leaves: jnp.stack(leaves), *map(_start, weights))
        step = _work.onward(jax.vmap(_step(), (0, 0, None)), states, stacked, ())
        return lambda: step()["loss"]

    def single() -> Callable:
        step = beside(turns)
        return lambda: _by_name(step(), names)

    makers = {"single": single, "one by one": apart, "vmap": batched}
    if with_torch:
        from benchmarks import _lstm_torch

        def peers() -> Callable:
            each = [
                _lstm_torch.Peer(mine).step([_torch.tensor(array) for array in batch])
                for mine, batch in zip(weights, data, strict=True)
            ]
            return lambda: [step() for step in each]

        makers["torch"] = peers
    _check_steps([make() for make in makers.values()])
    sides = {"facejax": beside(_work.scanned(turns, SCAN))} | {name: make() for name, make in makers.items()}
    theirs = _torch.threaded("torch", sides.pop("torch")) if with_torch else {}
    return _measure.row(
        f"lstm_train_step_x{count}_b{batch}", sides | theirs, peers=list(theirs), repeats=max(5, repeats // 2),
        calls={"facejax": SCAN}, gflop=count * _step_products(config, batch), items=count * batch, unit="sequences",
        batch=batch,
    )  # fmt: skip


def _follow(config: Config, batch: int, repeats: int) -> list[_measure.Row]:
    """Time the network that feeds back its own output from the start."""
    data, weights = _data(config, batch), _weights(config, 0)
    given = jnp.zeros(data.mask.shape, bool).at[0].set(True)
    forms = {"facejax": lstm.forward_scheduled, "automatic": jax.jit(_automatic)}

    def gradient(form: Callable) -> Callable:
        slope = jax.jit(jax.grad(lambda weights, data: _error(form(weights, data.x, given), data)))
        return lambda: slope(weights, data)

    tasks = {
        "lstm_follow": {name: lambda form=form: form(weights, data.x, given) for name, form in forms.items()},
        "lstm_follow_gradient": {name: gradient(form) for name, form in forms.items()},
    }
    forward, rows = _products(config, batch), []
    for (task, sides), gflop in zip(tasks.items(), (forward, 3 * forward), strict=True):
        _equal.check(*(side() for side in sides.values()))
        options = {"repeats": repeats, "gflop": gflop, "items": batch, "unit": "sequences"}
        rows.append(_measure.row(f"{task}_b{batch}", sides, batch=batch, **options))
    return rows


def _by_size(config: Config) -> list[dict]:
    def sized(batch: int, **sizes: int) -> Callable:
        given = dataclasses.replace(config, **sizes)
        return _work.onward(_step(), _start(_weights(given, 0)), _data(given, batch), ())

    first = config.batches[0]
    rows = _sizes.along(
        f"lstm_train_step_b{first}", "frames", config.along_frames, lambda count: sized(first, frames=count)
    )
    return rows + _sizes.along("lstm_train_step", "batch", config.along_batch, sized)


def _automatic(weights: lstm.Weights, x: jax.Array, given: jax.Array) -> jax.Array:
    """Implement `lstm.forward_scheduled` as a scan of `lstm.step`, differentiated automatically."""

    def advance(carry, inputs):
        states, last = carry
        x, given = inputs
        states, out = lstm.step(weights, states, jnp.where(given[:, None], x, last))
        return (states, out), out

    return jax.lax.scan(advance, (lstm.init_states(weights, x.shape[1]), jnp.zeros_like(x[0])), (x, given))[1]


def _data(config: Config, count: int, *, seed: int = 0) -> Batch:
    """Return random sequences of different lengths that return to their start."""
    rng, size = np.random.default_rng(seed), 3 * config.landmarks
    length = rng.integers(config.frames // 2, config.frames, count)
    phase = np.minimum(np.arange(config.frames + 2)[:, None] / length, 1)
    way = np.diff(np.sin(np.pi * phase) ** 2, axis=0)[..., None] * rng.normal(size=(count, size))
    way = (way / np.sqrt(np.mean(way**2))).astype(np.float32)
    mask = np.arange(config.frames)[:, None] < length + 5
    return Batch(*map(jnp.asarray, (way[:-1], way[1:], mask)))


def _weights(config: Config, seed: int) -> lstm.Weights:
    return lstm.init(jax.random.key(seed), 3 * config.landmarks, hidden=config.hidden)


def _error(made: jax.Array, batch: Batch) -> jax.Array:
    made, target = (array.reshape(*array.shape[:2], -1, 3) for array in (made, batch.target))
    return losses.next_step(made, target, batch.mask)


def _loss(weights: lstm.Weights, key, batch: Batch, constants):
    return _error(lstm.forward(weights, batch.x), batch), {}


def _step() -> loop.Step:
    return steps.supervised(_loss, optax.adam(RATE))


def _shared(batch: int) -> loop.Step | None:
    """Return the step sharded over the devices; None for one device, or where the batch does not divide evenly."""
    count = jax.device_count()
    return sharding.data_parallel(_step(), axis=1) if count > 1 and batch % count == 0 else None


def _start(weights: lstm.Weights) -> loop.TrainState:
    return steps.init_supervised(weights, optax.adam(RATE), jax.random.key(0))


def _by_name(metrics: dict, names: list[str]) -> list:
    """Return the losses of several models from their metrics; that of a single model has no name."""
    return [metrics[f"loss_{name}"] for name in names] if len(names) > 1 else [metrics["loss"]]


def _loss_of(found: Any) -> Any:
    """Return the losses from a step's metrics, or from losses."""
    return found["loss"] if isinstance(found, dict) else found


def _check_steps(forms: list[Callable]) -> None:
    """Assert that the losses of three steps agree."""
    for _ in range(3):
        expected, *others = [np.hstack(list(map(_equal.host, jax.tree.leaves(_loss_of(form()))))) for form in forms]
        for other in others:
            _equal.check(expected, other)


def _products(config: Config, batch: int) -> float:
    """Return the billions of operations of the matrix products of a forward pass."""
    size = 3 * config.landmarks
    widths = [size, config.hidden, config.hidden]
    each = sum((width + config.hidden) * 4 * config.hidden for width in widths) + config.hidden * size
    return 2e-9 * config.frames * batch * each


def _step_products(config: Config, batch: int) -> float:
    """Return those of a gradient: two more products each, without the gradient of the first layer's inputs."""
    return 3 * _products(config, batch) - 2e-9 * config.frames * batch * 3 * config.landmarks * 4 * config.hidden


if __name__ == "__main__":
    runtime.use_all_cores()
    _measure.main("lstm", Config, run)
