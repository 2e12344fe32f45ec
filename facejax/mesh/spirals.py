"""Spirals: a fixed order on the neighbourhood of every vertex, so that all vertices share one weight matrix.

A spiral is its centre, then ring after ring counter-clockwise (Lim et al. 2018; Bouritsas et al. 2019,
Neural3DMM). The first neighbour is the next vertex on a shortest path to a reference vertex, which aligns
the directions of neighbouring spirals. Tables are (N, S) int32; entry N is a dummy vertex that reads zero.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Int32, Integer, Real

from facejax.mesh import graph


def build(
    vertices: Real[np.ndarray, "N 3"],
    faces: Integer[np.ndarray, "F 3"],
    *,
    reference: int,
    length: int | None = None,
    rings: int = 2,
    dilation: int = 1,
) -> Int32[np.ndarray, "N S"]:
    """Return the spirals (N, S) int32 of a mesh of vertices (N, 3) and faces (F, 3).

    S is `length`, or int(mean + 2 std) of the number of vertices within `rings` rings; longer spirals are truncated,
    shorter ones padded with N. With a dilation of d, the centre and every d-th vertex after it are kept. Raises
    `ValueError` for an option out of range.
    """
    if (length is not None and length < 1) or dilation < 1 or rings < 1:
        raise ValueError(f"expected length, dilation and rings of 1 or more, got {length}, {dilation}, {rings}")
    around = graph.rings(faces, len(vertices))
    if length is None:
        sizes = [len(_walk(v, ring[0], around, rings=rings)[::dilation]) for v, ring in enumerate(around)]
        length = max(1, int(np.mean(sizes) + 2 * np.std(sizes)))
    table = np.full((len(vertices), length), len(vertices), np.int32)
    for vertex, first in enumerate(first_neighbours(vertices, faces, around, reference).tolist()):
        spiral = _walk(vertex, first, around, count=1 + (length - 1) * dilation)[::dilation]
        table[vertex, : len(spiral)] = spiral[:length]
    return table


def first_neighbours(
    vertices: Real[np.ndarray, "N 3"], faces: Integer[np.ndarray, "F 3"], around: list[list[int]], reference: int
) -> Integer[np.ndarray, " N"]:
    """Return each vertex's first neighbour (N,): the predecessor on the shortest path from the reference.

    A component that is not connected to the reference takes its vertex nearest to the reference instead. A
    reference has no predecessor and takes its nearest neighbour.
    """
    if not 0 <= reference < len(vertices):
        raise ValueError(f"reference: expected a vertex in 0..{len(vertices) - 1}, got {reference}")
    sources = [reference]
    straight = np.linalg.norm(vertices - vertices[reference], axis=1)
    distance, first = graph.paths(vertices, faces, sources)
    while not np.isfinite(distance).all():
        lost = np.flatnonzero(~np.isfinite(distance))
        sources.append(int(lost[np.argmin(straight[lost])]))
        distance, first = graph.paths(vertices, faces, sources)
    for source in sources:
        ring = np.array(around[source])
        first[source] = ring[np.argmin(np.linalg.norm(vertices[ring] - vertices[source], axis=1))]
    return first


def _walk(
    centre: int, first: int, around: list[list[int]], *, count: int | None = None, rings: int | None = None
) -> list[int]:
    """Return the vertices of the spiral at `centre`, up to `count` vertices or all of the first `rings` rings.

    Each vertex of a ring contributes its unseen neighbours, counter-clockwise from the one that it was reached from:
    so the outer ring runs counter-clockwise too.
    """
    seen = {centre: first}  # vertex: the neighbour at which its own fan starts
    ring = [centre]
    while ring and (count is None or len(seen) < count) and (rings is None or rings > 0):
        outer: list[int] = []
        for vertex in ring:
            fan = around[vertex]
            start = fan.index(seen[vertex])
            for neighbour in fan[start:] + fan[:start]:
                if neighbour not in seen:
                    seen[neighbour] = vertex
                    outer.append(neighbour)
        ring = outer
        rings = None if rings is None else rings - 1
    return list(seen)[:count]
