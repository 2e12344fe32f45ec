"""Alignment: compared with loops and SciPy; invariances; gradients, also with equal singular values."""

import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy.spatial.transform import Rotation

from facejax.geometry import align, host, srvf

GRADIENT = {"order": 1, "modes": ("fwd", "rev"), "eps": 1e-6, "atol": 1e-6, "rtol": 1e-6}


@pytest.fixture
def x64():
    with jax.enable_x64(True):
        yield


def random(seed, *shape):
    return np.random.default_rng(seed).normal(size=shape)


def weighted(f, seed=11):
    def loss(*args):
        value = f(*args)
        return jnp.sum(random(seed, *value.shape) * value)

    return loss


def test_centre(x64):
    points = random(0, 2, 5, 3)
    centred, centroid = align.centre(points)
    np.testing.assert_allclose(centroid, [sum(rows) / 5 for rows in points], atol=1e-15)
    np.testing.assert_allclose(centred + centroid[:, None], points, atol=1e-15)
    np.testing.assert_allclose(np.sum(centred, axis=-2), 0, atol=1e-14)


def test_normalise_is_undone_and_fixes_the_neutral(x64):
    curve, neutral = 40 * random(1, 6, 5, 3), 40 * random(2, 5, 3) + 7
    unitless, scale, centroid = align.normalise(curve, neutral)
    middle = sum(neutral) / 5
    np.testing.assert_allclose(scale, np.sqrt(sum(np.sum((row - middle) ** 2) for row in neutral)), rtol=1e-14)
    np.testing.assert_allclose(unitless, (curve - middle) / float(scale), atol=1e-13)
    np.testing.assert_allclose(align.denormalise(unitless, scale, centroid), curve, atol=1e-12)
    own = align.normalise(neutral[None], neutral)[0]
    np.testing.assert_allclose(np.linalg.norm(own), 1, rtol=1e-14)
    check_grads(weighted(lambda c, n: align.normalise(c, n)[0]), (curve, neutral), **GRADIENT)


def test_normalise_ignores_where_and_how_large_the_head_is(x64):
    curve, neutral = random(3, 6, 5, 3), random(4, 5, 3)
    moved = align.normalise(30 * curve + 5, 30 * neutral + 5)[0]
    np.testing.assert_allclose(moved, align.normalise(curve, neutral)[0], atol=1e-13)


def test_normalise_with_a_single_point_as_neutral_is_finite():
    def loss(neutral):
        return jnp.sum(align.normalise(jnp.ones((2, 4, 3)), neutral)[0])

    value, gradient = jax.value_and_grad(loss)(jnp.zeros((4, 3)))
    assert value == 24 and np.isfinite(gradient).all()


@pytest.mark.parametrize("scaling", [False, True])
def test_procrustes_recovers_a_similarity(x64, scaling):
    source = random(5, 7, 3)
    turn, scale, shift = Rotation.random(rng=1).as_matrix(), 2.5 if scaling else 1.0, np.asarray([1.0, -3, 2])
    found = align.procrustes(source, scale * source @ turn.T + shift, scaling=scaling)
    np.testing.assert_allclose(found.rotation, turn, atol=1e-14)
    np.testing.assert_allclose(found.scale, scale, rtol=1e-14)
    np.testing.assert_allclose(found.translation, shift, atol=1e-13)
    np.testing.assert_allclose(align.apply(found, source), scale * source @ turn.T + shift, atol=1e-13)


def test_procrustes_against_scipy(x64):
    source, target = random(6, 7, 3), random(7, 7, 3)
    expected, _ = Rotation.align_vectors(target - target.mean(0), source - source.mean(0))
    np.testing.assert_allclose(align.procrustes(source, target).rotation, expected.as_matrix(), atol=1e-12)


@pytest.mark.parametrize("seed", range(6))
def test_procrustes_of_a_mirror_image_is_a_rotation_and_no_other_is_better(x64, seed):
    source = random(seed, 7, 3)
    target = source * np.asarray([-1, 1, 1])
    found = align.procrustes(source, target)
    np.testing.assert_allclose(np.linalg.det(found.rotation), 1, rtol=1e-13)
    np.testing.assert_allclose(found.rotation @ found.rotation.T, np.eye(3), atol=1e-14)
    best = np.sum((align.apply(found, source) - target) ** 2)
    for other in Rotation.random(200, rng=seed).as_matrix():
        assert np.sum(((source - source.mean(0)) @ other.T - (target - target.mean(0))) ** 2) >= best - 1e-12


@pytest.mark.parametrize("scaling", [False, True])
def test_procrustes_gradients(x64, scaling):
    def moved(source, target):
        return align.apply(align.procrustes(source, target, scaling=scaling), source)

    check_grads(weighted(moved), (random(8, 7, 3), random(9, 7, 3)), **GRADIENT)
    octahedron = np.concatenate([np.eye(3), -np.eye(3)])
    # All three singular values are equal here: differentiating the SVD would give NaN.
    turned = octahedron @ Rotation.random(rng=2).as_matrix().T
    check_grads(weighted(moved), (octahedron, turned), **GRADIENT)


def test_procrustes_where_the_rotation_is_not_unique_is_finite_with_zero_gradient(x64):
    line = np.outer(np.arange(5.0), [1.0, 2.0, 3.0])
    for source in (line, np.zeros((5, 3))):
        found = align.procrustes(source, source, scaling=True)
        np.testing.assert_allclose(align.apply(found, source), source, atol=1e-13)
        np.testing.assert_allclose(np.linalg.det(found.rotation), 1, rtol=1e-13)
        gradient = jax.grad(lambda x, y=source: jnp.sum(align.procrustes(x, y).rotation ** 3))(source)
        np.testing.assert_array_equal(gradient, 0)


def loop_read(curve, places):
    out = []
    for place in places:
        k = min(int(place), len(curve) - 2)
        out.append((1 - (place - k)) * curve[k] + (place - k) * curve[k + 1])
    return np.stack(out)


@pytest.mark.parametrize("frames", [2, 4, 6, 11, 30])
def test_resample_in_time_against_a_loop(x64, frames):
    curve = random(10, 6, 4, 3)
    got = align.resample(curve, frames=frames)
    np.testing.assert_allclose(got, loop_read(curve, np.linspace(0, 5, frames)), atol=1e-14)
    np.testing.assert_array_equal(got[jnp.asarray([0, -1])], curve[[0, -1]])


def test_resample_to_the_same_frames_is_the_identity():
    curve = jnp.asarray(random(11, 6, 4, 3), jnp.float32)
    np.testing.assert_array_equal(align.resample(curve, frames=6), curve)
    np.testing.assert_array_equal(align.interpolate(curve, jnp.arange(6.0)), curve)
    np.testing.assert_array_equal(align.interpolate(curve, jnp.asarray([-3.0, 9.0])), curve[jnp.asarray([0, -1])])


def test_resample_by_arc_against_a_loop_and_makes_the_speed_even(x64):
    curve = random(12, 6, 4, 3)
    curve[3] = curve[2]
    steps = [np.sqrt(np.sum((b - a) ** 2)) for a, b in zip(curve[:-1], curve[1:], strict=True)]
    covered = np.concatenate([[0], np.cumsum(steps)])
    wanted = np.linspace(0, covered[-1], 9)
    expected = np.stack([np.interp(wanted, covered, x) for x in curve.reshape(6, -1).T], 1).reshape(9, 4, 3)
    got = align.resample(curve, frames=9, by="arc")
    np.testing.assert_allclose(got, expected, atol=1e-13)
    np.testing.assert_array_equal(got[0], curve[0])
    np.testing.assert_array_equal(got[-1], curve[-1])
    line = np.cumsum(np.asarray([0, 1, 5, 2, 1.0]))[:, None, None] * random(13, 1, 4, 3)
    speeds = np.linalg.norm(np.diff(align.resample(line, frames=8, by="arc"), axis=0), axis=(1, 2))
    np.testing.assert_allclose(speeds, speeds[0], rtol=1e-12)


@pytest.mark.parametrize("by", ["time", "arc"])
def test_resampled_standstill_stays_exactly_still_for_the_srvf(by):
    still = jnp.broadcast_to(jnp.asarray(random(14, 4, 3), jnp.float32), (6, 4, 3))
    again = align.resample(still, frames=11, by=by)
    np.testing.assert_array_equal(again, jnp.broadcast_to(still[0], (11, 4, 3)))
    np.testing.assert_array_equal(srvf.encode(again)[0], 0)
    assert np.isfinite(jax.grad(weighted(lambda c: align.resample(c, frames=11, by=by)))(still)).all()


@pytest.mark.parametrize("by", ["time", "arc"])
def test_resample_gradients(x64, by):
    curve = random(15, 6, 4, 3)
    check_grads(weighted(lambda c: align.resample(c, frames=9, by=by)), (curve,), **GRADIENT)
    even = jnp.arange(6.0)[:, None, None] * random(16, 4, 3)
    assert np.isfinite(jax.grad(weighted(lambda c: align.resample(c, frames=6, by=by)))(even)).all()


def test_interpolate_gradients(x64):
    places = jnp.asarray([0.3, 2.5, 4.9])
    check_grads(weighted(align.interpolate), (random(17, 6, 4, 3), places), **GRADIENT)


@pytest.mark.parametrize(
    ("call", "match"),
    [
        (lambda c: align.centre(c[..., :2]), r"points: expected \(\.\.\., K, 3\), got shape \(6, 4, 2\)"),
        (lambda c: align.centre(jnp.ones((4, 3), jnp.int32)), "floating dtype, got int32"),
        (lambda c: align.normalise(c, c[0, :3]), r"neutral: expected \(\.\.\., 4, 3\), got shape \(3, 3\)"),
        (lambda c: align.normalise(c[0], c[0]), r"curve \(\.\.\., T, L, 3\)"),
        (lambda c: align.procrustes(c, c[:, :3]), r"target: expected \(\.\.\., 4, 3\)"),
        (lambda c: align.resample(c[:1], frames=3), "T >= 2"),
        (lambda c: align.resample(c, frames=1), "at least 2, got 1"),
        (lambda c: align.resample(c, frames=3, by="length"), '"time" or "arc", got \'length\''),
    ],
)
def test_wrong_input_is_named(call, match, monkeypatch):
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)  # what a caller gets: only tests check shapes
    with pytest.raises(ValueError, match=match):
        call(jnp.ones((6, 4, 3)))


@pytest.mark.parametrize("seed", range(4))
def test_the_host_form_is_the_rigid_fit_of_procrustes(x64, seed):
    source = 5 * random(seed, 9, 3) + 20
    turn = Rotation.random(rng=seed).as_matrix()
    target = source @ turn.T + [3, -1, 2] + 0.1 * random(seed + 10, 9, 3)
    rotation, source_centroid, target_centroid = host.procrustes(source, target)
    expected = align.procrustes(source, target)
    np.testing.assert_allclose(rotation, expected.rotation, atol=1e-12)
    moved = (source - source_centroid) @ rotation.T + target_centroid
    np.testing.assert_allclose(moved, align.apply(expected, source), atol=1e-11)


def test_the_host_form_never_reflects():
    source = random(7, 9, 3)
    rotation, _, _ = host.procrustes(source, source * [-1, 1, 1])
    np.testing.assert_allclose(np.linalg.det(rotation), 1, atol=1e-12)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
