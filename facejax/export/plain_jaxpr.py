"""Rewrite a traced function in primitives that other formats have.

    found = plain_jaxpr.evaluate(jax.make_jaxpr(function)(*arguments), inputs)

computes the function with no call of another function, no custom gradient and no primitive of facejax's own, and with
operations on constants alone computed at once. Spiral convolutions and strains take their forms of
`facejax.export.onnx_forms`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import export
from jax.core import Tracer
from jax.extend import core

from facejax.export import onnx_forms
from facejax.mesh.stencils import Stencil
from facejax.mesh.strain import VertexTriangles

_INLINED = {"jit": "jaxpr", "pjit": "jaxpr", "custom_jvp_call": "call_jaxpr", "custom_vjp_call": "call_jaxpr"}
_IDENTITIES = ("stop_gradient", "optimization_barrier")
_UNCHANGED = ("broadcast_in_dim", "reshape", "slice", "squeeze")  # where the shape stays
_LARGE = 1024  # numbers: a larger array that is made of fewer numbers is computed where it is needed

# By the name of the compiled function.
_FORMS: dict[str, Callable[..., Sequence[Any]]] = {
    "spiral_conv": lambda x, kernel, *tables: [onnx_forms.spiral_conv(x, kernel, Stencil(*tables))],
    "strain": lambda moved, neutral, *tables: onnx_forms.strain(moved, neutral, VertexTriangles(*tables)),
    "elu": lambda x, *_: [onnx_forms.elu(x)],
}


def evaluate(closed: core.ClosedJaxpr, inputs: Sequence[Any]) -> list[Any]:
    """Return the outputs of a traced function for inputs, which may be traced; sizes may be symbols of `jax.export`."""
    return _evaluate(closed.jaxpr, closed.consts, inputs)


def _evaluate(jaxpr: Any, consts: Sequence[Any], inputs: Sequence[Any]) -> list[Any]:
    values: dict[Any, Any] = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*consts, *inputs], strict=True))

    def read(atom: Any) -> Any:
        return atom.val if isinstance(atom, core.Literal) else values[atom]

    for equation in jaxpr.eqns:
        found = _equation(equation, [read(atom) for atom in equation.invars])
        values.update(zip(equation.outvars, found, strict=True))
    return [read(atom) for atom in jaxpr.outvars]


def _equation(equation: Any, inputs: list[Any]) -> Sequence[Any]:
    name, params = equation.primitive.name, equation.params
    if _is_constant(equation, inputs):
        with jax.ensure_compile_time_eval():
            return _bind(equation, inputs)
    if name in _IDENTITIES or (name in _UNCHANGED and np.shape(inputs[0]) == equation.outvars[0].aval.shape):
        return inputs
    if name == "concatenate":
        # ONNX Runtime does not infer the shapes of empty arrays, such as those of a padding by nothing.
        filled = [value for value in inputs if 0 not in np.shape(value)]
        return [jax.lax.concatenate(filled, params["dimension"])] if filled else _bind(equation, inputs)
    if name in _INLINED:
        form = _FORMS.get(params.get("name", ""))
        return _inline(params[_INLINED[name]], inputs) if form is None else form(*inputs)
    if name == "cond" and not isinstance(inputs[0], Tracer):
        return _inline(params["branches"][int(inputs[0])], inputs[1:])
    if name == "scan":
        return _scan(params, inputs)
    if name == "gather" and (window := _window(params, inputs)) is not None:
        return [window]
    return _bind(equation, inputs)


def _bind(equation: Any, inputs: list[Any]) -> Sequence[Any]:
    found = equation.primitive.bind(*inputs, **equation.primitive.get_bind_params(equation.params))
    return found if equation.primitive.multiple_results else [found]


def _inline(closed: Any, inputs: Sequence[Any]) -> list[Any]:
    # Some primitives hold a closed jaxpr, others an open one without constants.
    return evaluate(closed, inputs) if hasattr(closed, "consts") else _evaluate(closed, (), inputs)


def _scan(params: dict[str, Any], inputs: list[Any]) -> Sequence[Any]:
    fixed, carried = params["num_consts"], params["num_carry"]
    constants, start, rows = inputs[:fixed], inputs[fixed : fixed + carried], inputs[fixed + carried :]

    def advance(carry: Sequence[Any], row: Sequence[Any]) -> tuple[list[Any], list[Any]]:
        found = evaluate(params["jaxpr"], [*constants, *carry, *row])
        return found[:carried], found[carried:]

    length = params["length"]
    if not export.is_symbolic_dim(length) and length == 1:
        carry, made = advance(start, [row[0] for row in rows])
        return [*carry, *(jnp.asarray(one)[None] for one in made)]
    # The length is that of the rows; `scan` takes no symbolic one.
    carry, made = jax.lax.scan(advance, start, rows, length=None if rows else int(length), reverse=params["reverse"])
    return [*carry, *made]


def _window(params: dict[str, Any], inputs: list[Any]) -> Any | None:
    """Return a gather of one window at constant indices as a slice, whose sizes may be symbolic; None: of others."""
    (x, indices), axes = inputs, params["dimension_numbers"]
    if isinstance(indices, Tracer) or np.ndim(indices) != 1 or axes.operand_batching_dims:
        return None
    start = [0] * x.ndim
    for axis, index in zip(axes.start_index_map, np.asarray(indices), strict=True):
        start[axis] = int(index)
    stop = [first + size for first, size in zip(start, params["slice_sizes"], strict=True)]
    return jnp.squeeze(jax.lax.slice(x, start, stop), axes.collapsed_slice_dims)


def _is_constant(equation: Any, inputs: Sequence[Any]) -> bool:
    """Return whether an equation is computed at once: on constants, unless it makes a large array of few numbers."""
    if equation.primitive.name == "dim_as_value" or any(isinstance(value, Tracer) for value in inputs):
        return False
    shapes = [variable.aval.shape for variable in equation.outvars]
    if any(export.is_symbolic_dim(size) for shape in shapes for size in shape):
        return False
    made = max((math.prod(shape) for shape in shapes), default=0)
    return made <= max([_LARGE, *(np.size(value) for value in inputs)])
