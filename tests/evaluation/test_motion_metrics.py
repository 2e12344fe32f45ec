"""Metrics of motions against naive loops and closed forms."""

import jax
import numpy as np
import pytest

from facejax.evaluation import motion_metrics
from facejax.inference import pipeline


def curves(seed, count=6, frames=7, landmarks=3):
    return np.random.default_rng(seed).normal(size=(count, frames, landmarks, 3)).astype(np.float32)


def test_measures_of_paths_against_loops():
    a = curves(0)
    steps = [[np.linalg.norm(c[t + 1] - c[t]) for t in range(len(c) - 1)] for c in a]
    for k, c in enumerate(a):
        assert motion_metrics.detour(a)[k] == pytest.approx(sum(steps[k]) / np.linalg.norm(c[-1] - c[0]), rel=1e-5)
        half = min(range(len(c) - 1), key=lambda t: abs(sum(steps[k][: t + 1]) / sum(steps[k]) - 0.5))
        displacement = np.mean([np.linalg.norm(point) for point in c[half + 1]])
        assert motion_metrics.displacement_at_half_path(a)[k] == pytest.approx(displacement, rel=1e-5)
        assert motion_metrics.end_norm(a)[k] == pytest.approx(np.sqrt((c[-1].astype(float) ** 2).sum()), rel=1e-5)
    np.testing.assert_allclose(motion_metrics.speed_profile(a).mean(axis=1), 1, rtol=1e-5)


def test_a_straight_even_motion():
    line = np.linspace(0, 1, 5, dtype=np.float32)[None, :, None, None] * np.ones((1, 1, 4, 3), np.float32)
    np.testing.assert_allclose(motion_metrics.detour(line), 1, rtol=1e-6)
    np.testing.assert_allclose(motion_metrics.speed_profile(line), 1, rtol=1e-5)
    np.testing.assert_allclose(motion_metrics.acceleration(line), 0, atol=1e-6)
    np.testing.assert_allclose(motion_metrics.mean_distance(line, 0 * line), np.sqrt(3) / 2, rtol=1e-6)
    assert motion_metrics.ratio_of_means(motion_metrics.length, 3 * line, line) == pytest.approx(3, rel=1e-5)


def test_real_motions_scored_as_generated_ones_have_ratios_of_one():
    one = curves(1, count=12)
    real = [np.concatenate([one, one])]
    (row,) = motion_metrics.pair_scores(motion_metrics.second_halves(real), real, [one[0]], [one])
    assert row["diversity_ratio"] == pytest.approx(1, rel=1e-6) and row["acceleration_ratio"] == pytest.approx(1)
    assert row["coverage"] == 1 and row["davies_mm"] == pytest.approx(0, abs=1e-3)
    (farther,) = motion_metrics.pair_scores([one + 5], real, [one[0]], [one])
    assert farther["coverage"] == 0 and farther["energy"] > 1 > row["energy"]
    assert farther["specificity_mm"] > row["specificity_mm"]
    means = motion_metrics.mean_scores([row, farther | {"diversity_ratio": 3.0}])
    assert means["diversity_ratio_range"] == [pytest.approx(1, rel=1e-6), 3.0]
    assert means["energy"] == pytest.approx((row["energy"] + farther["energy"]) / 2)


def test_generated_points_lie_on_the_sphere():
    models = pipeline.load()
    key = jax.random.key(0)
    error = motion_metrics.sphere_norm_error(models.motion, models.starts, key, [(0, 1), (2, 3)], samples=4)
    assert 0 <= error < 1e-5


def test_windowed_errors_find_the_nearest_frame():
    true = np.arange(8.0)[:, None, None] + np.zeros((8, 2, 3))
    frames, mask = np.array([0, 5, 7]), np.ones(2, bool)
    late = true - 2  # two frames behind
    aligned, best = motion_metrics.windowed_vertex_error(late, true[frames], frames, mask, window=4)
    np.testing.assert_allclose(aligned, 2 * np.sqrt(3))
    # The last frame has no frames after it.
    np.testing.assert_allclose(best, [0, 0, 2 * np.sqrt(3)], atol=1e-9)
    both = motion_metrics.windowed_vertex_error(late, true[frames], frames, mask, window=0)
    np.testing.assert_array_equal(both[1], aligned)
