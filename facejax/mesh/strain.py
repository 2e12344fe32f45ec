"""Green strain of a displacement at every vertex, and the vertex normals.

The Green strain of a displacement u on each triangle, E = 1/2 (G + G^T + G^T G) with G the gradient of u in the
triangle's plane, symmetric and invariant to rotation; averaged over the triangles about a vertex. N vertices, F
triangles, B samples, at most W triangles about a vertex. Signals are (N, B, C), the batch inside, as in
`facejax.mesh.spiral_conv`.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float32, Int32, Integer

from facejax.geometry.sphere import AnyArray
from facejax.mesh import normals


class VertexTriangles(NamedTuple):
    """The triangles, and those adjacent to each vertex."""

    faces: Int32[AnyArray, "F 3"]
    about: Int32[AnyArray, "N W"]  # F marks an empty slot
    count: Float32[AnyArray, " N"]  # pyright: ignore[reportIncompatibleMethodOverride]  a field, not tuple's method


def vertex_triangles(faces: Integer[np.ndarray, "F 3"], count: int) -> VertexTriangles:
    """Return the tables of triangles (F, 3) on `count` vertices."""
    owner = np.argsort(faces.ravel(), kind="stable")
    vertex = faces.ravel()[owner]
    sizes = np.bincount(vertex, minlength=count)
    place = np.arange(len(vertex)) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    about = np.full((count, sizes.max()), len(faces), np.int32)
    about[vertex, place] = owner // 3
    return VertexTriangles(np.asarray(faces, np.int32), about, np.maximum(sizes, 1).astype(np.float32))


@jax.jit
def strain(
    displacements: Float[AnyArray, "N B 3"], neutral: Float[AnyArray, "N B 3"], tables: VertexTriangles
) -> tuple[Float[Array, "N B 6"], Float[Array, "N B 3"]]:
    """Return the strain (N, B, 6) of displacements (N, B, 3) of a neutral face (N, B, 3), and its normals (N, B, 3).

    Strain has no unit: 0.1 is an elongation by a tenth; xx, yy, zz, xy, xz, yz in the axes of the mesh. Normals have
    unit length. Both are 0 where the triangles about a vertex have no area. Raises `ValueError` for other shapes.
    """
    if displacements.shape != neutral.shape or neutral.shape[-1] != 3:
        raise ValueError(f"expected two arrays (N, B, 3), got {displacements.shape} and {neutral.shape}")
    a, b, c = (neutral[tables.faces[:, corner]] for corner in range(3))
    moved = [displacements[tables.faces[:, corner]] for corner in range(3)]
    first, second = b - a, c - a
    normal, double = normals.triangle_normals(first, second)
    # The dual basis of the two edges: G = du1 (x) dual1 + du2 (x) dual2.
    over = jnp.where(double > 0, 1 / jnp.where(double > 0, double, 1), 0)
    duals = jnp.cross(second, normal) * over, jnp.cross(normal, first) * over
    slope = sum(
        (corner - moved[0])[..., :, None] * dual[..., None, :] for corner, dual in zip(moved[1:], duals, strict=True)
    )
    slope = jnp.asarray(slope)
    within = slope - normal[..., :, None] * jnp.sum(normal[..., :, None] * slope, axis=-2, keepdims=True)
    squared = jnp.sum(slope[..., :, :, None] * slope[..., :, None, :], axis=-3)
    green = 0.5 * (within + jnp.swapaxes(within, -1, -2) + squared)
    six = [green[..., i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))]
    on_faces = jnp.concatenate([jnp.stack(six, axis=-1), normal], axis=-1)
    padded = jnp.concatenate([on_faces, jnp.zeros_like(on_faces[:1])])
    mean = padded[tables.about].sum(axis=1) / tables.count[:, None, None]
    # The rounding error of normals that cancel has no meaningful direction.
    lean = mean[..., 6:]
    return mean[..., :6], normals.unit_or_zero(lean, normals.norm(lean), jnp.finfo(lean.dtype).eps)
