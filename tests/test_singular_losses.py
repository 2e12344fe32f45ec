"""Losses and measures of many samples near where their roots and ratios break down; both precisions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from facejax import losses, metrics
from facejax.geometry import sphere
from tests.near import COUNT, finite, steps

T, L = 3, 2


def motions(dtype):
    """Two sets (COUNT, T, L, 3), a third of which agree, and a mask (COUNT, T)."""
    rng = np.random.default_rng(0)
    first = steps(dtype, COUNT, T, L)
    second = jnp.where(rng.random((COUNT, 1, 1, 1)) < 0.3, first, jnp.roll(first, 1, axis=0))
    return first, second, jnp.asarray(rng.random((COUNT, T)) < 0.8)


def test_losses_of_steps(dtype):
    first, second, mask = motions(dtype)
    for loss in (losses.next_step, losses.path_distance):
        each = finite(lambda a, b, loss=loss: jax.vmap(loss)(a, b, mask), first, second)
        assert (np.asarray(each) >= 0).all() and (np.asarray(loss(first, first, mask)) == 0).all()
    wanted = losses.step_energy(second, mask)
    finite(lambda a: jax.vmap(losses.step_energy)(a, mask), first)
    finite(lambda a: losses.energy_ratio(a, mask, wanted), first, each=False)
    finite(lambda a: losses.energy_ratio(a, mask, wanted), jnp.zeros_like(first), each=False)
    for loss in (losses.tangent_l1, losses.displacement_l1):
        assert (np.asarray(finite(jax.vmap(loss), first, second)) >= 0).all()


def test_the_gradient_penalty_where_the_critic_is_flat(dtype):
    rng = np.random.default_rng(1)
    slopes = rng.normal(size=(COUNT, 3)) * 10.0 ** rng.uniform(-30, 0, (COUNT, 1))
    slopes[::3] = 0
    real, fake = jnp.asarray(rng.normal(size=(2, COUNT, 3)), dtype)

    def penalty(slopes):
        return losses.gradient_penalty(lambda x, slope: jnp.dot(x, slope), jax.random.key(0), real, fake, slopes)

    wanted = np.mean((np.linalg.norm(slopes, axis=1) - 1) ** 2)
    found = finite(penalty, jnp.asarray(slopes, dtype), each=False)
    np.testing.assert_allclose(found, wanted, rtol=1e-5)


def test_flow_matching_between_like_and_opposite_points(dtype):
    rng = np.random.default_rng(2)
    y, u = rng.normal(size=(2, COUNT, 1, 1, 4))
    y /= np.linalg.norm(y, axis=-1, keepdims=True)
    u -= y * np.sum(u * y, axis=-1, keepdims=True)
    u /= np.linalg.norm(u, axis=-1, keepdims=True)
    angle = 10.0 ** rng.uniform(-12, 0.4, (COUNT, 1, 1, 1))
    angle = np.where(rng.random(angle.shape) < 0.5, angle, np.maximum(np.pi - angle, 0))
    angle[::7], angle[3::7] = 0, np.pi
    y, other = (jnp.asarray(x, dtype) for x in (y, np.cos(angle) * y + np.sin(angle) * u))
    s = jnp.zeros((COUNT, 2), dtype)
    pull = jnp.asarray(rng.normal(size=(COUNT, 1, 1, 4)), dtype)

    def field(state, time, pull):
        return sphere.project(state[0], pull), state[1] * time

    def loss(y, other, pull):
        return losses.flow_matching(field, jax.random.key(0), (y, s), (other, s), pull, jnp.ones((COUNT, 4), dtype))

    assert finite(loss, y, other, pull, each=False) > 0


@pytest.mark.parametrize("mode", ["linear", "inverse", "none"])
def test_weights_at_landmarks(dtype, mode):
    rng = np.random.default_rng(3)
    vertices = rng.normal(size=(COUNT, 3)) * 10.0 ** rng.uniform(-12, 0, (COUNT, 1))
    vertices[4 : COUNT // 4] = vertices[rng.integers(4, size=COUNT // 4 - 4)]

    def weights(vertices):
        return losses.landmark_weights(vertices, np.arange(4), mode=mode, edge_length=0.1)

    found = np.asarray(finite(weights, jnp.asarray(vertices, dtype)))
    assert (found >= 0).all() and (found <= 1).all() and (found[: COUNT // 4] == 1).all()
    assert (np.asarray(finite(weights, jnp.zeros((5, 3), dtype))) == 1).all()


def test_measures(dtype):
    first, second, _ = motions(dtype)
    finite(metrics.vertex_distance, first, second)
    for measure in (metrics.vertex_error, lambda a, b: metrics.vertex_error(a, a)):
        mean, std, _ = finite(measure, first, second, each=False)
        assert mean >= 0 and std >= 0
    for measure in (metrics.speed, metrics.acceleration):
        assert (np.asarray(finite(measure, first)) >= 0).all()
    finite(metrics.peak_displacement, first, second[:, 0])
    sets = jnp.stack([first, second, first], axis=1)
    finite(metrics.specificity, sets, second)
    assert (np.asarray(finite(metrics.diversity, sets)) >= 0).all()
    some, others = first[:300], second[200:400]
    for measure in (metrics.distances, metrics.nearest_distance):
        assert (np.asarray(finite(measure, some, others)[:100]) >= 0).all()
