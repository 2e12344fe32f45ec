"""What landmarks leave open, where it is known."""

import numpy as np
import pytest

from facejax.evaluation import noise_floor


def sample(frames, *, unseen, groups=4, seed=0):
    """Landmarks (F, 1, 3), meshes (F, 5, 3) that are curved in them but for noise of `unseen` mm, and groups."""
    rng = np.random.default_rng(seed)
    landmarks = rng.uniform(-1, 1, (frames, 1, 3))
    seen = np.stack([np.sin(2 * landmarks[:, 0]) * (i + 1) for i in range(5)], axis=1)
    return landmarks, seen + unseen * rng.normal(size=seen.shape), rng.integers(groups, size=frames)


@pytest.mark.parametrize("unseen", [0.05, 0.3])
def test_it_is_the_noise_that_nobody_can_predict(unseen):
    landmarks, meshes, group = sample(4_000, unseen=unseen)
    found = noise_floor.estimate(meshes, *noise_floor.nearest_pairs(landmarks, group))
    expected = unseen * np.linalg.norm(np.random.default_rng(1).normal(size=(100_000, 3)), axis=1).mean()
    np.testing.assert_allclose(found, expected, rtol=0.25)


def test_without_noise_it_is_near_nothing():
    landmarks, meshes, group = sample(4_000, unseen=0.0)
    assert (
        noise_floor.estimate(meshes, *noise_floor.nearest_pairs(landmarks, group)).max() < 0.12 * np.abs(meshes).mean()
    )


def test_pairs_are_the_nearest_of_other_groups():
    landmarks, _, group = sample(60, unseen=0.0)
    both, squared = noise_floor.nearest_pairs(landmarks, group, count=3)
    flat = landmarks.reshape(60, -1)
    for i in range(60):
        others = np.flatnonzero(group != group[i])
        nearest = others[np.argsort(np.linalg.norm(flat[others] - flat[i], axis=1))[:3]]
        assert set(both[both[:, 0] == i][:, 1]) == set(nearest)
    np.testing.assert_allclose(squared, np.sum((flat[both[:, 0]] - flat[both[:, 1]]) ** 2, axis=1))


def test_pairs_within_a_group_are_of_other_recordings():
    landmarks, _, group = sample(80, unseen=0.0)
    recording = np.arange(80) // 10
    both, _ = noise_floor.nearest_pairs(landmarks, group, recording=recording, within_groups=True)
    assert (group[both[:, 0]] == group[both[:, 1]]).all() and (recording[both[:, 0]] != recording[both[:, 1]]).all()
    with pytest.raises(ValueError, match="needs `recording`"):
        noise_floor.nearest_pairs(landmarks, group, within_groups=True)
    with pytest.raises(ValueError, match="no pairs: expected two groups"):
        noise_floor.nearest_pairs(landmarks, np.zeros(80))
