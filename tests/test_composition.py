"""Transitions in a row: one line of time without jolts, and faces that stay faces."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from facejax import composition, pipeline
from facejax.models import motion, motion_reference, starts
from tests.models.test_motion import CONFIG, SHAPE, fitted, toy

DRAWN = 6


@pytest.fixture(scope="module")
def chart():
    return fitted(toy(), labels=3, rank=CONFIG.rank)


@pytest.fixture(scope="module")
def gan(chart):
    return motion.generator.init(jax.random.key(0), chart, config=CONFIG)


@pytest.fixture(scope="module")
def beginnings():
    rng = np.random.default_rng(0)
    return starts.fit(rng.normal(size=(40, CONFIG.pose)), np.repeat([1, 2], 20), classes=3)


def random_curves(count, seed=0):
    curves = np.random.default_rng(seed).normal(size=(2, count, DRAWN, 4, 3)).cumsum(axis=2)
    for i in range(1, count):
        curves[:, i] += curves[:, i - 1, -1:] - curves[:, i, :1]
    return curves.astype(np.float32)


def test_one_transition_at_its_own_length_is_left_alone():
    np.testing.assert_array_equal(composition.timeline([DRAWN], drawn=DRAWN), np.eye(DRAWN))


@pytest.mark.parametrize("frames", [(6, 6, 6), (2, 9, 3), (3, 2, 2), (17, 4, 30)], ids=str)
def test_positions_meet_speeds_agree_and_ends_stay(frames):
    curves = random_curves(3)
    line = composition.timeline(frames, drawn=DRAWN)
    joined = np.asarray(composition.join(curves, jnp.asarray(line)))
    assert joined.shape == (2, 1 + sum(n - 1 for n in frames), 4, 3)
    np.testing.assert_allclose(line.sum(axis=1), 1, atol=1e-5)
    joints = np.cumsum([n - 1 for n in frames])[:-1]
    np.testing.assert_allclose(joined[:, 0], curves[:, 0, 0], atol=1e-5)
    np.testing.assert_allclose(joined[:, -1], curves[:, -1, -1], atol=1e-5)
    np.testing.assert_allclose(joined[:, joints], curves[:, :-1, -1], atol=1e-5)
    bend = joined[:, joints + 1] - 2 * joined[:, joints] + joined[:, joints - 1]
    roomy = [max(a, b) > 2 for a, b in zip(frames[:-1], frames[1:], strict=True)]
    np.testing.assert_allclose(bend[:, roomy], 0, atol=2e-5)


def test_corrections_fade_within_their_reach():
    curves = random_curves(2)
    plain = [
        np.asarray(composition.join(curves[:, i : i + 1], composition.timeline([41], drawn=DRAWN))) for i in (0, 1)
    ]
    joined = np.asarray(composition.join(curves, composition.timeline([41, 41], drawn=DRAWN)))
    changed = np.abs(joined - np.concatenate([plain[0], plain[1][:, 1:]], axis=1)).max(axis=(0, 2, 3))
    assert changed[[39, 41]].min() > 1e-3
    np.testing.assert_allclose(changed[: 40 - composition.REACH], 0, atol=1e-5)
    np.testing.assert_allclose(changed[41 + composition.REACH :], 0, atol=1e-5)


def test_frames_between_lie_on_cubics():
    """Straight lines are kept throughout, parabolas where both neighbours are known."""
    place, wanted = np.arange(DRAWN), np.linspace(0, DRAWN - 1, 26)
    line = composition.timeline([26], drawn=DRAWN)
    np.testing.assert_allclose(line @ (2.0 * place - 1), 2 * wanted - 1, atol=1e-5)
    inside = (wanted >= 1) & (wanted <= DRAWN - 2)
    np.testing.assert_allclose((line @ place**2.0)[inside], wanted[inside] ** 2, atol=1e-5)


def test_chains_start_at_neutral_meet_and_come_home(gan, beginnings):
    keys = composition.keys_of(jax.random.key(1), 3)
    drawn = composition.draw(gan, beginnings, keys, composition.pairs_of([0, 1, 2, 0, 2]))
    assert drawn.curves.shape == (3, 4, DRAWN, *SHAPE[1:]) and drawn.log_seconds.shape == (3, 4)
    np.testing.assert_array_equal(drawn.curves[:, 0, 0], 0)
    np.testing.assert_allclose(drawn.curves[:, 1:, 0], drawn.curves[:, :-1, -1], atol=1e-5)
    np.testing.assert_allclose(drawn.curves[:, 2, -1], 0, atol=1e-5)
    few = composition.draw(gan, beginnings, keys[:1], composition.pairs_of([0, 1, 2, 0, 2]))
    np.testing.assert_allclose(few.curves[0], drawn.curves[0], atol=1e-5)
    whole = composition.compose(gan, beginnings, jax.random.key(1), [0, 1, 2, 0, 2], samples=3)
    assert whole.shape == (3, 1 + 4 * (DRAWN - 1), *SHAPE[1:])
    np.testing.assert_allclose(whole[:, :: DRAWN - 1][:, 1:], drawn.curves[:, :, -1], atol=1e-5)


def test_the_authors_generator_goes_on_from_where_it_stands(chart, beginnings):
    config = motion_reference.Config(steps=5, landmarks=4, labels=3, noise=6, width_divisor=32)
    reference = motion_reference.generator.init(jax.random.key(0), chart, config=config)
    keys = composition.keys_of(jax.random.key(1), 2)
    curves = composition.draw(reference, beginnings, keys, composition.pairs_of([1, 2, 1])).curves
    np.testing.assert_allclose(curves[:, 0, 0], jnp.stack([chart.pose_mean[1]] * 2), atol=1e-6)
    np.testing.assert_allclose(curves[:, 1, 0], curves[:, 0, -1], atol=1e-6)


def test_implausible_poses_are_brought_back(beginnings):
    far = 50 * jnp.ones(CONFIG.pose)
    near = starts.plausible(beginnings, far, 1)
    own = np.asarray(beginnings.poses[1])
    deviation = np.sqrt(np.linalg.eigvalsh(np.cov(own.T, bias=True)).sum())
    assert np.linalg.norm(near - own.mean(axis=0)) <= starts.LIMIT * deviation * 1.001
    np.testing.assert_allclose(starts.plausible(beginnings, near, 1), near, atol=1e-4)
    inside = starts.sample(beginnings, jax.random.key(0), 1) * 0.3
    np.testing.assert_allclose(starts.plausible(beginnings, inside, 1), inside, atol=1e-4)
    np.testing.assert_array_equal(starts.plausible(beginnings, far, 0), 0)


def test_long_chains_of_the_released_generator_stay_finite_and_strong():
    """Whatever 20 labels come, and 16 samples of each: no transition leaves the range of the first ones."""
    models, rng = pipeline.load(), np.random.default_rng(3)
    labels = [0]
    while len(labels) < 20:
        labels += [label for label in rng.integers(1, 19, 1).tolist() if label != labels[-1]]
    curves = np.asarray(composition.compose(models.motion, models.starts, jax.random.key(0), [*labels, 0], samples=16))
    peaks = np.linalg.norm(curves, axis=-1).mean(axis=-1)[:, 29:-1:29]
    assert np.isfinite(curves).all() and peaks.max() < 0.06
    assert 0.5 < peaks[:, 14:].mean() / peaks[:, :5].mean() < 2
    np.testing.assert_allclose(curves[:, -1], 0, atol=1e-6)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: composition.pairs_of([1]), "a start and an end"),
        (lambda: composition.pairs_of([0, 1, 1]), "number 3 repeats the one before"),
        (lambda: composition.keys_of(jax.random.key(0), 0), "samples must be 1 or more"),
        (lambda: composition.timeline([30, 1]), r"2 or more for each transition, got \[30, 1\]"),
        (lambda: composition.join(random_curves(2), jnp.eye(6)), r"expected \(F, 12\) for 2 x 6 frames"),
    ],
)
def test_bad_requests_are_named(call, message):
    with pytest.raises(ValueError, match=message):
        call()
