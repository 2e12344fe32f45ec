"""Roofline of the machine, measured in the same process: fastest matrix product, and memory bandwidth.

Work of `gflop` billions of operations that moves `gbyte` billions of bytes takes at least the longer of the two times.
That time over the measured one is its share of the roofline. Operations are counted for the work as its source states
it; an implementation with fewer operations may exceed 100 %.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

SQUARE = 1024
ENTRIES = 1 << 25  # 128 MB of float32, larger than any cache


class Roofline(NamedTuple):
    """Limits of the machine."""

    gflop_per_s: float
    gbyte_per_s: float


@functools.cache
def measured() -> Roofline:
    """Measure the limits: the best of several tries, with JAX and, where installed, PyTorch."""
    a = np.random.default_rng(0).normal(size=(SQUARE, SQUARE)).astype(np.float32)
    ours, product = jnp.asarray(a), jax.jit(functools.partial(jnp.matmul, precision="highest"))
    ways = [lambda: product(ours, ours)]
    try:
        import torch
    except ImportError:
        pass
    else:
        if jax.default_backend() == "cpu":  # on a GPU the call returns before the product is done
            theirs = torch.tensor(a)
            ways.append(lambda: theirs @ theirs)
    fastest = min(_fastest(way, 20) for way in ways)
    triad = jax.jit(lambda x, y: 0.5 * x + y, donate_argnums=0)
    x, y = jnp.ones(ENTRIES), jnp.ones(ENTRIES)

    def move() -> jax.Array:
        nonlocal x
        x = triad(x, y)
        return x

    return Roofline(2e-9 * SQUARE**3 / fastest, 3 * 4e-9 * ENTRIES / _fastest(move, 10))


def share(seconds: float, *, gflop: float | None, gbyte: float | None) -> float | None:
    """Return the share of the roofline; None without a count of operations or bytes."""
    if gflop is None and gbyte is None:
        return None
    limits = measured()
    return max((gflop or 0) / limits.gflop_per_s, (gbyte or 0) / limits.gbyte_per_s) / seconds


def _fastest(function: Callable[[], Any], repeats: int) -> float:
    jax.block_until_ready(function())
    times = []
    for _ in range(repeats):
        begun = time.perf_counter()
        jax.block_until_ready(function())
        times.append(time.perf_counter() - begun)
    return min(times)
