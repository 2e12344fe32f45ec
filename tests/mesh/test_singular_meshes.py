"""Normals, strain and closest points of many thin, folded and degenerate triangles, in both precisions."""

import jax.numpy as jnp
import numpy as np
import pytest

from facejax.mesh import closest_point, deformation_transfer, strain
from facejax.mesh.normals import vertex_normals
from tests.near import COUNT, finite

FACES = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 1]], np.int32)  # three triangles about vertex 0


def fans():
    """Return vertices (COUNT, 4, 3) of `FACES`; in the first 150 no triangle has an area."""
    rng = np.random.default_rng(0)
    found = rng.normal(size=(COUNT, 4, 3))
    thin = 10.0 ** rng.uniform(-20, 0, (COUNT, 1, 1))
    found[::5, 1:] = found[::5, :1] + thin[::5] * found[::5, 1:]  # small
    found[1::5, :, 2:] *= thin[1::5]  # flat; folded where vertex 0 is outside the triangle of the others
    found[2::5, :, 1:] *= thin[2::5]  # near a line
    found[3::5, 2] = found[3::5, 1] + thin[3::5, 0] * found[3::5, 2]  # two corners nearly coincide
    found[:50] = found[:50, :1]
    found[50:100, 1:] = found[50:100, 1:2]
    found[100:150, :, 1:] = 0
    return found * 10.0 ** rng.uniform(-3, 3, (COUNT, 1, 1))


def test_normals(dtype):
    vertices = jnp.asarray(fans(), dtype)
    found = np.asarray(finite(lambda vertices: vertex_normals(vertices, FACES), vertices), np.float64)
    length = np.linalg.norm(found, axis=-1)
    assert (np.minimum(np.abs(length - 1), length) < 8 * np.finfo(dtype).eps).all()
    assert (length[:150] == 0).all() and (length[154::5] > 0).all()


def test_strain(dtype):
    vertices = jnp.asarray(fans(), dtype)
    tables = strain.vertex_triangles(FACES, 4)

    def found(moved, vertices):
        return [x.swapaxes(0, 1) for x in strain.strain(moved.swapaxes(0, 1), vertices.swapaxes(0, 1), tables)]

    rng = np.random.default_rng(1)
    bend = rng.normal(size=(COUNT, 3, 3)) * 10.0 ** rng.uniform(-6, 1, (COUNT, 1, 1))
    moved = jnp.asarray(fans() @ bend, dtype)
    _, normals = finite(found, moved, vertices)
    length = np.linalg.norm(np.asarray(normals, np.float64), axis=-1)
    assert (np.minimum(np.abs(length - 1), length) < 8 * np.finfo(dtype).eps).all()
    assert (length[:150] == 0).all() and (length[154::5] > 0).all()
    still, _ = finite(lambda vertices: found(jnp.zeros_like(vertices), vertices), vertices)
    assert not np.asarray(still).any()


def test_the_nearest_point_of_a_triangle():
    rng = np.random.default_rng(2)
    triangles = fans()[:, :3]
    size = np.ptp(triangles, axis=(1, 2))
    points = triangles.mean(axis=1) + (size * 10.0 ** rng.uniform(-9, 1, COUNT))[:, None] * rng.normal(size=(COUNT, 3))
    weights = closest_point.barycentric(points, triangles)
    assert (weights >= 0).all() and (weights <= 1).all()
    np.testing.assert_allclose(weights.sum(axis=1), 1, atol=1e-12)

    def distance(weights):
        return np.linalg.norm(np.einsum("kc,kcx->kx", weights, triangles) - points, axis=1)

    slack = 1e-7 * (size + np.linalg.norm(points - triangles[:, 0], axis=1))
    for _ in range(8):
        assert (distance(weights) <= distance(rng.dirichlet(np.ones(3) / 2, COUNT)) + slack).all()


def test_the_nearest_points_of_a_surface_of_such_triangles():
    """Some triangles have no area, and so no normal and no unique barycentric weights."""
    rng = np.random.default_rng(3)
    vertices = fans()[:500].reshape(-1, 3)
    faces = (4 * np.arange(500)[:, None, None] + FACES).reshape(-1, 3)
    on = closest_point.surface(vertices, faces)
    points = np.concatenate([vertices[rng.integers(len(vertices), size=COUNT // 10)], rng.normal(size=(1_000, 3))])
    for normals in (None, rng.normal(size=points.shape)):
        hits = closest_point.closest_points(on, points, normals=normals)
        assert all(np.isfinite(part).all() for part in hits)
        assert (hits.weights >= 0).all() and np.abs(hits.weights.sum(axis=1) - 1).max() < 1e-12
    assert np.isfinite(on.normals).all()


def test_a_face_with_a_triangle_of_no_area_carries_nothing():
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0.5, 0]])
    with pytest.raises(ValueError, match="triangle 1 has no area"):
        deformation_transfer.gradient_operator(vertices, np.array([[0, 1, 2], [0, 2, 3]]))
