"""Spiral convolution on meshes of fixed connectivity, with upsampling.

V vertices out, M vertices in, B samples, C channels in, O channels out, S spiral positions, K vertices
read per position. Signals are (V, B, C), the batch inside, so that one gathered row is B * C contiguous
numbers.

Measurements behind the implementation (batch 16, 3,260 vertices, one core of a Xeon; ms of the decoder,
forward / gradient): gathering (V, S * C) blocks and multiplying them 340 / 342; multiplying first, per
position, and gathering sums 14 / 60. Upsampling and multiplication commute, so the product is taken on
the coarse side: a quarter of the arithmetic. The transposed gather of the finest upsampling takes 19 ms
as a scatter, 5 ms by inverse lists. Written out position by position, XLA fuses the producer of the
gradient into each of some 300 gathers (387 ms, 36 s to compile); a scan keeps it in memory and compiles
in a second or two. This holds for a CPU and whole batches. On a GPU the scan's many small kernels
dominate (H200: 0.76 / 2.1 ms), and all positions at once are faster (0.43 / 0.82 ms).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax import export
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array, Float

from facejax.geometry.sphere import AnyArray
from facejax.mesh.stencils import Stencil

# With few output channels the products of all positions are one matrix product, with the batch as the
# innermost axis: 1.3 ms for 16 -> 3 channels instead of 3.7. From 8 channels on, rows of B * O
# numbers are faster.
_FEW_CHANNELS = 8
# On a CPU, all positions at once while their products (S * M * B * O numbers) fit in the cache, as for single frames
# (5,041 vertices: 1.0 ms instead of 1.5).
_AT_ONCE = 400_000
# On other platforms up to this many gathers are unrolled; beyond, one gather and a sum, which a GPU's compiler fuses.
# A CPU's does not, and writes all gathered rows to memory: the decoder's gradient took 77 ms instead of 25.
_FEW_LISTS = 8


@jax.jit
def spiral_conv(
    x: Float[AnyArray, "M B C"], kernel: Float[AnyArray, "S C O"], stencil: Stencil
) -> Float[Array, "V B O"]:
    """Return the spiral convolution (V, B, O) of x (M, B, C) with kernel (S, C, O).

    out[v] = sum_s (upsampled x)[spiral[v, s]] @ kernel[s], where the stencil combines upsampling from a coarse mesh
    (barycentric, linear) and spirals (Bouritsas et al. 2019, eq 3; Lim et al. 2018). No bias. Raises `ValueError` on
    shapes that do not fit.
    """
    positions, channels, out_channels = kernel.shape
    count, batch, _ = x.shape
    if x.ndim != 3 or x.shape[2] != channels:
        raise ValueError(f"x: expected (M, B, {channels}) to fit the kernel {kernel.shape}, got {x.shape}")
    if stencil.source.shape[0] != positions or stencil.back.shape[2] != count:
        expected = (stencil.source.shape[0], stencil.back.shape[2])
        raise ValueError(
            f"stencil: has {expected} (positions, vertices), expected {(positions, count)} of kernel and x"
        )
    # A symbolic batch (`jax.export`) counts as large.
    if not export.is_symbolic_dim(batch) and positions * count * batch * out_channels <= _AT_ONCE:
        return spiral_conv_at_once(x, kernel, stencil)
    return jax.lax.platform_dependent(x, kernel, stencil, cpu=spiral_conv_by_position, default=spiral_conv_at_once)


@jax.jit
def spiral_conv_by_position(
    x: Float[AnyArray, "M B C"], kernel: Float[AnyArray, "S C O"], stencil: Stencil
) -> Float[Array, "V B O"]:
    """Compute `spiral_conv` one position after another, so that the gathered array stays in a CPU's cache.

    Memory for M * B * O numbers. `spiral_conv` takes this form on a CPU, except for small inputs.
    """
    positions, channels, out_channels = kernel.shape
    count, batch, _ = x.shape
    rows = jnp.reshape(x, (count * batch, channels))
    if out_channels < _FEW_CHANNELS and (export.is_symbolic_dim(batch) or batch >= _FEW_CHANNELS):
        flat_kernel = kernel.transpose(0, 2, 1).reshape(positions * out_channels, channels)
        planes = jax.lax.dot_general(flat_kernel, rows, (((1,), (1,)), ((), ())))
        planes = planes.reshape(positions, out_channels, count, batch)
        summed = _sum_positions(lambda plane: plane, planes, stencil, axis=1)
        return jnp.transpose(summed, (1, 2, 0))
    summed = _sum_positions(
        lambda weight: (rows @ weight).reshape(count, batch * out_channels), jnp.asarray(kernel), stencil, axis=0
    )
    return summed.reshape(stencil.source.shape[2], batch, out_channels)


@jax.jit
def spiral_conv_at_once(
    x: Float[AnyArray, "M B C"], kernel: Float[AnyArray, "S C O"], stencil: Stencil
) -> Float[Array, "V B O"]:
    """Compute `spiral_conv` as one product and one gathered sum over all positions: few large kernels for a GPU.

    Memory for S * M * B * O numbers. `spiral_conv` takes this form on accelerators, and on a CPU for small inputs.
    """
    positions, channels, out_channels = kernel.shape
    count, batch, _ = x.shape
    flat_kernel = kernel.transpose(1, 0, 2).reshape(channels, positions * out_channels)
    products = (x.reshape(count * batch, channels) @ flat_kernel).reshape(count, batch, positions, out_channels)
    products = products.transpose(0, 2, 1, 3).reshape(count * positions, batch * out_channels)
    summed = _stencil_p.bind(products, *_joined(stencil), axis=0, transposed=False)
    return summed.reshape(stencil.source.shape[2], batch, out_channels)


def _joined(stencil: Stencil) -> Stencil:
    """Return the maps of all positions as one map, without the axis S, from M * S rows ordered by vertex."""
    positions, vertices = len(stencil.source), stencil.source.shape[2]
    position = jnp.arange(positions)[:, None]
    return Stencil(
        (stencil.source * positions + position[:, None]).reshape(-1, vertices),
        stencil.weight.reshape(-1, vertices),
        _by_vertex(stencil.back),
        _by_vertex(stencil.back_weight),
        stencil.rest_from.reshape(-1),
        (stencil.rest_to * positions + position).reshape(-1),
        stencil.rest_weight.reshape(-1),
    )


def _by_vertex(table: AnyArray) -> AnyArray:
    """Reshape (S, J, M) to (J, M * S)."""
    positions, slots, vertices = table.shape
    return table.transpose(1, 2, 0).reshape(slots, vertices * positions)


def _sum_positions(
    make: Callable[[jax.Array], jax.Array], inputs: jax.Array, stencil: Stencil, *, axis: int
) -> jax.Array:
    """Return the sum over positions s of stencil_s @ make(inputs[s]), with the vertices along `axis`."""
    one = jax.eval_shape(make, inputs[0])
    shape = one.shape[:axis] + stencil.source.shape[2:] + one.shape[axis + 1 :]

    def add(total: jax.Array, position: tuple[jax.Array, Stencil]) -> tuple[jax.Array, None]:
        data, tables = position
        return total + _stencil_p.bind(make(data), *tables, axis=axis, transposed=False), None

    return jax.lax.scan(add, jnp.zeros(shape, one.dtype), (inputs, stencil))[0]


# One position's sparse map as a primitive: linear in its first operand, its transpose is the same primitive with
# `transposed`. So forward mode, reverse mode and vmap all exist; a custom_vjp would lose forward mode.
_stencil_p = Primitive("stencil")


def _apply(x: AnyArray, *tables: AnyArray, axis: int, transposed: bool) -> jax.Array:
    t = Stencil(*tables)
    if not transposed:
        return _gather(x, t.source, t.weight, axis)
    total = _gather(x, t.back, t.back_weight, axis)
    rest = _weigh(t.rest_weight, _take(x, t.rest_from, axis), axis)
    place = total.at[(slice(None),) * axis + (t.rest_to,)]
    return place.add(rest, mode="promise_in_bounds", wrap_negative_indices=False)


def _gather(x: AnyArray, index: AnyArray, weight: AnyArray, axis: int) -> jax.Array:
    """Return the sum over k of weight[k] x[index[k]]."""

    def one_by_one(x: AnyArray, index: AnyArray, weight: AnyArray) -> jax.Array:
        return jnp.asarray(sum(_weigh(w, _take(x, i, axis), axis) for i, w in zip(index, weight, strict=True)))

    def at_once(x: AnyArray, index: AnyArray, weight: AnyArray) -> jax.Array:
        return jnp.sum(_weigh(weight, _take(x, index, axis), axis), axis=axis)

    if len(index) <= _FEW_LISTS:
        return one_by_one(x, index, weight)
    return jax.lax.platform_dependent(x, index, weight, cpu=one_by_one, default=at_once)


def _take(x: AnyArray, index: AnyArray, axis: int) -> jax.Array:
    place = jnp.asarray(x).at[(slice(None),) * axis + (index,)]
    return place.get(mode="promise_in_bounds", wrap_negative_indices=False)


def _weigh(weight: AnyArray, x: jax.Array, axis: int) -> jax.Array:
    return jnp.asarray(weight).astype(x.dtype).reshape(weight.shape + (1,) * (x.ndim - axis - weight.ndim)) * x


def _abstract(x: ShapedArray, *tables: ShapedArray, axis: int, transposed: bool) -> ShapedArray:
    source, _, back, *_ = tables
    shape = list(x.shape)
    shape[axis] = (back if transposed else source).shape[1]
    return x.update(shape=tuple(shape))


def _jvp(primals: Sequence[Any], tangents: Sequence[Any], **options: Any) -> tuple[jax.Array, jax.Array]:
    x, *tables = primals
    slope = ad.instantiate_zeros(tangents[0])
    return _stencil_p.bind(x, *tables, **options), _stencil_p.bind(slope, *tables, **options)


def _transpose(cotangent: Any, _: Any, *tables: jax.Array, axis: int, transposed: bool) -> list[jax.Array | None]:
    back = _stencil_p.bind(ad.instantiate_zeros(cotangent), *tables, axis=axis, transposed=not transposed)
    return [back, *[None] * len(tables)]


def _batch(arguments: Sequence[jax.Array], axes: Sequence[Any], **options: Any) -> tuple[jax.Array, int]:
    x, *tables = arguments
    if any(a is not None for a in axes[1:]):
        raise ValueError("vmap over the tables of a hierarchy: expected one hierarchy for the whole batch")
    x = jnp.moveaxis(x, axes[0], -1)
    return _stencil_p.bind(x, *tables, **options), x.ndim - 1


_stencil_p.def_impl(jax.jit(_apply, static_argnames=("axis", "transposed")))
_stencil_p.def_abstract_eval(_abstract)
ad.primitive_jvps[_stencil_p] = _jvp
ad.primitive_transposes[_stencil_p] = _transpose
batching.primitive_batchers[_stencil_p] = _batch
mlir.register_lowering(_stencil_p, mlir.lower_fun(_apply, multiple_results=False))
