"""A stack of LSTM layers with a dense output, with custom gradients that use one product per weight matrix.

    i, f, g, o = split(x @ input + h @ hidden + bias)
    c' = sigmoid(f) c + sigmoid(i) tanh(g),    h' = sigmoid(o) tanh(c')

Vocabulary: T steps, B sequences, D inputs and outputs, H units per layer. Arrays are time-major, (T, B, ...), as a scan
reads them. Weights are {"layers": [{"input" (D or H, 4H), "hidden" (H, 4H), "bias" (4H,)}], "dense":
{"kernel" (H, D), "bias" (D,)}}; every sequence starts from a zero state.

JAX differentiates a scan by adding one outer product per step to every weight's gradient: 31 ms instead of 15 for three
layers of 128, 135 steps and 5 sequences of 204 numbers on 2 cores. Both backward passes here store the derivative of
each step's gates and multiply once at the end.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Real

from facejax.models import layers as dense_layers
from facejax.models.layers import Weights

State = tuple[Array, Array]  # hidden and cell, (B, H) each


def init(key: Array, size: int, *, hidden: int = 128, layers: int = 3) -> Weights:
    """Return random weights for `size` inputs and outputs: Glorot inputs, orthogonal recurrences, forget bias 1.

    The dense layer is scaled by 0.1, so that the initial predictions are close to zero.

    Raises:
      ValueError: a size below 1.
    """
    if min(size, hidden, layers) < 1:
        raise ValueError(f"size, hidden and layers must be 1 or more, got {size}, {hidden} and {layers}")
    dense_key, *keys = jax.random.split(key, layers + 1)
    glorot, orthogonal = jax.nn.initializers.glorot_uniform(), jax.nn.initializers.orthogonal()
    rows: list[Weights] = []
    for i, layer_key in enumerate(keys):
        input_key, *gate_keys = jax.random.split(layer_key, 5)
        rows.append(
            {
                "input": glorot(input_key, (size if i == 0 else hidden, 4 * hidden)),
                "hidden": jnp.concatenate([orthogonal(k, (hidden, hidden)) for k in gate_keys], axis=1),
                "bias": jnp.zeros(4 * hidden).at[hidden : 2 * hidden].set(1.0),
            }
        )
    dense = dense_layers.init_dense(dense_key, hidden, size, initializer=glorot)
    return {"layers": rows, "dense": dense | {"kernel": 0.1 * dense["kernel"]}}


@jax.jit
def forward(weights: Weights, x: Float[Array | np.ndarray, "T B D"]) -> Float[Array, "T B D"]:
    """Run the LSTM over a sequence of known inputs, by a scan per layer; the input product is outside of the scan."""
    signal = jnp.asarray(x)
    for row in weights["layers"]:
        signal = _layer(row, signal)
    return dense_layers.dense(weights["dense"], signal)


@jax.jit
def forward_scheduled(
    weights: Weights,
    x: Float[Array | np.ndarray, "T B D"],
    given: Bool[Array | np.ndarray, "T B"],
    base: Float[Array | np.ndarray, "T B D"] | None = None,
    carry: float | Real[Array, ""] = 0.0,
) -> Float[Array, "T B D"]:
    """Return the outputs with scheduled sampling: the input is x where `given`, else the previous output.

    The network's output is added to `base` where the input was given, else to `carry` times the previous output.
    Gradients flow through outputs that are fed back, but not into `carry`. A first input that is not given is zero.
    """
    base = jnp.zeros_like(x) if base is None else base
    return _scheduled(weights, x, given, base, jnp.asarray(carry, x.dtype))


def step(weights: Weights, states: list[State], x: Float[Array, "B D"]) -> tuple[list[State], Float[Array, "B D"]]:
    """Advance all layers by one step; return their new states and the output."""
    after: list[State] = []
    for row, (hidden, cell) in zip(weights["layers"], states, strict=True):
        x, cell, _ = _cell(x @ row["input"] + row["bias"] + hidden @ row["hidden"], cell)
        after.append((x, cell))
    return after, dense_layers.dense(weights["dense"], x)


def init_states(weights: Weights, count: Any) -> list[State]:
    """Return the zero initial states of `count` sequences; the number may be symbolic (`jax.export`)."""
    zeros = [jnp.zeros((count, row["hidden"].shape[0]), row["hidden"].dtype) for row in weights["layers"]]
    return [(zero, zero) for zero in zeros]


def _cell(gates: Array, cell: Array) -> tuple[Array, Array, tuple[Array, Array]]:
    """Return hidden and cell states, and residuals for the backward pass, from pre-activations (B, 4H) and cells."""
    # sigmoid(x) = (1 + tanh(x / 2)) / 2: one tanh over all four gates in memory order. Applied slice by slice, XLA does
    # not vectorise on a CPU, and a layer's scan took twice as long.
    half = _half(cell)
    opened = jax.lax.optimization_barrier(half * jnp.tanh(half * gates) + (1 - half))
    i, f, g, o = jnp.split(opened, 4, axis=-1)
    cell = f * cell + i * g
    bent = jnp.tanh(cell)
    return o * bent, cell, (opened, bent)


def _at(rows: Array, t: Array) -> Array:
    return jax.lax.dynamic_index_in_dim(rows, t, keepdims=False)


def _put(rows: Array, row: Array, t: Array) -> Array:
    return jax.lax.dynamic_update_index_in_dim(rows, row, t, 0)


def _half(cell: Array) -> Array:
    """Return 1/2 for the entries of the three sigmoid gates and 1 for those of g, (4H,)."""
    return jnp.repeat(jnp.array([0.5, 0.5, 1.0, 0.5], cell.dtype), cell.shape[-1])


@jax.custom_vjp
def _layer(row: Weights, x: Array) -> Array:
    """Return the hidden states (T, B, H) of one layer for inputs (T, B, D)."""
    return _layer_forward(row, x)[0]


def _layer_forward(row: Weights, x: Array) -> tuple[Array, Any]:
    # All gates are in one buffer in which each step's input is overwritten by its output; stacked by the scan, they
    # would be a second buffer, filled twice.
    def advance(carry: Any, t: Array) -> tuple[Any, Any]:
        hidden, cell, gates = carry
        hidden, after, (opened, bent) = _cell(_at(gates, t) + row["bias"] + hidden @ row["hidden"], cell)
        return (hidden, after, _put(gates, opened, t)), (hidden, cell, bent)

    zero = jnp.zeros((x.shape[1], row["hidden"].shape[0]), x.dtype)
    begin = (zero, zero, x @ row["input"])
    (_, _, opened), (hidden, before, bent) = jax.lax.scan(advance, begin, jnp.arange(len(x)))
    return hidden, (row, x, hidden, before, opened, bent)


def _layer_backward(saved: Any, slope: Array) -> tuple[Weights, Array]:
    row, x, hidden, before, opened, bent = saved
    transposed = row["hidden"].T
    sigmoid = _half(before) < 1

    def retreat(carry: Any, inputs: Any) -> tuple[Any, Array]:
        d_hidden, d_cell = carry
        slope, before, opened, bent = inputs
        i, f, g, o = jnp.split(opened, 4, axis=-1)
        d_hidden = d_hidden + slope
        d_cell = d_cell + d_hidden * o * (1 - bent * bent)
        d_opened = jnp.concatenate([d_cell * g, d_cell * before, d_cell * i, d_hidden * bent], axis=-1)
        # The derivative is z (1 - z) for a sigmoid z and 1 - z z for a tanh.
        d_gates = d_opened * (jnp.where(sigmoid, opened, 1) - opened * opened)
        return (d_gates @ transposed, d_cell * f), d_gates

    zero = jnp.zeros_like(hidden[0])
    _, d_gates = jax.lax.scan(retreat, (zero, zero), (slope, before, opened, bent), reverse=True)
    return _weight_slopes(x, hidden, d_gates), d_gates @ row["input"].T


_layer.defvjp(_layer_forward, _layer_backward)


def _weight_slopes(x: Array, hidden: Array, d_gates: Array) -> Weights:
    """Return a layer's gradient from its inputs, its hidden states and the gradient of its gates, (T, B, .) each."""
    previous = jnp.concatenate([jnp.zeros_like(hidden[:1]), hidden[:-1]])
    return {
        "input": _product(x, d_gates),
        "hidden": _product(previous, d_gates),
        "bias": jnp.sum(d_gates, axis=(0, 1)),
    }


def _product(a: Array, b: Array) -> Array:
    """Sum outer products over steps and sequences: (T, B, m) and (T, B, n) -> (m, n)."""
    # Not of arrays reshaped to (T B, .): sequences sharded over several devices would first be gathered on each.
    return jnp.tensordot(a, b, ((0, 1), (0, 1)))


@jax.custom_vjp
def _scheduled(weights: Weights, x: Array, given: Array, base: Array, carry: Array) -> Array:
    return _scheduled_forward(weights, x, given, base, carry)[0]


def _scheduled_forward(weights: Weights, x: Array, given: Array, base: Array, carry: Array) -> tuple[Array, Any]:
    count, width = x.shape[:2], weights["layers"][0]["hidden"].shape[1]
    # Zeros are added to the gates, because the derivative with respect to them is that of the gates.
    zeros = [jnp.zeros((*count, width), x.dtype) for _ in weights["layers"]] + [jnp.zeros_like(x)]
    outputs, pull, (fed, hidden) = jax.vjp(
        lambda added: _unroll(weights, x, given, base, carry, added), zeros, has_aux=True
    )
    return outputs, (weights, given, fed, hidden, pull)


def _scheduled_backward(saved: Any, slope: Array) -> tuple[Weights, Array, None, Array, None]:
    weights, given, fed, hidden, pull = saved
    (slopes,) = pull(slope)
    *d_gates, d_outputs = slopes
    inputs = [fed, *hidden[:-1]]
    rows = [_weight_slopes(*arrays) for arrays in zip(inputs, hidden, d_gates, strict=True)]
    dense = {"kernel": _product(hidden[-1], d_outputs), "bias": jnp.sum(d_outputs, axis=(0, 1))}
    d_x = jnp.where(given[..., None], d_gates[0] @ weights["layers"][0]["input"].T, 0)
    d_base = jnp.where(given[..., None], d_outputs, 0)
    return {"layers": rows, "dense": dense}, d_x, None, d_base, None


_scheduled.defvjp(_scheduled_forward, _scheduled_backward)


def _unroll(
    weights: Weights, x: Array, given: Array, base: Array, carry: Array, added: list[Array]
) -> tuple[Array, tuple[Array, list[Array]]]:
    """Return the outputs, and (the inputs that were used, the hidden states of each layer)."""

    def advance(before: Any, inputs: Any) -> tuple[Any, Any]:
        states, last = before
        x, given, base, (*added, added_last) = inputs
        fed = signal = jnp.where(given[:, None], x, last)
        carried = jnp.where(given[:, None], base, carry * last)
        found: list[State] = []
        for row, (hidden, cell), more in zip(weights["layers"], states, added, strict=True):
            signal, cell, _ = _cell(signal @ row["input"] + row["bias"] + hidden @ row["hidden"] + more, cell)
            found.append((signal, cell))
        last = carried + dense_layers.dense(weights["dense"], signal) + added_last
        return (found, last), (last, fed, [hidden for hidden, _ in found])

    begin = (init_states(weights, x.shape[1]), jnp.zeros_like(x[0]))
    _, (outputs, fed, hidden) = jax.lax.scan(advance, begin, (x, given, base, added))
    return outputs, (fed, hidden)
