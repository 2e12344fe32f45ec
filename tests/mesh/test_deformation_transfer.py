"""Deformation transfer: compared with a dense least-squares solution; fields whose transfer is known."""

import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest
import trimesh

from facejax.mesh import deformation_transfer
from facejax.mesh.deformation_transfer import DeformationTransfer, anchor_weights

BALL = trimesh.creation.icosphere(subdivisions=2)  # 162 vertices
N, FACES = len(BALL.vertices), np.asarray(BALL.faces)
MOVING = np.full(N, 10.0)  # mm: so much that anchors have almost no weight


def field(seed, *shape):
    return np.random.default_rng(seed).normal(size=shape)


def face(seed):
    """Return the vertices (N, 3) of a deformed sphere of about 50 mm."""
    return 50 * np.asarray(BALL.vertices) @ (np.eye(3) + 0.2 * field(seed, 3, 3)) + 2 * field(seed + 50, N, 3)


def smooth(seed, count):
    """Return smooth fields (count, N, 3) on the sphere, in mm."""
    return np.sin(2 * BALL.vertices @ field(seed, count, 3, 3) + field(seed + 50, count, 1, 3))


def grid(seed):
    """Return vertices and faces of a flat patch, its inner vertices displaced within the plane."""
    x, y = np.meshgrid(np.arange(6.0), np.arange(5.0))
    points = np.stack([x, y, 0 * x], axis=-1)
    points[1:-1, 1:-1, :2] += 0.3 * np.random.default_rng(seed).uniform(-1, 1, (3, 4, 2))
    at = np.arange(30).reshape(5, 6)
    a, b, c, d = (part.ravel() for part in (at[:-1, :-1], at[:-1, 1:], at[1:, :-1], at[1:, 1:]))
    return points.reshape(-1, 3), np.concatenate([np.stack([a, b, c], axis=1), np.stack([b, d, c], axis=1)])


def slope(vertices, corners, values):
    """Return the gradient (3,) of a triangle's corner values: in its plane, with their differences along edges."""
    a, b, c = vertices[corners]
    rows = np.stack([b - a, c - a, np.cross(b - a, c - a)])
    return np.linalg.solve(rows, [values[1] - values[0], values[2] - values[0], 0])


def test_gradients_and_areas_are_those_of_the_plain_loop():
    vertices, values = face(0), field(1, N)
    operator, areas = deformation_transfer.gradient_operator(vertices, FACES)
    expected = [slope(vertices, corners, values[corners]) for corners in FACES]
    np.testing.assert_allclose((operator @ values).reshape(-1, 3), expected, atol=1e-9)
    np.testing.assert_allclose(areas, trimesh.Trimesh(vertices, FACES, process=False).area_faces, rtol=1e-9)


def test_carried_fields_solve_the_stated_least_squares():
    source, target, fields = face(0), face(1), smooth(2, 3)
    motion = np.random.default_rng(3).uniform(0, 0.2, N)
    found = DeformationTransfer(source, target, FACES, anchor_weights(motion))(fields)
    areas = trimesh.Trimesh(target, FACES, process=False).area_faces
    held = np.sqrt(deformation_transfer.ANCHOR * areas.mean() / (1 + (motion / deformation_transfer.MOTION) ** 2))
    rows, wanted = [], []
    for corners, area in zip(FACES, areas, strict=True):
        row = np.zeros((3, N))
        for i, corner in enumerate(corners):
            row[:, corner] = np.sqrt(area) * slope(target, corners, np.eye(3)[i])
        rows.append(row)
        for x in range(3):
            wanted.append([np.sqrt(area) * slope(source, corners, each[corners, x]) for each in fields])
    wanted = np.asarray(wanted).reshape(len(FACES), 3, len(fields), 3).transpose(0, 3, 2, 1).reshape(3 * len(FACES), -1)
    rows, wanted = np.concatenate([*rows, np.diag(held)]), np.concatenate(
        [wanted, held[:, None] * fields.transpose(1, 0, 2).reshape(N, -1)]
    )  # fmt: skip
    expected = np.linalg.lstsq(rows, wanted, rcond=None)[0]
    np.testing.assert_allclose(found.transpose(1, 0, 2).reshape(N, -1), expected, atol=1e-6)


@pytest.mark.parametrize("motion", [np.zeros(N), MOVING, np.linspace(0, 3, N)], ids=["still", "moving", "mixed"])
def test_to_the_same_face_nothing_changes(motion):
    fields = field(1, 4, N, 3)
    np.testing.assert_allclose(
        DeformationTransfer(face(0), face(0), FACES, anchor_weights(motion))(fields), fields, atol=1e-6
    )


def test_translations_are_carried_as_they_are():
    fields = np.broadcast_to(field(1, 2, 1, 3), (2, N, 3))
    np.testing.assert_allclose(
        DeformationTransfer(face(0), face(1), FACES, anchor_weights(np.ones(N)))(fields), fields, atol=1e-6
    )


def test_an_affine_field_of_a_flat_patch_stays_affine():
    (source, faces), (target, _) = grid(0), grid(1)
    assert np.abs(source - target).max() > 0.2
    matrix = field(2, 3, 3)
    found = DeformationTransfer(source, target, faces, anchor_weights(np.full(len(source), 10.0)))(
        (source @ matrix)[None]
    )[0]
    # Gradients leave a translation free; the anchors determine it: the mean displacement is kept.
    expected = target @ matrix
    np.testing.assert_allclose(found, expected - expected.mean(axis=0) + (source @ matrix).mean(axis=0), atol=1e-5)


def test_a_scaled_face_moves_scaled():
    fields = smooth(1, 2)
    found = DeformationTransfer(face(0), 3 * face(0), FACES, anchor_weights(MOVING))(fields)
    shift = (found - 3 * fields).mean(axis=1, keepdims=True)
    np.testing.assert_allclose(found - shift, 3 * fields, atol=1e-4)


def test_turned_faces_turn_what_is_carried():
    turn = np.linalg.qr(field(9, 3, 3))[0]
    fields, motion = smooth(1, 2), np.linspace(0, 2, N)
    plain = DeformationTransfer(face(0), face(1), FACES, anchor_weights(motion))(fields)
    turned = DeformationTransfer(face(0) @ turn, face(1) @ turn, FACES, anchor_weights(motion))(fields @ turn)
    np.testing.assert_allclose(turned, plain @ turn, atol=1e-7)


def test_fields_are_carried_each_for_itself_and_linearly():
    carrier, fields = DeformationTransfer(face(0), face(1), FACES, anchor_weights(np.ones(N))), smooth(1, 3)
    together = carrier(fields)
    assert together.shape == fields.shape
    for one, expected in zip(fields, together, strict=True):
        np.testing.assert_allclose(carrier(one[None])[0], expected, atol=1e-9)
    np.testing.assert_allclose(carrier(2 * fields[:1] - fields[1:2])[0], 2 * together[0] - together[1], atol=1e-9)


def test_vertices_that_never_move_are_held():
    lower = np.asarray(BALL.vertices)[:, 2] < -0.3
    fields = np.where(lower[:, None], 0.0, smooth(1, 3))
    held = DeformationTransfer(face(0), face(1), FACES, anchor_weights(np.where(lower, 0.0, 10.0)))(fields)
    free = DeformationTransfer(face(0), face(1), FACES, anchor_weights(MOVING))(fields)
    # Gradients leave a translation free; anchors keep the vertices in place that do not move on the source.
    held, free = (np.linalg.norm(carried[:, lower].mean(axis=1), axis=-1) for carried in (held, free))
    assert (held < 1e-4).all() and (free > 1e-2).all()


def test_settled_fields_come_back():
    there = DeformationTransfer(face(0), face(1), FACES, anchor_weights(np.ones(N)))
    back = DeformationTransfer(face(1), face(0), FACES, anchor_weights(np.ones(N)))
    fields = smooth(1, 3)
    missing = [
        np.linalg.norm(back(deformation_transfer.invert(there, back, fields, rounds=rounds)) - fields, axis=-1).mean()
        for rounds in (0, 1, 2, 4)
    ]
    assert missing[0] > 2 * missing[1] > 2 * missing[2] > 2 * missing[3] > 0
    np.testing.assert_array_equal(deformation_transfer.invert(there, back, fields, rounds=0), there(fields))
    np.testing.assert_array_equal(
        deformation_transfer.invert(there, back, fields), deformation_transfer.invert(there, back, fields, rounds=2)
    )  # fmt: skip


def test_faces_of_different_shapes_are_named(monkeypatch):
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)  # what a caller gets: only tests check shapes
    with pytest.raises(
        ValueError, match=r"source and target .* of one shape .* got \(162, 3\), \(161, 3\) and \(162,\)"
    ):
        DeformationTransfer(face(0), face(1)[1:], FACES, anchor_weights(MOVING))
    with pytest.raises(ValueError, match=r"anchors \(N,\), got .* and \(161,\)"):
        DeformationTransfer(face(0), face(1), FACES, anchor_weights(MOVING[1:]))


@pytest.mark.parametrize("motion", [MOVING, np.where(np.arange(N) < 40, 0.0, 2.0)], ids=["free", "held"])
def test_in_jax_it_is_that_of_the_host(dtype, motion):
    """Also where all vertices move, and the anchors hardly determine a shift."""
    source, target, fields, anchors = face(0), face(1), smooth(2, 3), anchor_weights(motion)
    tables = deformation_transfer.transfer_tables(FACES, N)
    found = deformation_transfer.transfer(*(x.astype(dtype) for x in (source, target)), tables, anchors, fields)
    assert found.dtype == dtype
    expected = DeformationTransfer(source, target, FACES, anchors)(fields)
    np.testing.assert_allclose(found, expected, atol=2e-5 if dtype == np.float32 else 1e-10)


def test_in_jax_parts_of_a_mesh_do_not_pull_each_other():
    faces = np.concatenate([FACES, FACES + N])
    source, target = (np.concatenate([face(seed), face(seed + 1) + 200]) for seed in (0, 2))
    fields, anchors = smooth(2, 3), anchor_weights(MOVING)
    moved = np.concatenate([fields, 2 * fields], axis=1)
    tables = deformation_transfer.transfer_tables(faces, 2 * N)
    found = deformation_transfer.transfer(
        source.astype(np.float32), target.astype(np.float32), tables, np.tile(anchors, 2), moved
    )
    expected = DeformationTransfer(source, target, faces, np.tile(anchors, 2))(moved)
    np.testing.assert_allclose(found, expected, atol=5e-5)


def test_in_jax_faces_are_vectorised_and_gradients_are_exact():
    source, targets, fields = face(0), np.stack([face(1), face(2)]), smooth(2, 2)
    tables, anchors = deformation_transfer.transfer_tables(FACES, N), anchor_weights(MOVING)
    with jax.enable_x64(True):
        carry = lambda target: deformation_transfer.transfer(source, target, tables, anchors, fields)  # noqa: E731
        each = [carry(target) for target in targets]
        np.testing.assert_allclose(jax.vmap(carry)(targets), each, atol=1e-10)
        total = jax.jit(lambda target: jnp.sum(jnp.sin(carry(target))))
        slope, step = jax.grad(total)(targets[0]), field(5, N, 3)
        along = (total(targets[0] + 1e-5 * step) - total(targets[0] - 1e-5 * step)) / 2e-5
        np.testing.assert_allclose(np.sum(slope * step), along, rtol=1e-6)


def test_in_jax_a_triangle_without_area_has_no_influence():
    target = face(1)
    target[FACES[0, 1]] = target[FACES[0, 0]]
    tables = deformation_transfer.transfer_tables(FACES, N)
    found = deformation_transfer.transfer(face(0), target, tables, anchor_weights(MOVING), smooth(2, 1))
    assert np.isfinite(found).all()
