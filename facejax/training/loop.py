"""Model-independent training loop: pure step functions in, state out, with exact resumption after interruption.

Vocabulary: a *step* is a pure function `step(state, batch, constants) -> (state, metrics)`; metrics are a dict of
scalars. `constants` do not change (index tables, data on the device); they are an argument, because arrays that are
closed over would be folded into the program at compile time. A *chunk* is a number of steps scanned on the device in
one call. `batches(first, count)` returns the data of `count` steps with leading axes (count, batch), as a function of
its arguments alone; random keys are folded from the step index. So the state at a step is a function of that step, and
a run that was killed and resumed equals one that was not.
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
    """Everything that changes during training."""

    step: jax.Array  # () int32, steps done
    params: Tree
    opt_state: Tree
    key: jax.Array  # the run's key; step i uses fold_in(key, i)
    extra: Tree = ()  # such as a running average of the parameters


class TrainingError(RuntimeError):
    """A metric that is not finite or exceeds the limit, a lost process, or a file that cannot be written."""


def epoch_indices(seed: int, size: int, batch: int) -> Callable[[int, int], np.ndarray]:
    """Return `indices(first, count)`: the samples, of `size`, of `count` steps, (count, batch) int32.

    Epochs are shuffled by (seed, epoch) and concatenated: each sample occurs once per epoch, none is dropped, and a
    batch may extend into the next epoch.

    Raises:
      ValueError: a size or batch below 1.
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
    """Return a step that takes indices as batch and (data, constants) as constants, so that data stay on the device."""
    return lambda state, indices, held: step(state, jax.tree.map(lambda leaf: leaf[indices], held[0]), held[1])


def run(
    step: Step,
    state: TrainState,
    batches: Callable[[int, int], Tree],
    folder: str | os.PathLike[str],
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
    device_mesh: Mesh | None = None,
) -> TrainState:
    """Train until `steps` steps are done, counted from the first start, and return the state.

    Writes to `folder`: `metrics.jsonl` (one line per chunk, the means over its steps) and `checkpoints/`. SIGTERM and
    Ctrl-C save a checkpoint, then exit as usual (`SystemExit`, `KeyboardInterrupt`); a second one exits at once.

    Args:
      save_steps, save_seconds: save at the end of the chunk in which either is reached, whichever comes first.
      keep: checkpoints that stay on disk.
      resume: continue from the newest checkpoint, if there is one, and truncate `metrics.jsonl` to it.
      limit: largest absolute value of a metric.
      device_mesh: from `sharding.data_mesh`. Each batch is split along its first axis among the devices, which may
        belong to several processes: each calls with the same arguments, the primary one reads and writes `folder`, and
        the results are those of one device except for the order of sums. A run may resume with another number of
        devices or processes. If a process is lost, the others stop within a minute.

    Raises:
      ValueError: `folder` holds a longer run, or a run without `resume`.
      TrainingError: a metric that is not finite or beyond `limit` (with step and name), or a lost process.
      CheckpointError: a checkpoint that cannot be read or written.
    """
    folder = Path(folder)
    if device_mesh is not None:
        step = sharding.data_parallel(step, device_mesh=device_mesh)

    def several(state: TrainState, data: Tree, constants: Tree) -> tuple[TrainState, Metrics]:
        if chunk == 1:  # no loop: within one, XLA runs convolutions on a CPU several times slower
            state, metrics = step(state, jax.tree.map(lambda x: x[0], data), constants)
            return state, jax.tree.map(lambda value: value[None], metrics)
        return jax.lax.scan(lambda state, batch: step(state, batch, constants), state, data)

    # Replicated, so that any process can read the outputs.
    layout: dict[str, Any] = {} if device_mesh is None else {"out_shardings": sharding.replicated(device_mesh)}
    advance = jax.jit(several, donate_argnums=0, **layout)
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
        if device_mesh is not None:
            whole = sharding.replicated(device_mesh)
            state, constants = sharding.shard(state, whole), sharding.shard(constants, whole)

        def prepared(first: int) -> Tree:
            data = batches(first, min(chunk - first % chunk, steps - first))
            if device_mesh is None:
                return data
            sharding.check_divisible(data, device_mesh, 1)
            return sharding.shard(data, sharding.split_along(device_mesh, 1))

        saved_at, stopping = time.monotonic(), False
        with (
            MetricLogger(folder, done, steps, tensorboard=tensorboard)
            if sharding.is_primary()
            else NullLogger() as logger
        ):
            data = prepared(done) if done < steps else None
            while done < steps and not stopping:
                began = time.monotonic()
                first, count = done, jax.tree.leaves(data)[0].shape[0]
                with _process_loss(first, saved, folder):
                    state, metrics = advance(state, data, constants)
                    done += count
                    if done < steps:  # prepared while the device is busy
                        data = prepared(done)
                    metrics = jax.device_get(metrics)
                    # Processes stop together: a step that only some of them take would never end.
                    stopping = bool(sharding.max_over_processes(len(stopped)))
                _check(metrics, first, limit, saved.latest, folder)
                means = {name: float(np.mean(values, dtype=np.float64)) for name, values in metrics.items()}
                try:
                    logger.write(done, means, seconds=time.monotonic() - began)
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
    """The checkpoints of a run that several processes may share: the primary one reads and writes."""

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
        """Return the newest checkpoint that is complete on disk."""
        return self._checkpoints.on_disk() if self._checkpoints else self.latest

    def restored(self, state: TrainState) -> TrainState:
        """Return the newest checkpoint in all processes, or the given state if there is none."""
        if self.latest is None:
            return state
        if self._checkpoints:
            state = sharding.unshard(self._checkpoints.restore(state, step=self.latest))
        return sharding.broadcast_from_primary(state)

    def save(self, step: int, state: TrainState) -> None:
        """Write a checkpoint, if this process is the primary one."""
        if self._checkpoints:
            self._checkpoints.save(step, sharding.unshard(state) if jax.process_count() > 1 else state)
        self.latest = step


@contextmanager
def _process_loss(step: int, saved: _Saved, folder: Path):
    """Raise `TrainingError` with instructions if another process is lost."""
    try:
        yield
    except jax.errors.JaxRuntimeError as error:
        if jax.process_count() == 1:
            raise
        raise TrainingError(
            f"another process was lost after step {step} ({str(error).splitlines()[0][:200]}); {_last(saved.latest)}, "
            f"in {folder}: restart all processes to resume"
        ) from error


def _check(metrics: dict[str, np.ndarray], first: int, limit: float, saved: int | None, folder: Path) -> None:
    """Raise for the earliest bad value of a chunk: `metrics` (steps,) each, after `first` steps."""
    wrong = {name: ~(np.abs(values) <= limit) for name, values in metrics.items()}  # true for NaN too
    bad = [(int(np.argmax(where)), name) for name, where in wrong.items() if where.any()]
    if bad:
        at, name = min(bad)
        raise TrainingError(f"{name} became {metrics[name][at]} in step {first + at + 1}; {_last(saved)}, in {folder}")


def _last(saved: int | None) -> str:
    return f"the last good checkpoint is step {saved}" if saved is not None else "there is no checkpoint yet"


@contextmanager
def _stop_signals():
    """Yield a list that receives SIGTERM or SIGINT; a second signal has its previous effect."""
    received: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield received  # signals are delivered to the main thread only
        return
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}

    def receive(number: int, _: object) -> None:
        received.append(number)
        signal.signal(number, before[signal.Signals(number)] or signal.SIG_DFL)

    for number in before:
        signal.signal(number, receive)
    try:
        yield received
    finally:
        for number, handler in before.items():
            # None: the handler was installed from C and cannot be restored from Python.
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
