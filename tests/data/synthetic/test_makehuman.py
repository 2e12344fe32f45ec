"""Subjects: drawn by seed, different, human."""

import numpy as np
import pytest

from facejax.data.synthetic import makehuman
from facejax.mesh import graph


def test_face_mask_is_25_mm_about_the_landmarks(template):
    distance = graph.geodesic(template.vertices, template.faces, template.landmarks)
    np.testing.assert_array_equal(template.face_mask, distance <= 25.0)


def test_subject_depends_on_seed_and_index_alone():
    again, once = makehuman.subject(5), makehuman.subject(5)
    np.testing.assert_array_equal(again.neutral, once.neutral)
    assert not np.array_equal(makehuman.subject(6).neutral, once.neutral)
    assert not np.array_equal(makehuman.subject(5, seed=2).neutral, once.neutral)


def test_people_are_adults_of_human_size():
    people = [makehuman.subject(i) for i in range(12)]
    for person in people:
        assert 18 <= person.age <= 80 and 0 <= person.gender <= 1
        assert person.ethnicity.sum() == pytest.approx(1)
        width = np.ptp(person.vertices[:, 0])
        assert 120 < width < 220
        np.testing.assert_allclose(person.vertices.mean(axis=0), 0, atol=1e-3)
    spread = np.linalg.norm(people[0].vertices - people[1].vertices, axis=1).mean()
    assert 1 < spread < 30


def test_sliders_pair_opposites():
    pairs = dict(makehuman._sliders())
    assert pairs["nose/nose-width1-incr"] == "nose/nose-width1-decr"
    assert pairs["asym/asym-jaw-1-r"] == "asym/asym-jaw-1-l"
    assert pairs["head/head-oval"] is None
    assert not any("head-trans" in name for name in pairs)


def test_negative_index_is_refused():
    with pytest.raises(ValueError, match="0 or more"):
        makehuman.subject(-1)
