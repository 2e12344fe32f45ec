"""Rings and geodesic distances on meshes small enough to check by hand."""

import numpy as np
import pytest

from facejax.mesh import graph

# A square of four triangles about vertex 4, counter-clockwise seen from above.
FAN = np.array([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])
SQUARE = np.array([[0.0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0], [1, 1, 0]])


def cyclic(ring):
    start = ring.index(min(ring))
    return ring[start:] + ring[:start]


def test_interior_ring_runs_counter_clockwise_and_closes():
    assert cyclic(graph.rings(FAN, 5)[4]) == [0, 1, 2, 3]
    flipped = FAN[:, ::-1]
    assert cyclic(graph.rings(flipped, 5)[4]) == [0, 3, 2, 1]


def test_boundary_ring_starts_at_its_clockwise_end():
    assert graph.rings(FAN, 5)[0] == [1, 4, 3]


def test_two_fans_at_one_vertex_and_a_third_triangle_on_an_edge_keep_every_neighbour():
    bow_tie = np.array([[0, 1, 2], [0, 3, 4]])
    assert graph.rings(bow_tie, 5)[0] == [1, 2, 3, 4]
    three_on_edge = np.array([[0, 1, 2], [1, 0, 3], [0, 1, 4]])
    rings = graph.rings(three_on_edge, 5)
    for a in range(5):
        neighbours = {b for face in three_on_edge for b in face if a in face and b != a}
        assert set(rings[a]) == neighbours and len(rings[a]) == len(neighbours)


def test_edges_are_listed_once():
    assert graph.edges(FAN).tolist() == [[0, 1], [0, 3], [0, 4], [1, 2], [1, 4], [2, 3], [2, 4], [3, 4]]


def test_geodesic_against_floyd_warshall():
    rng = np.random.default_rng(0)
    vertices = SQUARE + rng.normal(size=SQUARE.shape)
    distance = np.full((5, 5), np.inf)
    np.fill_diagonal(distance, 0)
    for a, b in graph.edges(FAN):
        distance[a, b] = distance[b, a] = np.linalg.norm(vertices[a] - vertices[b])
    for k in range(5):
        for a in range(5):
            for b in range(5):
                distance[a, b] = min(distance[a, b], distance[a, k] + distance[k, b])
    np.testing.assert_allclose(graph.geodesic(vertices, FAN, [1]), distance[1], rtol=1e-12)
    np.testing.assert_allclose(graph.geodesic(vertices, FAN, [0, 2]), distance[[0, 2]].min(axis=0), rtol=1e-12)


def test_predecessors_lead_to_the_source_and_other_components_are_unreachable():
    vertices = np.concatenate([SQUARE, SQUARE + [0, 0, 9]])
    faces = np.concatenate([FAN, FAN + 5])
    distance, predecessor = graph.paths(vertices, faces, [2])
    assert np.isinf(distance[5:]).all() and (predecessor[5:] == -1).all() and predecessor[2] == -1
    assert predecessor[0] == 4 and predecessor[4] == 2


@pytest.mark.parametrize(
    ("vertices", "faces", "message"),
    [
        (SQUARE[:, :2], FAN, r"finite \(N, 3\)"),
        (SQUARE * np.nan, FAN, r"finite \(N, 3\)"),
        (SQUARE, FAN[:, :2], r"integers \(F, 3\)"),
        (SQUARE, FAN.astype(float), r"integers \(F, 3\)"),
        (SQUARE, FAN + 1, r"vertex indices in 0\.\.4"),
        (SQUARE, FAN[:0], "no face"),
        (np.vstack([SQUARE, SQUARE]), FAN, "5 unused vertices, first 5"),
    ],
)
def test_broken_meshes_are_named(vertices, faces, message):
    with pytest.raises(ValueError, match=message):
        graph.check(vertices, faces)
