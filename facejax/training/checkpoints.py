"""Training checkpoints: written in the background, atomic, the newest few kept, checked when restored.

A step's folder appears under its final name only when everything in it is on disk, so a process killed at any
moment leaves the last complete checkpoint; the half-written one is removed at the next start. A hash of all
numbers lies with them. Built on orbax-checkpoint. For weights to hand out see `facejax.weights`.
"""

import hashlib
import os
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp

from facejax.io import atomic, weights

Tree = Any


class CheckpointError(atomic.FileError):
    """A checkpoint that is missing, damaged, written by another model, or could not be written."""


class Checkpoints:
    """The checkpoints of one run in one folder; a context manager that waits for the last write at its end.

    `keep` newest steps stay on disk.
    """

    def __init__(self, folder: str | os.PathLike, *, keep: int = 3):
        self.folder = Path(folder).absolute()
        self._manager = ocp.CheckpointManager(
            self.folder,
            options=_options(self.folder, keep),
            item_handlers=ocp.StandardCheckpointHandler(),  # lets a reopened folder describe what it holds
        )

    def __enter__(self) -> "Checkpoints":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def latest(self) -> int | None:
        """The newest complete step, or None."""
        return self._manager.latest_step()

    def on_disk(self) -> int | None:
        """The newest step whose folder has its final name by now; `latest` counts one that is being written."""
        found = [int(path.name) for path in self.folder.iterdir() if path.name.isdigit()]
        return max(found, default=None)

    def steps(self) -> list[int]:
        """All complete steps, oldest first."""
        return sorted(self._manager.all_steps())

    def save(self, step: int, state: Tree) -> None:
        """Write `state` (arrays, typed keys among them) as `step`, in the background.

        The arrays are copied before this returns, so the caller may donate or overwrite them at once. A
        step that is already there stays as it is. Raises `CheckpointError` where this one or the one before
        could not be written.
        """
        if step in self._manager.all_steps():
            return
        # On a CPU the writer would read the very buffers that the next donated step overwrites.
        copied = jax.tree.map(lambda leaf: _alone(jnp.copy(_bare(leaf))), state)
        with self._writing():
            self._manager.save(step, args=ocp.args.StandardSave(copied), custom_metadata={"sha256": _digest(copied)})

    def restore(self, like: Tree, *, step: int | None = None) -> Tree:
        """Read a step (default: the newest).

        `like` gives tree, shapes and dtypes (arrays or `ShapeDtypeStruct`).
        Raises `CheckpointError` naming the folder and what is missing, unexpected, of another shape or
        dtype, or not what was written.
        """
        step = self.latest() if step is None else step
        if step not in self._manager.all_steps():
            raise CheckpointError(f"{self.folder} has no checkpoint of step {step}; it has {self.steps()}")
        place = self.folder / str(step)
        try:
            stored = weights.names(self._manager.item_metadata(step).tree)
        except Exception as error:
            raise CheckpointError(f"{place} is damaged ({error}); delete it to go on from an older one") from error
        if wrong := weights.mismatches(weights.names(jax.tree.map(_as_stored, like)), stored):
            raise CheckpointError(f"{place} was written by another model: {'; '.join(wrong)}")
        abstract = jax.tree.map(_abstract, like)
        try:
            found = self._manager.restore(step, args=ocp.args.StandardRestore(abstract))
            if (self._manager.metadata(step).custom_metadata or {}).get("sha256") != _digest(found):
                raise ValueError("its numbers are not those that were written")
        except Exception as error:
            raise CheckpointError(f"{place} is damaged ({error}); delete it to go on from an older one") from error
        return jax.tree.map(_as_was, like, found)

    def wait(self) -> None:
        """Return when every write has reached the disk. Raises `CheckpointError` where one did not."""
        with self._writing():
            self._manager.wait_until_finished()

    def close(self) -> None:
        """Wait for the last write and let go of the folder. Raises `CheckpointError` as `wait`."""
        with self._writing():
            self._manager.close()

    @contextmanager
    def _writing(self):
        try:
            yield
        except Exception as error:
            last = self.on_disk()
            there = "there is none yet" if last is None else f"the last good one is step {last}"
            raise CheckpointError(f"{self.folder}: a checkpoint could not be written ({error}); {there}") from error


def _options(folder: Path, keep: int) -> ocp.CheckpointManagerOptions:
    if jax.process_count() == 1:
        return ocp.CheckpointManagerOptions(max_to_keep=keep, cleanup_tmp_directories=True)
    # The process that calls writes alone: what it saves is the same in all of them.
    folder.mkdir(parents=True, exist_ok=True)
    me = jax.process_index()
    alone = ocp.options.MultiprocessingOptions(primary_host=me, active_processes={me}, barrier_sync_key_prefix=f"p{me}")
    return ocp.CheckpointManagerOptions(
        max_to_keep=keep, cleanup_tmp_directories=True, create=False, multiprocessing_options=alone
    )


def _digest(state: Tree) -> str:
    found = hashlib.sha256()
    for name, leaf in weights.names(state).items():
        array = np.ascontiguousarray(leaf)
        found.update(f"{name} {array.dtype} {array.shape}".encode())
        found.update(array)
    return found.hexdigest()


def _is_key(leaf: Any) -> bool:
    return jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _bare(leaf: Any) -> Any:
    """Typed random keys are stored as the integers that they wrap."""
    return jax.random.key_data(leaf) if _is_key(leaf) else leaf


def _alone(leaf: jax.Array) -> jax.Array | np.ndarray:
    """What one of several processes can store by itself."""
    return leaf if jax.process_count() == 1 else np.array(leaf)


def _as_stored(leaf: Any) -> jax.ShapeDtypeStruct:
    bare = jax.eval_shape(_bare, leaf) if _is_key(leaf) else leaf
    return jax.ShapeDtypeStruct(bare.shape, np.dtype(bare.dtype))


def _abstract(leaf: Any) -> Any:
    stored = _as_stored(leaf)
    if jax.process_count() > 1:
        return np.empty(stored.shape, stored.dtype)
    return stored if _is_key(leaf) else ocp.utils.to_shape_dtype_struct(leaf)


def _as_was(like: Any, found: Any) -> jax.Array:
    return jax.random.wrap_key_data(jnp.asarray(found), impl=jax.random.key_impl(like)) if _is_key(like) else found
