"""Exact closest points on a triangle mesh, and interpolation of vertex values there.

V vertices, F triangles, P points, in one unit. Works on the host, in float64.

The search is exact. Every triangle lies in a disc: in its plane, about its centroid, through its farthest corner. The
distance to the disc is a lower bound of the distance to the triangle. Triangles of the nearest centroids give each
point a first distance d; then every triangle whose centroid is nearer than d plus its radius is compared, unless its
disc is farther than the best one found. So that a few large triangles do not widen the search among many small ones,
triangles are grouped by radius, within a factor of four.
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree

from facejax.mesh import graph
from facejax.mesh.normals import vertex_normals_host

NEIGHBOURS = 8  # centroids whose triangles each point is compared with first
PAIRS = 1 << 20  # of points and triangles, about, that are compared at once


class Group(NamedTuple):
    """Triangles of similar size."""

    tree: KDTree  # of centroids
    triangles: np.ndarray  # (G,) indices into the faces
    radius: float  # the largest distance of a corner from its triangle's centroid


class Surface(NamedTuple):
    """A mesh with the tables of a closest-point search."""

    vertices: np.ndarray  # (V, 3) float64
    faces: np.ndarray  # (F, 3)
    normals: np.ndarray  # (V, 3) unit, weighted by area
    edge: np.ndarray  # (V,) bool: on the boundary
    centroids: np.ndarray  # (F, 3)
    radii: np.ndarray  # (F,)
    planes: np.ndarray  # (F, 3) unit normals of the triangles, 0 for one without area
    tree: KDTree  # of all centroids
    groups: tuple[Group, ...]  # from the largest triangles to the smallest


class Hits(NamedTuple):
    """Closest points of P points."""

    face: np.ndarray  # (P,)
    weights: np.ndarray  # (P, 3) barycentric
    points: np.ndarray  # (P, 3)
    distance: np.ndarray  # (P,)


def surface(vertices: np.ndarray, faces: np.ndarray) -> Surface:
    """Return the search tables of a mesh (V, 3), (F, 3). Raises `ValueError` for a mesh without area."""
    vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces, np.int64)
    corners = vertices[faces]
    doubled = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(doubled, axis=1)
    if not area.sum() > 0:
        raise ValueError("the mesh has no area")
    centroids = corners.mean(axis=1)
    radii = np.sqrt(((corners - centroids[:, None]) ** 2).sum(axis=2).max(axis=1))
    size = np.frexp(radii)[1] // 2  # powers of four
    groups = []
    for value in np.unique(size)[::-1]:
        members = np.flatnonzero(size == value)
        groups.append(Group(KDTree(centroids[members]), members, float(radii[members].max())))
    planes = doubled / np.maximum(area, 1e-30)[:, None]
    normals, edge = vertex_normals_host(vertices, faces), graph.on_boundary(faces, len(vertices))
    return Surface(vertices, faces, normals, edge, centroids, radii, planes, KDTree(centroids), tuple(groups))


def closest_points(
    surface: Surface, points: np.ndarray, *, normals: np.ndarray | None = None, normal_weight: float = 0.0
) -> Hits:
    """Return the closest point of the surface to each of `points` (P, 3): triangle, barycentric weights, distance.

    With their unit `normals` (P, 3), the triangle minimises distance + normal_weight * (1 - cosine of the angle between
    the normals): one that faces the other way counts as farther by twice `normal_weight`, in the unit of the vertices.
    """
    points = np.asarray(points, np.float64)
    search = _Search(surface, points, None if normals is None else np.asarray(normals, np.float64), normal_weight)
    search.visit_neighbours()
    for group in surface.groups:
        search.visit(group)
    at = np.einsum("pc,pcx->px", search.weights, surface.vertices[surface.faces[search.face]])
    return Hits(search.face, search.weights, at, search.distance)


class _Search:
    """The best triangle so far of each point (P, 3)."""

    def __init__(self, on: Surface, points: np.ndarray, normals: np.ndarray | None, turn: float):
        self.on, self.points, self.normals, self.turn = on, points, normals, turn
        self.face, self.weights = np.zeros(len(points), np.int64), np.zeros((len(points), 3))
        self.distance, self.cost = np.full((2, len(points)), np.inf)

    def visit_neighbours(self) -> None:
        """Compare all points with the triangles of the nearest centroids, which are mostly the best."""
        count, every = min(NEIGHBOURS, len(self.on.faces)), np.arange(len(self.points))
        away, triangles = self.on.tree.query(self.points, k=np.arange(1, count + 1))
        # The first alone: its distance mostly rules out all but a few of the others.
        self._compare(every, triangles[:, 0])
        row, column = np.nonzero(away[:, 1:] < self.cost[:, None] + self.on.radii[triangles[:, 1:]])
        self._compare(row, triangles[row, column + 1])

    def visit(self, group: Group) -> None:
        """Compare all points with the triangles of a group that may be nearer than the best so far."""
        start, size = 0, 64
        while start < len(self.points):
            rows = np.arange(start, min(start + size, len(self.points)))
            found = group.tree.query_ball_point(self.points[rows], self.cost[rows] + group.radius)
            near = np.fromiter(itertools.chain.from_iterable(found), np.int64)
            self._compare(np.repeat(rows, [len(one) for one in found]), group.triangles[near])
            start, size = start + size, min(4 * size, 1 + PAIRS * size // (1 + len(near)))

    def _compare(self, row: np.ndarray, triangle: np.ndarray) -> None:
        """Compare points of `row` (Q,) with triangles (Q,), and keep the best of each point."""
        on = self.on
        points, plane = self.points[row], on.planes[triangle]
        turned = 0.0
        if self.normals is not None:
            turned = self.turn * (1 - np.einsum("qx,qx->q", plane, self.normals[row]))
        away = points - on.centroids[triangle]
        height = np.einsum("qx,qx->q", away, plane)
        aside = np.sqrt(np.maximum(np.einsum("qx,qx->q", away, away) - height**2, 0)) - on.radii[triangle]
        near = np.hypot(height, np.maximum(aside, 0)) + turned < self.cost[row]
        row, triangle, points = row[near], triangle[near], points[near]
        corners = on.vertices[on.faces[triangle]]
        weights = barycentric(points, corners)
        distance = np.linalg.norm(np.einsum("qc,qcx->qx", weights, corners) - points, axis=1)
        cost = distance + (turned if self.normals is None else np.asarray(turned)[near])
        order = np.lexsort((cost, row))
        best = order[np.diff(row[order], prepend=-1) > 0]
        best = best[cost[best] < self.cost[row[best]]]
        row = row[best]
        self.face[row], self.weights[row] = triangle[best], weights[best]
        self.distance[row], self.cost[row] = distance[best], cost[best]


def barycentric(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return the barycentric weights (P, 3) of the point of each triangle (P, 3, 3) closest to each point (P, 3).

    The foot of the perpendicular where it falls inside; otherwise the best of the closest points of the three edges.
    Weights lie in [0, 1] and sum to 1, also for triangles without area.
    """
    a, b, c = np.moveaxis(triangles, 1, 0)
    candidates = np.empty((4, len(points), 3))
    for edge, (start, end) in enumerate(((a, b), (b, c), (c, a))):
        along = end - start
        t = np.sum((points - start) * along, axis=1) / np.maximum(np.sum(along**2, axis=1), 1e-300)
        t = np.clip(t, 0, 1)
        candidates[edge] = np.roll(np.stack([1 - t, t, np.zeros_like(t)], axis=1), edge, axis=1)
    normal = np.cross(b - a, c - a)
    square = np.maximum(np.sum(normal**2, axis=1), 1e-300)
    inside_b = np.sum(np.cross(points - a, c - a) * normal, axis=1) / square
    inside_c = np.sum(np.cross(b - a, points - a) * normal, axis=1) / square
    candidates[3] = np.stack([1 - inside_b - inside_c, inside_b, inside_c], axis=1)
    distance = np.linalg.norm(np.einsum("kpc,pcx->kpx", candidates, triangles) - points, axis=2)
    outside = (candidates[3] < 0).any(axis=1) | (np.sum(normal**2, axis=1) == 0)
    distance[3, outside] = np.inf
    return np.take_along_axis(candidates, np.argmin(distance, axis=0)[None, :, None], axis=0)[0]


def at(surface: Surface, hits: Hits, values: np.ndarray) -> np.ndarray:
    """Return the values (P, ...) at the closest points, interpolated from those (V, ...) of the surface's vertices."""
    return np.einsum("pk,pk...->p...", hits.weights, values[surface.faces[hits.face]])


def on_boundary(surface: Surface, hits: Hits) -> np.ndarray:
    """Return which closest points lie on the surface's boundary, (P,) bool."""
    return at(surface, hits, surface.edge.astype(np.float64)) > 0.99
