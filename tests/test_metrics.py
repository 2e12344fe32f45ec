"""Metrics against naive loops, their laws, and agreement of parts with the whole."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from facejax import metrics


@pytest.fixture
def x64():
    with jax.enable_x64(True):
        yield


def random(seed, *shape):
    return np.random.default_rng(seed).normal(size=shape)


def loop_motion_distance(a, b):
    distances = [np.sqrt(np.sum((p - q) ** 2)) for x, y in zip(a, b, strict=True) for p, q in zip(x, y, strict=True)]
    return sum(distances) / len(distances)


def test_vertex_error_against_a_loop(x64):
    predicted, target = random(0, 2, 4, 5, 3), random(1, 2, 4, 5, 3)
    distances = [np.sqrt(np.sum((predicted[i] - target[i]) ** 2)) for i in np.ndindex(2, 4, 5)]
    np.testing.assert_allclose(np.ravel(metrics.vertex_distance(predicted, target)), distances, rtol=1e-14)
    error = metrics.vertex_error(predicted, target)
    np.testing.assert_allclose(error, [np.mean(distances), np.std(distances), 40], rtol=1e-13)


def test_vertex_error_counts_only_the_mask(x64):
    predicted, target = random(0, 4, 5, 3), random(1, 4, 5, 3)
    mask = np.asarray([True, False, True, True, False])
    whole = metrics.vertex_error(predicted[:, mask], target[:, mask])
    np.testing.assert_allclose(metrics.vertex_error(predicted, target, mask), whole, rtol=1e-13)
    np.testing.assert_allclose(metrics.vertex_error(predicted, target, 1.0 * mask), whole, rtol=1e-13)
    predicted[:, ~mask] = 1e9
    np.testing.assert_allclose(metrics.vertex_error(predicted, target, mask), whole, rtol=1e-6)
    assert np.isnan(metrics.vertex_error(predicted, target, 0 * mask).mean)


def test_vertex_error_of_a_shift_is_its_length():
    target = jnp.asarray(random(2, 3, 6, 3), jnp.float32)
    error = metrics.vertex_error(target + jnp.asarray([3.0, 0.0, 4.0]), target)
    np.testing.assert_allclose(error.mean, 5, rtol=1e-6)
    np.testing.assert_allclose(error.std, 0, atol=1e-6)


def test_float32_error_over_many_frames_keeps_its_digits():
    target = np.zeros((3000, 200, 3), np.float32)
    predicted = np.abs(random(3, *target.shape)).astype(np.float32) + 1
    exact = np.linalg.norm(predicted.astype(np.float64), axis=-1)
    error = metrics.vertex_error(predicted, target)
    np.testing.assert_allclose([error.mean, error.std], [exact.mean(), exact.std()], rtol=2e-6)


def test_pool_of_parts_is_the_whole(x64):
    predicted, target = random(4, 10, 5, 3), random(5, 10, 5, 3)
    parts = [metrics.vertex_error(predicted[i:j], 2 * target[i:j]) for i, j in ((0, 2), (2, 3), (3, 10))]
    np.testing.assert_allclose(metrics.pool(parts), metrics.vertex_error(predicted, 2 * target), rtol=1e-12)
    with pytest.raises(ValueError, match="at least one"):
        metrics.pool([])


def test_speed_and_acceleration_against_a_loop(x64):
    motion = random(6, 6, 4, 3)
    first = [np.linalg.norm(motion[t + 1, k] - motion[t, k]) for t in range(5) for k in range(4)]
    second = [
        np.linalg.norm(motion[t + 2, k] - 2 * motion[t + 1, k] + motion[t, k]) for t in range(4) for k in range(4)
    ]
    np.testing.assert_allclose(metrics.speed(motion), np.mean(first), rtol=1e-14)
    np.testing.assert_allclose(metrics.acceleration(motion), np.mean(second), rtol=1e-14)


def test_laws_of_speed_and_acceleration(x64):
    line = np.arange(7.0)[:, None, None] * random(7, 1, 4, 3)
    np.testing.assert_allclose(metrics.acceleration(line), 0, atol=1e-13)
    np.testing.assert_allclose(metrics.speed(line), np.mean(np.linalg.norm(line[1], axis=-1)), rtol=1e-13)
    motion = random(8, 7, 4, 3)
    np.testing.assert_allclose(metrics.acceleration(3 * motion + line), 3 * metrics.acceleration(motion + line / 3))
    noise = 0.1 * random(9, 2000, 4, 3)
    np.testing.assert_allclose(metrics.acceleration(noise), 0.39, rtol=0.02)


def test_peak_displacement_against_a_loop(x64):
    motion, neutral = random(10, 6, 4, 3), random(11, 4, 3)
    expected = max(np.mean(np.linalg.norm(frame - neutral, axis=-1)) for frame in motion)
    np.testing.assert_allclose(metrics.peak_displacement(motion, neutral), expected, rtol=1e-14)
    np.testing.assert_allclose(metrics.peak_displacement(2 * motion, 2 * neutral), 2 * expected, rtol=1e-14)


def test_diversity_and_specificity_against_loops(x64):
    samples, reference = random(12, 5, 6, 4, 3), random(13, 6, 4, 3)
    pairs = [loop_motion_distance(samples[i], samples[j]) for i in range(5) for j in range(i)]
    np.testing.assert_allclose(metrics.diversity(samples), np.mean(pairs), rtol=1e-14)
    np.testing.assert_allclose(
        metrics.specificity(samples, reference),
        np.mean([loop_motion_distance(sample, reference) for sample in samples]),
        rtol=1e-14,
    )


def test_diversity_of_collapsed_samples_is_zero_with_a_finite_gradient():
    samples = jnp.ones((4, 6, 4, 3))
    value, gradient = jax.value_and_grad(metrics.diversity)(samples)
    assert value == 0 and np.isfinite(gradient).all()


@pytest.mark.parametrize("chunk", [1, 3, 7, 64])
def test_nearest_distance_against_a_loop(x64, chunk):
    samples, training = random(14, 3, 6, 4, 3), random(15, 7, 6, 4, 3)
    expected = [min(loop_motion_distance(sample, other) for other in training) for sample in samples]
    np.testing.assert_allclose(metrics.nearest_distance(samples, training, chunk=chunk), expected, rtol=1e-14)
    np.testing.assert_array_equal(metrics.nearest_distance(training[2:4], training, chunk=chunk), 0)


@pytest.mark.parametrize(
    ("function", "shapes"),
    [
        (metrics.vertex_distance, ((5, 3), (5, 3))),
        (metrics.speed, ((6, 4, 3),)),
        (metrics.acceleration, ((6, 4, 3),)),
        (metrics.peak_displacement, ((6, 4, 3), (4, 3))),
        (metrics.specificity, ((5, 6, 4, 3), (6, 4, 3))),
        (metrics.diversity, ((5, 6, 4, 3),)),
    ],
    ids=lambda x: getattr(x, "__name__", ""),
)
def test_eager_jit_vmap_and_gradients_agree(x64, function, shapes):
    args = [random(20 + k, 3, *shape) for k, shape in enumerate(shapes)]
    batched = function(*args)
    np.testing.assert_allclose(jax.vmap(function)(*args), batched, rtol=1e-13)
    with jax.disable_jit():
        np.testing.assert_allclose(function(*args), batched, rtol=1e-13)
    check_grads(
        lambda *one: jnp.sum(function(*one)),
        args,
        order=1,
        modes=("fwd", "rev"),
        eps=1e-6,
        atol=1e-6,
        rtol=1e-6,
    )


@pytest.mark.parametrize(
    ("call", "match"),
    [
        (
            lambda: metrics.vertex_error(jnp.ones((5, 3)), jnp.ones((4, 3))),
            r"one shape, got \(5, 3\) and \(4, 3\)",
        ),
        (
            lambda: metrics.vertex_error(jnp.ones((5, 3)), jnp.ones((5, 3)), jnp.ones(4)),
            r"mask: expected \(5,\)",
        ),
        (lambda: metrics.acceleration(jnp.ones((2, 4, 3))), r"T >= 3, got shape \(2, 4, 3\)"),
        (lambda: metrics.speed(jnp.ones((4, 3))), r"\(\.\.\., T, L, 3\)"),
        (lambda: metrics.diversity(jnp.ones((1, 6, 4, 3))), "at least 2, got 1"),
        (lambda: metrics.diversity(jnp.ones((6, 4, 3))), r"\(\.\.\., K, T, L, 3\)"),
        (lambda: metrics.specificity(jnp.ones((2, 6, 4, 3)), jnp.ones((5, 4, 3))), "reference: expected"),
        (lambda: metrics.peak_displacement(jnp.ones((6, 4, 3)), jnp.ones((5, 3))), "neutral: expected"),
        (lambda: metrics.nearest_distance(jnp.ones((2, 6, 4, 3)), jnp.ones((2, 5, 4, 3))), r"\(M, T, L, 3\)"),
        (lambda: metrics.nearest_distance(*2 * [jnp.ones((2, 6, 4, 3))], chunk=0), "at least 1, got 0 and 2"),
        (lambda: metrics.distances(jnp.ones((2, 6, 4, 3)), jnp.ones((2, 5, 4, 3))), r"got \(2, 6, 4, 3\) and"),
        (lambda: metrics.distances(jnp.ones((6, 4, 3)), jnp.ones((6, 4, 3))), r"\(\.\.\., K, T, L, 3\)"),
        (lambda: metrics.mean_off_diagonal(jnp.ones((3, 2))), r"\(K, K\) with K >= 2, got \(3, 2\)"),
        (lambda: metrics.mean_off_diagonal(jnp.ones((1, 1))), "K >= 2"),
        (lambda: metrics.coverage(jnp.ones((2, 5)), jnp.ones((5, 5))), "with M > 5, got"),
        (lambda: metrics.coverage(jnp.ones((2, 4)), jnp.ones((5, 5)), neighbours=2), r"got \(2, 4\) and \(5, 5\)"),
    ],
)
def test_wrong_input_is_named(call, match):
    with pytest.raises(ValueError, match=match):
        call()


def test_sets_of_motions_against_plain_loops():
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(5, 4, 3, 3)), rng.normal(size=(7, 4, 3, 3))
    table = np.array([[np.linalg.norm(x - y, axis=-1).mean() for y in b] for x in a])
    across, own, real = (metrics.distances(x, y) for x, y in ((a, b), (a, a), (b, b)))
    np.testing.assert_allclose(across, table, rtol=1e-5)
    pairs = [np.linalg.norm(x - y, axis=-1).mean() for i, x in enumerate(a) for j, y in enumerate(a) if i != j]
    assert float(metrics.mean_off_diagonal(own)) == pytest.approx(np.mean(pairs), rel=1e-5)
    others = np.array([[np.linalg.norm(x - y, axis=-1).mean() for y in b] for x in b])
    near = [table[:, j].min() < np.sort(others[j])[2] for j in range(7)]
    assert float(metrics.coverage(across, real, neighbours=2)) == pytest.approx(np.mean(near))
    spread = (others.sum() - np.trace(others)) / 42
    wanted = (2 * table.mean() - np.mean(pairs) - spread) / spread
    assert float(metrics.energy_distance(across, own, real)) == pytest.approx(wanted, rel=1e-4, abs=1e-5)


def test_laws_of_distances_and_coverage(x64):
    a, b = random(30, 6, 4, 3, 3), random(31, 9, 4, 3, 3)
    table = metrics.distances(a, b)
    np.testing.assert_allclose(metrics.distances(b, a), table.T, rtol=1e-13)
    np.testing.assert_allclose(metrics.distances(3 * a + 1, 3 * b + 1), 3 * table, rtol=1e-13)
    np.testing.assert_allclose(metrics.mean_off_diagonal(metrics.distances(a, a)), metrics.diversity(a), rtol=1e-13)
    np.testing.assert_allclose(table.min(axis=1), metrics.nearest_distance(a, b), rtol=1e-13)
    # Real motions cover themselves; motions far away cover none; what is drawn in one place covers its surroundings.
    real = metrics.distances(b, b)
    assert float(metrics.coverage(real, real, neighbours=1)) == 1
    assert float(metrics.coverage(metrics.distances(a + 100, b), real, neighbours=1)) == 0
    collapsed = float(metrics.coverage(metrics.distances(b[:1], b), real, neighbours=3))
    assert 1 / 9 <= collapsed < 1


def test_energy_distance_is_zero_for_one_distribution_and_grows_with_a_shift():
    rng = np.random.default_rng(1)

    def energy(shift):
        a, b = rng.normal(size=(40, 3, 2, 3)), rng.normal(size=(40, 3, 2, 3)) + shift
        return float(metrics.energy_distance(metrics.distances(a, b), metrics.distances(a, a), metrics.distances(b, b)))

    assert abs(np.mean([energy(0) for _ in range(8)])) < 0.01
    assert 0.03 < energy(0.5) < energy(1.0)
