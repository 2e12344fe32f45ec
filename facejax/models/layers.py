"""Dense and spiral-convolution layers: pure functions on plain dicts of a kernel and a bias."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax import export
from jaxtyping import Array, Float

from facejax.mesh import spiral_conv as spirals
from facejax.mesh.stencils import Stencil

Weights = dict[str, Any]
Activation = Callable[[Array], Array]

HE_NORMAL = jax.nn.initializers.he_normal()
HE_NORMAL_SPIRAL = jax.nn.initializers.he_normal(in_axis=(0, 1), out_axis=2)


def init_dense(key: Array, inputs: int, outputs: int, *, initializer: Any = HE_NORMAL) -> Weights:
    """Return a dense layer with a random kernel (inputs, outputs), He-normal by default, and a zero bias (outputs,)."""
    return {"kernel": initializer(key, (inputs, outputs)), "bias": jnp.zeros(outputs)}


def zero_dense(inputs: int, outputs: int) -> Weights:
    """Return a dense layer whose kernel and bias are zero."""
    return {"kernel": jnp.zeros((inputs, outputs)), "bias": jnp.zeros(outputs)}


def dense(layer: Weights, x: Float[Array, "... inputs"]) -> Float[Array, "... outputs"]:
    """Apply a dense layer: x @ kernel + bias."""
    return x @ layer["kernel"] + layer["bias"]


def residual_stack(
    weights: Weights, x: Float[Array, "... inputs"], activation: Activation
) -> Float[Array, "... width"]:
    """Apply `weights["stem"]`, then the residual blocks `weights["blocks"]`, each scaled by one over their number."""
    x = activation(dense(weights["stem"], x))
    for block in weights["blocks"]:
        x = x + activation(dense(block, x)) / len(weights["blocks"])
    return x


def init_spiral_conv(key: Array, length: int, inputs: int, outputs: int) -> Weights:
    """Return a spiral convolution with a He-normal kernel (length, inputs, outputs) and a zero bias (outputs,)."""
    return {"kernel": HE_NORMAL_SPIRAL(key, (length, inputs, outputs)), "bias": jnp.zeros(outputs)}


def spiral_conv(layer: Weights, x: Float[Array, "M B inputs"], stencil: Stencil) -> Float[Array, "V B outputs"]:
    """Apply a spiral convolution with bias to signals on M vertices; the stencil maps them to V vertices."""
    return spirals.spiral_conv(x, layer["kernel"], stencil) + layer["bias"]


def map_pieces(function: Callable[..., Array], arrays: Sequence[Array], most: int) -> Array:
    """Apply a function of rows (B, ...) to equal pieces of at most `most` rows, one after another.

    The last piece is padded with copies of the last row. B may be symbolic (`jax.export`).
    """
    count = arrays[0].shape[0]
    symbolic = export.is_symbolic_dim(count)
    pieces = -(-count // most)
    if not symbolic and pieces <= 1:
        return function(*arrays)
    size = -(-count // pieces)

    def cut(x: Array) -> Array:
        # With a symbolic B the number of copies is not known to be 0 or more, as `jnp.pad` requires.
        if symbolic:
            x = x[jnp.minimum(jnp.arange(pieces * size), count - 1)]
        elif pieces * size > count:
            x = jnp.pad(x, ((0, pieces * size - count), *[(0, 0)] * (x.ndim - 1)), mode="edge")
        return x.reshape(pieces, size, *x.shape[1:])

    out = jax.lax.map(lambda piece: function(*piece), tuple(map(cut, arrays)))
    out = out.reshape(pieces * size, *out.shape[2:])
    return out[jnp.arange(count)] if symbolic else out[:count]
