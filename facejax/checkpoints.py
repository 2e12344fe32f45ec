"""Training checkpoints: written in the background, atomic, the newest few kept, checked when restored.

A step's folder appears under its final name only when everything in it is on disk, so a process killed at any
moment leaves the last complete checkpoint; the half-written one is removed at the next start. Built on
orbax-checkpoint. For weights to hand out see `facejax.weights`.
"""

import os
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp

from facejax import weights

Tree = Any


class CheckpointError(ValueError):
    """A checkpoint that is missing or was written by another model."""


class Checkpoints:
    """The checkpoints of one run in one folder; a context manager that waits for the last write at its end.

    `keep` newest steps stay on disk.
    """

    def __init__(self, folder: str | os.PathLike, *, keep: int = 3):
        self.folder = Path(folder).absolute()
        self._manager = ocp.CheckpointManager(
            self.folder,
            options=ocp.CheckpointManagerOptions(max_to_keep=keep, cleanup_tmp_directories=True),
            item_handlers=ocp.StandardCheckpointHandler(),  # lets a reopened folder describe what it holds
        )

    def __enter__(self) -> "Checkpoints":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def latest(self) -> int | None:
        """The newest complete step, or None."""
        return self._manager.latest_step()

    def steps(self) -> list[int]:
        """All complete steps, oldest first."""
        return sorted(self._manager.all_steps())

    def save(self, step: int, state: Tree) -> None:
        """Write `state` (arrays, typed keys among them) as `step`, in the background.

        The arrays are copied before this returns, so the caller may donate or overwrite them at once. A
        step that is already there stays as it is.
        """
        if step in self._manager.all_steps():
            return
        # On a CPU the writer would read the very buffers that the next donated step overwrites.
        self._manager.save(step, args=ocp.args.StandardSave(jax.tree.map(jnp.copy, state)))

    def restore(self, like: Tree, *, step: int | None = None) -> Tree:
        """Read a step (default: the newest).

        `like` gives tree, shapes and dtypes (arrays or `ShapeDtypeStruct`).
        Raises `CheckpointError` naming the folder and what is missing, unexpected, or of another shape or
        dtype.
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
        abstract = jax.tree.map(ocp.utils.to_shape_dtype_struct, like)
        try:
            return self._manager.restore(step, args=ocp.args.StandardRestore(abstract))
        except Exception as error:
            raise CheckpointError(f"{place} is damaged ({error}); delete it to go on from an older one") from error

    def wait(self) -> None:
        """Return when every write has reached the disk."""
        self._manager.wait_until_finished()

    def close(self) -> None:
        """Wait for the last write and let go of the folder."""
        self._manager.close()


def _as_stored(leaf: Any) -> jax.ShapeDtypeStruct:
    """Typed random keys are stored as the integers that they wrap."""
    if jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key):
        leaf = jax.eval_shape(jax.random.key_data, leaf)
    return jax.ShapeDtypeStruct(leaf.shape, np.dtype(leaf.dtype))
