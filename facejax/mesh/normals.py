"""Normals and areas of triangles, as array functions whose values and gradients are finite for every triangle."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from facejax.geometry.sphere import root


def normals(first: jax.Array, second: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Unit normals (..., 3) and double areas (..., 1) of triangles with edges (..., 3) from one corner.

    Both 0 where there is no area: less than rounding leaves of a product of two edges, in float32 a triangle ten
    million times as long as high.
    """
    normal = jnp.cross(first, second)
    double = length(normal)
    eps = jnp.finfo(normal.dtype).eps
    unit = direction(normal, double, eps * jnp.sum(first * first + second * second, axis=-1, keepdims=True))
    return unit, jnp.where(jnp.any(unit != 0, axis=-1, keepdims=True), double, 0)


def direction(vectors: jax.Array, size: jax.Array, least: jax.Array) -> jax.Array:
    """Vectors (..., 3) over their `length`, `size` (..., 1); 0 where that is no more than `least`."""
    limits = jnp.finfo(vectors.dtype)
    # Squares of shorter ones are too small a number for all digits.
    kept = (size > least) & (size > (limits.tiny / limits.eps) ** 0.5)
    return jnp.where(kept, vectors / jnp.where(kept, size, 1), 0)


def length(vectors: jax.Array) -> jax.Array:
    """The norm (..., 1) of vectors (..., 3), with gradient 0 at 0."""
    return root(jnp.sum(vectors * vectors, axis=-1, keepdims=True))
