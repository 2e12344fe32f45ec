"""Values and gradients at many random points near singular sets, in both precisions.

Pairs of points on the sphere have angles from 1e-12 to pi - 1e-12, and 0 and pi exactly. Curves have units from 1e-12
to 1e12, some steps of zero, and steps that differ by twelve orders of magnitude; some are constant. Point sets for the
alignment are flat, collinear, coincident or mirrored.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from facejax import augment
from facejax.geometry import align, rbf, sphere, srvf
from tests.near import COUNT, finite

STEPS, LANDMARKS = 3, 2


def pairs(dtype):
    """Return points p and q (COUNT, T-1, L, 3), and a tangent vector at p, of unit length."""
    rng = np.random.default_rng(0)
    p, u = rng.normal(size=(2, COUNT, STEPS, LANDMARKS, 3))
    p = unit(p)
    # Some points on the axes, where the fixed direction for the antipode changes.
    p[::10] = 0
    p[np.arange(0, COUNT, 10), 0, 0, rng.integers(0, 3, COUNT // 10)] = np.sqrt(STEPS)
    u = unit(u - p * np.einsum("ktlc,ktlc->k", u, p)[:, None, None, None] / STEPS)
    theta = 10.0 ** rng.uniform(-12, 0.4, COUNT)
    theta = np.where(rng.random(COUNT) < 0.5, theta, np.maximum(np.pi - theta, 0))
    theta[::7], theta[3::7] = 0, np.pi
    q = np.cos(theta)[:, None, None, None] * p + np.sin(theta)[:, None, None, None] * u
    q[::7], q[3::7] = p[::7], -p[3::7]
    p[:10], q[5:15] = 0, 0  # constant motions
    return tuple(jnp.asarray(x, dtype) for x in (p, q, u))


def unit(x):
    return x * np.sqrt(STEPS / np.einsum("ktlc,ktlc->k", x, x))[:, None, None, None]


def curves(dtype):
    """Return curves (COUNT, T, L, 3)."""
    rng = np.random.default_rng(1)
    steps = rng.normal(size=(COUNT, STEPS, LANDMARKS, 3)) * 10.0 ** rng.uniform(-12, 0, (COUNT, STEPS, 1, 1))
    steps[rng.random((COUNT, STEPS)) < 0.2] = 0
    steps[:100] = 0
    steps *= 10.0 ** rng.uniform(-12, 12, (COUNT, 1, 1, 1))
    return jnp.asarray(np.concatenate([np.zeros_like(steps[:, :1]), np.cumsum(steps, axis=1)], axis=1), dtype)


def length(v):
    return np.sqrt(np.einsum("ktlc,ktlc->k", v, v, dtype=np.float64) / STEPS)


def test_the_sphere(dtype):
    p, q, u = pairs(dtype)
    eps = float(np.finfo(dtype).eps)
    whole = (length(p) > 0) & (length(q) > 0)
    way, angle = finite(sphere.log, p, q), np.asarray(finite(sphere.distance, p, q))
    assert (angle >= 0).all() and (angle <= np.pi * (1 + eps)).all()
    np.testing.assert_allclose(length(way)[whole], angle[whole], rtol=64 * eps, atol=eps)
    back = np.asarray(finite(sphere.exp, p, way))
    assert length(back - np.asarray(q))[whole].max() < 16 * eps
    assert np.abs(np.asarray(sphere.distance(q, p)) - angle).max() < 16 * eps
    assert (angle[~whole] == 0).all() and (length(way)[~whole] == 0).all()
    middle = finite(lambda p, q: sphere.geodesic(p, q, 0.5), p, q)
    np.testing.assert_allclose(
        np.asarray(sphere.distance(p, middle))[whole], angle[whole] / 2, rtol=64 * eps, atol=8 * eps
    )
    moved = finite(sphere.transport, p, q, u)
    assert np.abs(length(moved) - 1)[whole].max() < 64 * eps
    # Near the antipode p + q is small, and its relative rounding error large.
    off = np.abs(np.asarray(sphere.inner(q, moved))) * np.minimum(length(np.asarray(p) + np.asarray(q)), 1)
    assert off[whole].max() < 64 * eps
    for function in (sphere.inner, sphere.project):
        finite(function, p, q)
    finite(sphere.norm, p - q)


def test_roots(dtype):
    squared = 10.0 ** np.random.default_rng(4).uniform(-80, 30, COUNT)  # in float32 nearly half of them are 0
    squared[:100] = 0
    squared = np.asarray(squared, dtype)
    squared[squared < np.finfo(dtype).tiny] = 0  # XLA flushes denormal numbers to 0
    np.testing.assert_allclose(finite(sphere.safe_sqrt, jnp.asarray(squared)), np.sqrt(squared), rtol=1e-6)


def test_means(dtype):
    p, q, _ = pairs(dtype)
    sets = jnp.stack([p, q, p], axis=1)
    finite(sphere.extrinsic_mean, sets)
    near = np.asarray(sphere.distance(p, q)) < 1
    near &= (length(p) > 0) & (length(q) > 0)
    found = finite(sphere.karcher_mean, sets[near])
    pull = np.asarray(jnp.mean(sphere.log(found[:, None], sets[near]), axis=1))
    assert length(pull).max() < 64 * np.finfo(dtype).eps


def test_the_transform(dtype):
    curve = curves(dtype)
    eps, tiny = float(np.finfo(dtype).eps), float(np.finfo(dtype).tiny)
    q, log_length = finite(srvf.encode, curve)
    still = length(q) == 0
    assert still[:100].all() and not still.all()
    assert (np.asarray(log_length)[still] == np.log(np.asarray(srvf.FLOOR, dtype))).all()
    assert np.abs(length(q) - 1)[~still].max() < 16 * eps
    back = finite(srvf.decode, q, log_length, curve[:, 0])
    extent = np.maximum(np.abs(np.asarray(curve, np.float64)).max(axis=(1, 2, 3)), tiny)
    off = np.abs(np.asarray(back, np.float64) - np.asarray(curve, np.float64)).max(axis=(1, 2, 3)) / extent
    assert off[~still].max() < 64 * eps
    finite(srvf.displacement, q, log_length)
    share = np.asarray(finite(srvf.arc_length_fraction, q))
    assert (np.diff(share) >= 0).all() and set(share[:, 0]) == {0.0} and set(share[~still, -1]) == {1.0}
    finite(srvf.length, curve)


def clouds(dtype):
    """Return sources and targets (COUNT, 4, 3): rotated, mirrored, nearly flat or collinear, coincident."""
    rng = np.random.default_rng(3)
    source = rng.normal(size=(COUNT, 4, 3)) * 10.0 ** rng.uniform(-9, 0, (COUNT, 1, 3))
    turn = np.linalg.qr(rng.normal(size=(COUNT, 3, 3)))[0]
    turn[::2] = np.eye(3)
    target = np.einsum("kij,knj->kni", turn, source)
    target[1::4] *= [1, 1, -1]
    source[:100] = target[50:150] = 0
    target[200:300] = source[200:300, :1]
    scale = 10.0 ** rng.uniform(-6, 6, (COUNT, 1, 1))
    return jnp.asarray(scale * source, dtype), jnp.asarray(scale * target, dtype)


@pytest.mark.parametrize("scaling", [False, True])
def test_alignment(dtype, scaling):
    source, target = clouds(dtype)
    found = finite(lambda a, b: align.procrustes(a, b, scaling=scaling), source, target)
    rotation = np.asarray(found.rotation, np.float64)
    eps = float(np.finfo(dtype).eps)
    assert np.abs(rotation @ rotation.transpose(0, 2, 1) - np.eye(3)).max() < 64 * eps
    assert np.abs(np.linalg.det(rotation) - 1).max() < 64 * eps
    finite(lambda a, b: align.apply(align.procrustes(a, b, scaling=scaling), a), source, target)
    finite(lambda a: align.normalise(a[:, None], a), source)


@pytest.mark.parametrize("by", ["time", "arc"])
def test_resampling(dtype, by):
    curve = curves(dtype)
    found = np.asarray(finite(lambda curve: align.resample(curve, frames=5, by=by), curve))
    np.testing.assert_array_equal(found[:, [0, -1]], np.asarray(curve)[:, [0, -1]])
    low, high = np.asarray(curve).min(axis=1), np.asarray(curve).max(axis=1)
    slack = 8 * np.finfo(dtype).eps * np.abs(np.asarray(curve)).max(axis=1)
    assert (found >= (low - slack)[:, None]).all() and (found <= (high + slack)[:, None]).all()


def test_transitions(dtype):
    p, q, _ = pairs(dtype)
    sizes = jnp.asarray(np.random.default_rng(5).uniform(-9, 9, (2, COUNT)), dtype)
    starts = jnp.zeros((COUNT, LANDMARKS, 3), dtype)
    found = np.asarray(
        finite(lambda *both: augment.transition(*both, starts, starts, frames=4), p, sizes[0], q, sizes[1])
    )
    for frame, end, size in ((0, p, sizes[0]), (-1, q, sizes[1])):
        wanted = np.asarray(srvf.displacement(end, size)).sum(axis=1)
        off = np.abs(found[:, frame] - wanted).max(axis=(1, 2)) / np.exp(np.asarray(size))
        assert off[15:].max() < 64 * np.finfo(dtype).eps  # in the first 15 a motion is constant, and not on the sphere


def test_halves(dtype):
    curve = curves(dtype)
    peak = augment.apex(curve)
    found = finite(lambda curve: augment.split_at_peak(curve, peak, frames=3), curve)
    highest = np.asarray(curve)[np.arange(COUNT), np.asarray(peak)]
    np.testing.assert_array_equal(found[0][:, 0], curve[:, 0])
    np.testing.assert_array_equal(found[0][:, -1], highest)
    np.testing.assert_array_equal(found[1][:, 0], highest)
    np.testing.assert_array_equal(found[1][:, -1], curve[:, -1])


def landmarks(rng):
    """Return landmarks (5, 3): two nearly coincident, or all near a plane or a line; some far from the origin."""
    rest = rng.normal(size=(5, 3))
    kind = rng.integers(4)
    if kind == 0:
        rest[1] = rest[0] + 10.0 ** rng.uniform(-14, 0) * rng.normal(size=3)
    elif kind == 1:
        rest[:, 2] *= 10.0 ** rng.uniform(-14, 0)
    elif kind == 2:
        rest[:, 1:] *= 10.0 ** rng.uniform(-14, 0)
    rest += 10.0 ** rng.uniform(-2, 4) * rng.normal(size=3) * rng.integers(2)
    return 10.0 ** rng.uniform(-6, 6) * rest


def test_warps():
    """Either `fit` raises an error, or the landmarks are interpolated."""
    rng, refused = np.random.default_rng(6), 0
    for _ in range(COUNT):
        rest = landmarks(rng)
        try:
            found = rbf.fit(rest, kernel=str(rng.choice(list(rbf.KERNELS))))
        except ValueError:
            refused += 1
            continue
        # The weights are float32, and the system is solved in units of the landmarks' spacing.
        weights = rbf.weights(found, rest)
        assert np.abs(weights - np.eye(5)).max() < 1e-4
        assert np.isfinite(rbf.weights(found, rest[:3] + np.ptp(rest) * rng.normal(size=(3, 3)))).all()
    assert 0 < refused < COUNT


@pytest.mark.parametrize("kernel", rbf.KERNELS)
def test_kernels(kernel):
    squared = np.append(0, np.sort(10.0 ** np.random.default_rng(7).uniform(-300, 60, COUNT)))
    with jax.enable_x64(True):
        value = np.asarray(rbf.KERNELS[kernel].phi(jnp, jnp.asarray(squared)))
    assert np.isfinite(value).all()
    np.testing.assert_allclose(value, rbf.KERNELS[kernel].phi(np, squared), rtol=1e-9, atol=1e-300)
    if rbf.KERNELS[kernel].definite:
        assert value[0] == 1 and value[-1] == 0 and (np.diff(value) < 1e-15).all()
