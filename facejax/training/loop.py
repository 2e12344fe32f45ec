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
from jax.sharding import Mesh

from facejax.training import sharding
from facejax.training.checkpoints import Checkpoints
from facejax.training.metric_logger import MetricLogger, NullLogger

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


def gather_batches(step: Step) -> Step:
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
    mesh: Mesh | None = None,
) -> TrainState:
    """Train until `steps` steps are done, counted from the very first start, and return the state.

    Writes to `folder`: `metrics.jsonl` (one line a chunk: the means over its steps) and `checkpoints/`
    (every `save_steps` steps or `save_seconds` seconds, whichever comes first, at the end of a chunk; the
    newest `keep`). With `resume`, goes on from the newest checkpoint, if there is one, and cuts
    `metrics.jsonl` back to it. SIGTERM and Ctrl-C save, then leave as usual (`SystemExit`,
    `KeyboardInterrupt`); a second one leaves at once. Raises `ValueError` where `folder` holds
    a longer run, and `TrainingError` on a metric that is not finite or beyond `limit`, with the step and its name, and
    where a checkpoint cannot be written.

    With a `mesh` (`parallel.line`) every batch is shared out along its first axis among the devices, which may be those
    of several processes: each calls with the same arguments, the first one reads and writes `folder`, and the numbers
    are those of one device but for the order of sums. A run may go on with another number of devices or processes. A
    process that is lost stops the others within a minute.
    """
    folder = Path(folder)
    if mesh is not None:
        step = sharding.data_parallel(step, mesh=mesh)

    def several(state: TrainState, data: Tree, constants: Tree) -> tuple[TrainState, Metrics]:
        if chunk == 1:  # no loop: within one, XLA runs convolutions on a CPU several times slower
            state, metrics = step(state, jax.tree.map(lambda x: x[0], data), constants)
            return state, jax.tree.map(lambda value: value[None], metrics)
        return jax.lax.scan(lambda state, batch: step(state, batch, constants), state, data)

    # Whole on every device, so that any process can read what comes out.
    laid_out = {} if mesh is None else {"out_shardings": sharding.replicated(mesh)}
    advance = jax.jit(several, donate_argnums=0, **laid_out)
    with _Saved(folder / "checkpoints", keep) as saved, _stop_signals() as stopped:
        if not resume and saved.latest is not None:
            raise ValueError(f"{folder} holds a run of {saved.latest} steps: resume it, or name another folder")
        # Copied, since the first chunk would donate the caller's own arrays.
        state = saved.restored(jax.tree.map(jnp.copy, state))
        done = int(state.step)
        if done > steps:
            raise ValueError(
                f"{folder} holds a run of {done} steps, more than {steps}: ask for more, or name another folder"
            )
        if mesh is not None:
            whole, split = sharding.replicated(mesh), sharding.split_along(mesh, 1)
            state, constants = sharding.shard(state, whole), sharding.shard(constants, whole)

        def prepared(first: int) -> Tree:
            data = batches(first, min(chunk - first % chunk, steps - first))
            if mesh is None:
                return data
            sharding.check_divisible(data, mesh, 1)
            return sharding.shard(data, split)

        saved_at, stopping = time.monotonic(), False
        with (
            MetricLogger(folder, done, steps, tensorboard=tensorboard)
            if sharding.is_primary()
            else NullLogger() as journal
        ):
            data = prepared(done) if done < steps else None
            while done < steps and not stopping:
                began = time.monotonic()
                first, count = done, jax.tree.leaves(data)[0].shape[0]
                with _company(first, saved, folder):
                    state, metrics = advance(state, data, constants)
                    done += count
                    if done < steps:  # prepared while the device is busy
                        data = prepared(done)
                    metrics = jax.device_get(metrics)
                    # A step that only some of them take would never end.
                    stopping = bool(sharding.max_over_processes(len(stopped)))
                _check(metrics, first, limit, saved.latest, folder)
                means = {name: float(np.mean(values, dtype=np.float64)) for name, values in metrics.items()}
                try:
                    journal.write(done, means, seconds=time.monotonic() - began)
                except OSError as error:
                    why = f"{folder}: metrics.jsonl cannot be written ({error.strerror})"
                    raise TrainingError(f"{why}; {_last(saved.on_disk())}") from error
                due = save_steps is not None and done - (saved.latest or 0) >= save_steps
                if due or time.monotonic() - saved_at >= save_seconds or done >= steps or stopping:
                    saved.save(done, state)
                    saved_at = time.monotonic()
    if stopping or stopped:
        raise KeyboardInterrupt if stopped == [signal.SIGINT] else SystemExit(128 + (stopped or [signal.SIGTERM])[0])
    return sharding.unshard(state) if any(len(leaf.devices()) > 1 for leaf in jax.tree.leaves(state)) else state


class _Saved:
    """The checkpoints of a run that several processes may share: the first one reads and writes."""

    def __init__(self, folder: Path, keep: int):
        self._checkpoints = Checkpoints(folder, keep=keep) if sharding.is_primary() else None
        found = self._checkpoints.latest() if self._checkpoints else None
        number = sharding.broadcast_from_primary(np.int32(-1 if found is None else found))
        self.latest: int | None = None if number < 0 else int(number)

    def __enter__(self) -> "_Saved":
        return self

    def __exit__(self, *_: object) -> None:
        if self._checkpoints:
            self._checkpoints.close()

    def on_disk(self) -> int | None:
        """The newest checkpoint that is whole by now."""
        return self._checkpoints.on_disk() if self._checkpoints else self.latest

    def restored(self, state: TrainState) -> TrainState:
        """The newest checkpoint in all processes, or the state that is given."""
        if self.latest is None:
            return state
        if self._checkpoints:
            state = sharding.unshard(self._checkpoints.restore(state, step=self.latest))
        return sharding.broadcast_from_primary(state)

    def save(self, step: int, state: TrainState) -> None:
        if self._checkpoints:
            self._checkpoints.save(step, sharding.unshard(state) if jax.process_count() > 1 else state)
        self.latest = step


@contextmanager
def _company(step: int, saved: _Saved, folder: Path):
    """Say what to do where another process is gone."""
    try:
        yield
    except jax.errors.JaxRuntimeError as error:
        if jax.process_count() == 1:
            raise
        raise TrainingError(
            f"another process was lost after step {step} ({str(error).splitlines()[0][:200]}); {_last(saved.latest)}, "
            f"in {folder}: start again, with as many processes as there are"
        ) from error


def _check(metrics: dict[str, np.ndarray], first: int, limit: float, saved: int | None, folder: Path) -> None:
    """Raise on the earliest bad value of a chunk: `metrics` (steps,) each, `first` steps done before it."""
    wrong = {name: ~(np.abs(values) <= limit) for name, values in metrics.items()}  # true for NaN too
    bad = [(int(np.argmax(where)), name) for name, where in wrong.items() if where.any()]
    if bad:
        at, name = min(bad)
        raise TrainingError(f"{name} became {metrics[name][at]} in step {first + at + 1}; {_last(saved)}, in {folder}")


def _last(saved: int | None) -> str:
    return f"the last good checkpoint is step {saved}" if saved is not None else "there is no checkpoint yet"


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
        signal.signal(number, before[number] or signal.SIG_DFL)

    for number in before:
        signal.signal(number, receive)
    try:
        yield received
    finally:
        for number, handler in before.items():
            # None: it was set by a library in C, and cannot be set again from here.
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
