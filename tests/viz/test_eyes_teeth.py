"""Eyes and teeth go where the face has its sockets and its mouth."""

import numpy as np
import pytest

from facejax.data.synthetic import assets, makehuman
from facejax.viz import eyes_teeth


@pytest.fixture(scope="module")
def template_props(template):
    return eyes_teeth.Props(template.vertices[template.landmarks], *makehuman.template_props())


def test_eyes_of_another_person_land_in_their_sockets(template, template_props):
    person = makehuman.subject(100)
    rest = person.vertices[template.landmarks]
    left, right, *_ = eyes_teeth.parts(template_props, rest, rest[None])
    for part, name in ((left, "helper-l-eye"), (right, "helper-r-eye")):
        own = person.neutral[np.unique(assets.load().prop_faces[name])]
        assert np.linalg.norm(part.vertices.mean(axis=0) - own.mean(axis=0)) < 6
        assert np.ptp(part.vertices[:, 0]) == pytest.approx(np.ptp(own[:, 0]), rel=0.15)


def test_lower_teeth_follow_the_jaw_and_upper_teeth_stay(template, template_props):
    rest = template.vertices[template.landmarks]
    moved = np.stack([rest, rest])
    moved[1, 4:13] += [0, -10, -2]
    *_, upper, lower = eyes_teeth.parts(template_props, rest, moved)
    assert upper.vertices.ndim == 2
    np.testing.assert_allclose(lower.vertices[1], lower.vertices[0] + np.float32([0, -10, -2]), atol=1e-2)


def test_another_landmark_scheme_goes_bare(template_props):
    assert eyes_teeth.parts(template_props, np.zeros((51, 3)), np.zeros((2, 51, 3))) == ()


def test_eyes_look_where_the_face_looks(template, template_props):
    turn = np.array([[0.5**0.5, 0, 0.5**0.5], [0, 1, 0], [-(0.5**0.5), 0, 0.5**0.5]])
    rest = template.vertices[template.landmarks] @ turn.T
    for eye in eyes_teeth.parts(template_props, rest, rest[None])[:2]:
        pupil = eye.vertices[np.asarray(eye.colour).max(axis=1) < 0.1].mean(axis=0) - eye.vertices.mean(axis=0)
        np.testing.assert_allclose(pupil / np.linalg.norm(pupil), turn[:, 2], atol=0.05)
