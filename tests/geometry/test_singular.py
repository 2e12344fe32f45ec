"""Laws over 100,000 random points near the sets where formulas break down, values and gradients, in both precisions.

Points are pairs at angles from 1e-12 to pi less 1e-12 and exactly 0 and pi; motions are curves in units from 1e-12 to
1e12 with pauses, steps that differ by twelve orders, and standstill; clouds are flat, thin, single points and mirror
images.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from facejax.geometry import align, sphere, srvf

COUNT = 100_000
STEPS, LANDMARKS = 3, 2


@pytest.fixture(params=["float32", "float64"])
def dtype(request):
    with jax.enable_x64(request.param == "float64"):
        yield np.dtype(request.param)


def pairs(dtype):
    """Points p and q (COUNT, T-1, L, 3), and a tangent vector at p, of unit length."""
    rng = np.random.default_rng(0)
    p, u = rng.normal(size=(2, COUNT, STEPS, LANDMARKS, 3))
    p = unit(p)
    # Some along the axes, where the fixed direction of the antipode changes.
    p[::10] = 0
    p[np.arange(0, COUNT, 10), 0, 0, rng.integers(0, 3, COUNT // 10)] = np.sqrt(STEPS)
    u = unit(u - p * np.einsum("ktlc,ktlc->k", u, p)[:, None, None, None] / STEPS)
    theta = 10.0 ** rng.uniform(-12, 0.4, COUNT)
    theta = np.where(rng.random(COUNT) < 0.5, theta, np.maximum(np.pi - theta, 0))
    theta[::7], theta[3::7] = 0, np.pi
    q = np.cos(theta)[:, None, None, None] * p + np.sin(theta)[:, None, None, None] * u
    q[::7], q[3::7] = p[::7], -p[3::7]
    p[:10], q[5:15] = 0, 0  # motions at standstill
    return tuple(jnp.asarray(x, dtype) for x in (p, q, u))


def unit(x):
    return x * np.sqrt(STEPS / np.einsum("ktlc,ktlc->k", x, x))[:, None, None, None]


def curves(dtype):
    """Motions (COUNT, T, L, 3)."""
    rng = np.random.default_rng(1)
    steps = rng.normal(size=(COUNT, STEPS, LANDMARKS, 3)) * 10.0 ** rng.uniform(-12, 0, (COUNT, STEPS, 1, 1))
    steps[rng.random((COUNT, STEPS)) < 0.2] = 0
    steps[:100] = 0
    steps *= 10.0 ** rng.uniform(-12, 12, (COUNT, 1, 1, 1))
    return jnp.asarray(np.concatenate([np.zeros_like(steps[:, :1]), np.cumsum(steps, axis=1)], axis=1), dtype)


def finite(function, *arrays, where=None):
    """The values, checked with the gradients by every array."""
    made = function(*arrays)
    rng = np.random.default_rng(2)
    weights = [jnp.asarray(rng.normal(size=leaf.shape), leaf.dtype) for leaf in jax.tree.leaves(made)]

    def total(*arrays):
        return sum(jnp.sum(w * leaf) for w, leaf in zip(weights, jax.tree.leaves(function(*arrays)), strict=True))

    slopes = jax.jit(jax.grad(total, argnums=tuple(range(len(arrays)))))(*arrays)
    for leaf in [*jax.tree.leaves(made), *slopes]:
        bad = ~np.isfinite(np.asarray(leaf)).reshape(len(leaf), -1).all(axis=1)
        assert not bad.any(), f"{bad.sum()} of {len(bad)}, first {np.argmax(bad)}"
        assert leaf.dtype == arrays[0].dtype
    return made


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
    # The nearer to the antipode, the more of p + q, and so of the way, is rounding.
    off = np.abs(np.asarray(sphere.inner(q, moved))) * np.minimum(length(np.asarray(p) + np.asarray(q)), 1)
    assert off[whole].max() < 64 * eps
    for function in (sphere.inner, sphere.project):
        finite(function, p, q)
    finite(sphere.norm, p - q)


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
    share = np.asarray(finite(srvf.covered, q))
    assert (np.diff(share) >= 0).all() and set(share[:, 0]) == {0.0} and set(share[~still, -1]) == {1.0}
    finite(srvf.length, curve)


def clouds(dtype):
    """Points (COUNT, 4, 3) and what they are to be brought onto: turned, mirrored, thin, flat, single."""
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
