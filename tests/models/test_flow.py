"""The flow on the sphere: an exact great sphere, tangent velocities, unit motions, a toy distribution learned."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from jax.test_util import check_grads

from facejax import losses, steps, training
from facejax.geometry import sphere
from facejax.models import charts, flow, generators, motion, motion_reference
from tests.models.test_motion import CONFIG as GAN
from tests.models.test_motion import POSE, SHAPE, fitted, toy

CONFIG = flow.Config(steps=5, landmarks=4, labels=3, rank=8, pose=4, width=16, blocks=2, embedding=4)


@pytest.fixture(scope="module")
def chart():
    return fitted(toy(), labels=3, rank=CONFIG.rank)


@pytest.fixture(scope="module")
def still(chart):
    """Untrained: a field of zero."""
    return flow.init(jax.random.key(0), chart, config=CONFIG)


@pytest.fixture(scope="module")
def params(still):
    head = jax.random.normal(jax.random.key(5), still.weights["head"]["kernel"].shape) * 0.3
    gates = [gate | {"kernel": gate["kernel"] + 0.1} for gate in still.weights["gates"]]
    return still._replace(weights=still.weights | {"head": still.weights["head"] | {"kernel": head}, "gates": gates})


def values(seed, count=()):
    return jnp.asarray(np.random.default_rng(seed).normal(size=(*count, CONFIG.rank + 2)), jnp.float32)


def test_states_are_motions_of_the_large_sphere(chart):
    """exp_p in R + 1 numbers is exp_p in all: same point, same distances; log-length and log-seconds pass."""
    a, b = values(0), values(1)
    tangents = [charts.motion(chart, x, 1, 2) for x in (a, b)]
    points = [sphere.exp(chart.p, tangent) for tangent, *_ in tangents]
    motions = [flow.unwrap(chart, flow.wrap(chart, x), 1, 2) for x in (a, b)]
    for (_, *scalars), point, made in zip(tangents, points, motions, strict=True):
        np.testing.assert_allclose(made.q, point, atol=2e-6)
        np.testing.assert_allclose(made[1:], scalars, rtol=1e-6)
        assert abs(float(sphere.norm(made.q)) - 1) < 1e-6
    small = sphere.distance(flow.wrap(chart, a)[0], flow.wrap(chart, b)[0])
    assert float(small) == pytest.approx(float(sphere.distance(*points)), rel=1e-5)


def test_velocity_is_tangent_and_told_of_everything(params):
    state = flow.wrap(params.chart, values(2))
    told = [
        (0.3, 1, 2, 0 * POSE),
        (0.6, 1, 2, 0 * POSE),
        (0.3, 2, 1, 0 * POSE),
        (0.3, 1, 0, 0 * POSE),
        (0.3, 1, 2, POSE),
    ]
    found = [flow.velocity(params, state, jnp.float32(time), *rest) for time, *rest in told]
    for v, _ in found:
        assert abs(float(sphere.inner(state[0], v))) < 1e-6
    assert min(float(sphere.norm(found[0][0] - v)) for v, _ in found[1:]) > 1e-3


def test_a_field_of_zero_gives_the_source_and_the_source_is_the_gaussian(chart, still):
    keys = jax.random.split(jax.random.key(1), 3000)
    source = jax.vmap(flow.source, (None, 0, None, None, None))(chart, keys, 2, 1, 0 * POSE)
    direct = jax.vmap(flow.unwrap, (None, 0, None, None))(chart, source, 2, 1)
    drawn = jax.vmap(flow.sample, (None, 0, None, None, None))(still, keys, 2, 1, 0 * POSE)
    np.testing.assert_allclose(drawn.q, direct.q, atol=1e-5)
    np.testing.assert_allclose(sphere.norm(drawn.q), 1, atol=1e-5)
    tangents = sphere.log(chart.p, drawn.q)
    got = jax.vmap(charts.coordinates, (None, 0, 0, 0, None, None))(chart, tangents, *drawn[1:], 2, 1)
    np.testing.assert_allclose(got[:, 2:].mean(0), chart.mean[2, 1], atol=0.07 * float(chart.scale[2, 1].max()))
    np.testing.assert_allclose(got[:, 2:6].std(0), chart.scale[2, 1, :4], rtol=0.07)
    np.testing.assert_allclose(got[:, :2].std(0), 1, atol=0.07)


def test_more_steps_converge_and_a_key_decides(params):
    draws = [flow.sample(params, jax.random.key(3), 0, 1, 0 * POSE, steps=count) for count in (4, 8, 16, 128)]
    errors = [float(sphere.distance(one.q, draws[-1].q)) for one in draws[:-1]]
    assert errors[1] < 0.5 * errors[0] and errors[2] < 0.5 * errors[1]
    again = flow.sample(params, jax.random.key(3), 0, 1, 0 * POSE, steps=8)
    np.testing.assert_array_equal(again.q, draws[1].q)


def test_eager_jit_and_vmap_agree(params):
    state = flow.wrap(params.chart, values(4))
    many = jax.tree.map(lambda x: jnp.stack([x, x]), state)
    batch = jax.vmap(flow.velocity, (None, 0, None, 0, None, None))(params, many, 0.5, jnp.array([0, 1]), 2, POSE)
    for i in range(2):
        with jax.disable_jit():
            one = flow.velocity(params, state, 0.5, i, 2, POSE)
        for a, b in zip(batch, one, strict=True):
            np.testing.assert_allclose(a[i], b, atol=1e-5)


def test_gradients_equal_finite_differences_and_the_chart_has_none(params):
    state = flow.wrap(params.chart, values(4))

    def energy(y, s):
        v, rate = flow.velocity(params, (y, s), 0.4, 1, 2, POSE)
        return jnp.sum(v**2) + jnp.sum(rate**2)

    check_grads(energy, state, 1, eps=1e-2, rtol=2e-2)
    slope = jax.grad(lambda p: jnp.sum(flow.velocity(p, state, 0.4, 1, 2, POSE)[1] ** 2))(params)
    assert all(np.all(leaf == 0) for leaf in jax.tree.leaves(slope.chart))
    assert np.any(slope.weights["stem"]["kernel"] != 0)


def test_loss_is_the_plain_loop_and_zero_for_the_velocity_of_the_geodesic(chart):
    source, target = (flow.wrap(chart, values(seed)) for seed in (6, 7))
    one = jax.tree.map(lambda x: x[None], (source, target))
    unit = jnp.full((1, CONFIG.rank + 1), 0.5)

    def exact(state, time, condition):
        # What is left of the way, over the time that is left.
        return sphere.log(state[0], target[0]) / (1 - time), (target[1] - state[1]) / (1 - time)

    loss = losses.flow_matching(exact, jax.random.key(0), *one, None, unit)
    assert float(loss) < 1e-7

    def off(state, time, condition):
        v, rate = exact(state, time, condition)
        return v + 0.1 * sphere.project(state[0], jnp.ones_like(v)), rate + 0.2

    time = float(jax.random.uniform(jax.random.key(0), (1,))[0])
    y = np.asarray(sphere.geodesic(source[0], target[0], time)).ravel()
    ones = np.ones_like(y)
    wrong = np.concatenate([0.1 * (ones - (ones @ y) * y) / 0.5, [0.2, 0.2]])
    loss = losses.flow_matching(off, jax.random.key(0), *one, None, unit)
    assert float(loss) == pytest.approx(np.mean(wrong**2), rel=1e-3)


def test_wrong_charts_are_named(chart):
    with pytest.raises(ValueError, match=r"basis, means and poses must be .*128.* got .*\(8, 5, 4, 3\)"):
        flow.init(jax.random.key(0), chart)


def test_every_generator_answers_to_one_call(params, chart):
    gan = motion.generator.init(jax.random.key(0), chart, config=GAN)
    config = motion_reference.Config(steps=5, landmarks=4, labels=3, noise=6, width_divisor=32)
    reference = motion_reference.generator.init(jax.random.key(0), chart, config=config)
    for name, one in (("flow", params), ("gan", gan), ("reference", reference)):
        made = generators.sample(one, jax.random.key(1), 1, 2, POSE)
        assert made.q.shape == SHAPE and abs(float(sphere.norm(made.q)) - 1) < 1e-5
        assert np.isfinite(made.log_length) and np.isfinite(made.log_seconds)
        assert generators.kind(one) == name and type(one) is generators.KINDS[name]
        other = generators.sample(one, jax.random.key(1), 1, 2, 0 * POSE)
        assert bool(np.any(other.q != made.q)) == generators.heeds_pose(one) == (name != "reference")


@pytest.mark.slow
def test_the_flow_learns_both_styles():
    """Two styles along the first direction, where the Gaussian that it starts from has one hump."""
    chart = fitted(toy(3000), labels=3, rank=8)
    _, tangents, made, start, end, here = toy(3000)
    real = jax.vmap(charts.coordinates, (None, 0, 0, 0, 0, 0))(chart, tangents, *made[1:], start, end)
    poses = jax.vmap(charts.pose, (None, 0, 0))(chart, here, start)
    weights = flow.init(jax.random.key(0), chart, config=CONFIG._replace(width=96)).weights

    def loss(weights, key, batch, chart):
        found, condition = batch
        a, b = jax.random.split(key)
        keys = jax.random.split(a, len(found))
        source = jax.vmap(flow.source, (None, 0, 0, 0, 0))(chart, keys, *condition)
        target = jax.vmap(flow.wrap, (None, 0))(chart, found)
        unit = jax.vmap(flow.unit, (None, 0, 0))(chart, *condition[:2])
        field = lambda state, time, one: flow.velocity(flow.Params(chart, weights), state, time, *one)  # noqa: E731
        return losses.flow_matching(field, b, source, target, condition, unit), {}

    optimiser = optax.adam(optax.cosine_decay_schedule(3e-3, 2000))
    step = training.gathered(steps.supervised(loss, optimiser))
    state = steps.start_supervised(weights, optimiser, jax.random.key(1))
    indices = training.epoch_indices(0, len(real), 128)(0, 2000)
    held = ((real, (start, end, poses)), chart)
    state, _ = jax.jit(lambda s, i, h: jax.lax.scan(lambda s, b: step(s, b, h), s, i))(state, indices, held)
    params = flow.Params(chart, state.params)
    keys = jax.random.split(jax.random.key(2), 1000)
    drawn = jax.vmap(flow.sample, (None, 0, None, None, None))(params, keys, 1, 2, 0 * POSE)
    tangents = sphere.log(chart.p, drawn.q)
    fake = jax.vmap(charts.coordinates, (None, 0, 0, 0, None, None))(chart, tangents, *drawn[1:], 1, 2)
    true = np.asarray(real[(start == 1) & (end == 2)])
    widest = 2 + int(np.argmax(true[:, 2:].std(0)))
    middle, deviation = true[:, widest].mean(), true[:, widest].std()
    inside = [float(np.mean(np.abs(x[:, widest] - middle) < 0.4 * deviation)) for x in (np.asarray(fake), true)]
    assert inside[0] < inside[1] + 0.1 < 0.25  # a Gaussian has 31 % there
    np.testing.assert_allclose(np.asarray(fake)[:, 2:6].std(0), true[:, 2:6].std(0), rtol=0.25)
