"""Spirals on a regular triangle grid, where every ring is known; their invariances."""

import numpy as np
import pytest

from facejax.mesh import graph, spirals


def hexagons(rows=7, columns=8):
    """Return vertices and faces of a triangular lattice: interior vertices have six neighbours."""
    y, x = np.divmod(np.arange(rows * columns), columns)
    vertices = np.stack([x + 0.5 * y, y * np.sqrt(3) / 2, np.zeros(len(x))], axis=1)
    i = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = i[:-1, :-1].ravel(), i[:-1, 1:].ravel(), i[1:, 1:].ravel(), i[1:, :-1].ravel()
    return vertices, np.concatenate([np.stack([a, b, d], 1), np.stack([b, c, d], 1)])


VERTICES, FACES = hexagons()
CENTRE = 3 * 8 + 3


def test_interior_spiral_has_its_rings_in_order_and_turns_counter_clockwise():
    spiral = spirals.build(VERTICES, FACES, reference=0, length=19)[CENTRE]
    offsets = VERTICES[spiral] - VERTICES[CENTRE]
    radius = np.linalg.norm(offsets, axis=1)
    assert spiral[0] == CENTRE
    np.testing.assert_allclose(radius[1:7], 1)
    assert (radius[7:] > 1.5).all() and (radius[7:] < 2.1).all()
    for ring in (offsets[1:7], offsets[7:19]):
        angle = np.unwrap(np.arctan2(ring[:, 1], ring[:, 0]))
        np.testing.assert_allclose(np.diff(angle), 2 * np.pi / len(ring), atol=1e-9)


def test_first_neighbour_lies_on_a_shortest_path_to_the_reference():
    reference = 0
    distance = graph.geodesic(VERTICES, FACES, [reference])
    table = spirals.build(VERTICES, FACES, reference=reference, length=2)
    for vertex, first in table[1:]:
        step = np.linalg.norm(VERTICES[vertex] - VERTICES[first])
        np.testing.assert_allclose(distance[vertex], distance[first] + step, rtol=1e-12)
    assert np.linalg.norm(VERTICES[table[0, 1]] - VERTICES[0]) == pytest.approx(1)


def test_boundary_walks_on_from_the_other_side():
    corner = 0  # neighbours 1 and 8, in this order
    around = graph.rings(FACES, len(VERTICES))
    assert around[corner] == [1, 8]
    assert spirals._walk(corner, 8, around, rings=1) == [corner, 8, 1]


def test_spirals_hold_no_vertex_twice_and_pad_with_the_dummy():
    vertices, faces = hexagons(3, 3)
    table = spirals.build(vertices, faces, reference=4, length=12)
    for row in table:
        real = row[row < 9]
        assert len(np.unique(real)) == len(real) == 9
        assert (row[9:] == 9).all()


def test_automatic_length_and_dilation():
    around = graph.rings(FACES, len(VERTICES))
    sizes = np.array([1 + len(ring) for ring in around])
    auto = spirals.build(VERTICES, FACES, reference=0, rings=1)
    assert auto.shape == (len(VERTICES), int(sizes.mean() + 2 * sizes.std()))
    full = spirals.build(VERTICES, FACES, reference=0, length=9)
    thin = spirals.build(VERTICES, FACES, reference=0, length=5, dilation=2)
    np.testing.assert_array_equal(thin, full[:, ::2])


def test_relabelled_vertices_give_relabelled_spirals():
    order = np.random.default_rng(1).permutation(len(VERTICES))
    rank = np.argsort(order)
    rng = np.random.default_rng(2)
    bumpy = VERTICES + 0.05 * rng.normal(size=VERTICES.shape)  # no ties between shortest paths
    table = spirals.build(bumpy, FACES, reference=5, length=19)
    moved = spirals.build(bumpy[order], rank[FACES], reference=int(rank[5]), length=19)
    inner = ~np.isin(np.arange(len(VERTICES)), np.unique(_boundary()))
    padded = np.append(rank, len(rank))
    np.testing.assert_array_equal(moved[rank[inner], :7], padded[table[inner, :7]])


def test_a_second_component_gets_its_own_reference():
    vertices = np.concatenate([VERTICES, VERTICES + [0, 0, 5]])
    faces = np.concatenate([FACES, FACES + len(VERTICES)])
    both = spirals.build(vertices, faces, reference=10, length=7)
    alone = spirals.build(VERTICES, FACES, reference=10, length=7)
    np.testing.assert_array_equal(both[: len(VERTICES)], np.where(alone == 56, 112, alone))
    np.testing.assert_array_equal(both[len(VERTICES) :], np.where(alone == 56, 112, alone + 56))


@pytest.mark.parametrize("options", [{"length": 0}, {"dilation": 0}, {"rings": 0}, {"reference": 56}])
def test_options_out_of_range(options):
    with pytest.raises(ValueError, match="expected"):
        spirals.build(VERTICES, FACES, **{"reference": 0} | options)


def _boundary():
    pairs = np.sort(np.concatenate([FACES[:, [0, 1]], FACES[:, [1, 2]], FACES[:, [2, 0]]]), axis=1)
    unique, counts = np.unique(pairs, axis=0, return_counts=True)
    return unique[counts == 1]
