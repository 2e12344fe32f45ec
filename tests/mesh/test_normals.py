"""Normals by JAX and by NumPy, compared with a loop over triangles."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from jax.test_util import check_grads

from facejax.mesh.normals import triangle_normals, vertex_normals, vertex_normals_host
from facejax.viz import scene

BALL = trimesh.creation.icosphere(subdivisions=2)  # 162 vertices
VERTICES, FACES = np.asarray(BALL.vertices), np.asarray(BALL.faces)
FORMS = {"jax": vertex_normals, "host": vertex_normals_host}


def loop(vertices):
    """Return unit normals (N, 3), summed triangle by triangle."""
    total = np.zeros(vertices.shape)
    for a, b, c in FACES:
        p = np.asarray(vertices, np.float64)
        total[[a, b, c]] += np.cross(p[b] - p[a], p[c] - p[a])
    return total / np.linalg.norm(total, axis=1, keepdims=True)


def uneven(*lead):
    """Return spheres (..., N, 3) float32 with noise."""
    noise = np.random.default_rng(1).normal(size=(*lead, *VERTICES.shape))
    return np.asarray(VERTICES + 0.05 * noise, np.float32)


@pytest.mark.parametrize("lead", [(), (1,), (3, 2)], ids=str)
@pytest.mark.parametrize("form", FORMS)
def test_normals_against_a_loop(form, lead):
    vertices = uneven(*lead)
    found = FORMS[form](vertices, FACES)
    assert found.shape == vertices.shape and found.dtype == np.float32
    for index in np.ndindex(*lead):
        np.testing.assert_allclose(found[index], loop(vertices[index]), atol=1e-5)


def test_the_host_form_keeps_float64():
    vertices = VERTICES + 0.05 * np.random.default_rng(2).normal(size=VERTICES.shape)
    found = vertex_normals_host(vertices, FACES)
    assert found.dtype == np.float64
    np.testing.assert_allclose(found, loop(vertices), atol=1e-13)


@pytest.mark.parametrize("form", FORMS)
def test_normals_point_outwards_and_turn_with_the_mesh(form):
    vertices = np.asarray(VERTICES, np.float32)
    found = np.asarray(FORMS[form](vertices, FACES))
    assert np.sum(found * vertices, axis=1).min() > 0.99
    turn = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    turn = np.asarray(turn * np.sign(np.linalg.det(turn)), np.float32)
    np.testing.assert_allclose(FORMS[form](vertices @ turn, FACES), found @ turn, atol=1e-5)


@pytest.mark.parametrize("form", FORMS)
def test_normals_are_zero_without_area_or_triangle(form):
    """One triangle without area, two that cancel, and a vertex of no triangle."""
    fold = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [5, 5, 5]], np.float32)
    cancelling = np.array([[0, 1, 2], [0, 2, 1]])
    for vertices, faces in ((np.zeros((4, 3), np.float32), np.array([[0, 1, 2]])), (fold, cancelling)):
        assert not np.asarray(FORMS[form](vertices, faces)).any()
    up = np.asarray(FORMS[form](fold, cancelling[:1]))
    np.testing.assert_array_equal(up, [[0, 0, 1]] * 3 + [[0, 0, 0]])
    # Rendering needs a normal everywhere: here the one towards the camera.
    np.testing.assert_array_equal(scene.normals(fold, cancelling), [[0, 0, 1]] * 4)


def test_gradients_are_exact_and_finite_without_area():
    faces = np.array([[0, 1, 2]])
    assert jnp.isfinite(jax.grad(lambda v: jnp.sum(vertex_normals(v, faces)))(jnp.zeros((3, 3)))).all()
    check_grads(
        lambda v: jnp.sum(jnp.sin(3 * vertex_normals(v, FACES))),
        (jnp.asarray(VERTICES, jnp.float32),), order=1, atol=5e-2, rtol=5e-2, eps=1e-3,
    )  # fmt: skip


def test_double_areas_of_triangles():
    first, second = np.random.default_rng(3).normal(size=(2, 20, 3)).astype(np.float32)
    normal, double = triangle_normals(first, second)
    expected = np.cross(first, second)
    np.testing.assert_allclose(double[:, 0], np.linalg.norm(expected, axis=1), rtol=1e-5)
    np.testing.assert_allclose(double * normal, expected, atol=1e-5)
