"""Interpolation functions that work on NumPy and JAX arrays alike."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeVar

import numpy as np
from jaxtyping import Float

if TYPE_CHECKING:
    import jax

    Values = TypeVar("Values", np.ndarray, jax.Array)
else:
    Values = TypeVar("Values")  # any kind of array: this module does not import JAX


def smoothstep(x: Float[Values, "*shape"], low: float = 0.0, high: float = 1.0) -> Float[Values, "*shape"]:
    """Return 3 t^2 - 2 t^3 (...) with t = (x - low) / (high - low), clipped to [0, 1], for x (...).

    It rises from 0 at `low` to 1 at `high`, with slope 0 at both. NumPy arrays give NumPy arrays, JAX arrays, traced or
    not, JAX arrays.
    """
    t = ((x - low) / (high - low)).clip(0, 1)
    return t * t * (3 - 2 * t)
