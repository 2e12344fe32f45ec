"""Training loops that know no model: functions in, state out, the same numbers after any interruption.

Vocabulary: a *step* is a pure function `step(state, batch, constants) -> (state, metrics)`; metrics are a
dict of scalars. `constants` hold what does not change (index tables, data on the device): passed as an
argument, because arrays closed over would be folded into the program at compile time. A *chunk* is a number
of steps scanned on the device in one call. `batches(first, count)` gives the data of `count` steps with
leading axes (count, batch), and depends on nothing else; random keys are folded from the step index. So the
state at a step is a function of that step alone, and a run that was killed and resumed cannot differ from
one that was not.
"""

import os
import signal
import threading
import time
from collections.abc import Callable
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from facejax.checkpoints import Checkpoints
from facejax.journal import Journal

Tree = Any
Metrics = dict[str, jax.Array]
Step = Callable[["TrainState", Tree, Tree], tuple["TrainState", Metrics]]


class TrainState(NamedTuple):
    """Everything that changes while training."""

    step: jax.Array  # () int32, steps done
    params: Tree
    opt_state: Tree
    key: jax.Array  # the run's key; step i uses fold_in(key, i)
    extra: Tree = ()  # such as a running average of the parameters


class TrainingError(RuntimeError):
    """A loss that is no longer a number, or past all bounds."""


def epoch_indices(seed: int, size: int, batch: int) -> Callable[[int, int], np.ndarray]:
    """`indices(first, count)`: which of `size` samples `count` steps see, (count, batch) int32.

    Epoch after epoch in an order drawn from (seed, epoch), end to end: each sample comes once an epoch,
    none is dropped, and a batch may reach over into the next epoch.
    """
    if size < 1 or batch < 1:
        raise ValueError(f"size and batch must be at least 1; got {size} and {batch}")

    @lru_cache(maxsize=2)
    def order(epoch: int) -> np.ndarray:
        return np.random.default_rng((seed, epoch)).permutation(size).astype(np.int32)

    def indices(first: int, count: int) -> np.ndarray:
        begin, end = first * batch, (first + count) * batch
        epochs = range(begin // size, (end - 1) // size + 1)
        whole = np.concatenate([order(epoch) for epoch in epochs])
        return whole[begin - epochs.start * size :][: end - begin].reshape(count, batch)

    return indices


def gathered(step: Step) -> Step:
    """Let `step` take indices as its batch and (data, constants) as constants: data stay on the device."""
    return lambda state, indices, held: step(state, jax.tree.map(lambda leaf: leaf[indices], held[0]), held[1])


def run(
    step: Step,
    state: TrainState,
    batches: Callable[[int, int], Tree],
    folder: str | os.PathLike,
    *,
    steps: int,
    constants: Tree = (),
    chunk: int = 100,
    save_steps: int | None = None,
    save_seconds: float = 300.0,
    keep: int = 3,
    resume: bool = True,
    limit: float = 1e6,
    tensorboard: bool = False,
) -> TrainState:
    """Train until `steps` steps are done, counted from the very first start, and return the state.

    Writes to `folder`: `metrics.jsonl` (one line a chunk: the means over its steps) and `checkpoints/`
    (every `save_steps` steps or `save_seconds` seconds, whichever comes first, at the end of a chunk; the
    newest `keep`). With `resume`, goes on from the newest checkpoint, if there is one, and cuts
    `metrics.jsonl` back to it. SIGTERM and Ctrl-C save, then leave as usual (`SystemExit`,
    `KeyboardInterrupt`); a second one leaves at once. Raises `TrainingError` on a metric that is not finite
    or beyond `limit`, with the step and its name.
    """
    folder = Path(folder)

    @jax.jit(donate_argnums=0)
    def advance(state: TrainState, data: Tree, constants: Tree) -> tuple[TrainState, Metrics]:
        if chunk == 1:  # no loop: within one, XLA runs convolutions on a CPU several times slower
            state, metrics = step(state, jax.tree.map(lambda x: x[0], data), constants)
            return state, jax.tree.map(lambda value: value[None], metrics)
        return jax.lax.scan(lambda state, batch: step(state, batch, constants), state, data)

    with Checkpoints(folder / "checkpoints", keep=keep) as checkpoints, _stop_signals() as stopped:
        if not resume and checkpoints.latest() is not None:
            raise ValueError(f"{folder} holds a run of {checkpoints.latest()} steps: resume it, or name another folder")
        # Copied, since the first chunk would donate the caller's own arrays.
        state = jax.tree.map(jnp.copy, state) if checkpoints.latest() is None else _unbound(checkpoints.restore(state))
        done = saved = int(state.step)
        saved_at = time.monotonic()
        with Journal(folder, done, steps, tensorboard=tensorboard) as journal:
            data = batches(done, min(chunk - done % chunk, steps - done)) if done < steps else None
            while done < steps and not stopped:
                began = time.monotonic()
                state, metrics = advance(state, data, constants)
                first, done = done, done + jax.tree.leaves(data)[0].shape[0]
                if done < steps:  # prepared while the device is busy
                    data = batches(done, min(chunk, steps - done))
                metrics = jax.device_get(metrics)
                _check(metrics, first, limit, saved if checkpoints.latest() is not None else None, folder)
                means = {name: float(np.mean(values, dtype=np.float64)) for name, values in metrics.items()}
                journal.write(done, means, seconds=time.monotonic() - began)
                due = save_steps is not None and done - saved >= save_steps
                if due or time.monotonic() - saved_at >= save_seconds or done >= steps or stopped:
                    checkpoints.save(done, state)
                    saved, saved_at = done, time.monotonic()
    if stopped:
        raise KeyboardInterrupt if stopped[0] == signal.SIGINT else SystemExit(128 + stopped[0])
    return _unbound(state) if any(len(leaf.devices()) > 1 for leaf in jax.tree.leaves(state)) else state


def _unbound(state: TrainState) -> TrainState:
    """Copies that belong to no device in particular, as new arrays do: a step may run on one or on several."""

    def unbound(leaf: jax.Array) -> jax.Array:
        if jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            data = jnp.asarray(np.asarray(jax.random.key_data(leaf)))
            return jax.random.wrap_key_data(data, impl=jax.random.key_impl(leaf))
        return jnp.asarray(np.asarray(leaf))

    return jax.tree.map(unbound, state)


def _check(metrics: dict[str, np.ndarray], first: int, limit: float, saved: int | None, folder: Path) -> None:
    """Raise on the earliest bad value of a chunk: `metrics` (steps,) each, `first` steps done before it."""
    wrong = {name: ~(np.abs(values) <= limit) for name, values in metrics.items()}  # true for NaN too
    bad = [(int(np.argmax(where)), name) for name, where in wrong.items() if where.any()]
    if bad:
        at, name = min(bad)
        last = f"the last good checkpoint is step {saved}" if saved is not None else "there is no checkpoint yet"
        raise TrainingError(f"{name} became {metrics[name][at]} in step {first + at + 1}; {last}, in {folder}")


@contextmanager
def _stop_signals():
    """A list that receives SIGTERM or SIGINT; the same signal a second time acts as it did before."""
    received: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield received  # only the main thread can be told
        return
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}

    def receive(number: int, _: object) -> None:
        received.append(number)
        signal.signal(number, before[number])

    for number in before:
        signal.signal(number, receive)
    try:
        yield received
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
