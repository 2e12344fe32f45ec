"""Training checkpoints: written in the background, atomically; the newest few are kept and verified when restored.

A step's folder gets its final name only when everything in it is on disk, so a process that is killed at any moment
leaves the last complete checkpoint; incomplete ones are removed at the next start. A hash of all arrays is stored with
them. Built on orbax-checkpoint. For released weights see `facejax.io.weights`.
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

from facejax.io import errors, weights

Tree = Any


class CheckpointError(errors.FileError):
    """A checkpoint that is missing, damaged, written by another model, or could not be written."""


class Checkpoints:
    """The checkpoints of one run in one folder; a context manager that waits for the last write on exit.

    The `keep` newest steps stay on disk.
    """

    def __init__(self, folder: str | os.PathLike[str], *, keep: int = 3):
        self.folder = Path(folder).absolute()
        self._manager = ocp.CheckpointManager(
            self.folder,
            options=_options(self.folder, keep),
            item_handlers=ocp.StandardCheckpointHandler(),  # needed to read the metadata of a reopened folder
        )

    def __enter__(self) -> "Checkpoints":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def latest(self) -> int | None:
        """Return the newest complete step, or None."""
        return self._manager.latest_step()

    def on_disk(self) -> int | None:
        """Return the newest step whose folder has its final name; `latest` includes one that is still being written."""
        steps = [int(path.name) for path in self.folder.iterdir() if path.name.isdigit()]
        return max(steps, default=None)

    def steps(self) -> list[int]:
        """Return all complete steps, oldest first."""
        return sorted(self._manager.all_steps())

    def save(self, step: int, state: Tree) -> None:
        """Write `state` (arrays, typed keys among them) as `step`, in the background.

        The arrays are copied before this returns, so the caller may donate or overwrite them at once. An existing step
        is not overwritten.

        Raises:
          CheckpointError: this or the previous checkpoint could not be written.
        """
        if step in self._manager.all_steps():
            return
        # On a CPU the writer shares the buffers that the next donated step overwrites.
        copied = jax.tree.map(lambda leaf: _local(jnp.copy(_key_data(leaf))), state)
        with self._writing():
            self._manager.save(step, args=ocp.args.StandardSave(copied), custom_metadata={"sha256": _digest(copied)})

    def restore(self, like: Tree, *, step: int | None = None) -> Tree:
        """Read a step (default: the newest).

        Args:
          like: the expected tree, shapes and dtypes (arrays or `ShapeDtypeStruct`).

        Raises:
          CheckpointError: names the folder and what is missing, unexpected, of another shape or dtype, or damaged.
        """
        step = self.latest() if step is None else step
        if step is None or step not in self._manager.all_steps():
            raise CheckpointError(f"{self.folder} has no checkpoint of step {step}; it has {self.steps()}")
        place = self.folder / str(step)
        try:
            stored = weights.names(self._manager.item_metadata(step).tree)
        except Exception as error:
            raise CheckpointError(f"{place} is damaged ({error}); delete it to resume from an older one") from error
        if wrong := weights.mismatches(weights.names(jax.tree.map(_as_stored, like)), stored):
            raise CheckpointError(f"{place} was written by another model: {'; '.join(wrong)}")
        abstract = jax.tree.map(_abstract, like)
        try:
            restored = self._manager.restore(step, args=ocp.args.StandardRestore(abstract))
            if (self._manager.metadata(step).custom_metadata or {}).get("sha256") != _digest(restored):
                raise ValueError("its hash does not match its arrays")
        except Exception as error:
            raise CheckpointError(f"{place} is damaged ({error}); delete it to resume from an older one") from error
        return jax.tree.map(_wrap_key, like, restored)

    def wait(self) -> None:
        """Wait until every write has reached the disk.

        Raises:
          CheckpointError: a checkpoint could not be written.
        """
        with self._writing():
            self._manager.wait_until_finished()

    def close(self) -> None:
        """Wait for the last write and release the folder.

        Raises:
          CheckpointError: a checkpoint could not be written.
        """
        with self._writing():
            self._manager.close()

    @contextmanager
    def _writing(self):
        try:
            yield
        except Exception as error:
            last = self.on_disk()
            latest = "there is none yet" if last is None else f"the last good one is step {last}"
            raise CheckpointError(f"{self.folder}: a checkpoint could not be written ({error}); {latest}") from error


def _options(folder: Path, keep: int) -> ocp.CheckpointManagerOptions:
    if jax.process_count() == 1:
        return ocp.CheckpointManagerOptions(max_to_keep=keep, cleanup_tmp_directories=True)
    # Only the calling process writes: the state is the same in all processes.
    folder.mkdir(parents=True, exist_ok=True)
    me = jax.process_index()
    options = ocp.options.MultiprocessingOptions(
        primary_host=me, active_processes={me}, barrier_sync_key_prefix=f"p{me}"
    )
    return ocp.CheckpointManagerOptions(
        max_to_keep=keep, cleanup_tmp_directories=True, create=False, multiprocessing_options=options
    )


def _digest(state: Tree) -> str:
    digest = hashlib.sha256()
    for name, leaf in weights.names(state).items():
        array = np.ascontiguousarray(leaf)
        digest.update(f"{name} {array.dtype} {array.shape}".encode())
        digest.update(array.data)
    return digest.hexdigest()


def _is_key(leaf: Any) -> bool:
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _key_data(leaf: Any) -> Any:
    """Return the integers of a typed random key, which is how keys are stored; other leaves unchanged."""
    return jax.random.key_data(leaf) if _is_key(leaf) else leaf


def _local(leaf: jax.Array) -> jax.Array | np.ndarray:
    """Return a leaf that one of several processes can store without the others."""
    return leaf if jax.process_count() == 1 else np.array(leaf)


def _as_stored(leaf: Any) -> jax.ShapeDtypeStruct:
    bare = jax.eval_shape(_key_data, leaf) if _is_key(leaf) else leaf
    return jax.ShapeDtypeStruct(bare.shape, np.dtype(bare.dtype))


def _abstract(leaf: Any) -> Any:
    stored = _as_stored(leaf)
    if jax.process_count() > 1:
        return np.empty(stored.shape, stored.dtype)
    return stored if _is_key(leaf) else ocp.utils.to_shape_dtype_struct(leaf)


def _wrap_key(like: Any, restored: Any) -> jax.Array:
    return (
        jax.random.wrap_key_data(jnp.asarray(restored), impl=jax.random.key_impl(like)) if _is_key(like) else restored
    )
