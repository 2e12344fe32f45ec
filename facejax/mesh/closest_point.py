"""The nearest points of a surface, and what holds there. V vertices, F triangles, P points, in one unit."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import trimesh
from scipy.spatial import cKDTree

from facejax.mesh import graph

CANDIDATES = 12  # triangles looked at for each point: those of the nearest samples
FINE = 24_000  # samples of a surface at least: a large triangle gets several
TILT = 5.0  # mm that a normal counts as in the search for what looks the same way: opposite ones lie twice as far apart


class Surface(NamedTuple):
    """A mesh that is asked for nearest points."""

    vertices: np.ndarray  # (V, 3) float64
    faces: np.ndarray  # (F, 3)
    normals: np.ndarray  # (V, 3) unit, by area
    edge: np.ndarray  # (V,) bool: on the boundary
    tree: cKDTree  # of samples
    looking: cKDTree  # of samples and their normals: of two sheets that touch it knows one from the other
    owner: np.ndarray  # the triangle of each sample


class Hits(NamedTuple):
    """What was found for P points."""

    face: np.ndarray  # (P,)
    weights: np.ndarray  # (P, 3) barycentric
    points: np.ndarray  # (P, 3)
    distance: np.ndarray  # (P,)


def surface(vertices: np.ndarray, faces: np.ndarray, *, seed: int = 0) -> Surface:
    """Make a surface ready. Its samples are the middles of triangles, and points drawn by area."""
    vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces, np.int64)
    corners = vertices[faces]
    doubled = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(doubled, axis=1) / 2
    if not area.sum() > 0:
        raise ValueError("the mesh has no area")
    edge = graph.on_boundary(faces, len(vertices))
    rng = np.random.default_rng(seed)
    extra = rng.choice(len(faces), max(0, FINE - len(faces)), p=area / area.sum())
    owner = np.concatenate([np.arange(len(faces)), extra])
    u = np.sort(rng.random((len(extra), 2)), axis=1)
    share = np.concatenate(
        [np.full((len(faces), 3), 1 / 3), np.column_stack([u[:, 0], u[:, 1] - u[:, 0], 1 - u[:, 1]])]
    )
    samples = np.einsum("pk,pkx->px", share, corners[owner])
    flat = doubled / np.maximum(2 * area, 1e-30)[:, None]
    both = np.concatenate([samples, TILT * flat[owner]], axis=1)
    return Surface(vertices, faces, normals(vertices, faces), edge, cKDTree(samples), cKDTree(both), owner)


def closest_points(on: Surface, points: np.ndarray, *, normals: np.ndarray | None = None, turn: float = 0.0) -> Hits:
    """The nearest point of the surface to each of `points` (P, 3).

    With their `normals` (P, 3), a triangle that looks the other way counts as farther: by twice `turn`.
    """
    points = np.asarray(points, np.float64)
    near = on.tree.query(points, k=min(CANDIDATES, len(on.owner)))[1].reshape(len(points), -1)
    if normals is not None:
        alike = np.concatenate([points, TILT * normals], axis=1)
        more = on.looking.query(alike, k=min(CANDIDATES, len(on.owner)))[1].reshape(len(points), -1)
        near = np.concatenate([near, more], axis=1)
    candidates = on.owner[near]
    count = candidates.shape[1]
    triangles = on.vertices[on.faces[candidates.reshape(-1)]]
    found = trimesh.triangles.closest_point(triangles, np.repeat(points, count, axis=0))
    found = found.reshape(len(points), count, 3)
    distance = np.linalg.norm(found - points[:, None], axis=-1)
    cost = distance
    if normals is not None:
        flat = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        flat /= np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-30)
        cost = distance + turn * (1 - np.einsum("pkx,px->pk", flat.reshape(len(points), count, 3), normals))
    best = np.argmin(cost, axis=1)
    row = np.arange(len(points))
    face, at = candidates[row, best], found[row, best]
    with np.errstate(divide="ignore", invalid="ignore"):
        weights = trimesh.triangles.points_to_barycentric(on.vertices[on.faces[face]], at)
    bad = ~np.isfinite(weights).all(axis=1)  # a triangle without area
    weights = np.clip(np.where(bad[:, None], 1 / 3, weights), 0, 1)
    return Hits(face, weights / weights.sum(axis=1, keepdims=True), at, distance[row, best])


def normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Unit normals (V, 3) float64 of vertices, by area; zero where there is none.

    As `ops.vertex_normals`, without a compilation for every new mesh.
    """
    corners = np.asarray(vertices, np.float64)[faces]
    doubled = np.repeat(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), 3, axis=0)
    total = np.stack([np.bincount(np.ravel(faces), axis, len(vertices)) for axis in doubled.T], axis=1)
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-30)


def at(on: Surface, hits: Hits, values: np.ndarray) -> np.ndarray:
    """Values (V, ...) of the surface's vertices at the points that were found, (P, ...)."""
    return np.einsum("pk,pk...->p...", hits.weights, values[on.faces[hits.face]])


def on_edge(on: Surface, hits: Hits) -> np.ndarray:
    """Which of the points found lie on the surface's boundary, (P,): what is nearest to a hole's far side."""
    return at(on, hits, on.edge.astype(np.float64)) > 0.99
