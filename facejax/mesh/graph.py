"""Mesh connectivity as a graph: edges, ordered vertex rings, geodesic distances, boundaries.

N vertices, F triangles. A triangle's corners run counter-clockwise seen from outside.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float64, Int32, Integer, Real
from scipy.sparse import csgraph, csr_array

WELD = 1e-7  # of the mesh's size: vertices nearer to one another are merged


def check(vertices: np.ndarray, faces: np.ndarray) -> tuple[Float64[np.ndarray, "N 3"], Int32[np.ndarray, "F 3"]]:
    """Check a mesh and return copies of its vertices (N, 3) float64 and faces (F, 3) int32.

    Raises `ValueError` for wrong shapes, face indices out of range, and vertices that no triangle uses.
    """
    vertices, faces = np.array(vertices, np.float64), np.array(faces)
    if vertices.ndim != 2 or vertices.shape[1] != 3 or not np.isfinite(vertices).all():
        raise ValueError(f"vertices: expected finite (N, 3), got {vertices.shape}")
    if faces.ndim != 2 or faces.shape[1] != 3 or not np.issubdtype(faces.dtype, np.integer):
        raise ValueError(f"faces: expected integers (F, 3), got {faces.dtype} {faces.shape}")
    if faces.size == 0 or faces.min() < 0 or faces.max() >= len(vertices):
        raise ValueError(f"faces: expected vertex indices in 0..{len(vertices) - 1}, got one out of range or no face")
    unused = np.setdiff1d(np.arange(len(vertices)), faces)
    if len(unused):
        raise ValueError(
            f"faces: expected every vertex in a triangle, got {len(unused)} unused vertices, first {unused[0]}"
        )
    return vertices, faces.astype(np.int32)


def weld(
    vertices: Real[np.ndarray, "N 3"], faces: Integer[np.ndarray, "F 3"]
) -> tuple[Integer[np.ndarray, " W"], Integer[np.ndarray, " N"], Integer[np.ndarray, "G 3"]]:
    """Merge vertices at the same position, which exporters duplicate along texture seams.

    Returns:
      the kept vertices (W,), the index (N,) of each vertex among them, -1 where no triangle uses it, and triangles
      (G, 3) over the kept ones, without those that have become degenerate.
    """
    size = np.ptp(vertices, axis=0).max()
    used, places = np.unique(faces, return_inverse=True)
    _, first, same = np.unique(np.round(vertices[used] / (WELD * size)), axis=0, return_index=True, return_inverse=True)
    same = same.reshape(-1)
    joined = same[places].reshape(-1, 3)
    whole = (joined[:, 0] != joined[:, 1]) & (joined[:, 1] != joined[:, 2]) & (joined[:, 2] != joined[:, 0])
    where = np.full(len(vertices), -1)
    where[used] = same
    return used[first], where, joined[whole]


def edges(faces: Integer[np.ndarray, "F 3"]) -> Integer[np.ndarray, "E 2"]:
    """Return the undirected edges (E, 2), smaller index first, each once, sorted."""
    pairs = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    return np.unique(pairs, axis=0)


def rings(faces: Integer[np.ndarray, "F 3"], count: int) -> list[list[int]]:
    """Return the neighbours of each of `count` vertices in counter-clockwise order, as a cycle.

    A boundary vertex's open fan starts at its clockwise end, so that the cycle jumps across the boundary and continues
    from the other side. Several fans at one vertex follow one another.
    """
    following: list[dict[int, int | None]] = [{} for _ in range(count)]
    for a, b, c in faces.tolist():
        for corner, first, second in ((a, b, c), (b, c, a), (c, a, b)):
            turns = following[corner]
            if turns.get(first) is None:  # a third triangle on an edge may not unlink the first two
                turns[first] = second
            turns.setdefault(second, None)
    return [_chain(turns) for turns in following]


def _chain(following: dict[int, int | None]) -> list[int]:
    """Return all keys of {neighbour: next one}, run by run; a closed run starts at its smallest key."""
    starts = sorted(following.keys() - set(following.values())) + sorted(following)
    ordered: dict[int, bool] = {}
    for vertex in starts:
        while vertex is not None and vertex not in ordered:
            ordered[vertex] = True
            vertex = following[vertex]
    return list(ordered)


def paths(
    vertices: Real[np.ndarray, "N 3"],
    faces: Integer[np.ndarray, "F 3"],
    sources: Sequence[int] | Integer[np.ndarray, " K"],
) -> tuple[Float64[np.ndarray, " N"], Integer[np.ndarray, " N"]]:
    """Return the shortest paths along edges from the nearest source: distances (N,) and predecessors (N,).

    Unreachable vertices have distance inf; they and the sources have predecessor -1.
    """
    pairs = edges(faces)
    lengths = np.linalg.norm(vertices[pairs[:, 0]] - vertices[pairs[:, 1]], axis=1)
    # SciPy takes an entry of 0 for no edge.
    lengths = np.maximum(lengths, np.finfo(np.float64).tiny)
    graph = csr_array((lengths, (pairs[:, 0], pairs[:, 1])), shape=(len(vertices),) * 2)
    distance, predecessor, _ = csgraph.dijkstra(
        graph, directed=False, indices=np.atleast_1d(sources), return_predecessors=True, min_only=True
    )
    return distance, np.maximum(predecessor, -1)


def geodesic(
    vertices: Real[np.ndarray, "N 3"],
    faces: Integer[np.ndarray, "F 3"],
    sources: Sequence[int] | Integer[np.ndarray, " K"],
) -> Float64[np.ndarray, " N"]:
    """Return the distance (N,) along edges to the nearest source vertex, in the vertices' unit; inf if unreachable."""
    return paths(np.asarray(vertices, np.float64), faces, sources)[0]


def boundary_loops(faces: Integer[np.ndarray, "F 3"]) -> list[Integer[np.ndarray, " _"]]:
    """Return the closed loops of the boundary, each as its vertices in the orientation of its triangles."""
    directed = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    ahead, back = (
        np.ravel_multi_index(edge.T, (np.max(faces, initial=0) + 1,) * 2) for edge in (directed, directed[:, ::-1])
    )
    follows = dict(directed[~np.isin(ahead, back)].tolist())
    loops: list[np.ndarray] = []
    while follows:
        loop = [next(iter(follows))]
        after = follows.pop(loop[0])
        # Where the boundary of a non-manifold mesh touches itself, a chain may end without closing.
        while after != loop[0] and after in follows:
            loop.append(after)
            after = follows.pop(after)
        loops.append(np.array(loop))
    return loops


def on_boundary(faces: Integer[np.ndarray, "F 3"], count: int) -> Bool[np.ndarray, " {count}"]:
    """Return which of `count` vertices lie on a boundary edge, one of a single triangle: (count,) bool."""
    pairs = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1).astype(np.int64)
    found, times = np.unique(pairs[:, 0] * count + pairs[:, 1], return_counts=True)
    mask = np.zeros(count, bool)
    mask[np.concatenate(np.divmod(found[times == 1], count))] = True
    return mask
