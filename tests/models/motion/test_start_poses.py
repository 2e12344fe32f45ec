"""Peaks to start from: the smoothed bootstrap keeps mean, covariance and modes."""

import jax
import numpy as np
import pytest

from facejax.models.motion import start_poses


@pytest.fixture(scope="module")
def peaks():
    """Poses of three expressions with known, different spreads; the third is of two kinds, left and right."""
    rng = np.random.default_rng(0)
    labels = np.repeat([1, 2, 3], [400, 300, 400])
    drawn = rng.normal(size=(len(labels), 5)) * np.array([[0, 0, 0, 0, 0], [1, 0.5, 0.2, 1, 0], [2, 1, 1, 0, 0.3],
        [0.2, 1, 1, 1, 1]])[labels]  # fmt: skip
    drawn[labels == 2] += 0.5
    drawn[labels == 3, 0] += np.where(rng.random(400) < 0.5, -2, 2)
    return drawn, labels


@pytest.fixture(scope="module")
def params(peaks):
    return start_poses.fit(*peaks, classes=4)


def draw(params, label, count=4000):
    keys = jax.random.split(jax.random.key(label), count)
    return np.asarray(jax.vmap(start_poses.sample, (None, 0, None))(params, keys, label))


@pytest.mark.parametrize("label", [1, 2, 3])
def test_mean_and_covariance_are_those_of_the_peaks(peaks, params, label):
    drawn, labels = peaks
    own, found = drawn[labels == label], draw(params, label)
    np.testing.assert_allclose(found.mean(0), own.mean(0), atol=0.12)
    np.testing.assert_allclose(np.cov(found.T), np.cov(own.T), atol=0.06 * np.cov(own.T).max())


def test_two_kinds_stay_two_and_no_peak_is_copied(peaks, params):
    drawn, labels = peaks
    found = draw(params, 3)
    between = np.mean(np.abs(found[:, 0]) < 0.4)
    # A Gaussian of the same mean and deviation, 2, has 16 % there.
    assert between < 0.05 and 0.4 < np.mean(found[:, 0] > 0) < 0.6
    nearest = np.min(np.linalg.norm(found[:200, None] - drawn[None, labels == 3], axis=-1), axis=1)
    assert nearest.min() > 0.01


def test_neutral_has_one_pose(params):
    np.testing.assert_array_equal(draw(params, 0, 3), 0)


def test_an_expression_without_peaks_is_refused(peaks):
    with pytest.raises(ValueError, match=r"two peaks or more, got \[400, 300, 400, 0\]"):
        start_poses.fit(*peaks, classes=5)
