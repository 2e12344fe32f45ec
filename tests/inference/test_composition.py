"""Transitions in a row: one line of time without jolts, and faces that stay faces."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from facejax.inference import composition, pipeline
from facejax.models.motion import (
    flow_matching,
    generators,
    motion3dgan,
    motion3dgan_reference,
    start_poses,
    tangent_pca,
)
from tests.models.motion.test_flow_matching import CONFIG as FLOW
from tests.models.motion.test_generators import REFERENCE
from tests.models.motion.test_motion3dgan import CONFIG, SHAPE, fitted, plain_weights, toy

DRAWN = 6
CHAIN = [0, 1, 2, 0, 2, 1] + [2, 1] * 6 + [0, 1, 0]  # twenty transitions
KEYS = composition.sample_keys(jax.random.key(1), 3)


@pytest.fixture(scope="module")
def chart():
    return fitted(toy(), labels=3, rank=CONFIG.rank)


@pytest.fixture(scope="module")
def made(chart):
    """Untrained: each is a Gaussian, but for the authors'."""
    with plain_weights():
        return {
            "gan": motion3dgan.generator.init(jax.random.key(0), chart, config=CONFIG),
            "flow": flow_matching.init(jax.random.key(0), chart, config=FLOW),
            "reference": motion3dgan_reference.generator.init(jax.random.key(0), chart, config=REFERENCE),
        }


@pytest.fixture(scope="module")
def beginnings():
    rng = np.random.default_rng(0)
    return start_poses.fit(rng.normal(size=(40, CONFIG.pose)), np.repeat([1, 2], 20), classes=3)


def random_curves(count, seed=0):
    curves = np.random.default_rng(seed).normal(size=(2, count, DRAWN, 4, 3)).cumsum(axis=2)
    for i in range(1, count):
        curves[:, i] += curves[:, i - 1, -1:] - curves[:, i, :1]
    return curves.astype(np.float32)


def test_one_transition_at_its_own_length_is_left_alone():
    np.testing.assert_array_equal(composition.timeline([DRAWN], drawn=DRAWN), np.eye(DRAWN))


def loop_join(curves, frames, reach):
    """One coordinate, transition by transition and frame by frame: (P, T) -> (F,)."""
    line = []
    for curve, count in zip(curves, frames, strict=True):
        known = [2 * curve[0] - curve[1], *curve, 2 * curve[-1] - curve[-2]]
        for frame in range(1 if line else 0, count):
            place = frame * (len(curve) - 1) / (count - 1)
            low = min(int(place), len(curve) - 2)
            a, b, c, d = known[low : low + 4]
            x = place - low
            cubic = (2 * b, c - a, 2 * a - 5 * b + 4 * c - d, 3 * b - a - 3 * c + d)
            line.append(sum(factor * x**power for power, factor in enumerate(cubic)) / 2)
    joint = len(line) - 1
    for i in range(len(frames) - 2, -1, -1):
        joint -= frames[i + 1] - 1
        last = i == len(frames) - 2
        room = [(-1, min(reach, (frames[i] - 1) // 2)), (1, min(reach, (frames[i + 1] - (1 if last else 2)) // 2))]
        room = [(sign, width) for sign, width in room if width]
        bend = line[joint + 1] - 2 * line[joint] + line[joint - 1]
        for sign, width in room:
            for k in range(1, width + 1):
                line[joint + sign * k] -= bend / len(room) * k * ((width + 1 - k) / width) ** 2
    return line


CASES = [((6, 11, 4), 6, 8), ((3, 3, 40), 6, 5), ((2, 7), 2, 8)]


@pytest.mark.parametrize(("frames", "drawn", "reach"), CASES, ids=str)
def test_one_line_of_time_is_the_plain_loop(frames, drawn, reach):
    curves = np.random.default_rng(0).normal(size=(len(frames), drawn)).cumsum(axis=1)
    for i in range(1, len(frames)):
        curves[i] += curves[i - 1, -1] - curves[i, 0]
    line = composition.timeline(frames, drawn=drawn, reach=reach)
    np.testing.assert_allclose(line @ curves.ravel(), loop_join(curves, frames, reach), atol=1e-5)
    joined = composition.join(jnp.float32(curves[None, ..., None, None] * np.ones(3)), jnp.asarray(line))
    np.testing.assert_allclose(joined[0, :, 0, 1], line @ curves.ravel(), atol=1e-5)


FRAMES = [
    *((6, 6, 6), (2, 9, 3), (3, 2, 2), (17, 4, 30), (30, 30)),
    *((10, 3, 10), (10, 3, 3, 10), (3, 3, 3), (2, 3, 2), (5, 4, 3, 2), (9, 2, 3, 9)),
]


@pytest.mark.parametrize("frames", FRAMES, ids=str)
def test_positions_meet_speeds_agree_and_ends_stay(frames):
    curves = random_curves(len(frames))
    line = composition.timeline(frames, drawn=DRAWN)
    joined = np.asarray(composition.join(curves, jnp.asarray(line)))
    assert joined.shape == (2, 1 + sum(n - 1 for n in frames), 4, 3)
    np.testing.assert_allclose(line.sum(axis=1), 1, atol=1e-5)
    joints = np.cumsum([n - 1 for n in frames])[:-1]
    np.testing.assert_allclose(joined[:, 0], curves[:, 0, 0], atol=1e-5)
    np.testing.assert_allclose(joined[:, -1], curves[:, -1, -1], atol=1e-5)
    np.testing.assert_allclose(joined[:, joints], curves[:, :-1, -1], atol=1e-5)
    bend = joined[:, joints + 1] - 2 * joined[:, joints] + joined[:, joints - 1]
    # Beside a joint there must be a frame of its own: the middle one of three belongs to the joint that follows.
    least = [3] * (len(frames) - 2) + [2]
    roomy = [a > 2 or b > few for a, b, few in zip(frames[:-1], frames[1:], least, strict=True)]
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


@pytest.fixture(scope="module", params=["gan", "flow"])
def drawn(request, made, beginnings):
    return composition.draw(made[request.param], beginnings, KEYS, composition.label_pairs(CHAIN))


def test_chains_start_at_neutral_meet_and_come_home_exactly(drawn):
    curves = np.asarray(drawn.curves)
    assert curves.shape == (3, 20, DRAWN, *SHAPE[1:]) and drawn.log_seconds.shape == (3, 20)
    assert np.isfinite(curves).all() and np.isfinite(drawn.log_seconds).all()
    np.testing.assert_array_equal(curves[:, 0, 0], 0)
    np.testing.assert_allclose(curves[:, 1:, 0], curves[:, :-1, -1], atol=1e-5)
    home = np.array(CHAIN[1:]) == 0
    np.testing.assert_array_equal(curves[:, home, -1], 0)
    assert np.abs(curves[:, ~home, -1]).max(axis=(-1, -2)).min() > 1e-2


def test_twenty_transitions_do_not_drift(drawn):
    size = np.linalg.norm(drawn.curves[:, :, -1], axis=(-2, -1)).mean(axis=0)
    to = np.array(CHAIN[1:])
    for label in (1, 2):
        visits = size[to == label]
        assert visits[-4:].mean() < 1.5 * visits[:4].mean()


def test_samples_do_not_depend_on_how_many_there_are_and_compose_joins_them(made, beginnings):
    pairs, key = composition.label_pairs(CHAIN), jax.random.key(1)
    many, few = (composition.draw(made["gan"], beginnings, KEYS[:count], pairs) for count in (3, 1))
    np.testing.assert_allclose(few.curves[0], many.curves[0], atol=1e-5)
    whole = composition.compose(made["gan"], beginnings, key, CHAIN, samples=3)
    assert whole.shape == (3, 1 + 20 * (DRAWN - 1), *SHAPE[1:])
    np.testing.assert_allclose(whole[:, :: DRAWN - 1][:, 1:], many.curves[:, :, -1], atol=1e-5)
    # With frames of their own, the same peaks at other times.
    frames = (9, 4, 12, 7) * 5
    timed = composition.compose(made["gan"], beginnings, key, CHAIN, samples=3, frames=frames)
    ends = np.cumsum([count - 1 for count in frames])
    assert timed.shape[1] == ends[-1] + 1
    np.testing.assert_allclose(timed[:, ends], many.curves[:, :, -1], atol=1e-5)


def loop_chain(params, beginnings, key, labels):
    """Transition by transition: where the face stands, what the generator is told, and what of its answer is kept."""
    chart, heeds = params.chart, not isinstance(params, motion3dgan_reference.Motion3DGANReference)
    first_key, key = jax.random.split(key)
    pose = start_poses.sample(beginnings, first_key, labels[0]) if heeds else jnp.zeros(CONFIG.pose)
    here, curves = np.asarray(tangent_pca.decode_pose(chart, pose, labels[0])), []
    for one, start, end in zip(jax.random.split(key, len(labels) - 1), labels, labels[1:], strict=False):
        pose = start_poses.clip_to_distribution(beginnings, tangent_pca.encode_pose(chart, here, start), start)
        made = generators.sample(params, one, start, end, pose)
        meant = np.asarray(tangent_pca.decode_pose(chart, pose, start)) if heeds else here
        curve, covered = [meant], [0.0]
        for step in np.asarray(made.q):
            speed = np.linalg.norm(step)
            curve.append(curve[-1] + np.exp(made.log_length) / (DRAWN - 1) * speed * step)
            covered.append(covered[-1] + speed**2)
        share = np.array(covered)[:, None, None] / covered[-1]
        curve = np.stack(curve) + (1 - share) * (here - meant)
        if heeds and end == 0:
            curve = curve - share * curve[-1]
        curves.append(curve)
        here = curve[-1]
    return np.stack(curves)


@pytest.mark.parametrize("name", ["gan", "reference"])
def test_a_chain_is_the_plain_loop(made, beginnings, name):
    """The authors' generator starts at the mean peak and goes on from where it stands: its errors add up."""
    labels = [1, 2, 0, *CHAIN[1:-2]]
    curves = composition.draw(made[name], beginnings, KEYS, composition.label_pairs(labels)).curves
    np.testing.assert_allclose(curves[1], loop_chain(made[name], beginnings, KEYS[1], labels), atol=1e-4)
    home = np.linalg.norm(curves[:, 1, -1], axis=(-2, -1))
    if name == "gan":
        np.testing.assert_array_equal(home, 0)
        assert np.abs(curves[0, 0, 0] - curves[1, 0, 0]).max() > 1e-2
    else:
        assert home.min() > 0.1
        np.testing.assert_allclose(curves[:, 0, 0], np.stack([made[name].chart.pose_mean[1]] * 3), atol=1e-6)


def test_implausible_poses_are_brought_back(beginnings):
    far = 50 * jnp.ones(CONFIG.pose)
    near = start_poses.clip_to_distribution(beginnings, far, 1)
    own = np.asarray(beginnings.poses[1])
    deviation = np.sqrt(np.linalg.eigvalsh(np.cov(own.T, bias=True)).sum())
    assert np.linalg.norm(near - own.mean(axis=0)) <= start_poses.LIMIT * deviation * 1.001
    np.testing.assert_allclose(start_poses.clip_to_distribution(beginnings, near, 1), near, atol=1e-4)
    inside = start_poses.sample(beginnings, jax.random.key(0), 1) * 0.3
    np.testing.assert_allclose(start_poses.clip_to_distribution(beginnings, inside, 1), inside, atol=1e-4)
    np.testing.assert_array_equal(start_poses.clip_to_distribution(beginnings, far, 0), 0)


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


def test_compose_knows_its_labels_and_one_length_serves_all(made, beginnings):
    chain = made["flow"], beginnings, jax.random.key(2)
    with pytest.raises(ValueError, match="number 3 is 99"):
        composition.compose(*chain, [0, 1, 99])
    with pytest.raises(ValueError, match="2 for 2 transitions, got 3"):
        composition.compose(*chain, [0, 1, 0], frames=[5, 5, 5])
    with pytest.raises(TypeError, match="parameters of a generator"):
        composition.compose(made, *chain[1:], [0, 1])
    one, each = (composition.compose(*chain, [0, 1, 0], frames=frames) for frames in (5, [5, 5]))
    np.testing.assert_array_equal(one, each)
    assert one.shape[1] == 9


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: composition.label_pairs([1]), "a start and an end"),
        (lambda: composition.label_pairs([0, 1, 1]), "number 3 repeats the previous one"),
        (lambda: composition.label_pairs(["neutral", "anger"]), "expected indices.*models.labels.encode"),
        (lambda: composition.label_pairs([0, -1]), "number 2 is -1, expected one from 0$"),
        (lambda: composition.label_pairs([0, 3], classes=3), "number 2 is 3, expected one from 0 to 2"),
        (lambda: composition.sample_keys(jax.random.key(0), 0), "samples must be 1 or more"),
        (lambda: composition.timeline([30, 1]), r"2 or more for each transition, got \[30, 1\]"),
        (lambda: composition.join(random_curves(2), jnp.eye(6)), r"expected \(F, 12\) for 2 x 6 frames"),
    ],
)
def test_bad_requests_are_named(call, message):
    with pytest.raises(ValueError, match=message):
        call()
