"""The sphere: compared with loops; identities of exp and log; gradients at singular points and elsewhere."""

import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jax.test_util import check_grads

from facejax.geometry import sphere

SHAPE = (4, 5, 3)
EPS = {jnp.float32: 1.2e-7, jnp.float64: 2.3e-16}


@pytest.fixture(params=[jnp.float32, jnp.float64], ids=["float32", "float64"])
def dtype(request):
    with jax.enable_x64(request.param == jnp.float64):
        yield request.param


@pytest.fixture
def x64():
    with jax.enable_x64(True):
        yield


def points(seed, count, dtype=jnp.float64, shape=SHAPE):
    raw = np.random.default_rng(seed).normal(size=(count, *shape))
    return [jnp.asarray(x * np.sqrt(shape[0]) / np.linalg.norm(x), dtype) for x in raw]


def unit_tangent(seed, p):
    p = np.asarray(p, np.float64)
    raw = np.random.default_rng(seed).normal(size=p.shape)
    raw = raw - loop_inner(p, raw) * p
    return raw / np.sqrt(loop_inner(raw, raw))


def tangent(seed, p, length=1.0):
    return jnp.asarray(length * unit_tangent(seed, p), p.dtype)


def loop_inner(a, b):
    total = 0.0
    for t in range(a.shape[0]):
        for point in range(a.shape[1]):
            for axis in range(3):
                total += float(a[t, point, axis]) * float(b[t, point, axis])
    return total / a.shape[0]


def angle_at(p, theta):
    """Return a point at the angle theta from p, in float64."""
    p = np.asarray(p, np.float64)
    return np.cos(theta) * p + np.sin(theta) * unit_tangent(9, p)


def test_inner_and_norm_against_loops(dtype):
    a, b = points(0, 2, dtype)
    np.testing.assert_allclose(sphere.inner(a, 3 * b), 3 * loop_inner(a, b), atol=20 * EPS[dtype])
    np.testing.assert_allclose(sphere.norm(-2 * a), 2, rtol=8 * EPS[dtype])


def test_root_is_zero_with_zero_derivative_where_not_positive():
    x = jnp.asarray([4.0, 0.0, -1e-9])
    np.testing.assert_array_equal(sphere.safe_sqrt(x), [2, 0, 0])
    np.testing.assert_array_equal(jax.grad(lambda x: jnp.sum(sphere.safe_sqrt(x)))(x), [0.25, 0, 0])


def test_maps_against_the_formulas_of_the_paper(x64):
    p, q = points(1, 2)
    theta = np.arccos(loop_inner(p, q))
    np.testing.assert_allclose(sphere.distance(p, q), theta, rtol=1e-13)
    expected = theta / np.sin(theta) * (np.asarray(q) - np.cos(theta) * np.asarray(p))
    np.testing.assert_allclose(sphere.log(p, q), expected, atol=1e-14)
    for tau in (0.0, 0.3, 1.0):
        weights = np.sin((1 - tau) * theta) / np.sin(theta), np.sin(tau * theta) / np.sin(theta)
        arc = weights[0] * np.asarray(p) + weights[1] * np.asarray(q)
        np.testing.assert_allclose(sphere.geodesic(p, q, tau), arc, atol=1e-14)
    v = tangent(2, p, 0.7)
    expected = np.cos(0.7) * np.asarray(p) + np.sin(0.7) / 0.7 * np.asarray(v)
    np.testing.assert_allclose(sphere.exp(p, v), expected, atol=1e-14)


@pytest.mark.parametrize("theta", [0, 1e-12, 1e-8, 1e-4, 0.1, 0.36, 0.38, 1, np.pi / 2, 3, np.pi - 1e-6])
def test_distance_keeps_relative_precision(x64, theta):
    p = points(3, 1)[0]
    q = jnp.asarray(angle_at(p, theta))
    # The rounding of a point's entries limits the precision of an angle.
    np.testing.assert_allclose(sphere.distance(p, q), theta, rtol=1e-13, atol=3e-16)
    np.testing.assert_allclose(sphere.norm(sphere.log(p, q)), theta, rtol=1e-13, atol=3e-16)


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**20), length=st.floats(0, 3.1))
def test_log_inverts_exp_within_the_injectivity_radius(seed, length):
    with jax.enable_x64(True):
        p = points(seed, 1)[0]
        v = tangent(seed + 1, p, length)
        q = sphere.exp(p, v)
        np.testing.assert_allclose(sphere.norm(q), 1, rtol=1e-14)
        np.testing.assert_allclose(sphere.log(p, q), v, atol=1e-12)
        np.testing.assert_allclose(sphere.distance(p, q), length, atol=1e-13)


def test_exp_inverts_log(dtype):
    for seed in range(10):
        p, q = points(seed, 2, dtype)
        v = sphere.log(p, q)
        assert abs(float(sphere.inner(p, v))) < 10 * EPS[dtype]
        np.testing.assert_allclose(sphere.exp(p, v), q, atol=20 * EPS[dtype])
    np.testing.assert_array_equal(sphere.exp(p, jnp.zeros_like(p)), p)
    np.testing.assert_array_equal(sphere.log(p, p), jnp.zeros_like(p))


@pytest.mark.parametrize("name", ["cosine", "sinc", "log"])
def test_series_meet_the_closed_forms_where_they_take_over(dtype, name):
    radius = float(jnp.finfo(dtype).eps) ** 0.125
    for theta in radius * np.asarray([0.999, 0.99999, 1.00001, 1.001]):
        squared = jnp.asarray(theta**2, dtype)
        exact = np.sqrt(np.float64(squared))
        if name == "log":
            p = points(4, 1, dtype)[0]
            q = jnp.asarray(angle_at(p, theta), dtype)
            np.testing.assert_allclose(sphere.norm(sphere.log(p, q)), theta, rtol=20 * EPS[dtype])
        else:
            got = sphere._cos_sinc(squared)[name == "sinc"]
            wanted = np.cos(exact) if name == "cosine" else np.sin(exact) / exact
            np.testing.assert_allclose(got, wanted, rtol=2 * EPS[dtype])


def test_geodesic_is_even_and_reversible(x64):
    p, q = points(5, 2)
    tau = jnp.linspace(0, 1, 7)
    path = sphere.geodesic(p, q, tau)
    assert path.shape == (7, *SHAPE)
    np.testing.assert_allclose(sphere.norm(path), 1, rtol=1e-14)
    np.testing.assert_allclose(sphere.distance(path[:-1], path[1:]), sphere.distance(p, q) / 6, rtol=1e-13)
    np.testing.assert_allclose(path, sphere.geodesic(q, p, 1 - tau), atol=1e-14)


def test_transport_is_an_isometry_and_carries_the_geodesic_along(x64):
    p, q = points(6, 2)
    v, w = tangent(1, p, 0.4), tangent(2, p, 2.0)
    moved_v, moved_w = sphere.transport(p, q, v), sphere.transport(p, q, w)
    np.testing.assert_allclose(sphere.inner(moved_v, moved_w), sphere.inner(v, w), rtol=1e-12)
    np.testing.assert_allclose(sphere.inner(q, moved_v), 0, atol=1e-15)
    np.testing.assert_allclose(sphere.transport(p, q, sphere.log(p, q)), -sphere.log(q, p), atol=1e-14)
    np.testing.assert_allclose(sphere.transport(q, p, moved_v), v, atol=1e-14)
    np.testing.assert_allclose(sphere.transport(p, p, v), v, atol=1e-15)


def test_transport_against_the_ode(x64):
    # Parallel along the arc: the covariant derivative, the tangent part of dv/dtau, is zero.
    p, q = points(7, 2)
    v = tangent(3, p)

    def along(tau):
        return sphere.transport(p, sphere.geodesic(p, q, tau), v)

    for tau in (0.2, 0.7):
        _, rate = jax.jvp(along, (tau,), (1.0,))
        np.testing.assert_allclose(sphere.project(sphere.geodesic(p, q, tau), rate), 0, atol=1e-13)


def test_antipode_follows_a_fixed_direction(dtype):
    # The second point lies along the first coordinate, where that direction would not be tangent.
    axis = jnp.zeros(SHAPE, dtype).at[0, 0, 0].set(np.sqrt(SHAPE[0]))
    for p in (points(8, 1, dtype)[0], axis, -axis):
        v = sphere.log(p, -p)
        np.testing.assert_allclose(sphere.norm(v), np.pi, rtol=10 * EPS[dtype])
        np.testing.assert_allclose(sphere.inner(p, v), 0, atol=10 * EPS[dtype])
        np.testing.assert_allclose(sphere.distance(p, -p), np.pi, rtol=4 * EPS[dtype])
        np.testing.assert_allclose(sphere.geodesic(p, -p, 1.0), -p, atol=10 * EPS[dtype])
        np.testing.assert_allclose(sphere.transport(p, -p, v), -sphere.log(-p, p), atol=100 * EPS[dtype])


def test_transport_approaches_its_value_at_the_antipode(x64):
    p = points(8, 1)[0]
    v = tangent(4, p)
    near = sphere.geodesic(p, -p, 1 - 1e-7)
    np.testing.assert_allclose(sphere.transport(p, near, v), sphere.transport(p, -p, v), atol=1e-6)


def scalar(f, seed=11):
    weights = np.random.default_rng(seed).normal(size=SHAPE)
    return lambda *args: jnp.sum(jnp.asarray(weights) * f(*args))


@pytest.mark.parametrize("theta", [1e-2, 0.37, 0.5, np.pi / 2, 2.5, 3.0])
def test_gradients_equal_finite_differences(x64, theta):
    p = points(12, 1)[0]
    q, v = jnp.asarray(angle_at(p, theta)), tangent(13, p, theta)
    near = {"order": 1, "modes": ("fwd", "rev"), "eps": 1e-6, "atol": 1e-6, "rtol": 1e-6}
    check_grads(sphere.distance, (p, q), **near)
    check_grads(sphere.norm, (v,), **near)
    check_grads(scalar(sphere.exp), (p, v), **near)
    check_grads(scalar(sphere.log), (p, q), **near)
    check_grads(scalar(sphere.geodesic), (p, q, 0.3), **near)
    check_grads(scalar(sphere.transport), (p, q, v), **near)
    check_grads(scalar(sphere.project), (p, q), **near)


def test_exp_and_log_are_smooth_at_the_identity(x64):
    p = points(14, 1)[0]
    zero = jnp.zeros_like(p)
    near = {"order": 1, "modes": ("fwd", "rev"), "eps": 1e-5, "atol": 1e-8, "rtol": 1e-8}
    check_grads(scalar(sphere.exp), (p, zero), **near)
    check_grads(scalar(sphere.log), (p, p), **near)
    check_grads(scalar(sphere.geodesic), (p, p, 0.3), **near)
    check_grads(scalar(sphere.transport), (p, p, tangent(1, p)), **near)
    check_grads(scalar(sphere.exp), (p, zero), order=2, modes=("rev",), eps=1e-4, atol=1e-5, rtol=1e-5)


def test_subgradients_at_the_singular_points_are_zero(dtype):
    p = points(15, 1, dtype)[0]
    zero = jnp.zeros_like(p)
    np.testing.assert_array_equal(jax.grad(sphere.norm)(zero), zero)
    for q in (p, -p):
        for argument in (0, 1):
            np.testing.assert_array_equal(jax.grad(sphere.distance, argument)(p, q), zero)
            np.testing.assert_array_equal(jax.jvp(lambda q: sphere.distance(p, q), (q,), (p,))[1], 0)
    for argument in (0, 1):
        gradient = jax.grad(lambda p, q: jnp.sum(sphere.log(p, q) ** 3), argument)(p, -p)
        np.testing.assert_array_equal(gradient, zero)


@pytest.mark.parametrize("function", ["log", "distance", "geodesic", "transport"])
def test_nothing_is_nan_near_or_at_singular_points(dtype, function):
    p = points(16, 1, dtype)[0]
    v = tangent(1, p)
    call = {
        "log": sphere.log,
        "distance": sphere.distance,
        "geodesic": lambda p, q: sphere.geodesic(p, q, 0.5),
        "transport": lambda p, q: sphere.transport(p, q, v),
    }[function]
    others = [p, -p, jnp.zeros_like(p), p * (1 + 4 * EPS[dtype]), -p * (1 - 4 * EPS[dtype])]
    others += [jnp.asarray(s * angle_at(p, x), dtype) for s in (1, -1) for x in (1e-20, 1e-12, 1e-7, 1e-3)]
    for q in others:
        value, pull = jax.vjp(call, p, q)
        assert np.isfinite(value).all()
        assert all(np.isfinite(gradient).all() for gradient in pull(jnp.ones_like(value)))


def test_extrinsic_mean_against_a_loop(x64):
    qs = jnp.stack(points(17, 5))
    total = sum(np.asarray(q) for q in qs)
    expected = total / np.sqrt(loop_inner(total, total))
    np.testing.assert_allclose(sphere.extrinsic_mean(qs), expected, atol=1e-14)
    near = {"order": 1, "modes": ("fwd", "rev"), "eps": 1e-6, "atol": 1e-7, "rtol": 1e-7}
    check_grads(scalar(sphere.extrinsic_mean), (qs,), **near)
    np.testing.assert_array_equal(sphere.extrinsic_mean(jnp.stack([qs[0], -qs[0]])), qs[0])


def cluster(seed, count, spread, dtype=jnp.float64):
    centre = points(seed, 1, dtype)[0]
    return jnp.stack([sphere.exp(centre, tangent(seed + k, centre, spread)) for k in range(1, count + 1)])


def loop_karcher(qs):
    """Return the mean by gradient descent with a small step, by the formulas of the paper."""
    p = np.asarray(qs[0])
    for _ in range(400):
        step = np.zeros_like(p)
        for q in np.asarray(qs):
            theta = np.arccos(np.clip(loop_inner(p, q), -1, 1))
            if theta > 1e-9:
                step += 0.5 / len(qs) * theta / np.sin(theta) * (q - np.cos(theta) * p)
        size = np.sqrt(loop_inner(step, step))
        if size < 1e-14:
            break
        p = np.cos(size) * p + np.sin(size) / size * step
    return p


def test_karcher_mean_against_gradient_descent(x64):
    qs = cluster(20, 4, 0.8)
    np.testing.assert_allclose(sphere.karcher_mean(qs), loop_karcher(qs), atol=1e-12)


def test_karcher_mean_is_stationary_equivariant_and_a_midpoint(dtype):
    qs = cluster(21, 6, 1.0, dtype)
    mean = sphere.karcher_mean(qs)
    np.testing.assert_allclose(sphere.norm(mean), 1, rtol=4 * EPS[dtype])
    assert sphere.norm(jnp.mean(sphere.log(mean, qs), axis=0)) < 40 * EPS[dtype]
    turn = jnp.asarray(np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0], dtype)
    np.testing.assert_allclose(sphere.karcher_mean(qs @ turn), mean @ turn, atol=100 * EPS[dtype])
    np.testing.assert_allclose(sphere.karcher_mean(qs[:2]), sphere.geodesic(qs[0], qs[1], 0.5), atol=100 * EPS[dtype])
    np.testing.assert_allclose(sphere.karcher_mean(qs[:1]), qs[0], atol=4 * EPS[dtype])


def test_karcher_mean_stops_by_tolerance_and_by_steps(x64):
    qs = cluster(22, 6, 1.2)

    def residual(**options):
        return float(sphere.norm(jnp.mean(sphere.log(sphere.karcher_mean(qs, **options), qs), axis=0)))

    assert residual(tolerance=1e-3) <= 1e-3
    assert residual(tolerance=1e-12) <= 1e-12 < residual(tolerance=1e-3)
    assert residual(steps=30) < residual(steps=1)


def test_karcher_mean_gradient_is_exact(x64):
    qs = cluster(23, 3, 0.9)
    loss = scalar(sphere.karcher_mean)
    check_grads(loss, (qs,), order=1, modes=("fwd", "rev"), eps=1e-5, atol=1e-7, rtol=1e-7)


@pytest.mark.parametrize(
    ("call", "match"),
    [
        (lambda p: sphere.inner(p, p[:, :-1]), r"end alike.*\(4, 5, 3\), \(4, 4, 3\)"),
        (lambda p: sphere.norm(p[0]), r"\(\.\.\., T-1, L, 3\)"),
        (lambda p: sphere.norm(jnp.ones(SHAPE, jnp.int32)), "floating dtype, got int32"),
        (lambda p: sphere.transport(p, p, p[:-1]), "end alike"),
        (lambda p: sphere.karcher_mean(p), "at least one point"),
        (lambda p: sphere.extrinsic_mean(p[None][:0]), "at least one point"),
        (lambda p: sphere.karcher_mean(p[None], steps=0), "at least 1, got 0"),
    ],
)
def test_wrong_input_is_named(call, match, monkeypatch):
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)  # what a caller gets: only tests check shapes
    with pytest.raises(ValueError, match=match):
        call(jnp.ones(SHAPE))
