"""Normals of triangles and vertices.

N vertices, F triangles whose corners run counter-clockwise seen from outside. `triangle_normals` and `vertex_normals`
are JAX functions, finite in value and gradient for every triangle. `vertex_normals_host` is the NumPy form, for code
that meets a new mesh with every call and would compile anew each time. Both take the sum of the adjacent triangles'
normals weighted by area, and return 0 where that sum has no direction.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Integer

from facejax.geometry.sphere import AnyArray, safe_sqrt

SHORTEST = 1e-20  # a sum of normals times double areas that is no longer has no direction, in the unit squared


@jax.jit
def vertex_normals(
    vertices: Float[AnyArray, "*lead N 3"], faces: Integer[AnyArray, "F 3"]
) -> Float[Array, "*lead N 3"]:
    """Return the area-weighted unit normals (..., N, 3) of vertices (..., N, 3) with triangles (F, 3); differentiable.

    A normal is 0 where the adjacent triangles have no area, where their normals cancel to rounding, and at a vertex
    without a triangle.
    """
    a, b, c = (vertices[..., faces[:, corner], :] for corner in range(3))
    normal, double = triangle_normals(b - a, c - a)
    parts = jnp.concatenate([double * normal, double], axis=-1)
    total = jnp.zeros((*vertices.shape[:-1], 4), vertices.dtype)
    for corner in range(3):
        total = total.at[..., faces[:, corner], :].add(parts)
    mean, area = total[..., :3], total[..., 3:]
    # The rounding error of a sum that cancels has no meaningful direction.
    return unit_or_zero(mean, norm(mean), jnp.finfo(mean.dtype).eps * area)


def vertex_normals_host(
    vertices: Float[np.ndarray, "*lead N 3"], faces: Integer[np.ndarray, "F 3"]
) -> Float[np.ndarray, "*lead N 3"]:
    """Return the unit normals (..., N, 3) of vertices (..., N, 3), float32 or float64, in their dtype; see the module.

    Edges are computed in the dtype of the vertices, products and sums in float64. A normal is 0 where the sum of the
    adjacent normals times double areas is no longer than `SHORTEST`.
    """
    points = vertices.shape[-2]
    owner = faces.T.ravel()
    total = np.empty(vertices.shape, vertices.dtype)
    for frame in np.ndindex(vertices.shape[:-2]):
        a, b, c = np.take(vertices[frame], faces.T, axis=0)
        face = _cross(b - a, c - a)
        for axis in range(3):
            total[(*frame, slice(None), axis)] = np.bincount(owner, np.tile(face[axis], 3), points)
    length = np.sqrt(np.einsum("...a,...a->...", total, total))[..., None]
    return np.where(length > SHORTEST, total / np.maximum(length, SHORTEST), np.zeros((), total.dtype))


def triangle_normals(
    first: Float[AnyArray, "*lead 3"], second: Float[AnyArray, "*lead 3"]
) -> tuple[Float[Array, "*lead 3"], Float[Array, "*lead 1"]]:
    """Return unit normals (..., 3) and double areas (..., 1) of triangles with edges (..., 3) from one corner.

    Both are 0 where the area is below the rounding error of a product of two edges: in float32, for a triangle ten
    million times as long as high.
    """
    normal = jnp.cross(first, second)
    double = norm(normal)
    eps = jnp.finfo(normal.dtype).eps
    unit = unit_or_zero(normal, double, eps * jnp.sum(first * first + second * second, axis=-1, keepdims=True))
    return unit, jnp.where(jnp.any(unit != 0, axis=-1, keepdims=True), double, 0)


def unit_or_zero(
    vectors: Float[Array, "*lead 3"], size: Float[Array, "*lead 1"], least: ArrayLike
) -> Float[Array, "*lead 3"]:
    """Return vectors (..., 3) divided by their `norm`, `size` (..., 1); 0 where the size is at most `least`."""
    limits = jnp.finfo(vectors.dtype)
    # The squares of shorter vectors are denormal numbers, which have lost digits.
    kept = (size > least) & (size > (limits.tiny / limits.eps) ** 0.5)
    return jnp.where(kept, vectors / jnp.where(kept, size, 1), 0)


def norm(vectors: Float[Array, "*lead 3"]) -> Float[Array, "*lead 1"]:
    """Return the norm (..., 1) of vectors (..., 3), with gradient 0 at 0."""
    return safe_sqrt(jnp.sum(vectors * vectors, axis=-1, keepdims=True))


def _cross(u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the coordinates of u x v in float64; `np.cross` works on the short axis and takes ten times as long."""
    (a, b, c), (x, y, z) = u.T.astype(np.float64), v.T.astype(np.float64)
    return b * z - c * y, c * x - a * z, a * y - b * x
