"""Motion on meshes of any topology, unit, pose and landmark scheme."""

import jax
import numpy as np
import pytest
import trimesh

from facejax.data.synthetic import makehuman
from facejax.inference import retarget
from facejax.io.meshes import MeshError
from facejax.landmarks import schemes
from facejax.mesh import rbf_weights


@pytest.fixture(scope="module")
def head():
    """Vertices, triangles and landmarks of a person, and the template's landmarks."""
    shape, person = makehuman.template(), makehuman.subject(3)
    return person.vertices, shape.faces, person.vertices[shape.landmarks], shape.vertices[shape.landmarks]


@pytest.fixture(scope="module")
def curve(head):
    """Five frames: the jaw's landmarks and the lips go down, unitless."""
    moved = np.zeros((5, 68, 3), np.float32)
    which = [*range(5, 12), *range(54, 60), *range(64, 68)]
    moved[:, which, 1] = -np.linspace(0, 0.03, 5)[:, None]
    return moved


def turned(angle):
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    return turn.astype(np.float64)


def test_landmarks_go_where_they_are_sent_and_the_neck_stays(head, curve):
    vertices, faces, marks, template = head
    face = retarget.prepare(vertices, faces, marks, template)
    moved = np.asarray(retarget.animate(face, curve))
    index = makehuman.template().landmarks
    norm = np.linalg.norm(marks - marks.mean(axis=0))
    # The person's landmarks are turned a little against the template's: the motion goes with them.
    np.testing.assert_allclose(np.linalg.norm(moved[-1, index] - vertices[index], axis=1).max(), 0.03 * norm, rtol=1e-3)
    np.testing.assert_allclose(moved[:, index], retarget.landmarks_of(face, curve), atol=1e-3)
    np.testing.assert_allclose(moved[0], vertices, atol=1e-4)
    neck = rbf_weights.distant_boundary(vertices, faces, marks)
    assert np.abs(moved[-1, neck] - vertices[neck]).max() < 1e-4 and not face.notes
    loose = retarget.prepare(vertices, faces, marks, template, pin=False)
    assert np.abs(np.asarray(retarget.animate(loose, curve))[-1, neck] - vertices[neck]).max() > 0.1


@pytest.mark.parametrize("unit", [1.0, 0.1, 0.001])
@pytest.mark.parametrize("angle", [0.0, 0.6, np.pi / 2, 2.5])
def test_pose_and_unit_of_the_file_do_not_matter(head, curve, unit, angle):
    """The same mesh turned and in another unit: the same motion, turned with it."""
    vertices, faces, marks, template = head
    plain = retarget.prepare(vertices, faces, marks, template)
    turn = turned(angle)
    other = retarget.prepare(vertices @ turn.T * unit + 7 * unit, faces, marks @ turn.T * unit + 7 * unit, template)
    a, b = (np.asarray(retarget.animate(f, curve)) - f.vertices for f in (plain, other))
    # The pose that is left after the axes were put in order.
    rest = plain.rotation.T @ other.rotation
    np.testing.assert_allclose(b, a @ (other.rotation @ plain.rotation.T).T, atol=5e-3)
    assert np.trace(rest) > 1 + 2 * np.cos(np.pi / 4) - 1e-3  # at most 45 degrees about an axis
    notes = " ".join(other.notes)
    assert ("read as" in notes) == (unit != 1.0) and ("turned so that" in notes) == (angle > np.pi / 4)


def test_a_head_of_no_usual_unit_is_scaled(head, curve):
    vertices, faces, marks, template = head
    face = retarget.prepare(vertices * 0.005, faces, marks * 0.005, template)
    assert any("scaled to the size of a head" in note for note in face.notes)
    np.testing.assert_allclose(np.ptp(face.vertices, axis=0), np.ptp(vertices, axis=0), rtol=0.2)


def test_another_topology_moves_like_the_first(head, curve):
    vertices, faces, marks, template = head
    plain = retarget.prepare(vertices, faces, marks, template)
    finer = trimesh.Trimesh(vertices, faces, process=False).subdivide()
    shuffled = np.random.default_rng(0).permutation(len(finer.vertices))
    where = np.argsort(shuffled)
    other = retarget.prepare(np.asarray(finer.vertices)[shuffled], where[finer.faces], marks, template)
    a, b = (np.asarray(retarget.animate(f, curve)) for f in (plain, other))
    off = np.abs(b[:, where[: len(vertices)]] - a)
    # Ways along edges are a little shorter on the finer mesh, so the lips part a little elsewhere at their corners.
    assert np.quantile(off, 0.98) < 0.02 and off.max() < 1


@pytest.mark.parametrize("count", [51, 83])
def test_other_landmark_schemes(head, curve, count):
    vertices, faces, marks, template = head
    ours, theirs = schemes.common(68, count)
    given = np.zeros((count, 3))
    given[:] = marks[:1] + np.random.default_rng(0).normal(size=(count, 3))  # those that 68 does not know
    given[theirs] = marks[ours]
    face = retarget.prepare(vertices, faces, given, template)
    assert any(f"{len(ours)} of the motion's 68" in note for note in face.notes)
    moved = np.asarray(retarget.animate(face, curve))
    index = makehuman.template().landmarks[ours]
    np.testing.assert_allclose(moved[:, index], retarget.landmarks_of(face, curve), atol=1e-3)
    assert retarget.landmarks_of(face, curve).shape == (5, len(ours), 3)


def test_intensity_scales_and_batches_are_free(head, curve):
    vertices, faces, marks, template = head
    face = retarget.prepare(vertices, faces, marks, template, kernel="thin_plate")
    once, twice = (np.asarray(retarget.animate(face, curve, intensity=i)) - face.vertices for i in (1.0, 2.0))
    np.testing.assert_allclose(twice, 2 * once, atol=1e-3)
    both = retarget.animate(face, np.stack([curve, 0 * curve]))
    np.testing.assert_allclose(both[0] - face.vertices, once, atol=1e-4)
    slope = jax.grad(lambda c: retarget.animate(face, c).sum())(jax.numpy.asarray(curve))
    assert np.isfinite(slope).all() and np.abs(slope).max() > 0


def test_landmarks_that_are_no_face(head, curve):
    vertices, faces, marks, template = head
    with pytest.raises(MeshError, match=r"that.obj: its 68 landmarks do not form a face"):
        retarget.prepare(vertices, faces, marks[schemes.by_count(68).mirror], template, name="that.obj")
    with pytest.raises(MeshError, match="do not form a face"):
        retarget.prepare(vertices, faces, marks[17:][schemes.by_count(51).mirror], template)
    with pytest.raises(MeshError, match="unsupported number of landmarks: 20"):
        retarget.prepare(vertices, faces, marks[:20], template)
    with pytest.raises(MeshError, match=r"landmark 3 is .* off the mesh"):
        off = marks.copy()
        off[3] += 200
        retarget.prepare(vertices, faces, off, template)
    with pytest.raises(MeshError, match="landmarks 5 and 6"):
        same = marks.copy()
        same[6] = same[5]
        retarget.prepare(vertices, faces, same, template)
    with pytest.raises(MeshError, match="kernel: expected one of"):
        retarget.prepare(vertices, faces, marks, template, kernel="cubic")
    face = retarget.prepare(vertices, faces, marks, template)
    with pytest.raises(ValueError, match=r"curve: expected \(..., T, L, 3\) with L of 68 or more"):
        retarget.animate(face, curve[:, :51])
    with pytest.raises(ValueError, match="intensity"):
        retarget.animate(face, curve, intensity=3)


def test_a_head_that_turns_takes_its_neck_along(head, curve):
    """The same expression on a nodding head: the expression, nodding."""
    vertices, faces, marks, template = head
    face = retarget.prepare(template=template, vertices=vertices, triangles=faces, landmarks=marks)
    still = np.asarray(retarget.landmarks_of(face, curve))
    angles = np.linspace(0, 0.2, 5)
    nods = np.stack([[[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]] for a in angles])
    nodding = np.einsum("tij,tlj->tli", nods, still) + 3 * angles[:, None, None]
    unitless = (nodding - marks) @ face.rotation / face.size
    moved = np.asarray(retarget.animate(face, unitless, head=True))
    wanted = np.einsum("tij,tlj->tli", nods, np.asarray(retarget.animate(face, curve))) + 3 * angles[:, None, None]
    np.testing.assert_allclose(moved, wanted, atol=2e-2)
