"""What tests near singular sets share: that values and gradients are finite, of 100,000 points by `make faults`."""

import jax
import jax.numpy as jnp
import numpy as np

from tests.faults._record import FILES

COUNT = 5 * FILES or 10_000


def finite(function, *arrays, each=True):
    """The values, checked with the gradients by every array.

    `each`: the first axis is that of the points; otherwise all of them make one value.
    """
    made = function(*arrays)
    rng = np.random.default_rng(2)
    weights = [jnp.asarray(rng.normal(size=leaf.shape), leaf.dtype) for leaf in jax.tree.leaves(made)]

    def total(*arrays):
        return sum(jnp.sum(w * leaf) for w, leaf in zip(weights, jax.tree.leaves(function(*arrays)), strict=True))

    slopes = jax.jit(jax.grad(total, argnums=tuple(range(len(arrays)))))(*arrays)
    for leaf in [*jax.tree.leaves(made), *slopes]:
        rows = np.asarray(leaf).reshape(len(leaf) if each else 1, -1)
        bad = ~np.isfinite(rows).all(axis=1)
        assert not bad.any(), f"{bad.sum()} of {len(bad)}, first {np.argmax(bad)}"
        assert leaf.dtype == arrays[0].dtype
    return made


def steps(dtype, *shape):
    """Steps (*shape, 3) of motions in units from 1e-9 to 1e9, that pause, differ by nine orders, or stand still."""
    rng = np.random.default_rng(1)
    found = rng.normal(size=(*shape, 3)) * 10.0 ** rng.uniform(-9, 0, (*shape[:-1], 1, 1))
    found[rng.random(shape[:-1]) < 0.2] = 0
    found[:100] = 0
    return jnp.asarray(found * 10.0 ** rng.uniform(-9, 9, (shape[0],) + (1,) * len(shape)), dtype)
