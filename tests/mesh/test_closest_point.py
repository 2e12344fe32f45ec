"""Closest points of a surface, compared with a search of all triangles."""

import numpy as np
import pytest
import trimesh

from facejax.mesh import closest_point, graph

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
    # Two sheets at a distance of 1, their normals pointing away from each other, as those of touching lips.
    sheet = size * np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.0]])
    vertices = np.concatenate([sheet, sheet + [0, 0, 1]])
    faces = np.array([[0, 2, 1], [0, 3, 2], [4, 5, 6], [4, 6, 7]])
    on = closest_point.surface(vertices, faces)
    points = np.array([[0.3 * size, 0.2 * size, z] for z in (0.4, 0.6)])
    assert closest_point.closest_points(on, points).points[:, 2].tolist() == [0, 1]
    up, down = np.array([[0, 0, 1.0]] * 2), np.array([[0, 0, -1.0]] * 2)
    assert closest_point.closest_points(on, points, normals=up, normal_weight=1.0).points[:, 2].tolist() == [1, 1]
    assert closest_point.closest_points(on, points, normals=down, normal_weight=1.0).points[:, 2].tolist() == [0, 0]


def test_the_far_side_of_a_hole_is_its_edge():
    kept = FACES[VERTICES[FACES].mean(axis=1)[:, 2] < 0.8]
    on = closest_point.surface(VERTICES, kept)
    hits = closest_point.closest_points(on, np.array([[0, 0, 1.0], [0, 0, -1.0]]))
    assert closest_point.on_boundary(on, hits).tolist() == [True, False]
    loops = np.concatenate(graph.boundary_loops(kept))
    assert (
        np.flatnonzero(on.edge).tolist() == sorted(loops.tolist())
        and not closest_point.surface(VERTICES, FACES).edge.any()
    )


def soup(seed, count=300):
    """Return triangles (F, 3, 3) of sizes from 0.001 to 100 at random positions; some have no area."""
    rng = np.random.default_rng(seed)
    size = 10.0 ** rng.uniform(-3, 2, (count, 1, 1))
    found = 20 * rng.normal(size=(count, 1, 3)) + size * rng.normal(size=(count, 3, 3))
    found[::50, 2] = found[::50, 1]
    return found


@pytest.mark.parametrize("turn", [None, 2.0, 20.0])
@pytest.mark.parametrize("seed", range(3))
def test_triangles_of_all_sizes_against_a_search_of_every_triangle(seed, turn):
    triangles, rng = soup(seed), np.random.default_rng(seed + 10)
    on = closest_point.surface(triangles.reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3))
    points = np.concatenate([20 * rng.normal(size=(200, 3)), triangles[::3, 0] + 0.01 * rng.normal(size=(100, 3))])
    looking = rng.normal(size=points.shape)
    looking /= np.linalg.norm(looking, axis=1, keepdims=True)
    pairs = np.tile(triangles, (len(points), 1, 1)), np.repeat(points, len(triangles), axis=0)
    cost = np.linalg.norm(trimesh.triangles.closest_point(*pairs) - pairs[1], axis=1).reshape(len(points), -1)
    if turn is None:
        hits = closest_point.closest_points(on, points)
    else:
        hits = closest_point.closest_points(on, points, normals=looking, normal_weight=turn)
        cost += turn * (1 - looking @ on.planes.T)
    # trimesh may return a wrong closest point of a triangle without area.
    whole = np.setdiff1d(np.arange(len(triangles)), np.arange(0, len(triangles), 50))
    row = np.arange(len(points))
    got = hits.distance + (0 if turn is None else turn * (1 - np.sum(looking * on.planes[hits.face], axis=1)))
    assert (got <= cost[:, whole].min(axis=1) + 1e-9).all()
    proper = np.isin(hits.face, whole)
    np.testing.assert_allclose(got[proper], cost[row, hits.face][proper], atol=1e-9)
    np.testing.assert_allclose(closest_point.at(on, hits, on.vertices), hits.points, atol=1e-9)


def test_a_large_triangle_beside_many_small_ones():
    """Two triangles of 100 mm beside 30,752 of a quarter of a millimetre."""
    n = 125
    x, y = np.meshgrid(np.linspace(0, 31, n), np.linspace(0, 31, n))
    a = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    fine = np.concatenate([np.stack([a, a + 1, a + n + 1], axis=1), np.stack([a, a + n + 1, a + n], axis=1)])
    square = np.array([[100, 0, 0], [200, 0, 0], [200, 100, 0], [100, 100, 0]])
    vertices = np.concatenate([np.column_stack([x.ravel(), y.ravel(), 0 * x.ravel()]), square])
    faces = np.concatenate([fine, n * n + np.array([[0, 1, 2], [0, 2, 3]])])
    on = closest_point.surface(vertices, faces)
    hits = closest_point.closest_points(on, np.array([[120, 50, 1.0], [15, 15, 2.0], [60, 20, 0]]))
    np.testing.assert_allclose(hits.distance, [1, 2, 29], atol=1e-9)


def test_no_points_have_no_closest_points():
    assert closest_point.closest_points(closest_point.surface(VERTICES, FACES), np.zeros((0, 3))).points.shape == (0, 3)


def test_a_mesh_without_area_is_refused():
    with pytest.raises(ValueError, match="no area"):
        closest_point.surface(np.zeros((3, 3)), np.array([[0, 1, 2]]))


def test_closest_point_against_dense_sampling():
    rng = np.random.default_rng(0)
    triangles, points = rng.normal(size=(40, 3, 3)), 2 * rng.normal(size=(40, 3))
    found = closest_point.barycentric(points, triangles)
    assert found.min() >= 0 and np.allclose(found.sum(axis=1), 1)
    distance = np.linalg.norm(np.einsum("pc,pcx->px", found, triangles) - points, axis=1)
    u, v = np.meshgrid(np.linspace(0, 1, 101), np.linspace(0, 1, 101))
    inside = u + v <= 1 + 1e-9
    grid = np.stack([1 - u - v, u, v], axis=-1)[inside]
    sampled = np.einsum("gc,pcx->pgx", grid, triangles)
    best = np.linalg.norm(sampled - points[:, None], axis=2).min(axis=1)
    assert (distance <= best + 1e-12).all() and (distance > best - 0.05).all()


def test_closest_point_of_flattened_triangles_is_on_their_longest_edge():
    line = np.array([[[0.0, 0, 0], [1, 0, 0], [3, 0, 0]], [[1.0, 1, 1], [1, 1, 1], [1, 1, 1]]])
    found = closest_point.barycentric(np.array([[2.0, 1, 0], [0, 0, 0]]), line)
    np.testing.assert_allclose(np.einsum("pc,pcx->px", found, line), [[2, 0, 0], [1, 1, 1]], atol=1e-12)
