"""Losses against plain loops, the laws that they obey, and their gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from facejax import losses
from facejax.geometry import sphere

RNG = np.random.default_rng(0)
PREDICTED, TARGET = RNG.standard_normal((2, 2, 5, 7, 3)).astype(np.float32)
WEIGHTS = RNG.random(7).astype(np.float32)


def loop_weighted(predicted, target, weights):
    total = 0.0
    for p, t in zip(predicted.reshape(-1, 7, 3), target.reshape(-1, 7, 3), strict=True):
        for i in range(7):
            total += float(weights[i]) * sum(abs(float(p[i, c]) - float(t[i, c])) for c in range(3)) / 7
    return total / (predicted.size // 21)


def test_mesh_losses_are_the_plain_loops():
    plain, weighted = loop_weighted(PREDICTED, TARGET, np.ones(7)), loop_weighted(PREDICTED, TARGET, WEIGHTS)
    np.testing.assert_allclose(losses.displacement_l1(PREDICTED, TARGET), plain, rtol=1e-5)
    np.testing.assert_allclose(losses.weighted_l1(PREDICTED, TARGET, WEIGHTS), weighted, rtol=1e-5)
    got = losses.s2d(PREDICTED, TARGET, WEIGHTS, beta1=2.0, beta2=0.5)
    np.testing.assert_allclose(got, 2.0 * plain + 0.5 * weighted, rtol=1e-5)
    got = losses.s2d(PREDICTED, TARGET, WEIGHTS, beta1=2.0, beta2=0.5, reduction="reference")
    np.testing.assert_allclose(got, 0.5 * plain + 2.0 * 7 * weighted, rtol=1e-5)
    np.testing.assert_allclose(
        losses.tangent_l1(PREDICTED, TARGET), np.abs(PREDICTED - TARGET).sum() / PREDICTED.size, rtol=1e-5
    )


def test_with_equal_weights_the_papers_loss_is_one_tenth_more_than_its_first_term():
    plain = losses.displacement_l1(PREDICTED, TARGET)
    np.testing.assert_allclose(losses.s2d(PREDICTED, TARGET, np.ones(7, np.float32)), 1.1 * plain, rtol=1e-6)


def test_the_neutral_face_cancels_and_units_scale():
    neutral = RNG.standard_normal((7, 3)).astype(np.float32)
    a = losses.weighted_l1(PREDICTED, TARGET, WEIGHTS)
    np.testing.assert_allclose(losses.weighted_l1(PREDICTED + neutral, TARGET + neutral, WEIGHTS), a, rtol=1e-5)
    np.testing.assert_allclose(losses.weighted_l1(10 * PREDICTED, 10 * TARGET, WEIGHTS), 10 * a, rtol=1e-5)
    assert float(losses.weighted_l1(TARGET, TARGET, WEIGHTS)) == 0.0


@pytest.mark.parametrize(
    "loss",
    [
        losses.tangent_l1,
        losses.displacement_l1,
        lambda p, t: losses.s2d(p, t, WEIGHTS),
        lambda p, t: losses.s2d(p, t, WEIGHTS, reduction="reference"),
    ],
)
def test_eager_jit_vmap_and_gradients_agree(loss):
    batch = jax.vmap(loss)(PREDICTED, TARGET)
    for i in range(2):
        with jax.disable_jit():
            np.testing.assert_allclose(loss(PREDICTED[i], TARGET[i]), batch[i], rtol=1e-5)
    np.testing.assert_allclose(loss(PREDICTED, TARGET), batch.mean(), rtol=1e-5)
    far = TARGET + np.where(PREDICTED > TARGET, 1, -1).astype(np.float32)  # away from the kinks
    check_grads(lambda p: loss(p, TARGET), (jnp.asarray(far),), 1, eps=1e-2, rtol=1e-2)


@pytest.mark.parametrize("mode", ["linear", "inverse", "none"])
def test_landmark_weights_are_the_plain_loop(mode):
    vertices, landmarks = RNG.standard_normal((30, 3)).astype(np.float32), np.array([3, 17, 8])
    distance = np.array([min(np.linalg.norm(v - vertices[j]) for j in landmarks) for v in vertices])
    expected = {
        "linear": 1 - distance / distance.max(),
        "inverse": 1 / np.maximum(distance, 0.3) / (1 / 0.3),
        "none": np.ones(30),
    }[mode]
    got = np.asarray(losses.landmark_weights(vertices, landmarks, mode=mode, edge_length=0.3))
    np.testing.assert_allclose(got, expected, atol=1e-6)
    np.testing.assert_array_equal(got[landmarks], 1.0)
    assert got.min() >= 0 and got.max() == 1.0
    moved = losses.landmark_weights(5 * vertices + 1, landmarks, mode=mode, edge_length=1.5)
    np.testing.assert_allclose(moved, got, atol=1e-5)


def test_wrong_shapes_and_options_are_named():
    with pytest.raises(ValueError, match=r"expected equal shapes, got \(7, 3\) and \(6, 3\)"):
        losses.displacement_l1(jnp.zeros((7, 3)), jnp.zeros((6, 3)))
    with pytest.raises(ValueError, match=r"weights: expected shape \(7,\), one per vertex, got \(6,\)"):
        losses.weighted_l1(jnp.zeros((7, 3)), jnp.zeros((7, 3)), jnp.zeros(6))
    with pytest.raises(ValueError, match="reduction: expected 'paper' or 'reference', got 'sum'"):
        losses.s2d(PREDICTED, TARGET, WEIGHTS, reduction="sum")
    with pytest.raises(ValueError, match=r"mode: expected .*, got 'square'"):
        losses.landmark_weights(jnp.zeros((7, 3)), jnp.arange(2), mode="square")
    with pytest.raises(ValueError, match="edge_length: mode 'inverse' needs"):
        losses.landmark_weights(jnp.zeros((7, 3)), jnp.arange(2), mode="inverse")
    with pytest.raises(ValueError, match=r"vertices: expected shape \(N, 3\), got \(7, 2\)"):
        losses.landmark_weights(jnp.zeros((7, 2)), jnp.arange(2))


REAL, FAKE = (
    {"v": RNG.standard_normal((6, 4, 3)).astype(np.float32), "s": RNG.standard_normal(6).astype(np.float32)}
    for _ in range(2)
)
CONDITION = np.arange(6) % 3
DIRECTION = RNG.standard_normal((3, 4, 3)).astype(np.float32)


def linear(sample, condition):
    return jnp.sum(jnp.asarray(DIRECTION)[condition] * sample["v"]) + 0.5 * sample["s"]


def test_penalty_of_a_linear_score_is_exact_and_counts_every_leaf_and_condition():
    slopes = [np.sqrt(np.sum(DIRECTION[c] ** 2) + 0.25) for c in CONDITION]
    got = losses.gradient_penalty(linear, jax.random.key(0), REAL, FAKE, CONDITION)
    np.testing.assert_allclose(got, np.mean([(s - 1) ** 2 for s in slopes]), rtol=1e-5)


def test_penalty_is_taken_on_the_chords():
    """For |x|^2 / 2 the slope is the point itself, so the penalty shows where it was taken."""
    real, fake = np.array([[1.0, 0.0]], np.float32), np.array([[0.0, 2.0]], np.float32)
    taken = []
    for seed in range(200):
        penalty = losses.gradient_penalty(lambda x, _: jnp.sum(x**2) / 2, jax.random.key(seed), real, fake, np.zeros(1))
        tau = float(jax.random.uniform(jax.random.key(seed), (1,))[0])
        point = (1 - tau) * real + tau * fake
        np.testing.assert_allclose(penalty, (np.linalg.norm(point) - 1) ** 2, atol=1e-5)
        taken.append(tau)
    assert min(taken) < 0.05 and max(taken) > 0.95


def test_critic_loss_is_its_terms_and_the_generator_answers_it():
    key = jax.random.key(0)
    pick = lambda samples, i: jax.tree.map(lambda x: x[i], samples)  # noqa: E731
    scores = [[float(linear(pick(s, i), CONDITION[i])) for i in range(6)] for s in (REAL, FAKE)]
    loss, terms = losses.critic(linear, key, REAL, FAKE, CONDITION, penalty=3.0)
    slope = losses.gradient_penalty(linear, key, REAL, FAKE, CONDITION)
    np.testing.assert_allclose(terms["wasserstein"], np.mean(scores[0]) - np.mean(scores[1]), rtol=1e-4)
    np.testing.assert_allclose(terms["slope"], slope, rtol=1e-6)
    np.testing.assert_allclose(loss, 3.0 * slope - terms["wasserstein"], rtol=1e-5)
    np.testing.assert_allclose(losses.generator(linear, FAKE, CONDITION), -np.mean(scores[1]), rtol=1e-4)


def test_a_critic_without_slope_has_a_finite_gradient():
    def loss(scale):
        return losses.critic(lambda x, _: scale * jnp.sum(x["v"]) * 0, jax.random.key(0), REAL, FAKE, CONDITION)[0]

    assert float(loss(1.0)) == 10.0 and np.isfinite(jax.grad(loss)(1.0))


def test_penalty_gradient_equals_finite_differences():
    def loss(w):
        score = lambda x, c: jnp.sum(jnp.tanh(w[c] * x["v"])) + w[0, 0, 0] * x["s"]  # noqa: E731
        return losses.critic(score, jax.random.key(1), REAL, FAKE, CONDITION)[0]

    check_grads(lambda w: loss(jnp.asarray(w)), (jnp.asarray(DIRECTION),), 1, modes=["rev"], eps=1e-2, rtol=2e-2)


# Flow matching: five numbers on the sphere, two beside them, three samples.

LABEL, UNIT, KEY = np.array([0, 2, 1]), RNG.uniform(0.2, 2, (3, 5)).astype(np.float32), jax.random.key(4)
FIELD = {"v": RNG.standard_normal((3, 5, 5)).astype(np.float32), "s": RNG.standard_normal((3, 2)).astype(np.float32)}


def states(seed):
    y, s = np.random.default_rng(seed).normal(size=(3, 7)).astype(np.float32)[:, :5], RNG.standard_normal((3, 2))
    return (y / np.linalg.norm(y, axis=1, keepdims=True))[:, None, None], s.astype(np.float32)


SOURCE, END = states(5), states(6)


def bilinear(weights):
    def field(state, time, label):
        y, s = state
        v = jnp.asarray(weights["v"])[label] @ y[0, 0] + time
        return sphere.project(y, v[None, None]), time * s + jnp.asarray(weights["s"])[label]

    return field


def loop_flow_matching(weights):
    rows, times = [], np.asarray(jax.random.uniform(KEY, (3,)), np.float64)
    for i, t in enumerate(times):
        (a, s0), (b, s1) = ((np.float64(y[i, 0, 0]), np.float64(s[i])) for y, s in (SOURCE, END))
        angle = np.arccos(a @ b)
        y = (np.sin((1 - t) * angle) * a + np.sin(t * angle) * b) / np.sin(angle)
        way = angle * (np.cos(t * angle) * b - np.cos((1 - t) * angle) * a) / np.sin(angle)
        v = weights["v"][LABEL[i]] @ y + t
        off = (v - (v @ y) * y - way) / UNIT[i]
        rate = t * ((1 - t) * s0 + t * s1) + weights["s"][LABEL[i]]
        rows.append(np.concatenate([off, rate - (s1 - s0)]) ** 2)
    return np.mean(rows)


def test_flow_matching_is_the_plain_loop_with_gradients():
    def loss(weights):
        return losses.flow_matching(bilinear(weights), KEY, SOURCE, END, LABEL, UNIT)

    np.testing.assert_allclose(jax.jit(loss)(FIELD), loop_flow_matching(FIELD), rtol=1e-4)
    check_grads(jax.jit(loss), (jax.tree.map(jnp.asarray, FIELD),), 1, modes=["rev"], eps=1e-2, rtol=1e-2)


def test_flow_matching_is_zero_for_what_is_left_of_the_way_and_counts_in_units():
    ends = END[0], END[1]

    def exact(state, time, i):
        (y, s), (y1, s1) = state, jax.tree.map(lambda x: jnp.asarray(x)[i], ends)
        return sphere.log(y, y1) / (1 - time), (s1 - s) / (1 - time)

    def off(state, time, i):
        v, rate = exact(state, time, i)
        return v + 0.1 * sphere.project(state[0], jnp.ones_like(v)), rate

    @jax.jit
    def cost(unit):
        return [losses.flow_matching(field, KEY, SOURCE, END, np.arange(3), unit) for field in (exact, off)]

    none, one = cost(UNIT)
    assert float(none) < 1e-9 < 1e-5 < float(one)
    np.testing.assert_allclose(cost(2 * UNIT)[1], one / 4, rtol=1e-3)


# Steps of expression networks.


def steps_of(seed, *lead, frames=6, landmarks=4):
    return jnp.asarray(np.random.default_rng(seed).normal(size=(*lead, frames, landmarks, 3)), jnp.float32)


MASK = np.arange(6) < np.array([[6], [4], [2]])


def naive_next_step(predicted, target, mask):
    rows = [np.mean((predicted[k, t] - target[k, t]) ** 2) for k in range(len(mask)) for t in range(6) if mask[k, t]]
    return np.mean(rows)


def naive_path(predicted, target, mask):
    rows = []
    for k in range(len(mask)):
        off = np.zeros((4, 3))
        for t in range(6):
            if mask[k, t]:
                off = off + predicted[k, t] - target[k, t]
                rows.append(np.mean([np.linalg.norm(v) for v in off]))
    return np.mean(rows)


@pytest.mark.parametrize(("loss", "naive"), [(losses.next_step, naive_next_step), (losses.path_distance, naive_path)])
def test_losses_of_steps_are_the_loops(loss, naive):
    a, b = np.asarray(steps_of(1, 3), np.float64), np.asarray(steps_of(2, 3), np.float64)
    np.testing.assert_allclose(loss(steps_of(1, 3), steps_of(2, 3), jnp.asarray(MASK)), naive(a, b, MASK), rtol=1e-5)


@pytest.mark.parametrize("loss", [losses.next_step, losses.path_distance])
def test_what_is_masked_changes_nothing_and_the_truth_costs_nothing(loss):
    a, b, mask = steps_of(1, 3), steps_of(2, 3), jnp.asarray(MASK)
    changed = jnp.where(mask[..., None, None], a, 100.0)
    assert float(loss(changed, b, mask)) == pytest.approx(float(loss(a, b, mask)), rel=1e-6)
    assert float(loss(a, a, mask)) == 0
    assert float(loss(a, b, jnp.zeros_like(mask))) == 0
    slope = jax.grad(loss)(a, a, mask)
    assert np.isfinite(slope).all() and not np.asarray(slope).any()
    with pytest.raises(ValueError, match="mask: expected shape"):
        loss(a, b, mask[:, :5])


def test_the_best_path_is_the_median_where_the_mean_is_nobodys():
    """Two thirds go one way, one third the other: distance wants the way of the many, its square would not."""
    targets = jnp.asarray(np.array([1.0, 1.0, -1.0])[:, None, None, None] * np.ones((3, 6, 1, 3)), jnp.float32)
    mask = jnp.ones((3, 6), bool)
    costs = [float(losses.path_distance(jnp.full_like(targets, x), targets, mask)) for x in (1.0, 1 / 3, 0.0, -1.0)]
    assert costs == sorted(costs)


def test_strength_and_energy():
    a, mask = steps_of(1, 3), jnp.asarray(MASK)
    first = [np.mean(np.square(a[k, t])) for k in range(3) for t in range(6) if MASK[k, t]]
    second = [
        np.mean(np.square(a[k, t + 1] - a[k, t])) for k in range(3) for t in range(5) if MASK[k, t] and MASK[k, t + 1]
    ]
    wanted = losses.step_energy(a, mask)
    np.testing.assert_allclose(wanted, [np.mean(first), np.mean(second)], rtol=1e-5)
    assert float(losses.energy_ratio(a, mask, wanted)) == pytest.approx(0, abs=1e-10)
    assert float(losses.energy_ratio(-a, mask, wanted)) == pytest.approx(0, abs=1e-10)  # whatever its direction
    assert float(losses.energy_ratio(0.5 * a, mask, wanted)) == pytest.approx(0.5, rel=1e-5)  # (1/2 - 1)^2, twice
    assert float(losses.energy_ratio(a, jnp.zeros_like(mask), wanted)) == 0
    slope = jax.grad(losses.energy_ratio)(jnp.zeros_like(a), mask, wanted)
    assert np.isfinite(slope).all()
    check_grads(lambda x: losses.energy_ratio(x, mask, wanted), (0.7 * a,), order=1, atol=1e-2, rtol=1e-2)
