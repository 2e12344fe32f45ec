"""Boundary loops of a mesh."""

import numpy as np

from facejax.mesh import graph


def test_loops_of_the_head_are_neck_mouth_and_eyes(template):
    loops = graph.boundary_loops(template.faces)
    assert sorted(len(loop) for loop in loops) == [28, 28, 38, 42]
    edges = {tuple(edge) for f in template.faces.tolist() for edge in ((f[0], f[1]), (f[1], f[2]), (f[2], f[0]))}
    for loop in loops:
        for a, b in zip(loop.tolist(), np.roll(loop, -1).tolist(), strict=True):
            assert (a, b) in edges and (b, a) not in edges


def test_a_closed_surface_has_none():
    assert graph.boundary_loops(np.array([[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]])) == []


def test_a_boundary_that_touches_itself_does_no_harm():
    two_triangles_at_a_point = np.array([[0, 1, 2], [0, 3, 4]])
    loops = graph.boundary_loops(two_triangles_at_a_point)
    assert sorted(v for loop in loops for v in loop) in ([0, 1, 2, 3, 4], [1, 2, 3, 4], [0, 3, 4, 1, 2])
