"""A user's face: other units, other axes, whole bodies, and what is refused."""

import numpy as np
import pytest

from facejax.data.synthetic import assets, makehuman
from facejax.io import meshes, neutral_face
from facejax.landmarks import canonical_frame


@pytest.fixture(scope="module")
def topology(template):
    return canonical_frame.Topology(
        template.vertices, template.landmarks, assets.load().source_index[: len(template.vertices)]
    )


@pytest.fixture(scope="module")
def person():
    return makehuman.subject(3).vertices


def test_a_plain_face_comes_back_as_it_is(topology, person):
    found = canonical_frame.fit(person, topology)
    np.testing.assert_array_equal(found.vertices, person)
    assert found.notes == ()


@pytest.mark.parametrize(("unit", "millimetres"), [("centimetres", 10.0), ("decimetres", 100.0), ("metres", 1000.0)])
def test_units_are_recognised_and_said(topology, person, unit, millimetres):
    found = canonical_frame.fit(person / millimetres, topology)
    np.testing.assert_allclose(found.vertices, person, atol=1e-3)
    assert found.notes == (f"read as {unit}",)


def test_a_face_with_z_up_is_turned(topology, person):
    z_up = person[:, [0, 2, 1]] * [1, -1, 1]  # y up, z forward -> z up, -y forward, as Blender has it
    found = canonical_frame.fit(z_up, topology)
    np.testing.assert_allclose(found.vertices, person, atol=1e-4)
    assert "y is up" in found.notes[0]


@pytest.mark.parametrize("count", [13_380, 19_158])
def test_the_head_is_cut_out_of_a_body(topology, person, count, tmp_path):
    body = np.random.default_rng(0).normal(size=(count, 3)) * 500
    body[topology.source_index] = person + [0, 1600, 0]
    path = tmp_path / "body.obj"
    meshes.write(path, body / 1000, np.array([[0, 1, 2]]))
    found = neutral_face.read(path, topology)
    np.testing.assert_allclose(found.vertices, person + np.float32([0, 1600, 0]), atol=1e-3)
    assert "MakeHuman body" in found.notes[0] and "metres" in found.notes[1]


def test_what_is_no_face_is_refused(topology, person):
    with pytest.raises(canonical_frame.FaceError, match=r"12 vertices, expected 3260.*13380 or 19158.*--sample"):
        canonical_frame.fit(np.zeros((12, 3)), topology)
    with pytest.raises(canonical_frame.FaceError, match="vertex 7 is not finite"):
        broken = person.copy()
        broken[7, 1] = np.nan
        canonical_frame.fit(broken, topology)
    with pytest.raises(canonical_frame.FaceError, match="another order"):
        canonical_frame.fit(np.random.default_rng(0).permutation(person), topology)
    with pytest.raises(canonical_frame.FaceError, match="times as large as a head"):
        canonical_frame.fit(person * 30, topology)
    with pytest.raises(canonical_frame.FaceError, match="coincide"):
        canonical_frame.fit(np.zeros_like(person), topology)
    with pytest.raises(canonical_frame.FaceError, match=r"must be \(3260, 3\)"):
        canonical_frame.fit(person[:, :2], topology)


def test_a_file_with_another_topology_is_refused_as_a_mesh(topology, tmp_path):
    path = tmp_path / "small.obj"
    meshes.write(path, np.zeros((12, 3)), np.array([[0, 1, 2]]))
    with pytest.raises(meshes.MeshError, match=r"small.obj: 12 vertices, expected 3260"):
        neutral_face.read(path, topology)


@pytest.mark.parametrize(("size", "unit"), [(231.0, "millimetres"), (0.147, "metres"), (12.0, "centimetres")])
def test_the_unit_of_a_mesh_without_known_landmarks_is_told_by_its_size(size, unit):
    """Heads, and faces cut out of them: no size fits two units."""
    millimetres, found = canonical_frame.infer_head_unit(size, "it")
    assert found == unit and millimetres == canonical_frame.UNITS[unit]
    with pytest.raises(canonical_frame.FaceError, match="it: size 41; expected a head of 100 to 400 mm"):
        canonical_frame.infer_head_unit(41.0, "it")
