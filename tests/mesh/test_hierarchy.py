"""Hierarchies: consistent from level to level, cached by content, and restored from named arrays."""

import jax
import numpy as np
import pytest
import trimesh

from facejax.mesh import hierarchy as mesh_hierarchy

BALL = trimesh.creation.icosphere(subdivisions=3)
VERTICES, FACES = np.asarray(BALL.vertices), np.asarray(BALL.faces)
OPTIONS = {"factors": (4, 4), "lengths": (9, 7)}


@pytest.fixture(scope="module")
def hierarchy():
    return mesh_hierarchy.build(VERTICES, FACES, **OPTIONS)


def assert_same(a, b):
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert x.dtype == y.dtype
        np.testing.assert_array_equal(x, y)


def test_levels_fit_together(hierarchy):
    sizes = hierarchy.sizes
    assert sizes[0] == len(VERTICES) and len(sizes) == 3
    assert all(0.2 < b / a < 0.32 for a, b in zip(sizes, sizes[1:], strict=False))
    for level in range(2):
        assert np.isin(hierarchy.kept[level + 1], hierarchy.kept[level]).all()
        assert hierarchy.spirals[level].shape == (sizes[level], OPTIONS["lengths"][level])
        np.testing.assert_array_equal(hierarchy.spirals[level][:, 0], np.arange(sizes[level]))
        # A kept vertex is interpolated from itself alone.
        rows = np.searchsorted(hierarchy.kept[level], hierarchy.kept[level + 1])
        lifted = np.zeros((sizes[level], sizes[level + 1]))
        np.add.at(
            lifted,
            (np.arange(sizes[level])[:, None], hierarchy.corners[level]),
            hierarchy.weights[level],
        )
        np.testing.assert_array_equal(lifted[rows], np.eye(sizes[level + 1]))
    for kept, faces in zip(hierarchy.kept, hierarchy.faces, strict=True):
        mesh = trimesh.Trimesh(VERTICES[kept], faces, process=False)
        assert mesh.is_watertight and mesh.is_winding_consistent


def test_stencils_are_the_product_of_spirals_and_lifting(hierarchy):
    for level, stencil in enumerate(hierarchy.climbs):
        fine, coarse = hierarchy.sizes[level : level + 2]
        for position in range(OPTIONS["lengths"][level]):
            expected = np.zeros((fine, coarse))
            for vertex in range(fine):
                read = hierarchy.spirals[level][vertex, position]
                if read < fine:
                    for corner, weight in zip(
                        hierarchy.corners[level][read], hierarchy.weights[level][read], strict=True
                    ):
                        expected[vertex, corner] += weight
            forward, backward = dense(stencil, position, fine, coarse)
            np.testing.assert_allclose(forward, expected, atol=1e-7)
            np.testing.assert_array_equal(backward, forward)


def test_surface_stencil_is_the_spirals(hierarchy):
    size = hierarchy.sizes[0]
    for position in range(OPTIONS["lengths"][0]):
        forward, backward = dense(hierarchy.surface, position, size, size)
        read = hierarchy.spirals[0][:, position]
        np.testing.assert_array_equal(forward, np.eye(size + 1)[read, :size])
        np.testing.assert_array_equal(backward, forward)


def test_inverse_lists_leave_a_remainder(hierarchy):
    # Otherwise the tests of the transposed map would not cover the scattered part.
    assert all(stencil.rest_weight.any() for stencil in (*hierarchy.climbs, hierarchy.surface))


def dense(stencil, position, fine, coarse):
    """Return one position's map as matrices (fine, coarse): by the forward and by the transposed tables."""
    forward, backward = np.zeros((2, fine, coarse), np.float32)
    for index, weight in zip(stencil.source[position], stencil.weight[position], strict=True):
        np.add.at(forward, (np.arange(fine), index), weight)
    for index, weight in zip(stencil.back[position], stencil.back_weight[position], strict=True):
        np.add.at(backward, (index, np.arange(coarse)), weight)
    rest = (stencil.rest_from[position], stencil.rest_to[position])
    np.add.at(backward, rest, stencil.rest_weight[position])
    return forward, backward


def test_saved_tables_restore_the_hierarchy(hierarchy):
    arrays = mesh_hierarchy.save(hierarchy)
    assert all(isinstance(name, str) and isinstance(array, np.ndarray) for name, array in arrays.items())
    assert_same(mesh_hierarchy.load(arrays), hierarchy)


def test_wrong_tables_are_named(hierarchy):
    arrays = mesh_hierarchy.save(hierarchy)
    with pytest.raises(ValueError, match="faces/1"):
        mesh_hierarchy.load({name: array for name, array in arrays.items() if name != "faces/1"})
    with pytest.raises(ValueError, match="kept/0"):
        mesh_hierarchy.load({})
    with pytest.raises(ValueError, match="level 0: expected tables for 642"):
        mesh_hierarchy.load(arrays | {"corners/0": arrays["corners/0"][1:]})
    with pytest.raises(ValueError, match="level 1: a table has a vertex index out of range"):
        mesh_hierarchy.load(arrays | {"spirals/1": arrays["spirals/1"] + 2})


def test_cache_returns_the_same_and_survives_damage(hierarchy, tmp_path, monkeypatch):
    first = mesh_hierarchy.build(VERTICES, FACES, cache=tmp_path, **OPTIONS)
    (file,) = tmp_path.iterdir()
    assert_same(first, hierarchy)
    monkeypatch.setattr(mesh_hierarchy, "_build", None)  # from here on, a result can only come from the cached file
    assert_same(mesh_hierarchy.build(VERTICES, FACES, cache=tmp_path, **OPTIONS), hierarchy)
    monkeypatch.undo()
    whole = file.read_bytes()
    for damaged in (whole[: len(whole) // 2], b"", b"not a zip"):
        file.write_bytes(damaged)
        assert_same(mesh_hierarchy.build(VERTICES, FACES, cache=tmp_path, **OPTIONS), hierarchy)
        assert file.read_bytes() == whole


def test_cache_tells_meshes_and_options_apart(tmp_path):
    mesh_hierarchy.build(VERTICES, FACES, cache=tmp_path, **OPTIONS)
    mesh_hierarchy.build(VERTICES * 2, FACES, cache=tmp_path, **OPTIONS)
    mesh_hierarchy.build(VERTICES, FACES[::-1], cache=tmp_path, **OPTIONS)
    mesh_hierarchy.build(VERTICES, FACES, cache=tmp_path, **OPTIONS | {"lengths": 9})
    mesh_hierarchy.build(VERTICES, FACES, cache=tmp_path, reference=3, **OPTIONS)
    assert len(list(tmp_path.iterdir())) == 5


def test_a_failed_write_leaves_nothing(tmp_path, monkeypatch):
    def fail(*_, **__):
        raise OSError("disk full")

    monkeypatch.setattr(np, "savez", fail)
    with pytest.raises(OSError, match="disk full"):
        mesh_hierarchy.build(VERTICES, FACES, cache=tmp_path, **OPTIONS)
    assert list(tmp_path.iterdir()) == []


def test_options_that_do_not_fit():
    with pytest.raises(ValueError, match="one length per factor, got 1 and 2"):
        mesh_hierarchy.build(VERTICES, FACES, factors=(4, 4), lengths=(9,))
    with pytest.raises(ValueError, match="reference"):
        mesh_hierarchy.build(VERTICES, FACES, reference=10_000, **OPTIONS)


def test_the_head(template):
    hierarchy = mesh_hierarchy.build(template.vertices, template.faces)
    assert hierarchy.sizes[0] == 3260 and len(hierarchy.sizes) == 5
    assert 10 <= hierarchy.sizes[-1] <= 30
    assert [table.shape[1] for table in hierarchy.spirals] == [15, 14, 9, 9]
