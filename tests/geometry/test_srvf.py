"""The SRVF transform: compared with loops; round trips; invariances; gradients with and without steps of zero."""

import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jax.test_util import check_grads

from facejax.geometry import sphere, srvf

GRADIENT = {"order": 1, "modes": ("fwd", "rev"), "eps": 1e-6, "atol": 1e-6, "rtol": 1e-6}


@pytest.fixture
def x64():
    with jax.enable_x64(True):
        yield


def curves(seed, *lead, frames=6, landmarks=4):
    return np.random.default_rng(seed).normal(size=(*lead, frames, landmarks, 3))


def loop_encode(curve):
    frames = len(curve)
    steps = [(curve[t + 1] - curve[t]).reshape(-1) for t in range(frames - 1)]
    length = sum(np.sqrt(np.sum(step**2)) for step in steps)
    q = []
    for step in steps:
        velocity = (frames - 1) * step / length
        speed = np.sqrt(np.sum(velocity**2))
        q.append(velocity / np.sqrt(speed) if speed > 0 else 0 * velocity)
    return np.stack(q).reshape(frames - 1, -1, 3), np.log(length)


def test_encode_against_a_loop(x64):
    curve = curves(0)
    curve[3] = curve[2]
    q, log_length = srvf.encode(curve)
    expected, expected_log = loop_encode(curve)
    np.testing.assert_allclose(q, expected, atol=1e-14)
    np.testing.assert_allclose(log_length, expected_log, rtol=1e-14)
    np.testing.assert_allclose(srvf.length(curve), np.exp(expected_log), rtol=1e-14)


def test_decode_against_a_loop(x64):
    q, start = curves(1, frames=5), curves(2, frames=1)[0]
    curve = [start]
    for t in range(5):
        curve.append(curve[-1] + np.exp(0.3) / 5 * np.sqrt(np.sum(q[t] ** 2)) * q[t])
    np.testing.assert_allclose(srvf.decode(q, 0.3, start), np.stack(curve), atol=1e-13)


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 2**20),
    frames=st.sampled_from([2, 3, 12]),
    scale=st.floats(-9, 6),
    double=st.booleans(),
    still=st.booleans(),
)
def test_round_trip_over_all_units(seed, frames, scale, double, still):
    with jax.enable_x64(double):
        curve = 10.0**scale * curves(seed, frames=frames)
        if still:
            curve[1:-1] = curve[0]
        curve = jnp.asarray(curve)
        q, log_length = srvf.encode(curve)
        back = srvf.decode(q, log_length, curve[0])
        tolerance = 1e-12 if double else 1e-5
        np.testing.assert_allclose(sphere.norm(q), 1, rtol=tolerance)
        assert jnp.linalg.norm(back - curve) <= tolerance * jnp.linalg.norm(curve)
        np.testing.assert_allclose(srvf.length(curve), jnp.exp(log_length), rtol=1e-11 if double else 2e-5)
        np.testing.assert_array_equal(back[0], curve[0])


def test_decode_of_a_sphere_point_has_the_length_and_encodes_back(x64):
    q = jnp.asarray(curves(3, 2))
    q = q / sphere.norm(q)[..., None, None, None]
    log_length = jnp.asarray([-1.0, 2.0])
    curve = srvf.decode(q, log_length, jnp.zeros((2, 4, 3)))
    np.testing.assert_allclose(srvf.length(curve), jnp.exp(log_length), rtol=1e-13)
    again, again_log = srvf.encode(curve)
    np.testing.assert_allclose(again, q, atol=1e-13)
    np.testing.assert_allclose(again_log, log_length, atol=1e-13)


def test_invariances(x64):
    curve = jnp.asarray(curves(4))
    q, log_length = srvf.encode(curve)
    moved, moved_log = srvf.encode(1e3 * curve + jnp.asarray([5.0, -2.0, 1.0]))
    np.testing.assert_allclose(moved, q, atol=1e-12)
    np.testing.assert_allclose(moved_log, log_length + np.log(1e3), atol=1e-12)
    turn = jnp.asarray(np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0])
    np.testing.assert_allclose(srvf.encode(curve @ turn)[0], q @ turn, atol=1e-13)
    np.testing.assert_allclose(srvf.encode(curve[::-1])[0], -q[::-1], atol=1e-13)
    order = jnp.asarray([2, 0, 3, 1])
    np.testing.assert_allclose(srvf.encode(curve[:, order])[0], q[:, order], atol=1e-14)


def test_leading_axes_of_start_and_log_length_broadcast():
    q = jnp.ones((2, 5, 4, 3))
    curve = srvf.decode(q, 0.0, jnp.zeros((3, 1, 4, 3)))
    assert curve.shape == (3, 2, 6, 4, 3)
    np.testing.assert_array_equal(srvf.displacement(q, jnp.zeros(2)), jnp.diff(curve, axis=-3)[0])


@pytest.mark.parametrize("double", [False, True])
@pytest.mark.parametrize("size", [0.0, 1e-40, 1e-16])
def test_standstill(double, size):
    with jax.enable_x64(double):
        start = jnp.asarray(curves(5, frames=1)[0]) * (0 if size else 1)
        curve = jnp.broadcast_to(start, (6, 4, 3)).at[1, 0, 0].add(size)
        q, log_length = srvf.encode(curve)
        np.testing.assert_array_equal(q, 0)
        np.testing.assert_allclose(log_length, np.log(1e-12), rtol=1e-6)
        np.testing.assert_array_equal(srvf.decode(q, log_length, start), jnp.broadcast_to(start, (6, 4, 3)))
        weights = jnp.asarray(curves(6, frames=5))

        def loss(curve):
            q, log_length = srvf.encode(curve)
            return jnp.sum(weights * q) + log_length

        np.testing.assert_array_equal(jax.grad(loss)(curve), 0)
        np.testing.assert_array_equal(jax.jvp(loss, (curve,), (jnp.ones_like(curve),))[1], 0)
        assert np.isfinite(jax.grad(lambda q: jnp.sum(srvf.decode(q, log_length, start) ** 2))(q)).all()


def test_covered_against_a_loop_and_from_zero_to_one_exactly(x64):
    q = curves(14, 3, frames=5)
    for one, share in zip(q, srvf.arc_length_fraction(q), strict=True):
        speeds = [np.sum(step**2) for step in one]
        np.testing.assert_allclose(share, [sum(speeds[:t]) / sum(speeds) for t in range(6)], atol=1e-14)
    single = srvf.arc_length_fraction(jnp.asarray(curves(15, 500, frames=29), jnp.float32))
    np.testing.assert_array_equal(single[:, 0], 0)
    np.testing.assert_array_equal(single[:, -1], 1)
    np.testing.assert_array_equal(srvf.arc_length_fraction(jnp.zeros((5, 4, 3))), 0)
    check_grads(
        lambda q: jnp.sum(curves(16, frames=1)[0, 0, 0] * srvf.arc_length_fraction(q) ** 2),
        (jnp.asarray(q),),
        **GRADIENT,
    )


def test_covered_is_the_share_of_the_path_in_the_curve(x64):
    curve = jnp.asarray(curves(17))
    q, _ = srvf.encode(curve)
    lengths = [srvf.length(curve[: t + 1]) for t in range(1, 6)]
    np.testing.assert_allclose(srvf.arc_length_fraction(q)[1:], np.array(lengths) / lengths[-1], atol=1e-13)
    even = jnp.concatenate([q[:1], q[:1], q[:1]])
    np.testing.assert_allclose(srvf.arc_length_fraction(even), np.linspace(0, 1, 4), atol=1e-14)


def encode_loss(curve, seed=7):
    q, log_length = srvf.encode(curve)
    weights = np.random.default_rng(seed).normal(size=q.shape)
    return jnp.sum(weights * q) + 0.7 * log_length


def test_encode_gradients_equal_finite_differences(x64):
    curve = jnp.asarray(curves(8))
    check_grads(encode_loss, (curve,), **GRADIENT)
    constant_speed = curve[:1] + jnp.arange(6.0)[:, None, None] * curve[1:2]
    check_grads(encode_loss, (constant_speed,), **GRADIENT)
    check_grads(srvf.length, (curve,), **GRADIENT)


def test_encode_gradient_of_a_tiny_curve_scales_as_one_over_its_size(x64):
    curve = jnp.asarray(curves(9))
    expected = jax.grad(encode_loss)(curve)
    np.testing.assert_allclose(1e-9 * jax.grad(encode_loss)(1e-9 * curve), expected, rtol=1e-10, atol=1e-12)


def test_decode_gradients_equal_finite_differences_also_at_a_still_step(x64):
    q, start = jnp.asarray(curves(10)).at[2].set(0), jnp.asarray(curves(11, frames=1)[0])
    weights = curves(12, frames=7)

    def loss(q, log_length, start):
        return jnp.sum(weights * srvf.decode(q, log_length, start))

    check_grads(loss, (q, 0.4, start), **GRADIENT)


@pytest.mark.parametrize("double", [False, True])
def test_gradient_of_a_pause_is_finite_and_that_of_the_pause_itself_zero(double):
    with jax.enable_x64(double):
        curve = jnp.asarray(curves(13))
        paused = curve.at[3].set(curve[2])
        _, pull = jax.vjp(lambda steps: srvf.encode(jnp.cumsum(steps, axis=0))[0], jnp.diff(paused, axis=0))
        gradient = pull(jnp.ones((4, 4, 3)))[0]
        assert np.isfinite(gradient).all()
        # The gradient of the zero step is 0, up to the rounding of the running sums.
        np.testing.assert_allclose(gradient[2], 0, atol=1e-14 if double else 1e-6)
        for size in (1e-5, 1e-12, 1e-18, 1e-30):
            moved = jnp.zeros_like(curve).at[3:, 0, 0].set(size).at[4:, 1, 1].set(1.0)
            assert np.isfinite(jax.grad(encode_loss)(moved)).all(), size


@pytest.mark.parametrize(
    ("call", "match"),
    [
        (lambda: srvf.encode(jnp.ones((1, 4, 3))), r"T >= 2, got shape \(1, 4, 3\)"),
        (lambda: srvf.encode(jnp.ones((6, 12))), r"\(\.\.\., T, L, 3\)"),
        (lambda: srvf.encode(jnp.ones((6, 4, 2))), r"\(6, 4, 2\)"),
        (lambda: srvf.encode(jnp.ones((6, 4, 3), jnp.int32)), "floating dtype, got int32"),
        (lambda: srvf.decode(jnp.ones((6, 4, 3)), 0.0, jnp.ones((5, 3))), r"start.*L = 4.*\(5, 3\)"),
        (lambda: srvf.decode(jnp.ones((6, 4)), 0.0, jnp.ones((4, 3))), "q: expected"),
        (lambda: srvf.length(jnp.ones((4, 3))), "curve: expected"),
        (lambda: srvf.arc_length_fraction(jnp.ones((4, 3))), "q: expected"),
    ],
)
def test_wrong_input_is_named(call, match, monkeypatch):
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)  # what a caller gets: only tests check shapes
    with pytest.raises(ValueError, match=match):
        call()
