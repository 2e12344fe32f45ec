"""Data parallelism over several devices and processes: a one-axis device mesh that batches are sharded over.

JAX's partitioner and `jax.distributed` do the work; these are the helpers that a training loop and a writer of many
files need around them. State and data are replicated in every process; batches are split along one axis. Everything
works with one process and one device too.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec

Tree = Any
AXIS = "data"


def data_mesh(devices: Sequence[Any] | None = None) -> Mesh:
    """Return a device mesh with one axis, `data`; by default of all devices of all processes."""
    return Mesh(np.array(jax.devices() if devices is None else devices), (AXIS,))


def replicated(device_mesh: Mesh) -> NamedSharding:
    """Return the sharding of arrays that every device holds whole."""
    return NamedSharding(device_mesh, PartitionSpec())


def split_along(device_mesh: Mesh, axis: int = 0) -> NamedSharding:
    """Return the sharding of arrays that are split along an axis, counted from the first.

    Raises:
      ValueError: a negative axis.
    """
    if axis < 0:
        raise ValueError(f"axis: expected 0 or more, got {axis}")
    return NamedSharding(device_mesh, PartitionSpec(*(None,) * axis, AXIS))


def shard(tree: Tree, sharding: NamedSharding) -> Tree:
    """Shard arrays that every process holds whole over the devices of all processes; typed random keys too."""

    def one(leaf: Any) -> jax.Array:
        if _is_key(leaf):
            return jax.random.wrap_key_data(one(jax.random.key_data(leaf)), impl=jax.random.key_impl(leaf))
        whole = np.asarray(leaf)
        return jax.make_array_from_callback(whole.shape, sharding, lambda index: whole[index])

    return jax.tree.map(one, tree)


def unshard(tree: Tree) -> Tree:
    """Copy arrays to uncommitted arrays on the default device."""

    def one(leaf: Any) -> jax.Array:
        if _is_key(leaf):
            return jax.random.wrap_key_data(one(jax.random.key_data(leaf)), impl=jax.random.key_impl(leaf))
        # An array shared with other processes is whole on every device; one of this process may be split.
        shared = isinstance(leaf, jax.Array) and not leaf.is_fully_addressable
        return jax.numpy.asarray(np.array(leaf.addressable_data(0) if shared else leaf))

    return jax.tree.map(one, tree)


def data_parallel(
    step: Callable[[Tree, Tree, Tree], Tree], *, axis: int = 0, device_mesh: Mesh | None = None
) -> Callable[[Tree, Tree, Tree], Tree]:
    """Return a `step(state, batch, constants)` that splits each batch among devices along an axis of its leaves.

    By default among all devices. The result is to be jitted, as any `loop.Step`. JAX's partitioner splits the work and
    sums the gradients: batch, random numbers and results are those of one device, except for the order of sums. On a
    CPU it helps if products are too small to use several cores (`facejax.cli.runtime.use_all_cores`).

    Raises:
      ValueError: a batch that cannot be split evenly.
    """
    device_mesh = data_mesh() if device_mesh is None else device_mesh
    place = partial(jax.lax.with_sharding_constraint, shardings=replicated(device_mesh))

    def stepped(state: Tree, batch: Tree, constants: Tree) -> Tree:
        check_divisible(batch, device_mesh, axis)
        batch = jax.tree.map(
            lambda leaf: jax.lax.with_sharding_constraint(leaf, split_along(device_mesh, axis % jax.numpy.ndim(leaf))),
            batch,
        )
        return place(step(place(state), batch, place(constants)))

    return stepped


def check_divisible(batch: Tree, device_mesh: Mesh, axis: int) -> None:
    """Raise `ValueError` for arrays that cannot be split evenly along an axis."""
    for leaf in jax.tree.leaves(batch):
        shape = np.shape(leaf)
        exists = -len(shape) <= axis < len(shape)
        if not exists or not shape[axis] or shape[axis] % device_mesh.size:
            what = f"{shape[axis]}" if exists else f"shape {shape}"
            raise ValueError(f"a batch of {what} cannot be split evenly among {device_mesh.size} devices")


def is_primary() -> bool:
    """Return whether this process is the one that writes files."""
    return jax.process_index() == 0


def broadcast_from_primary(tree: Tree) -> Tree:
    """Return the primary process's tree in all processes; trees of one structure, typed random keys included."""
    if jax.process_count() == 1:
        return tree
    bare = jax.tree.map(lambda leaf: np.asarray(jax.random.key_data(leaf) if _is_key(leaf) else leaf), tree)
    received = multihost_utils.broadcast_one_to_all(bare)

    def like(leaf: Any, found: Any) -> Any:
        found = jax.numpy.asarray(np.asarray(found))
        return jax.random.wrap_key_data(found, impl=jax.random.key_impl(leaf)) if _is_key(leaf) else found

    return jax.tree.map(like, tree, received)


def max_over_processes(number: int) -> int:
    """Return the maximum of a number over all processes."""
    if jax.process_count() == 1:
        return number
    return int(np.max(multihost_utils.process_allgather(np.int32(number))))


def barrier(name: str) -> None:
    """Wait until all processes have reached this point."""
    if jax.process_count() > 1:
        multihost_utils.sync_global_devices(name)


def _is_key(leaf: Any) -> bool:
    return hasattr(leaf, "dtype") and jax.numpy.issubdtype(leaf.dtype, jax.dtypes.prng_key)
