"""Pictures: what must be seen where, from spheres whose look is known."""

import numpy as np
import pytest

from facejax.viz import eyes_teeth, render, scene, shading

SIZE = (64, 80)


def _background(size=SIZE, **options):
    speck = np.array([[0, 0, 0], [1e-3, 0, 0], [0, 1e-3, 0]])
    view = render.Camera(np.eye(3), np.array([0.0, 0, 500]), 5.0)
    return render.image(speck + [0, 400, 0], np.array([[0, 1, 2]]), size=size, camera=view, **options)


def test_the_whole_motion_is_framed_within_the_margin(moving):
    vertices, _ = moving
    for turn, tilt in ((0, 0), (50, 20), (-120, -40)):
        view = render.fit_camera(vertices, size=SIZE, turn=turn, tilt=tilt, margin=0.1)
        z = (vertices - view.eye) @ view.turn.T
        shown = np.abs(z[..., :2] * view.zoom / -z[..., 2:]) / [SIZE[0] / SIZE[1], 1]
        assert shown.max() == pytest.approx(0.8, abs=1e-5)
        np.testing.assert_allclose(view.turn @ view.turn.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(view.turn) == pytest.approx(1)


def test_turn_and_tilt_go_the_way_they_say(ball):
    left = render.fit_camera(ball[0], turn=30).eye
    above = render.fit_camera(ball[0], tilt=30).eye
    assert left[0] > 0 and left[2] > 0 and above[1] > 0 and above[2] > 0


def test_a_sphere_covers_the_area_of_its_outline(ball):
    vertices, faces = ball
    picture = render.image(vertices, faces, size=SIZE)
    covered = (np.abs(picture.astype(int) - _background()) > 2).any(-1)
    rows, columns = np.nonzero(covered)
    width, height = np.ptp(columns) + 1, np.ptp(rows) + 1
    assert abs(width - height) <= 1 and width == pytest.approx(0.9 * SIZE[0], abs=1.5)
    assert covered.sum() == pytest.approx(np.pi / 4 * width * height, rel=0.03)
    # The key light is at the upper left of the viewer.
    grey = picture.mean(-1)
    assert grey[25:35, 15:25].mean() > grey[45:55, 40:50].mean() + 10


def test_frames_are_the_single_images_under_one_camera(moving):
    vertices, faces = moving
    pictures = render.frames(vertices, faces, size=SIZE)
    assert pictures.shape == (5, 80, 64, 3) and pictures.dtype == np.uint8
    view = render.fit_camera(vertices, size=SIZE)
    for t in (0, 3):
        np.testing.assert_array_equal(pictures[t], render.image(vertices[t], faces, size=SIZE, camera=view))
    assert (pictures[0] != pictures[4]).any()


def test_back_faces_are_dark_and_front_faces_hide_what_is_behind(ball):
    vertices, faces = ball
    inside_out = render.image(vertices, faces[:, ::-1], size=SIZE)
    assert inside_out[40, 32].max() < 60
    marble = scene.Part(vertices * 0.2, faces, (0, 0, 1))
    hidden = render.image(vertices, faces, size=SIZE, extras=(marble,))
    np.testing.assert_array_equal(hidden, render.image(vertices, faces, size=SIZE))
    outside = marble._replace(vertices=vertices * 0.2 + np.array([0, 0, 90], np.float32))
    shown = render.image(vertices, faces, size=SIZE, extras=(outside,))
    assert shown[40, 32, 2] > shown[40, 32, 0] + 40


def test_the_neck_is_stopped_but_a_mask_is_not(ball):
    vertices, faces = ball
    centre = vertices[faces].mean(1)
    mask = faces[centre[:, 1] > -60]
    assert len(render.close_largest_hole(vertices, faces)) == 0 and len(render.close_largest_hole(vertices, mask)) == 0
    two_holes = mask[centre[centre[:, 1] > -60][:, 1] < 76]
    closing = render.close_largest_hole(vertices, two_holes)
    assert (vertices[closing][..., 1] < 0).all()
    # Closing the neck leaves one hole, and every new edge is used once in each direction.
    assert len(render.close_largest_hole(vertices, np.concatenate([two_holes, closing]))) == 0
    edges = np.concatenate([closing[:, [0, 1]], closing[:, [1, 2]], closing[:, [2, 0]]]).tolist()
    old = np.concatenate([two_holes[:, [0, 1]], two_holes[:, [1, 2]], two_holes[:, [2, 0]]]).tolist()
    assert all([b, a] in edges or [b, a] in old for a, b in edges)


def test_landmarks_are_dots_where_they_can_be_seen(ball):
    vertices, faces = ball
    plain = render.image(vertices, faces, size=SIZE).astype(int)
    front, back = int(vertices[:, 2].argmax()), int(vertices[:, 2].argmin())
    marked = render.image(vertices, faces, size=SIZE, landmarks=np.array([front])).astype(int)
    rows, columns = np.nonzero((marked != plain).any(-1))
    assert 3 < len(rows) < 60 and abs(rows.mean() - 39.5) < 1 and abs(columns.mean() - 31.5) < 1
    hidden = render.image(vertices, faces, size=SIZE, landmarks=vertices[[back]])
    np.testing.assert_array_equal(hidden, plain)


def test_colours_and_heat(ball):
    vertices, faces = ball
    heat = render.heat_colours(vertices[:, 1], low=-80, high=80)
    picture = render.image(vertices, faces, size=SIZE, colours=heat).astype(int)
    top, bottom = picture[20, 32], picture[60, 32]
    assert bottom[1] > top[1] + 30 and bottom[2] > top[2] + 10
    np.testing.assert_allclose(render.heat_colours([0, 5, 10])[[0, -1]], [[0.90, 0.90, 0.92], [0.35, 0.03, 0.16]])
    np.testing.assert_allclose(render.heat_colours([0.0, 0.0]), render.heat_colours([0.0, 0.0], high=1))
    with pytest.raises(ValueError, match="colours must be"):
        render.image(vertices, faces, colours=heat[:-1])


def test_hollows_are_darker_than_ridges():
    x, z = np.meshgrid(np.linspace(-1, 1, 21), np.linspace(-1, 1, 21))
    waves = np.stack([x, z, 0.1 * np.cos(3 * np.pi * x)], -1).reshape(-1, 3)
    a = (np.arange(20)[:, None] * 21 + np.arange(20)).ravel()
    faces = np.concatenate([np.stack([a, a + 1, a + 22], -1), np.stack([a, a + 22, a + 21], -1)])
    bright = shading.cavity(waves, scene.normals(waves, faces), shading.neighbours(faces, len(waves)))
    inner = (np.abs(waves[:, :2]) < 0.9).all(1)
    assert bright[inner & (waves[:, 2] > 0.09)].min() > 1.02
    assert bright[inner & (waves[:, 2] < -0.09)].max() < 0.98


def test_normals_equal_a_loop_and_point_out_of_a_sphere(ball):
    vertices, faces = ball
    expected = np.zeros((len(vertices), 3))
    for a, b, c in faces:
        area = np.cross(vertices[b] - vertices[a], vertices[c] - vertices[a]).astype(float)
        for corner in (a, b, c):
            expected[corner] += area
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    found = scene.normals(np.stack([vertices, vertices * 2]), faces)
    np.testing.assert_allclose(found, np.stack([expected, expected]), atol=1e-5)
    np.testing.assert_allclose(found[0], vertices / 80, atol=0.03)
    alone = scene.normals(np.zeros((4, 3)), np.array([[0, 1, 2]]))
    np.testing.assert_array_equal(alone, [[0, 0, 1]] * 4)


def test_an_eyeball_looks_where_it_is_told():
    for gaze in ((0, 0, 1), (1, 0.5, 1), (0, 1, 0)):
        eye = eyes_teeth.eyeball((1, 2, 3), 12.0, gaze=gaze)
        away = eye.vertices - [1, 2, 3]
        np.testing.assert_allclose(np.linalg.norm(away, axis=1), 12, rtol=1e-5)
        pupil = away[eye.colour.max(1) < 0.05].mean(0)
        np.testing.assert_allclose(pupil / np.linalg.norm(pupil), gaze / np.linalg.norm(gaze), atol=1e-5)
        corner = eye.vertices[eye.faces]
        facing = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        assert (np.einsum("fx,fx->f", facing, corner.mean(1) - [1, 2, 3]) > -1e-6).all()
    assert eyes_teeth.eyeball(np.zeros((4, 3)), 12.0).vertices.shape == (4, *eye.vertices.shape)
    with pytest.raises(ValueError, match="iris_radius"):
        eyes_teeth.eyeball((0, 0, 0), 5.0)


def test_contact_sheet_and_caption(ball):
    picture = render.image(*ball, size=SIZE)
    sheet = render.contact_sheet([[picture, picture], [picture]], ["a → b", "long row label"], ["1", "2" * 90], gap=4)
    assert sheet.dtype == np.uint8
    bottom_left = sheet[-84:-4, -136:-72]
    np.testing.assert_array_equal(bottom_left, picture)
    np.testing.assert_array_equal(sheet[-84:-4, -68:-4], 255)
    assert (sheet[:, : sheet.shape[1] - 136] < 100).any()
    film = render.caption(np.stack([picture] * 4), ((1, "first"), (3, "then → " + "w" * 200)))
    assert film.shape[0] == 4 and film.shape[1] % 2 == 0
    np.testing.assert_array_equal(film[:, :80], np.stack([picture] * 4))
    strips = film[:, 80:]
    assert (strips[0] == 255).all() and (strips[1] == strips[2]).all() and (strips[2] != strips[3]).any()
    with pytest.raises(ValueError, match="expected 2 column labels, got 1"):
        render.contact_sheet([[picture, picture]], column_labels=["1"])
    with pytest.raises(ValueError, match=r"picture \[0\]\[1\]"):
        render.contact_sheet([[picture, picture[1:]]])
    with pytest.raises(ValueError, match="at least one"):
        render.contact_sheet([])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"vertices": np.zeros((3, 2))}, r"vertices must be \(T, N, 3\)"),
        ({"vertices": np.full((2, 4, 3), np.nan)}, r"vertices\[0, 0\] is not finite"),
        ({"faces": np.array([[0, 1, 4]])}, r"faces must lie in 0\.\.3, got 0\.\.4"),
        ({"faces": np.array([[0.0, 1, 2]])}, "integers"),
        ({"fps": float("nan")}, "fps must be positive"),
        ({"captions": ((2, "late"),)}, r"caption 'late' starts at frame 2, outside 0\.\.1"),
        ({"landmarks": np.array([4])}, r"landmarks must lie in 0\.\.3"),
        ({"landmarks": np.zeros((3, 68, 3))}, r"landmarks must be \(2, L, 3\)"),
        (
            {"extras": [(np.zeros((3, 3, 3)), np.array([[0, 1, 2]]), (1, 1, 1))]},
            r"extras\[0\].*2 frames, got 3",
        ),
        ({"extras": [(np.zeros((3, 3)), np.array([[0, 1, 3]]), (1, 1, 1))]}, r"extras\[0\]\.faces"),
        ({"extras": [(np.zeros((3, 3)), np.array([[0, 1, 2]]), (1, 1))]}, r"extras\[0\]\.colour"),
    ],
)
def test_scenes_out_of_order(change, message):
    good = {"vertices": np.zeros((2, 4, 3)), "faces": np.array([[0, 1, 2]])}
    scene.make(**good)
    with pytest.raises(ValueError, match=message):
        scene.make(**{**good, **change})
