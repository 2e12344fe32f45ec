"""Spiral convolution and strain in operations that ONNX has, for one sample; equal to facejax's up to rounding.

ONNX Runtime does not fuse: it writes the result of every operation to memory, and is slow where the last axis is short.
So there are few operations, and triangles or channels come last. The forms are used by `facejax.export.plain_jaxpr`.

V vertices out, M vertices in, C channels in, O channels out, S spiral positions, K vertices read per position; N
vertices, F triangles.
"""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import batching, mlir
from jaxtyping import Array, Float

from facejax.mesh import normals
from facejax.mesh.stencils import Stencil
from facejax.mesh.strain import VertexTriangles

TAKE, ELU = "facejax_take", "facejax_elu"  # names of primitives
_OPERATORS = {TAKE: "Gather", ELU: "Elu"}


def take(x: Any, index: np.ndarray, *, axis: int) -> jax.Array:
    """Return `jnp.take` of constant indices (n,), not checked, as one primitive: a Gather of ONNX."""
    return _take_p.bind(jnp.asarray(x), jnp.asarray(index, jnp.int32), axis=axis)


def elu(x: Any) -> jax.Array:
    """Return `jax.nn.elu` as one primitive: an Elu of ONNX."""
    return _elu_p.bind(jnp.asarray(x))


def spiral_conv(x: Float[Array, "M 1 C"], kernel: Float[Array, "S C O"], stencil: Stencil) -> Float[Array, "V 1 O"]:
    """Return `facejax.mesh.spiral_conv.spiral_conv` by one gather of all positions and one product.

    The stencil must be constant. Raises `ValueError` for more than one sample.
    """
    if x.shape[1] != 1:
        raise ValueError(f"x: expected one sample, (M, 1, C), got {x.shape}")
    positions, channels, outputs = kernel.shape
    signal, index = _upsample(x[:, 0], np.asarray(stencil.source), np.asarray(stencil.weight))
    rows = take(signal, index.reshape(-1), axis=0).reshape(len(index), positions * channels)
    return (rows @ jnp.reshape(kernel, (positions * channels, outputs)))[:, None]


def strain(
    displacements: Float[Array, "N 1 3"], neutral: Float[Array, "N 1 3"], tables: VertexTriangles
) -> tuple[Float[Array, "N 1 6"], Float[Array, "N 1 3"]]:
    """Return `facejax.mesh.strain.strain` with the triangles as the last axis; the tables must be constant."""
    faces, about = np.asarray(tables.faces), np.asarray(tables.about)
    count = jnp.asarray(np.asarray(tables.count))
    a, b, c = take(neutral[:, 0], faces.T.reshape(-1), axis=0).reshape(3, -1, 3)
    normal, double = normals.triangle_normals(b - a, c - a)
    over = jnp.where(double > 0, 1 / jnp.where(double > 0, double, 1), 0)
    duals = (jnp.cross(c - a, normal) * over).T, (jnp.cross(normal, b - a) * over).T
    corners = take(displacements[:, 0].T, faces.T.reshape(-1), axis=1).reshape(3, 3, -1)
    edges = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    slope = edges[0][:, None] * duals[0] + edges[1][:, None] * duals[1]
    upward = normal.T
    along = upward[0] * slope[0] + upward[1] * slope[1] + upward[2] * slope[2]
    within = slope - upward[:, None] * along
    squared = sum(slope[i][:, None] * slope[i] for i in range(3))
    green = 0.5 * (within + jnp.swapaxes(within, 0, 1) + squared)
    six = jnp.stack([green[i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))])
    mean = _about(six, about) / count
    lean = (_about(normal.T, about) / count).T
    upward = normals.unit_or_zero(lean, normals.norm(lean), jnp.finfo(lean.dtype).eps)[:, None]
    # The normals do not depend on the displacements. Added to zeros that do, they get the batch axis under `vmap` by an
    # addition: jax2onnx takes a wrong size for an axis that is broadcast otherwise.
    return mean.T[:, None], upward + 0 * displacements


def register() -> None:
    """Tell jax2onnx the operators of the primitives."""
    system = importlib.import_module("jax2onnx.plugins.plugin_system")
    for primitive, operator in _OPERATORS.items():
        if primitive in system.PLUGIN_REGISTRY:
            continue

        class Plugin(system.PrimitiveLeafPlugin):
            _operator = operator

            def lower(self, ctx: Any, eqn: Any) -> None:
                inputs = [ctx.get_value_for_var(v, name_hint=ctx.fresh_name("input")) for v in eqn.invars]
                like = ctx.get_value_for_var(eqn.outvars[0], name_hint=ctx.fresh_name("output"))
                made = getattr(ctx.builder, self._operator)(*inputs, _outputs=[like.name], **eqn.params)
                made.type, made.shape = like.type, like.shape
                ctx.bind_value_for_var(eqn.outvars[0], made)

        system.register_primitive(
            jaxpr_primitive=primitive, jax_doc="", onnx=[], since="", context="primitives.facejax", component=primitive,
            testcases=[],
        )(Plugin)  # fmt: skip


def _about(values: Array, about: np.ndarray) -> Array:
    """Return the sum (k, N) of values (k, F) over the triangles about each vertex."""
    padded = jnp.concatenate([values, jnp.zeros_like(values[:, :1])], axis=1)
    return jnp.sum(take(padded, about.T.reshape(-1), axis=1).reshape(len(values), *about.T.shape), axis=1)


def _upsample(x: Array, source: np.ndarray, weight: np.ndarray) -> tuple[Array, np.ndarray]:
    """Return an upsampled signal (U, C), each distinct vertex once, and the index (V, S) of each spiral position."""
    slots, vertices = source.shape[1:]
    if slots == 1 and np.isin(weight, (0, 1)).all():
        index = np.where(weight[:, 0] == 1, source[:, 0], len(x)).T
        return jnp.concatenate([x, jnp.zeros_like(x[:1])]), index
    pairs = np.concatenate([source, weight.view(np.int32)], axis=1).transpose(2, 0, 1).reshape(-1, 2 * slots)
    kept, index = np.unique(pairs, axis=0, return_inverse=True)
    sources = np.ascontiguousarray(kept[:, :slots])
    weights = np.ascontiguousarray(kept[:, slots:]).view(np.float32)
    parts = [take(x, sources[:, k], axis=0) * jnp.asarray(weights[:, k, None], x.dtype) for k in range(slots)]
    return sum(parts[1:], parts[0]), index.reshape(vertices, -1)


_take_p = Primitive(TAKE)


def _take(x: Array, index: Array, *, axis: int) -> Array:
    return jnp.take(x, index, axis=axis, mode="clip")


def _abstract(x: ShapedArray, index: ShapedArray, *, axis: int) -> ShapedArray:
    return x.update(shape=(*x.shape[:axis], *index.shape, *x.shape[axis + 1 :]))


def _batch(arguments: Sequence[Any], axes: Sequence[Any], *, axis: int) -> tuple[Array, int]:
    x, index = arguments
    if axes[1] is not None:
        raise ValueError("vmap over the indices of a gather: expected constant indices")
    return _take_p.bind(jnp.moveaxis(x, axes[0], 0), index, axis=axis + 1), 0


_take_p.def_impl(jax.jit(_take, static_argnames="axis"))
_take_p.def_abstract_eval(_abstract)
batching.primitive_batchers[_take_p] = _batch
mlir.register_lowering(_take_p, mlir.lower_fun(_take, multiple_results=False))

_elu_p = Primitive(ELU)
_elu_p.def_impl(jax.nn.elu)
_elu_p.def_abstract_eval(lambda x: x)
batching.defvectorized(_elu_p)
mlir.register_lowering(_elu_p, mlir.lower_fun(jax.nn.elu, multiple_results=False))
