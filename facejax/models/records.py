"""The type of the leaves of records, which are pytrees: flax's `struct.PyTreeNode` with static fields."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import jax
    import numpy as np

    Leaf = jax.Array | np.ndarray
    HostLeaf = np.ndarray  # of tables that stay on the host until a compiled function takes them
    Number = jax.Array | np.ndarray | float
else:
    # JAX puts tracers, shapes, axes and placeholders into records: nothing may be checked where they are created.
    Leaf = HostLeaf = Number = Any
