"""Checks that all timed implementations give equal results."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np


def check(ours: Any, theirs: Any, *, tolerance: float = 1e-4) -> None:
    """Assert that two pytrees of arrays or PyTorch tensors agree, relative to the largest entry of each array."""
    for a, b in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        a, b = host(a), host(b)
        np.testing.assert_allclose(b, a, rtol=0, atol=tolerance * np.abs(a).max())


def host(array: Any) -> np.ndarray:
    """Return an array or a tensor on any device as a NumPy array."""
    return np.asarray(array.detach().cpu() if hasattr(array, "detach") else array)
