"""RBF weights of landmarks on a mesh: validity checks, distant boundary, falloff, separation of the lips."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from facejax.data.synthetic import makehuman
from facejax.geometry import rbf
from facejax.mesh import graph, rbf_weights


@pytest.fixture
def landmarks(template):
    return template.vertices[template.landmarks].astype(np.float64)


def sheet(side=21):
    """Return a flat square of side^2 vertices at distance 1, its faces, and four landmarks in its middle."""
    y, x = np.divmod(np.arange(side * side), side)
    i = np.arange(side * side).reshape(side, side)
    a, b, c, d = (q.ravel() for q in (i[:-1, :-1], i[:-1, 1:], i[1:, 1:], i[1:, :-1]))
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    vertices = np.stack([x, y, np.zeros(side * side)], axis=1).astype(np.float64)
    return vertices, faces, np.array([[9.0, 9, 0], [11, 9, 0], [11, 11, 0], [9, 11, 0]])


def test_the_rim_of_the_head_is_its_neck(template, landmarks):
    neck = next(loop for loop in graph.boundary_loops(template.faces) if len(loop) == 42)
    found = rbf_weights.distant_boundary(template.vertices, template.faces, landmarks)
    np.testing.assert_array_equal(found, np.sort(neck))


def test_the_rim_of_a_mask_is_the_part_that_no_landmark_is_near():
    vertices, faces, marks = sheet()
    found = rbf_weights.distant_boundary(vertices, faces, marks, reach=5)
    edge = np.flatnonzero((vertices[:, :2] == 0).any(axis=1) | (vertices[:, :2] == 20).any(axis=1))
    expected = [v for v in edge if min(np.linalg.norm(vertices[v] - m) for m in marks) > 5 * 2]
    np.testing.assert_array_equal(found, expected)
    assert 0 < len(found) < len(edge)


def test_falloff_on_the_head(template, landmarks):
    factor = rbf_weights.falloff(template.vertices, template.faces, landmarks)
    assert factor.dtype == np.float32 and factor.min() == 0 and factor.max() == 1
    np.testing.assert_array_equal(factor[template.landmarks], 1)
    np.testing.assert_array_equal(factor[rbf_weights.distant_boundary(template.vertices, template.faces, landmarks)], 0)
    inner = np.concatenate([loop for loop in graph.boundary_loops(template.faces) if len(loop) != 42])
    assert factor[inner].min() > 0.95
    assert factor[template.face_mask].mean() > 0.9


def test_falloff_against_a_loop():
    vertices, faces, marks = sheet()
    pinned = rbf_weights.distant_boundary(vertices, faces, marks)
    nearest = [min(np.linalg.norm(v - m) for m in marks) for v in vertices]
    end = min(nearest[v] for v in pinned)
    for value, distance in zip(rbf_weights.falloff(vertices, faces, marks), nearest, strict=True):
        t = min(distance / end, 1)
        assert value == pytest.approx(1 - 3 * t**2 + 2 * t**3, abs=1e-6)


def test_falloff_is_smooth_and_falls_with_distance(template, landmarks):
    factor = rbf_weights.falloff(template.vertices, template.faces, landmarks)
    a, b = graph.edges(template.faces).T
    length = np.linalg.norm(template.vertices[a] - template.vertices[b], axis=1)
    # The steepest slope of the smoothstep is 1.5 divided by the distance to the boundary, 58 mm here.
    assert (np.abs(factor[a] - factor[b]) <= 1.5 * length / 57 + 1e-6).all()
    order = np.argsort(cKDTree(landmarks).query(template.vertices)[0])
    assert (np.diff(factor[order]) <= 1e-6).all()


def test_falloff_knows_no_unit(template, landmarks):
    factor = rbf_weights.falloff(template.vertices, template.faces, landmarks)
    metres = rbf_weights.falloff(1e-3 * template.vertices, template.faces, 1e-3 * landmarks)
    np.testing.assert_allclose(metres, factor, atol=1e-5)


def test_a_closed_mesh_is_let_go_of_nowhere():
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
    assert len(rbf_weights.distant_boundary(vertices, faces, 0.1 * vertices)) == 0
    np.testing.assert_array_equal(rbf_weights.falloff(vertices, faces, 0.1 * vertices), 1)


def test_landmarks_on_triangles_pass_and_on_coarse_meshes_too(template, landmarks):
    rbf_weights.check(landmarks, template.vertices)
    rng = np.random.default_rng(0)
    inside = np.einsum("lc,lcx->lx", rng.dirichlet(np.ones(3), 68), template.vertices[template.faces[:68]])
    rbf_weights.check(inside, template.vertices)
    vertices, faces, _ = sheet(4)
    rbf_weights.check(vertices[faces].mean(axis=1), vertices)


@pytest.mark.parametrize(
    ("move", "match"),
    [
        (lambda x: x + np.eye(68, 1, -7) * [[0, 0, 40.0]], r"landmark 7 is \d+\.?\d* off the mesh \(nearest vertex"),
        (lambda x: 1e-3 * x, r"landmark \d+ is .* face, unit and"),
        (lambda x: 1e3 * x, r"landmark \d+ is .* face, unit and"),
        (lambda x: x[:, [2, 0, 1]], r"landmark \d+ is .* and coordinate system"),
        (lambda x: x * np.nan, r"landmarks: expected finite \(K, 3\)"),
        (lambda x: x[:, :2], r"landmarks: expected finite \(K, 3\), got \(68, 2\)"),
    ],
)
def test_landmarks_off_the_mesh_are_named(template, landmarks, move, match):
    with pytest.raises(ValueError, match=match):
        rbf_weights.check(move(landmarks), template.vertices)


def test_the_sides_of_the_mouth(template, landmarks):
    share = rbf_weights.upper_lip_share(template.vertices, template.faces, landmarks, rbf_weights.IBUG_LIPS)
    upper, lower = (template.landmarks[list(lip)] for lip in rbf_weights.IBUG_LIPS)
    assert (share[upper] == 1).all() and (share[lower] == 0).all()
    # The boundary of the mouth, closed at rest: its upper half belongs to the upper lip.
    (rim,) = (loop for loop in graph.boundary_loops(template.faces) if len(loop) == 38)
    middle = rim[np.abs(template.vertices[rim, 0]) < 12]
    assert set(np.round(share[middle])) == {0, 1} and np.abs(share[middle] - 0.5).min() > 0.45
    assert np.abs(share[template.landmarks[[48, 54]]] - 0.5).max() < 0.35
    up = np.array([1, 2, 0])
    swapped = rbf_weights.upper_lip_share(template.vertices, template.faces, landmarks, rbf_weights.IBUG_LIPS[::-1])
    np.testing.assert_allclose(swapped, 1 - share, atol=1e-6)
    turned = rbf_weights.upper_lip_share(
        template.vertices[:, up], template.faces, landmarks[:, up], rbf_weights.IBUG_LIPS
    )
    np.testing.assert_allclose(turned, share, atol=1e-5)


def test_sides_where_no_way_leads():
    vertices, faces, _ = sheet(3)
    two = np.concatenate([vertices, vertices + [0, 0, 5]])
    share = rbf_weights.upper_lip_share(two, np.concatenate([faces, faces + 9]), two[[0, 8]], ([0], [1]))
    assert share[0] == 1 and share[8] == 0 and (share[9:] == 0.5).all()


@pytest.mark.parametrize("lips", [None, rbf_weights.IBUG_LIPS])
def test_weights_meet_the_landmarks_and_pin_the_rim(template, landmarks, lips):
    found = rbf_weights.weights(template.vertices, template.faces, landmarks, lips=lips)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found[template.landmarks], np.eye(68), atol=1e-6)
    np.testing.assert_array_equal(found[rbf_weights.distant_boundary(template.vertices, template.faces, landmarks)], 0)
    if lips is None:
        factor = rbf_weights.falloff(template.vertices, template.faces, landmarks)[:, None]
        np.testing.assert_allclose(found, factor * rbf.weights(rbf.fit(landmarks), template.vertices), atol=1e-6)


def test_parted_lips_open_a_closed_mouth(template, landmarks):
    (rim,) = (loop for loop in graph.boundary_loops(template.faces) if len(loop) == 38)
    moved = np.zeros((68, 3), np.float32)
    moved[list(rbf_weights.IBUG_LIPS[1]), 1] = -20
    gap = {}
    for lips in (None, rbf_weights.IBUG_LIPS):
        found = np.asarray(
            rbf.warp(rbf_weights.weights(template.vertices, template.faces, landmarks, lips=lips), moved)
        )
        middle = rim[np.abs(template.vertices[rim, 0]) < 8]
        gap[lips] = np.ptp(found[middle, 1])
    assert gap[rbf_weights.IBUG_LIPS] > 15 and gap[None] < 12


def test_parted_lips_still_carry_affine_motion(template, landmarks):
    found = rbf_weights.weights(template.vertices, template.faces, landmarks, lips=rbf_weights.IBUG_LIPS)
    factor = rbf_weights.falloff(template.vertices, template.faces, landmarks)[:, None]
    matrix, shift = np.array([[0.1, 0, 0.2], [0, -0.1, 0], [0.3, 0, 0]]), np.array([1.0, 2, 3])
    expected = factor * (template.vertices @ matrix + shift)
    np.testing.assert_allclose(rbf.warp(found, landmarks @ matrix + shift), expected, atol=2e-4)


def test_weights_refuse_landmarks_off_the_mesh(template, landmarks):
    with pytest.raises(ValueError, match="off the mesh"):
        rbf_weights.weights(template.vertices, template.faces, landmarks + [0, 0, 60.0])


def test_a_single_landmark_has_no_spacing(template):
    with pytest.raises(ValueError, match="at least 2, got 1"):
        rbf_weights.distant_boundary(template.vertices, template.faces, np.zeros((1, 3)))


def test_landmarks_in_one_place_are_named_as_the_user_counts_them():
    """The error has the indices of all landmarks, also where a fit uses a part of them, as those of one lip."""
    shape = makehuman.template()
    marks = shape.vertices[shape.landmarks].astype(np.float64)
    marks[63] = marks[61]
    with pytest.raises(ValueError, match="landmarks 61 and 63 coincide"):
        rbf_weights.weights(shape.vertices, shape.faces, marks, lips=rbf_weights.IBUG_LIPS)
