"""The ladder of realism: each level's law, and rest is rest on all of them."""

import numpy as np
import pytest

from facejax.data.synthetic import assets, contact, expression_recipes, makehuman, performance, rig, skin
from facejax.mesh import deformation_transfer


@pytest.fixture(scope="module")
def subject():
    return makehuman.subject(10)


@pytest.fixture(scope="module")
def rigs(subject):
    return [rig.build(subject, level=level) for level in rig.LEVELS]


@pytest.fixture(scope="module")
def peaks():
    return np.stack([performance.apex_weights(label, 10) for label in expression_recipes.EXPRESSIONS])


def unit(**weights):
    row = np.zeros((1, len(rig.unit_names())), np.float32)
    for name, value in weights.items():
        row[0, rig.unit_names().index(name)] = value
    return row


def test_rest_is_the_neutral_face_on_every_level(rigs, subject):
    for posed in rigs:
        np.testing.assert_allclose(rig.pose(posed, unit())[0], subject.neutral, atol=2e-5)


def test_level_0_is_linear(rigs, subject, peaks):
    rng = np.random.default_rng(0)
    weights = rng.normal(size=(2, peaks.shape[1])).astype(np.float32)
    first, second, total = rig.pose(rigs[0], np.concatenate([weights, weights.sum(0, keepdims=True)]))
    np.testing.assert_allclose(total - subject.neutral, first + second - 2 * subject.neutral, atol=1e-3)


@pytest.mark.parametrize("level", (1, 2, 3))
def test_higher_levels_are_not_linear(rigs, level):
    half, whole = rig.pose(rigs[level], np.concatenate([unit(jawOpen=0.5), unit(jawOpen=1.0)]))
    rest = rigs[level].neutral
    assert np.linalg.norm(2 * (half - rest) - (whole - rest), axis=1).max() > 0.5


def test_the_jaw_turns_about_its_hinge_by_an_angle_in_proportion_to_the_weight(rigs):
    posed = rigs[1]._replace(units=np.zeros_like(rigs[1].units))
    chin = assets.load().landmarks[8]
    path = rig.pose(posed, np.concatenate([unit(jawOpen=w) for w in (0.0, 0.5, 1.0)]))[:, chin] - posed.hinge
    np.testing.assert_allclose(np.linalg.norm(path[:, 1:], axis=1), np.linalg.norm(path[0, 1:]), rtol=1e-5)
    angle = np.arctan2(path[:, 2], path[:, 1])
    assert angle[1] - angle[0] == pytest.approx(angle[2] - angle[1], rel=1e-4)
    assert 0.2 < abs(angle[2] - angle[0]) < 0.6


def test_full_jaw_opening_reaches_the_artists_target(rigs, subject):
    # Rotation and remainder together give the unit back at weight 1.
    target = assets.load().targets["arkit/jawOpen"]
    np.testing.assert_allclose(rig.pose(rigs[1], unit(jawOpen=1.0))[0], subject.neutral + target, atol=2e-3)


def test_saturation_is_odd_monotone_and_exact_at_one():
    w = np.linspace(-2, 2, 41)
    f = rig.saturate(w)
    np.testing.assert_allclose(f, -f[::-1], atol=1e-12)
    assert np.all(np.diff(f) > 0) and f[30] == pytest.approx(1)


def test_lids_stay_outside_the_eyeball(rigs, subject):
    blink = unit(eyeBlinkLeft=1.0, eyeBlinkRight=1.0)
    posed = rigs[2]
    inside = []
    for level in (1, 2):
        vertices = rig.pose(rigs[level], blink)[0]
        for centre, radius, lids in zip(
            posed.contact.eye_centre, posed.contact.eye_radius, posed.contact.lid_index, strict=True
        ):
            inside.append((radius - np.linalg.norm(vertices[lids] - centre, axis=1)).max())
    assert max(inside[:2]) > 0.3, "without contact the lid cuts through the eye: else this test shows nothing"
    assert max(inside[2:]) < 1e-3


def test_lips_do_not_cross(rigs):
    press = unit(mouthShrugLower=1.2, mouthRollUpper=0.5)
    upper, lower = rigs[2].contact.lip_pairs.T
    gaps = [
        (v[upper, 1] - v[lower, 1] - rigs[2].contact.lip_gap).min()
        for v in (rig.pose(rigs[1], press)[0], rig.pose(rigs[2], press)[0])
    ]
    assert gaps[0] < -1.0
    assert gaps[1] > 0.5 * gaps[0]


def test_lips_stay_in_front_of_the_teeth(rigs):
    posed = rigs[2]
    far_back = posed.neutral[None] - np.array([0, 0, 8], np.float32)
    held = contact.clear_teeth(posed.contact, far_back)[0, posed.contact.teeth_index]
    x = held[:, 0]
    arch = posed.contact.teeth_arch
    assert np.all(held[:, 2] >= arch[0] + x * (arch[1] + x * arch[2]) + posed.contact.teeth_margin - 1e-4)


def test_deformation_transfer_to_the_template_itself_changes_nothing():
    loaded = assets.load()
    units = np.zeros((1, len(loaded.base), 3))
    units[0] = loaded.targets["arkit/mouthSmileLeft"]
    shape = np.zeros((len(loaded.base), 3))
    shape[: loaded.skin] = makehuman.template().vertices
    np.testing.assert_allclose(rig._transfer(units, shape), units, atol=2e-3)


def test_deformation_transfer_follows_size():
    loaded = assets.load()
    units = np.zeros((1, len(loaded.base), 3))
    units[0] = loaded.targets["arkit/mouthSmileLeft"]
    shape = np.zeros((len(loaded.base), 3))
    shape[: loaded.skin] = 1.3 * makehuman.template().vertices
    carried = rig._transfer(units, shape)[0, : loaded.skin]
    moving = np.linalg.norm(units[0, : loaded.skin], axis=1) > 3
    np.testing.assert_allclose(carried[moving], 1.3 * units[0, : loaded.skin][moving], atol=0.05)


def test_gradient_of_a_linear_function_is_its_slope_in_the_plane(template):
    slope = np.array([0.3, -1.1, 0.7])
    operator, areas = deformation_transfer.gradient_operator(template.vertices.astype(np.float64), template.faces)
    found = (operator @ (template.vertices @ slope)).reshape(-1, 3)
    a, b, c = (template.vertices[template.faces[:, i]].astype(np.float64) for i in range(3))
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    np.testing.assert_allclose(found, slope - (normal @ slope)[:, None] * normal, atol=1e-4)
    assert areas.min() > 0


def test_skin_folds_only_where_it_is_compressed(rigs):
    posed = rigs[3].skin
    rest = rigs[3].neutral[None]
    np.testing.assert_allclose(skin.add_wrinkles(posed, rest), rest, atol=2e-5)
    # Stretching everything leaves every direction longer: nothing may fold.
    np.testing.assert_allclose(skin.add_wrinkles(posed, 1.2 * rest), 1.2 * rest, atol=2e-4)
    squeezed = rest * np.array([1, 0.8, 1], np.float32)
    assert np.linalg.norm(skin.add_wrinkles(posed, squeezed) - squeezed, axis=-1).max() > 0.3


def test_older_skin_folds_deeper(subject):
    young, old = (skin.build(subject._replace(age=age)) for age in (20.0, 80.0))
    assert np.abs(old.height).max() > 1.5 * np.abs(young.height).max()


def test_unknown_level_and_wrong_weights_are_refused(subject, rigs):
    with pytest.raises(ValueError, match=r"one of \(0, 1, 2, 3\), got 4"):
        rig.build(subject, level=4)
    with pytest.raises(ValueError, match=r"shape \(T, 85\), got \(3, 4\)"):
        rig.pose(rigs[0], np.zeros((3, 4)))
