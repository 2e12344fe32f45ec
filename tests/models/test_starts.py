"""The start of a motion, given its travel, against brute force."""

import jax
import numpy as np
import pytest

from facejax.models import starts


@pytest.fixture(scope="module")
def peaks():
    """Three expressions of five landmarks with known, different spreads."""
    rng = np.random.default_rng(0)
    labels = np.repeat([1, 2, 3], 4000)
    mean = rng.normal(size=(4, 5, 3))
    turn = rng.normal(size=(4, 6, 5, 3)) * np.array([0, 0.2, 0.5, 0.1])[:, None, None, None]
    drawn = mean[labels] + np.einsum("nd,ndlc->nlc", rng.normal(size=(len(labels), 6)), turn[labels])
    return drawn, labels


@pytest.fixture(scope="module")
def params(peaks):
    return starts.fit(*peaks, classes=4, directions=15)


def test_neutral_starts_at_zero_and_a_way_home_starts_where_it_must(params):
    travel = np.random.default_rng(1).normal(size=(5, 3)).astype(np.float32)
    np.testing.assert_array_equal(starts.sample(params, jax.random.key(0), travel, 0, 2), 0)
    np.testing.assert_array_equal(starts.sample(params, jax.random.key(0), travel, 2, 0), -travel)


def test_starts_have_the_mean_and_covariance_of_the_peaks(peaks, params):
    drawn, labels = peaks
    first, second = drawn[labels == 1], drawn[labels == 2]
    travel = (second - first).astype(np.float32)
    keys = jax.random.split(jax.random.key(2), len(travel))
    found = np.asarray(jax.vmap(starts.sample, (None, 0, 0, None, None))(params, keys, travel, 1, 2))
    np.testing.assert_allclose(found.mean(0), first.mean(0), atol=0.02)
    true, mine = (np.cov(x.reshape(len(x), -1).T) for x in (first, found))
    np.testing.assert_allclose(mine, true, atol=0.06 * np.abs(true).max())
    # And with the travel: the end that they imply is one of the second expression's.
    ends = found + travel
    true, mine = (np.cov(x.reshape(len(x), -1).T) for x in (second, ends))
    np.testing.assert_allclose(mine, true, atol=0.06 * np.abs(true).max())


def test_the_guess_beats_the_mean(peaks, params):
    drawn, labels = peaks
    first, second = drawn[labels == 2][:500], drawn[labels == 1][:500]
    travel = (second - first).astype(np.float32)
    keys = jax.random.split(jax.random.key(3), 500)
    found = np.asarray(jax.vmap(starts.sample, (None, 0, 0, None, None))(params, keys, travel, 2, 1))
    assert np.mean((found - first) ** 2) < 0.6 * np.mean((drawn[labels == 2].mean(0) - first) ** 2)


def test_an_expression_without_peaks_is_refused(peaks):
    with pytest.raises(ValueError, match="two peaks or more"):
        starts.fit(*peaks, classes=5)


@pytest.mark.parametrize(("start", "end"), [(0, 1), (2, 0), (1, 3)])
def test_gradients_are_finite_and_those_of_finite_differences(params, start, end):
    travel = np.random.default_rng(4).normal(size=(5, 3)).astype(np.float32)

    def total(travel):
        return jax.numpy.sum(starts.sample(params, jax.random.key(5), travel, start, end) ** 2)

    slope = np.asarray(jax.grad(total)(travel))
    assert np.isfinite(slope).all()
    step = np.zeros_like(travel)
    step[2, 1] = 1e-2
    difference = (total(travel + step) - total(travel - step)) / 2e-2
    assert slope[2, 1] == pytest.approx(float(difference), rel=2e-2, abs=1e-3)
