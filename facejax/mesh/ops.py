"""Array operations on meshes of fixed connectivity: spiral convolution, upsampling, normals.

V vertices, M coarse vertices, B samples, C channels in, O channels out, S spiral positions. Signals are (V, B, C): the
batch lies inside, so that one gathered row is B * C contiguous numbers.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from facejax.mesh.stencils import Stencil


def spiral_conv(x: jax.Array, kernel: jax.Array, stencil: Stencil) -> jax.Array:
    S, C, O = kernel.shape
    M, B, _ = x.shape
    if O < 8 <= B:
        y = jax.lax.dot_general(kernel.transpose(0, 2, 1).reshape(S*O, C), x.reshape(M*B, C), (((1,), (1,)), ((), ())))
        return jnp.transpose(gather_sum(list(y.reshape(S, O, M, B)), stencil, axis=1), (1, 2, 0))
    rows = x.reshape(M*B, C)
    ys = [(rows @ k).reshape(M, B * O) for k in kernel]
    return gather_sum(ys, stencil, axis=0).reshape(-1, B, O)


def gather_sum(ys, stencil, axis):
    (out,) = _stencil_p.bind(*ys, *stencil, axis=axis, adjoint=False)
    return out


_TABLES = len(Stencil._fields)
_stencil_p = Primitive("stencil")
_stencil_p.multiple_results = True


def _take(x, index, axis):
    return x.at[(slice(None),) * axis + (index,)].get(mode="promise_in_bounds")


def _column(weight, x, axis):
    return weight.reshape((-1,) + (1,) * (x.ndim - axis - 1)).astype(x.dtype)


def _apply(*args, axis, adjoint):
    xs, t = args[:-_TABLES], Stencil(*args[-_TABLES:])
    if not adjoint:
        return [sum(
            _column(t.weight[s, k], x, axis) * _take(x, t.source[s, k], axis)
            for s, x in enumerate(xs) for k in range(t.source.shape[1])
        )]
    (g,) = xs
    out = []
    for s in range(t.back.shape[0]):
        y = sum(_column(t.back_weight[s, j], g, axis) * _take(g, t.back[s, j], axis) for j in range(t.back.shape[1]))
        if t.rest_to.shape[1]:
            rest = _column(t.rest_weight[s], g, axis) * _take(g, t.rest_from[s], axis)
            y = y.at[(slice(None),) * axis + (t.rest_to[s],)].add(rest, mode="promise_in_bounds")
        out.append(y)
    return out


def _abstract(*args, axis, adjoint):
    xs, t = args[:-_TABLES], Stencil(*args[-_TABLES:])
    shape = list(xs[0].shape)
    shape[axis] = (t.back if adjoint else t.source).shape[2]
    return [xs[0].update(shape=tuple(shape))] * (t.back.shape[0] if adjoint else 1)


def _jvp(primals, tangents, **options):
    xs, tables = primals[:-_TABLES], primals[-_TABLES:]
    slopes = [ad.instantiate_zeros(slope) for slope in tangents[:-_TABLES]]
    return _stencil_p.bind(*xs, *tables, **options), _stencil_p.bind(*slopes, *tables, **options)


def _transpose(cotangents, *args, axis, adjoint):
    tables = args[-_TABLES:]
    cotangents = [ad.instantiate_zeros(c) for c in cotangents]
    return _stencil_p.bind(*cotangents, *tables, axis=axis, adjoint=not adjoint) + [None] * _TABLES


_stencil_p.def_impl(jax.jit(_apply, static_argnames=("axis", "adjoint")))
_stencil_p.def_abstract_eval(_abstract)
ad.primitive_jvps[_stencil_p] = _jvp
ad.primitive_transposes[_stencil_p] = _transpose
mlir.register_lowering(_stencil_p, mlir.lower_fun(_apply, multiple_results=True))
