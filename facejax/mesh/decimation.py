"""Mesh decimation to a subset of the vertices, and upsampling back to the full mesh.

`decimate` merges vertices by quadric edge collapse (Garland and Heckbert 1997, fast-simplification) and
keeps of every merged group the member nearest to the position of the merged vertex. `upsampling` expresses every
fine vertex as a barycentric combination of three coarse ones.
"""

from __future__ import annotations

import fast_simplification
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float32, Int32, Integer, Real

from facejax.geometry.precision import HIGHEST
from facejax.geometry.sphere import AnyArray
from facejax.mesh import closest_point, graph


def decimate(
    vertices: Real[np.ndarray, "N 3"], faces: Integer[np.ndarray, "F 3"], factor: float
) -> tuple[Int32[np.ndarray, " M"], Int32[np.ndarray, "G 3"], Int32[np.ndarray, " N"]]:
    """Decimate a mesh of N vertices to about N / factor.

    Returns:
      the kept vertices (M,), faces (G, 3) over them, and the kept vertex (N,) that each vertex merges into; int32.

    Raises:
      ValueError: the mesh cannot be decimated by that factor.
    """
    if factor <= 1:
        raise ValueError(f"factor: expected more than 1, got {factor}")
    # The library's error thresholds are absolute: vertices are scaled to mean edge length 1, so that the result does
    # not depend on the unit.
    pairs = graph.edges(faces)
    scaled = vertices / np.mean(np.linalg.norm(vertices[pairs[:, 0]] - vertices[pairs[:, 1]], axis=1))
    reduction = 1 - 1 / factor
    collapses = fast_simplification.simplify(scaled, faces, target_reduction=reduction, return_collapses=True)[-1]
    points, coarse, group = fast_simplification.replay_simplification(scaled, faces, collapses)
    if len(coarse) == 0 or len(points) > 0.9 * len(vertices):
        raise ValueError(
            f"a mesh of {len(vertices)} vertices and {len(faces)} faces cannot be decimated by a factor of {factor}; "
            "use a smaller factor, or a finer mesh"
        )
    # The member nearest to its group's new position, the first of equals: sort by (group, distance).
    distance = np.linalg.norm(scaled - points[group], axis=1)
    order = np.lexsort((distance, group))
    members = order[np.flatnonzero(np.diff(group[order], prepend=-1))]
    used = np.unique(coarse)
    rank = np.full(len(points), -1)
    kept = np.sort(members[used])
    rank[used] = np.searchsorted(kept, members[used])
    return kept.astype(np.int32), rank[coarse].astype(np.int32), rank[group].astype(np.int32)


def upsampling(
    vertices: Real[np.ndarray, "N 3"], coarse: Real[np.ndarray, "M 3"], faces: Integer[np.ndarray, "G 3"]
) -> tuple[Int32[np.ndarray, "N 3"], Float32[np.ndarray, "N 3"]]:
    """Return corners (N, 3) int32 and barycentric weights (N, 3) float32 of the closest points on a coarse mesh.

    `upsample` applies them to values of the coarse mesh; the decoders' spiral convolutions include that step.
    Weights lie in [0, 1] and sum to 1. A vertex that is a coarse vertex has weights 1, 0, 0 in some order. The search
    is exact: a triangle is skipped only if its bounding sphere lies beyond a point already found. Of equally near
    triangles the first is taken, so that the tables of a hierarchy are reproducible.
    """
    triangles = coarse[faces]
    centre = triangles.mean(axis=1)
    radius = np.linalg.norm(triangles - centre[:, None], axis=2).max(axis=1)
    corners = np.empty((len(vertices), 3), np.int32)
    weights = np.empty((len(vertices), 3), np.float32)
    for start in range(0, len(vertices), 256):  # 256 x G distances at a time
        points = vertices[start : start + 256]
        to_centre = np.linalg.norm(points[:, None] - centre, axis=2)
        reach = np.min(to_centre + radius, axis=1, keepdims=True)
        row, triangle = np.nonzero(to_centre - radius <= reach * (1 + 1e-9))
        found = closest_point.barycentric(points[row], triangles[triangle])
        distance = np.linalg.norm(np.einsum("pc,pcx->px", found, triangles[triangle]) - points[row], axis=1)
        order = np.lexsort((distance, row))
        best = order[np.flatnonzero(np.diff(row[order], prepend=-1))]
        corners[start : start + 256] = faces[triangle[best]]
        weights[start : start + 256] = found[best]
    # Weights of 1e-16 are rounding errors; without them a kept vertex maps to itself exactly.
    weights[weights < 1e-6] = 0
    return corners, weights / weights.sum(axis=1, keepdims=True)


@jax.jit
def upsample(
    values: Float[AnyArray, "*lead M C"], corners: Integer[AnyArray, "N 3"], weights: Float[AnyArray, "N 3"]
) -> Float[Array, "*lead N C"]:
    """Upsample values (..., M, C) of a coarse mesh, such as a decoder's features, to the N vertices of the fine one.

    `corners` and `weights` are those of `upsampling`, or of a level of `facejax.mesh.hierarchy`.
    """
    return jnp.einsum(
        "nk,...nkc->...nc", jnp.asarray(weights), jnp.asarray(values)[..., jnp.asarray(corners), :], precision=HIGHEST
    )
