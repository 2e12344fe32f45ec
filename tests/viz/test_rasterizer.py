"""The rasteriser against a loop over samples and triangles, and the laws of coverage."""

import numpy as np
import pytest

from facejax.viz import rasterizer


def _naive(points, nearness, faces, size):
    """Nearest triangle per sample, or -1: every sample against every triangle."""
    width, height = size
    seen = np.full((height, width), -1)
    best = np.zeros((height, width))
    for i, face in enumerate(faces):
        a, b, c = points[face]
        area = (b[0] - a[0]) * (c[1] - a[1]) - (c[0] - a[0]) * (b[1] - a[1])
        if abs(area) <= 1e-9 or (nearness[face] <= 0).any():
            continue
        for y in range(height):
            for x in range(width):
                u = ((b[0] - x) * (c[1] - y) - (c[0] - x) * (b[1] - y)) / area
                v = ((c[0] - x) * (a[1] - y) - (a[0] - x) * (c[1] - y)) / area
                inside = np.array([u, v, 1 - u - v])
                if (inside >= 0).all() and inside @ nearness[face] > best[y, x]:
                    best[y, x], seen[y, x] = inside @ nearness[face], i
    return seen


def _picture(hits, size):
    seen = np.full(size[0] * size[1], -1)
    seen[hits.sample] = hits.face
    return seen.reshape(size[1], size[0])


@pytest.mark.parametrize("seed", range(4))
def test_equals_the_loop(seed):
    rng = np.random.default_rng(seed)
    size = (17, 13)
    points = rng.uniform(-6, 22, (30, 2))
    nearness = rng.uniform(0.2, 1.0, 30)
    nearness[3] = 0  # behind the camera
    faces = rng.integers(0, 30, (25, 3))
    hits = rasterizer.rasterize(points, nearness, faces, size)
    np.testing.assert_array_equal(_picture(hits, size), _naive(points, nearness, faces, size))
    np.testing.assert_allclose(hits.inside.sum(0), 1, atol=1e-5)
    places = np.einsum("cs,csx->sx", hits.inside, points[faces[hits.face]].transpose(1, 0, 2))
    np.testing.assert_allclose(places, np.stack([hits.sample % 17, hits.sample // 17], -1), atol=1e-3)


def test_triangles_that_share_edges_leave_no_gap():
    rng = np.random.default_rng(1)
    grid = np.stack(np.meshgrid(np.linspace(-3, 42, 9), np.linspace(-3, 42, 9)), -1)
    grid[1:-1, 1:-1] += rng.uniform(-2, 2, (7, 7, 2))
    a = (np.arange(8)[:, None] * 9 + np.arange(8)).ravel()
    faces = np.concatenate([np.stack([a, a + 1, a + 10], -1), np.stack([a, a + 10, a + 9], -1)])
    hits = rasterizer.rasterize(grid.reshape(-1, 2), np.ones(81), faces, (40, 40))
    np.testing.assert_array_equal(hits.sample, np.arange(1600))
    assert hits.inside.min() > -1e-3


@pytest.mark.parametrize("faces", [[[0, 1, 2], [2, 3, 0]], [[0, 2, 1], [2, 0, 3]], [[1, 0, 3], [1, 2, 3]]])
def test_samples_on_whole_numbers_and_level_edges(faces):
    points = np.array([[0, 0], [4, 0], [4, 4], [0, 4]], float)
    hits = rasterizer.rasterize(points, np.ones(4), np.array(faces), (6, 6))
    expected = np.zeros((6, 6), bool)
    expected[:5, :5] = True
    np.testing.assert_array_equal(_picture(hits, (6, 6)) >= 0, expected)


def test_the_nearer_wins_whatever_the_order_and_winding():
    points = np.array([[-9, -9], [30, -9], [-9, 30]] * 2, float)
    nearness = np.array([0.5, 0.5, 0.5, 0.500001, 0.500001, 0.500001])
    for faces in ([[0, 1, 2], [3, 4, 5]], [[3, 5, 4], [0, 1, 2]]):
        hits = rasterizer.rasterize(points, nearness, np.array(faces), (5, 5))
        assert set(hits.face) == {faces.index(max(faces, key=max))} and len(hits.sample) == 25


def test_nothing_to_draw():
    nothing = rasterizer.rasterize(np.zeros((3, 2)), np.ones(3), np.array([[0, 1, 2]]), (4, 4))
    assert len(nothing.sample) == 0
    assert len(rasterizer.rasterize(np.zeros((0, 2)), np.zeros(0), np.zeros((0, 3), int), (4, 4)).sample) == 0
    with pytest.raises(ValueError, match="at most"):
        rasterizer.rasterize(np.zeros((3, 2)), np.ones(3), np.broadcast_to(np.int8(0), (1 << 24, 3)), (4, 4))
