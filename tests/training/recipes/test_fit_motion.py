"""Training generators of motion, on made-up data and for a few steps: they run, learn, resume, and sample."""

import json
from contextlib import contextmanager

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from facejax import augment
from facejax.data import motions, transitions
from facejax.data.synthetic import expression_recipes
from facejax.models.motion import flow_matching, generators, motion3dgan, motion3dgan_reference, tangent_pca
from facejax.training import loop
from facejax.training.recipes import fit_motion
from tests.data.test_motions import recorded
from tests.models.motion.test_motion3dgan import plain_weights


@pytest.fixture(autouse=True)
def quick():
    with plain_weights():
        yield


@pytest.fixture(scope="module")
def data():
    return recorded(subjects=6)


@pytest.fixture(scope="module")
def known(data):
    return transitions.transitions(data, "train", per_pair=6)


@pytest.fixture(scope="module")
def chart(known):
    return transitions.fit_chart(known, labels=4, rank=8, pose=4)


@pytest.fixture(scope="module")
def examples(known, chart):
    return transitions.encode_examples(chart, [known.take(np.arange(36)), known.take(np.arange(36, 72))])


def test_examples_are_the_motions_in_the_chart(known, chart, examples):
    assert len(known.curves) == len(examples.values) == 6 * 3 * 2 + 6 * 6
    assert examples.values.shape[1] == 2 + 8 and examples.pose.shape[1] == 4
    np.testing.assert_array_equal(examples.start, known.start)
    np.testing.assert_array_equal(examples.end, known.end)
    np.testing.assert_array_equal(examples.pose[known.start == 0], 0)
    lengths = np.linalg.norm(np.diff(known.curves, axis=1).reshape(72, 29, -1), axis=-1).sum(axis=1)
    mean, deviation = np.asarray(chart.scalar_mean)[known.start, known.end], np.asarray(chart.scalar_std)
    np.testing.assert_allclose(mean[:, 0] + deviation[0] * examples.values[:, 0], np.log(lengths), atol=2e-3)
    np.testing.assert_allclose(np.exp(mean[:, 1] + deviation[1] * examples.values[:, 1]), known.seconds, rtol=1e-4)
    # The chart's means are those of its own motions.
    for a, b in {*zip(known.start.tolist(), known.end.tolist(), strict=True)}:
        rows = (known.start == a) & (known.end == b)
        np.testing.assert_allclose(examples.values[rows, 2:].mean(axis=0), chart.mean[a, b], atol=2e-3)


def test_wrong_requests_are_named(known, chart, examples, tmp_path):
    with pytest.raises(ValueError, match="the highest label of the motions; got 2"):
        transitions.fit_chart(known, labels=2)
    with pytest.raises(ValueError, match="1 step or more, got 0"):
        fit_motion.fit_flow(examples, chart, tmp_path / "none", plan=fit_motion.FlowPlan(steps=0))
    assert not (tmp_path / "none").exists()
    for whole, parts in zip(
        transitions.encode_examples(chart, known), transitions.encode_examples(chart, [known]), strict=True
    ):
        np.testing.assert_array_equal(whole, parts)


def test_the_papers_set_has_the_papers_size():
    """12 people, 12 expressions: 288 halves, 48 of each of 132 ordered pairs: about 6,740; one of each held out."""
    data = recorded(subjects=12, labels=("neutral", *expression_recipes.COMA))
    found = transitions.transitions(data, "train", per_pair=transitions.TRANSITIONS_PER_PAIR, reuse=None)
    assert len(found.start) == 288 + 132 * 48 == 6624
    pairs = np.bincount(found.start * 13 + found.end, minlength=169).reshape(13, 13)
    expected = np.where(np.eye(13), 0, 48)
    expected[0, 1:] = expected[1:, 0] = 12
    np.testing.assert_array_equal(pairs, expected)
    assert augment.sample_per_pair(found.start, found.end).sum() == 132 + 24


def test_coma_labels_are_13():
    """Of a dataset with more expressions than CoMA has; numbers follow the names given, not the dataset."""
    data = recorded(subjects=2, labels=("neutral", *expression_recipes.EXPRESSIONS[::-1]))
    names = ("neutral", *expression_recipes.COMA)
    found = motions.join(*transitions.all_pairs(data, "train", label_names=names, per_pair=1))
    assert len(found.start) == 2 * 12 * 2 + 132
    assert {*found.start.tolist()} == {*found.end.tolist()} == {*range(13)}
    first = next(one for one in data.sequences if one.label == "bareteeth" and one.subject == 1)
    rest = data.neutral[1][data.landmark_index]
    peak = (data.landmarks[first.start + first.apex_start] - rest) / np.linalg.norm(rest - rest.mean(axis=0))
    own = (found.start == 0) & (found.end == 1) & (found.subject == 1)
    np.testing.assert_allclose(found.curves[own, -1], peak[None], atol=1e-6)


def test_everything_lets_everybody_meet_everybody(data):
    parts = [*transitions.all_pairs(data, "train", per_pair=None)]
    assert [len(part.start) for part in parts] == [36, 6 * 36]
    counts = np.bincount(parts[1].subject, minlength=6)
    assert counts.tolist() == [36] * 6


def test_balanced_rows_hold_every_pair_equally_often():
    start, end = np.array([0, 0, 0, 1, 1, 2]), np.array([1, 1, 1, 0, 0, 1])
    rows = transitions.balance_pairs(start, end)
    pairs = list(zip(start[rows].tolist(), end[rows].tolist(), strict=True))
    assert {pair: pairs.count(pair) for pair in set(pairs)} == {(0, 1): 3, (1, 0): 3, (2, 1): 3}
    assert set(rows.tolist()) == set(range(6))
    np.testing.assert_array_equal(transitions.balance_pairs(start, end), rows)
    assert len({transitions.balance_pairs(start, end, seed).tobytes() for seed in range(9)}) > 1


def test_extrinsic_mean_is_near_the_karcher_mean(known, chart):
    other = transitions.fit_chart(known, labels=4, rank=8, pose=4, mean="extrinsic")
    cosine = float(np.sum(np.asarray(chart.p) * np.asarray(other.p))) / 29
    assert 0.5 < cosine < 1 - 1e-6
    # Of the two, the Karcher mean is the one about which the motions are centred.
    off = [np.linalg.norm(np.average(one.mean.reshape(16, -1), axis=0, weights=np.bincount(
        known.start * 4 + known.end, minlength=16))) for one in (chart, other)]  # fmt: skip
    assert off[0] < 1e-3 < off[1]
    with pytest.raises(ValueError, match="mean: expected"):
        transitions.fit_chart(known, labels=4, mean="median")


def check(params, kind):
    assert generators.kind(params) == kind
    made = generators.sample(params, jax.random.key(0), 0, 2, jnp.zeros(4))
    assert made.q.shape == (29, 4, 3) and all(np.isfinite(x).all() for x in made)


def entries(folder):
    return [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]


def test_the_gan_trains_with_every_term(examples, chart, tmp_path):
    config = motion3dgan.Config(width=16, blocks=1, noise=4, embedding=4)
    plan = fit_motion.GanPlan(steps=3, batch=4, critic_steps=2, reconstruction=1.0, length=0.1, geodesic=0.1)
    params = fit_motion.fit_gan(examples, chart, tmp_path, plan=plan, config=config)
    check(params, "gan")
    (entry,) = entries(tmp_path)
    assert {"reconstruction", "length", "geodesic", "adversarial", "wasserstein", "slope"} <= set(entry)
    assert min(entry[name] for name in ("reconstruction", "length", "geodesic")) > 0
    last = fit_motion.fit_gan(examples, chart, tmp_path, plan=plan, config=config, average=False)
    assert np.any(last.weights["head"]["kernel"] != params.weights["head"]["kernel"])


def test_terms_of_the_gan_are_those_of_the_motions(chart):
    """Equation 6 on tangent vectors, log-length and log-seconds as they are, and angles between motions."""
    rng = np.random.default_rng(0)
    fake, real = (jnp.asarray(0.3 * rng.normal(size=(5, 10)), jnp.float32) for _ in range(2))
    plan = fit_motion.GanPlan(reconstruction=2.0, length=3.0, geodesic=5.0)
    found = fit_motion._terms(plan)(chart, fake, real, None)
    rows = []
    for a, b in zip(np.asarray(fake), np.asarray(real), strict=True):
        (v, *s), (w, *t) = ([np.asarray(x, np.float64) for x in tangent_pca.decode(chart, x, 1, 2)] for x in (a, b))
        points = []
        for x in (v, w):
            angle = np.sqrt(np.sum(x**2) / 29)
            points.append(np.cos(angle) * np.asarray(chart.p, np.float64) + np.sin(angle) / angle * x)
        away = np.arccos(np.sum(points[0] * points[1]) / 29)
        rows.append([np.mean(np.abs(v - w)), np.sum(np.abs(np.subtract(s, t))), away])
    wanted = np.mean(rows, axis=0) * [2, 3, 5]
    got = [found[name] for name in ("reconstruction", "length", "geodesic")]
    np.testing.assert_allclose(got, wanted, rtol=1e-4)


def test_the_flow_trains_and_a_resumed_run_equals_an_uninterrupted_one(examples, chart, tmp_path, monkeypatch):
    plan = fit_motion.FlowPlan(steps=200, batch=8)

    def fit(name, **options):
        config = flow_matching.Config(width=16, blocks=1, embedding=4)
        return fit_motion.fit_flow(examples, chart, tmp_path / name, plan=plan, config=config, **options)

    whole = fit("whole")
    check(whole, "flow")
    assert np.any(whole.weights["head"]["kernel"] != 0) and len(entries(tmp_path / "whole")) == 2

    stopped, rows = [], loop.epoch_indices

    @contextmanager
    def signals():
        yield stopped

    def stopping(*arguments):
        def indices(first, count):
            stopped.extend([15] if first else [])
            return rows(*arguments)(first, count)

        return indices

    with monkeypatch.context() as patch:
        patch.setattr(loop, "_stop_signals", signals)
        patch.setattr(loop, "epoch_indices", stopping)
        with pytest.raises(SystemExit):
            fit("parts")
    assert [entry["step"] for entry in entries(tmp_path / "parts")] == [100]
    for a, b in zip(jax.tree.leaves(fit("parts")), jax.tree.leaves(whole), strict=True):
        np.testing.assert_array_equal(a, b)
    with pytest.raises(ValueError, match="a run with another seed"):
        fit("whole", seed=1)


def test_the_authors_gan_trains(known, chart, tmp_path):
    config = motion3dgan_reference.Config(width_divisor=16, noise=4)
    plan = fit_motion.REFERENCE._replace(steps=2, batch=4, critic_steps=2)
    params = fit_motion.fit_reference(known, chart, tmp_path, plan=plan, config=config)
    check(params, "reference")
    entry, last = entries(tmp_path)  # of each step: they are slow
    assert (entry["step"], last["step"]) == (1, 2)
    assert {"reconstruction", "length", "adversarial", "wasserstein", "slope"} <= set(entry)


def test_starts_are_fitted_on_the_peaks(known, chart):
    found = transitions.fit_start_poses(chart, known)
    assert found.poses.shape == (4, 6, 4) and found.count.tolist() == [1, 6, 6, 6]
    peaks = known.take((known.start == 0) & (known.end == 2)).curves[:, -1]
    basis = np.asarray(chart.pose_basis, np.float64).reshape(4, -1)
    wanted = (peaks - np.asarray(chart.pose_mean[2])).reshape(6, -1) @ basis.T / np.asarray(chart.pose_scale)
    np.testing.assert_allclose(found.poses[2], wanted, atol=1e-3)
