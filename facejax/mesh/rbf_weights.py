"""RBF weights of landmarks on a face mesh: validity checks, falloff with distance, separation of the lips.

L landmarks, anywhere on a mesh of N vertices and F triangles, in one unit. The spacing of landmarks is their mean
distance to their nearest other; their spread is their root mean square distance to their centroid.

`weights` adapts a warp by `geometry.rbf` to faces. Plain radial functions fail in two places: they extend the jaw's
motion to neck and skull, which `falloff` prevents; and they use distances in space, in which closed lips coincide, so
that skin closes an opening mouth, which `upper_lip_share` prevents. On makehuman4d's validation subjects the two
together reduce the mean error of the head from 0.76 to 0.25 mm, of the face from 0.39 to 0.29 mm and of the rim of the
mouth from 1.20 to 0.59 mm (`experiments.rbf_warp`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Integer, Real
from scipy.spatial import KDTree

from facejax.geometry import rbf
from facejax.geometry.interpolation import smoothstep
from facejax.mesh import decimation, graph

# The upper and the lower lip among iBUG's 68 landmarks; the corners of the mouth belong to both.
IBUG_LIPS = ((*range(49, 54), *range(61, 64)), (*range(55, 60), *range(65, 68)))
OFF_MESH = 0.1  # of the landmarks' spread
REACH = 3.0  # in landmark spacings


def check(landmarks: np.ndarray, vertices: np.ndarray) -> None:
    """Raise `ValueError` where landmarks (L, 3) coincide, or do not lie on the mesh of vertices (N, 3).

    The distance to the nearest vertex may be a tenth of the landmarks' spread or, on a coarse mesh, the distance of
    that vertex to its sixth neighbour.
    """
    landmarks, vertices = _points(landmarks, "landmarks"), _points(vertices, "vertices")
    tree = KDTree(vertices)
    distance, nearest = (np.asarray(found) for found in tree.query(landmarks))
    ring = tree.query(vertices[nearest], k=min(7, len(vertices)))[0].reshape(len(nearest), -1)[:, -1]
    spread = np.sqrt(np.mean(np.sum((landmarks - landmarks.mean(axis=0)) ** 2, axis=1)))
    pairs = KDTree(landmarks).query_pairs(rbf.COINCIDENT * spread)
    if pairs:
        a, b = min(pairs)
        raise ValueError(f"landmarks {a} and {b} coincide at {landmarks[a]}: move one of them")
    limit = np.maximum(OFF_MESH * spread, ring)
    worst = int(np.argmax(distance - limit))
    if distance[worst] > limit[worst]:
        raise ValueError(
            f"landmark {worst} is {distance[worst]:.4g} off the mesh (nearest vertex {nearest[worst]}, allowed "
            f"{limit[worst]:.4g}): check that landmarks and mesh have the same face, unit and coordinate system"
        )


def distant_boundary(
    vertices: Real[np.ndarray, "N 3"],
    faces: Integer[np.ndarray, "F 3"],
    landmarks: Real[np.ndarray, "L 3"],
    *,
    reach: float = REACH,
) -> Integer[np.ndarray, " P"]:
    """Return the boundary vertices (P,) that are farther than `reach` spacings from every landmark (L, 3).

    On a head, the edge of the neck; on a cropped face, the parts of its edge without landmarks. The edges of mouth and
    eyes, along which landmarks lie, are not among them. Empty on a closed mesh.
    """
    landmarks, vertices = _points(landmarks, "landmarks"), _points(vertices, "vertices")
    if len(landmarks) < 2:
        raise ValueError(f"landmarks: expected at least 2, got {len(landmarks)}")
    edge = np.sort(np.concatenate([np.zeros(0, np.int64), *graph.boundary_loops(faces)]))
    tree = KDTree(landmarks)
    spacing = tree.query(landmarks, k=2)[0][:, 1].mean()
    return edge[tree.query(vertices[edge])[0] > reach * spacing]


def falloff(
    vertices: Real[np.ndarray, "N 3"],
    faces: Integer[np.ndarray, "F 3"],
    landmarks: Real[np.ndarray, "L 3"],
    *,
    reach: float = REACH,
) -> Float32[np.ndarray, " N"]:
    """Return factors (N,) float32 in [0, 1] for the rows of `geometry.rbf.weights`, falling with distance to landmarks.

    1 at a landmark (L, 3); 0 where the nearest landmark is as far as from the nearest vertex of the
    `distant_boundary`, or farther; a smoothstep between. This fixes skull and neck, and the unstable boundary of Seo &
    Luo (2021, section 5). It would damp the motion of the whole head: remove that first (`geometry.align.procrustes`).
    1 everywhere on a closed mesh, which has no boundary.
    """
    landmarks, vertices = _points(landmarks, "landmarks"), _points(vertices, "vertices")
    pinned = distant_boundary(vertices, faces, landmarks, reach=reach)
    if len(pinned) == 0:
        return np.ones(len(vertices), np.float32)
    distance = KDTree(landmarks).query(vertices)[0]
    return (1 - smoothstep(distance, 0, distance[pinned].min())).astype(np.float32)


def upper_lip_share(
    vertices: Real[np.ndarray, "N 3"],
    faces: Integer[np.ndarray, "F 3"],
    landmarks: Real[np.ndarray, "L 3"],
    lips: tuple[Sequence[int], Sequence[int]],
) -> Float32[np.ndarray, " N"]:
    """Return the upper lip's share (N,) in [0, 1] of each vertex: 1 above, 0 below, in between at the corners.

    lips: the landmarks (of L, 3) of the upper and of the lower lip. With a and b the geodesic distances to the nearest
    of the upper and of the lower: the smoothstep of b / (a + b) from 1/4 to 3/4. 1/2 where one is unreachable.
    """
    landmarks, vertices = _points(landmarks, "landmarks"), _points(vertices, "vertices")
    # From the corners of the triangle that contains the landmark: the nearest vertex may be the other lip's.
    corners, _ = decimation.upsampling(landmarks, vertices, faces)
    upper, lower = (graph.geodesic(vertices, faces, np.unique(corners[list(lip)])) for lip in lips)
    reached = np.isfinite(upper) & np.isfinite(lower)
    total = np.where(reached, upper + lower, 2)
    share = np.where(reached, lower, 1) / np.maximum(total, np.finfo(np.float64).tiny)
    return smoothstep(share, 0.25, 0.75).astype(np.float32)


def split_lips(
    vertices: Real[np.ndarray, "N 3"],
    landmarks: Real[np.ndarray, "L 3"],
    lips: tuple[Sequence[int], Sequence[int]],
    share: Real[np.ndarray, " N"],
    **options: Any,
) -> Float32[np.ndarray, "N L"]:
    """Return weights (N, L) float32 blended from two fits, one without the lower and one without the upper lip.

    `share` (N,), from `upper_lip_share`, is the weight of the first fit at each vertex. Landmarks are interpolated and
    affine motions reproduced as by each of the two; options as of `geometry.rbf.fit`.
    """
    found = np.zeros((len(vertices), len(landmarks)), np.float32)
    for left_out, part in ((lips[1], share), (lips[0], 1 - share)):
        kept = np.setdiff1d(np.arange(len(landmarks)), left_out)
        found[:, kept] += part[:, None] * rbf.weights(rbf.fit(landmarks[kept], **options), vertices)
    return found


def weights(
    vertices: Real[np.ndarray, "N 3"],
    faces: Integer[np.ndarray, "F 3"],
    landmarks: Real[np.ndarray, "L 3"],
    *,
    lips: tuple[Sequence[int], Sequence[int]] | None = None,
    reach: float = REACH,
    **options: Any,
) -> Float32[np.ndarray, "N L"]:
    """Return weights (N, L) float32 for `geometry.rbf.warp` of a face at rest, with falloff and separate lips.

    lips: the landmarks of the upper and of the lower lip, `IBUG_LIPS` with 68; without them one fit serves the whole
    face. options as of `geometry.rbf.fit`. Raises `ValueError` as `check` and `geometry.rbf.fit` do.
    """
    landmarks, vertices = _points(landmarks, "landmarks"), _points(vertices, "vertices")
    check(landmarks, vertices)
    if lips is None:
        found = rbf.weights(rbf.fit(landmarks, **options), vertices)
    else:
        found = split_lips(vertices, landmarks, lips, upper_lip_share(vertices, faces, landmarks, lips), **options)
    return found * falloff(vertices, faces, landmarks, reach=reach)[:, None]


def face_region(
    vertices: Real[np.ndarray, "N 3"],
    faces: Integer[np.ndarray, "F 3"],
    landmark_index: Integer[np.ndarray, " L"],
    *,
    within: float = 25.0,
) -> Bool[np.ndarray, " N"]:
    """Return the face region of a head: a mask (N,) of vertices with geodesic distance to a landmark <= `within` mm."""
    return graph.geodesic(vertices, faces, landmark_index) <= within


def _points(points: np.ndarray, name: str) -> np.ndarray:
    points = np.asarray(points, np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or len(points) == 0 or not np.isfinite(points).all():
        raise ValueError(f"{name}: expected finite (K, 3), got {points.shape}")
    return points
