"""Nearest points of a surface against a search of every triangle."""

import numpy as np
import pytest
import trimesh

from facejax.mesh import closest_point, graph, normals

BALL = trimesh.creation.icosphere(subdivisions=2)
VERTICES, FACES = np.asarray(BALL.vertices), np.asarray(BALL.faces)


def test_the_nearest_point_of_all_triangles_is_found():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(200, 3))
    hits = closest_point.closest_points(closest_point.surface(VERTICES, FACES), points)
    triangles = VERTICES[FACES]
    for point, distance, found in zip(points, hits.distance, hits.points, strict=True):
        everywhere = trimesh.triangles.closest_point(triangles, np.repeat(point[None], len(FACES), axis=0))
        assert np.isclose(distance, np.linalg.norm(everywhere - point, axis=1).min(), atol=1e-9)
        assert np.isclose(np.linalg.norm(found - point), distance)
    on = closest_point.surface(VERTICES, FACES)
    np.testing.assert_allclose(closest_point.at(on, hits, VERTICES), hits.points, atol=1e-9)
    assert (hits.weights >= 0).all() and np.allclose(hits.weights.sum(axis=1), 1)


def test_large_triangles_are_found_from_afar():
    square = np.array([[0, 0, 0], [100, 0, 0], [100, 100, 0], [0, 100, 0], [50, 50, -40.0]])
    faces = np.array([[0, 1, 2], [0, 2, 3], [0, 4, 1]])
    points = np.column_stack([np.random.default_rng(1).uniform(5, 95, size=(100, 2)), np.full(100, 3.0)])
    hits = closest_point.closest_points(closest_point.surface(square, faces), points)
    np.testing.assert_allclose(hits.distance, 3.0, atol=1e-9)


@pytest.mark.parametrize("size", [10, 200])
def test_normals_tell_two_sheets_apart(size):
    # Two sheets 1 apart, the upper looking up and the lower down: lips that touch.
    # Far closer than samples of a sheet are to one another, or far wider.
    sheet = size * np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.0]])
    vertices = np.concatenate([sheet, sheet + [0, 0, 1]])
    faces = np.array([[0, 2, 1], [0, 3, 2], [4, 5, 6], [4, 6, 7]])
    on = closest_point.surface(vertices, faces)
    points = np.array([[0.3 * size, 0.2 * size, z] for z in (0.4, 0.6)])
    assert closest_point.closest_points(on, points).points[:, 2].tolist() == [0, 1]
    up, down = np.array([[0, 0, 1.0]] * 2), np.array([[0, 0, -1.0]] * 2)
    assert closest_point.closest_points(on, points, normals=up, turn=1.0).points[:, 2].tolist() == [1, 1]
    assert closest_point.closest_points(on, points, normals=down, turn=1.0).points[:, 2].tolist() == [0, 0]


def test_the_far_side_of_a_hole_is_its_edge():
    kept = FACES[VERTICES[FACES].mean(axis=1)[:, 2] < 0.8]
    on = closest_point.surface(VERTICES, kept)
    hits = closest_point.closest_points(on, np.array([[0, 0, 1.0], [0, 0, -1.0]]))
    assert closest_point.on_edge(on, hits).tolist() == [True, False]
    loops = np.concatenate(graph.boundary_loops(kept))
    assert (
        np.flatnonzero(on.edge).tolist() == sorted(loops.tolist())
        and not closest_point.surface(VERTICES, FACES).edge.any()
    )


def test_normals_are_those_of_the_jitted_function():
    rng = np.random.default_rng(2)
    bent = VERTICES + 0.1 * rng.normal(size=VERTICES.shape)
    expected = normals.vertex_normals(np.asarray(bent, np.float32), FACES)
    np.testing.assert_allclose(normals.vertex_normals_host(bent, FACES), expected, atol=1e-5)
    lonely = normals.vertex_normals_host(np.concatenate([bent, [[9, 9, 9.0]]]), FACES)
    assert not lonely[-1].any()
