"""Decimation to subsets of the vertices; upsampling, compared with a search of all triangles."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from facejax.mesh import closest_point, decimation

BALL = trimesh.creation.icosphere(subdivisions=3)  # 642 vertices


def test_decimated_mesh_is_a_consistent_subset():
    vertices, faces = np.asarray(BALL.vertices), np.asarray(BALL.faces)
    kept, coarse, group = decimation.decimate(vertices, faces, 4)
    assert 0.2 < len(kept) / len(vertices) < 0.3
    assert (np.diff(kept) > 0).all()
    np.testing.assert_array_equal(np.unique(coarse), np.arange(len(kept)))
    np.testing.assert_array_equal(group[kept], np.arange(len(kept)))
    mesh = trimesh.Trimesh(vertices[kept], coarse, process=False)
    assert mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0.9 * BALL.volume
    # The members of a group lie near the vertex that represents them.
    assert np.linalg.norm(vertices - vertices[kept][group], axis=1).max() < 0.6


def test_decimation_ignores_the_unit():
    vertices, faces = np.asarray(BALL.vertices), np.asarray(BALL.faces)
    small = decimation.decimate(vertices, faces, 4)
    large = decimation.decimate(vertices * 1024, faces, 4)
    for a, b in zip(small, large, strict=True):
        np.testing.assert_array_equal(a, b)


def test_impossible_factors():
    tetrahedron = trimesh.creation.icosphere(subdivisions=0)
    with pytest.raises(ValueError, match="more than 1"):
        decimation.decimate(np.asarray(BALL.vertices), np.asarray(BALL.faces), 1)
    with pytest.raises(ValueError, match="cannot be decimated"):
        decimation.decimate(np.asarray(tetrahedron.vertices), np.asarray(tetrahedron.faces), 1000)


def test_upsampling_against_every_triangle():
    rng = np.random.default_rng(1)
    vertices, faces = np.asarray(BALL.vertices) + 0.05 * rng.normal(size=BALL.vertices.shape), BALL.faces
    kept, coarse, _ = decimation.decimate(vertices, np.asarray(faces), 4)
    corners, weights = decimation.upsampling(vertices, vertices[kept], coarse)
    assert corners.dtype == np.int32 and weights.dtype == np.float32
    assert weights.min() >= 0 and weights.max() <= 1
    np.testing.assert_allclose(weights.sum(axis=1), 1, atol=3e-7)
    found = np.einsum("nc,ncx->nx", weights, vertices[kept][corners])
    triangles = vertices[kept][coarse]
    for vertex in range(0, len(vertices), 7):
        points = np.repeat(vertices[vertex][None], len(triangles), axis=0)
        every = closest_point.barycentric(points, triangles)
        best = np.linalg.norm(np.einsum("tc,tcx->tx", every, triangles) - points, axis=1).min()
        assert np.linalg.norm(found[vertex] - vertices[vertex]) == pytest.approx(best, abs=1e-6)
    np.testing.assert_array_equal(found[kept], vertices[kept])


def test_upsampling_is_exact_for_affine_functions_of_a_flat_mesh():
    y, x = np.divmod(np.arange(36), 6)
    fine = np.stack([x, y, np.zeros(36)], axis=1).astype(float)
    coarse = np.array([[0.0, 0, 0], [5, 0, 0], [5, 5, 0], [0, 5, 0]])
    corners, weights = decimation.upsampling(fine, coarse, np.array([[0, 1, 2], [0, 2, 3]]))
    affine = coarse @ [2.0, -3.0, 0] + 7
    np.testing.assert_allclose(np.sum(weights * affine[corners], axis=1), fine @ [2.0, -3.0, 0] + 7, atol=1e-5)
    values = coarse @ np.array([[2.0, 1], [-3, 0], [0, 5]])
    found = decimation.upsample(np.stack([values, -values]).astype(np.float32), corners, weights)
    expected = fine @ np.array([[2.0, 1], [-3, 0], [0, 5]])
    np.testing.assert_allclose(found, [expected, -expected], atol=1e-5)


def test_upsample_keeps_the_dtype_and_is_linear(dtype):
    rng = np.random.default_rng(2)
    corners, weights = rng.integers(0, 4, (9, 3)).astype(np.int32), rng.dirichlet(np.ones(3), 9).astype(dtype)
    values = rng.normal(size=(2, 4, 5)).astype(dtype)
    found = decimation.upsample(values, corners, weights)
    assert found.dtype == dtype and found.shape == (2, 9, 5)
    expected = sum(weights[:, k, None] * values[:, corners[:, k]] for k in range(3))
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6)
    weight = rng.normal(size=found.shape).astype(dtype)
    slope = jax.grad(lambda x: jnp.sum(weight * decimation.upsample(x, corners, weights)))(jnp.asarray(values))
    np.testing.assert_allclose(jnp.sum(slope * values), jnp.sum(weight * found), rtol=1e-4)
