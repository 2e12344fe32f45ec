"""Strain: compared with a loop over triangles; motions whose strain is known."""

import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest
import trimesh
from jax.test_util import check_grads

from facejax.mesh import strain

BALL = trimesh.creation.icosphere(subdivisions=1)  # 42 vertices
VERTICES, FACES, N = np.asarray(BALL.vertices), np.asarray(BALL.faces), len(BALL.vertices)
TABLES = strain.vertex_triangles(FACES, N)
SIX = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))


def array(seed, *shape):
    return jnp.asarray(np.random.default_rng(seed).normal(size=shape), jnp.float32)


def faces(batch, seed=0):
    """Return deformed spheres (N, B, 3)."""
    return jnp.asarray(VERTICES, jnp.float32)[:, None] + 0.05 * array(seed, N, batch, 3)


def plain(displacements, neutral, triangles):
    """Return strain and normals of one sample (N, 3): of each triangle in its plane, averaged about each vertex."""
    total, normals, count = np.zeros((len(neutral), 3, 3)), np.zeros((len(neutral), 3)), np.zeros(len(neutral))
    moved = neutral + displacements
    for corners in triangles:
        a, b, c = neutral[corners]
        normal = np.cross(b - a, c - a)
        normal /= np.linalg.norm(normal)
        first = (b - a) / np.linalg.norm(b - a)
        plane = np.stack([first, np.cross(normal, first)], axis=1)  # (3, 2)
        before = np.stack([b - a, c - a], axis=1)
        after = np.stack([moved[corners[1]] - moved[corners[0]], moved[corners[2]] - moved[corners[0]]], axis=1)
        deformation = after @ np.linalg.inv(plane.T @ before)  # (3, 2)
        green = 0.5 * (deformation.T @ deformation - np.eye(2))
        total[corners] += plane @ green @ plane.T
        normals[corners] += normal
        count[corners] += 1
    mean = total / np.maximum(count, 1)[:, None, None]
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.stack([mean[:, i, j] for i, j in SIX], axis=-1), normals / np.maximum(length, 1e-12)


def test_tables_name_the_triangles_about_each_vertex():
    # An open mesh; the last vertex belongs to no triangle.
    triangles = FACES[5:]
    tables = strain.vertex_triangles(triangles, N + 1)
    for vertex in range(N + 1):
        named = tables.about[vertex]
        assert sorted(named[named < len(triangles)]) == np.flatnonzero((triangles == vertex).any(axis=1)).tolist()
        assert tables.count[vertex] == max((triangles == vertex).sum(), 1)
    assert tables.about.max() == len(triangles) and (tables.about[N] == len(triangles)).all()


@pytest.mark.parametrize("scale", [1.0, 50.0])
def test_strain_and_normals_are_those_of_the_plain_loop(scale):
    neutral, moved = scale * faces(3), scale * 0.3 * array(1, N, 3, 3)
    found, normals = strain.strain(moved, neutral, TABLES)
    for i in range(3):
        expected, normal = plain(np.asarray(moved[:, i], np.float64), np.asarray(neutral[:, i], np.float64), FACES)
        np.testing.assert_allclose(found[:, i], expected, atol=2e-5)
        np.testing.assert_allclose(normals[:, i], normal, atol=1e-5)


def test_on_an_open_mesh_a_vertex_of_no_triangle_has_none():
    triangles = FACES[5:]
    tables = strain.vertex_triangles(triangles, N + 1)
    neutral = jnp.concatenate([faces(1), jnp.ones((1, 1, 3))])
    moved = 0.3 * array(1, N + 1, 1, 3)
    found, normals = strain.strain(moved, neutral, tables)
    expected, normal = plain(*(np.asarray(x[:, 0], np.float64) for x in (moved, neutral)), triangles)
    np.testing.assert_allclose(found[:, 0], expected, atol=2e-5)
    np.testing.assert_allclose(normals[:, 0], normal, atol=1e-5)
    assert not found[N].any() and not normals[N].any()


def test_rigid_motions_strain_nothing():
    turn = jnp.linalg.qr(array(2, 3, 3))[0]
    turn = turn * jnp.sign(jnp.linalg.det(turn))
    neutral = faces(2)
    moved = neutral @ turn + jnp.array([3.0, -1.0, 2.0]) - neutral
    assert float(jnp.abs(moved).max()) > 1
    np.testing.assert_allclose(strain.strain(moved, neutral, TABLES)[0], 0, atol=1e-5)


@pytest.mark.parametrize("stretch", [-0.2, 0.1, 0.5])
def test_a_uniform_stretch_is_that_in_all_directions_of_the_skin(stretch):
    neutral = faces(2)
    found, _ = strain.strain(stretch * neutral, neutral, TABLES)
    exact = ((1 + stretch) ** 2 - 1) / 2
    np.testing.assert_allclose(found[..., :3].sum(axis=-1), 2 * exact, atol=1e-5)  # two directions
    flat = jnp.asarray([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], jnp.float32)[:, None]
    found, normals = strain.strain(stretch * flat, flat, strain.vertex_triangles(np.array([[0, 1, 2], [1, 3, 2]]), 4))
    np.testing.assert_allclose(found[:, 0], np.broadcast_to([exact, exact, 0, 0, 0, 0], (4, 6)), atol=1e-6)
    np.testing.assert_allclose(normals[:, 0], np.broadcast_to([0, 0, 1], (4, 3)), atol=1e-6)


def test_turning_the_face_or_the_moved_face():
    turn = jnp.linalg.qr(array(2, 3, 3))[0]
    turn = turn * jnp.sign(jnp.linalg.det(turn))
    neutral, moved = faces(2), 0.2 * array(1, N, 2, 3)
    found, normals = strain.strain(moved, neutral, TABLES)
    # A rotation of the moved face alone does not change the strain.
    alone, _ = strain.strain((neutral + moved) @ turn - neutral, neutral, TABLES)
    np.testing.assert_allclose(alone, found, atol=1e-5)
    # A rotation of both faces rotates the tensor.
    both, turned = strain.strain(moved @ turn, neutral @ turn, TABLES)
    tensor = np.zeros((N, 2, 3, 3))
    for k, (i, j) in enumerate(SIX):
        tensor[..., i, j] = tensor[..., j, i] = found[..., k]
    tensor = turn.T @ tensor @ turn
    np.testing.assert_allclose(both, np.stack([tensor[..., i, j] for i, j in SIX], axis=-1), atol=1e-5)
    np.testing.assert_allclose(turned, normals @ turn, atol=1e-5)


def test_a_triangle_without_area_adds_nothing():
    triangles = np.concatenate([FACES, [[0, 0, 1]]])
    neutral, moved = faces(1), 0.2 * array(1, N, 1, 3)
    found, _ = strain.strain(moved, neutral, strain.vertex_triangles(triangles, N))
    expected, _ = strain.strain(moved, neutral, TABLES)
    assert jnp.isfinite(found).all()
    np.testing.assert_allclose(found[2:], expected[2:], atol=1e-6)


def test_samples_do_not_mix():
    neutral, moved = faces(3), 0.2 * array(1, N, 3, 3)
    for one, all_ in zip(
        strain.strain(moved[:, 1:2], neutral[:, 1:2], TABLES), strain.strain(moved, neutral, TABLES), strict=True
    ):
        np.testing.assert_allclose(one[:, 0], all_[:, 1], atol=1e-5)


def test_gradients_and_finite_differences_agree():
    with jax.enable_x64(True):
        neutral, moved = faces(1).astype(float), 0.2 * array(1, N, 1, 3).astype(float)
        check_grads(
            jax.jit(lambda d, v: sum(jnp.sum(jnp.sin(3 * part)) for part in strain.strain(d, v, TABLES))),
            (moved, neutral), order=1, modes=("rev",),
        )  # fmt: skip


def test_wrong_shapes_are_named(monkeypatch):
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)  # what a caller gets: only tests check shapes
    with pytest.raises(ValueError, match=r"two arrays \(N, B, 3\), got \(42, 2, 3\) and \(42, 3\)"):
        strain.strain(jnp.zeros((N, 2, 3)), jnp.zeros((N, 3)), TABLES)
    with pytest.raises(ValueError, match=r"two arrays \(N, B, 3\)"):
        strain.strain(jnp.zeros((N, 2, 2)), jnp.zeros((N, 2, 2)), TABLES)
