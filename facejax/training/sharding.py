"""Several devices in one process, several processes: a line of devices that share out a batch.

JAX's own partitioner and `jax.distributed` do the work; here is what a training loop and a writer of many files need
around them. What every process holds is the same on all of them (the state, the data), batches are split along one
axis. All of it goes for one process with one device too.
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


def data_mesh(devices: Sequence[jax.Device] | None = None) -> Mesh:
    """A mesh of one axis, `data`; by default all devices of all processes."""
    return Mesh(np.array(jax.devices() if devices is None else devices), (AXIS,))


def replicated(mesh: Mesh) -> NamedSharding:
    """The sharding of what every device holds whole."""
    return NamedSharding(mesh, PartitionSpec())


def split_along(mesh: Mesh, axis: int = 0) -> NamedSharding:
    """The sharding of arrays that are split along an axis, counted from the first."""
    if axis < 0:
        raise ValueError(f"axis: expected 0 or more, got {axis}")
    return NamedSharding(mesh, PartitionSpec(*(None,) * axis, AXIS))


def shard(tree: Tree, sharding: NamedSharding) -> Tree:
    """Arrays, which every process has whole, laid out over the devices of all processes; typed random keys too."""

    def one(leaf: Any) -> jax.Array:
        if _is_key(leaf):
            return jax.random.wrap_key_data(one(jax.random.key_data(leaf)), impl=jax.random.key_impl(leaf))
        held = np.asarray(leaf)
        return jax.make_array_from_callback(held.shape, sharding, lambda index: held[index])

    return jax.tree.map(one, tree)


def unshard(tree: Tree) -> Tree:
    """Copies of whole arrays that belong to no device in particular, as new arrays do."""

    def one(leaf: jax.Array) -> jax.Array:
        if _is_key(leaf):
            return jax.random.wrap_key_data(one(jax.random.key_data(leaf)), impl=jax.random.key_impl(leaf))
        # An array that lies with other processes too is whole on every device; one of this process may be in parts.
        apart = isinstance(leaf, jax.Array) and not leaf.is_fully_addressable
        return jax.numpy.asarray(np.array(leaf.addressable_data(0) if apart else leaf))

    return jax.tree.map(one, tree)


def data_parallel(step: Callable, *, axis: int = 0, mesh: Mesh | None = None) -> Callable:
    """A `step(state, batch, constants)`, each batch shared out among devices along an axis of its leaves.

    By default among all devices that there are. What comes back is to be jitted, as any `training.Step`. JAX's
    partitioner splits the work and sums the gradients: the step, its batch, its random numbers and so its
    results, but for the order of sums, are those of one device. On a CPU it is worth it where products are too small
    for several cores: `runtime.use_all_cores()`. Raises `ValueError` for a batch that cannot be shared out evenly.
    """
    mesh = data_mesh() if mesh is None else mesh
    place = partial(jax.lax.with_sharding_constraint, shardings=replicated(mesh))

    def stepped(state: Tree, batch: Tree, constants: Tree) -> Tree:
        check_divisible(batch, mesh, axis)
        batch = jax.tree.map(
            lambda leaf: jax.lax.with_sharding_constraint(leaf, split_along(mesh, axis % jax.numpy.ndim(leaf))), batch
        )
        return place(step(place(state), batch, place(constants)))

    return stepped


def check_divisible(batch: Tree, mesh: Mesh, axis: int) -> None:
    """Raise `ValueError` for arrays that cannot be shared out evenly along an axis."""
    for leaf in jax.tree.leaves(batch):
        shape = np.shape(leaf)
        there = -len(shape) <= axis < len(shape)
        if not there or not shape[axis] or shape[axis] % mesh.size:
            what = f"{shape[axis]}" if there else f"shape {shape}"
            raise ValueError(f"a batch of {what} cannot be shared out evenly among {mesh.size} devices")


def is_primary() -> bool:
    """Whether this process is the one that writes what all of them have."""
    return jax.process_index() == 0


def broadcast_from_primary(tree: Tree) -> Tree:
    """What the first process has, in all of them; trees of one structure, with typed random keys or without."""
    if jax.process_count() == 1:
        return tree
    bare = jax.tree.map(lambda leaf: np.asarray(jax.random.key_data(leaf) if _is_key(leaf) else leaf), tree)
    told = multihost_utils.broadcast_one_to_all(bare)

    def like(leaf: Any, found: Any) -> Any:
        found = jax.numpy.asarray(np.asarray(found))
        return jax.random.wrap_key_data(found, impl=jax.random.key_impl(leaf)) if _is_key(leaf) else found

    return jax.tree.map(like, tree, told)


def max_over_processes(number: int) -> int:
    """The largest of what the processes say."""
    if jax.process_count() == 1:
        return number
    return int(np.max(multihost_utils.process_allgather(np.int32(number))))


def barrier(name: str) -> None:
    """Wait until all processes are here."""
    if jax.process_count() > 1:
        multihost_utils.sync_global_devices(name)


def _is_key(leaf: Any) -> bool:
    return hasattr(leaf, "dtype") and jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key)
