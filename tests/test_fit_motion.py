"""Training generators of motion, on a tiny dataset and for a few steps: they run, resume, and sample."""

import jax
import numpy as np
import pytest

from facejax import augment, fit_motion
from facejax.data import motions
from facejax.models import flow, generators, motion, motion_reference


@pytest.fixture(scope="module")
def known(tiny_store):
    return fit_motion.transitions(tiny_store, "train", per_pair=1)


@pytest.fixture(scope="module")
def chart(known):
    return fit_motion.chart_of(known, labels=19, rank=16, pose=8)


@pytest.fixture(scope="module")
def examples(known, chart):
    return fit_motion.examples_of(chart, [known.take(np.arange(300)), known.take(np.arange(300, len(known.start)))])


def test_examples_are_the_motions_in_the_chart(known, chart, examples):
    assert len(known.curves) == len(examples.values) == 4 * 18 * 2 + 18 * 17
    assert examples.values.shape[1] == 18 and examples.pose.shape[1] == 8
    np.testing.assert_array_equal(examples.start, known.start)
    np.testing.assert_array_equal(examples.pose[known.start == 0], 0)
    lengths = np.linalg.norm(np.diff(known.curves, axis=1).reshape(len(known.start), 29, -1), axis=-1).sum(axis=1)
    mean, deviation = np.asarray(chart.scalar_mean)[known.start, known.end], np.asarray(chart.scalar_std)
    np.testing.assert_allclose(mean[:, 0] + deviation[0] * examples.values[:, 0], np.log(lengths), atol=2e-3)
    np.testing.assert_allclose(np.exp(mean[:, 1] + deviation[1] * examples.values[:, 1]), known.seconds, rtol=1e-4)


def test_the_papers_set_has_the_papers_size():
    """12 people, 12 expressions: 288 halves, 48 of each of 132 ordered pairs: about 6,740; one of each held out."""
    rng = np.random.default_rng(0)
    peaks, labels = rng.normal(size=(144, 4, 3)), np.repeat(np.arange(12), 12)
    prototypes = augment.prototypes(peaks, labels, classes=12)
    pairs = augment.select(peaks, labels, prototypes, per_pair=fit_motion.PER_PAIR).pairs
    assert 288 + len(pairs) == 288 + 132 * 48 == 6624
    held = augment.one_of_each(labels[pairs[:, 0]], labels[pairs[:, 1]])
    assert held.sum() == 132


def test_coma_labels_are_13(tiny_store):
    names = ("neutral", "bareteeth", "cheeks_in")
    parts = list(fit_motion.everything(tiny_store, "train", names=names, per_pair=3))
    found = motions.join(*parts)
    assert sorted(set(zip(found.start.tolist(), found.end.tolist(), strict=True))) == [
        (0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1),
    ]  # fmt: skip
    assert len(found.start) == 4 * 2 * 2 + 2 * 3


def test_balanced_rows_hold_every_pair_equally_often():
    start, end = np.array([0, 0, 0, 1, 1, 2]), np.array([1, 1, 1, 0, 0, 1])
    rows = fit_motion.balanced(start, end)
    pairs = list(zip(start[rows].tolist(), end[rows].tolist(), strict=True))
    assert {pair: pairs.count(pair) for pair in set(pairs)} == {(0, 1): 3, (1, 0): 3, (2, 1): 3}
    assert set(rows.tolist()) == set(range(6))


def test_extrinsic_mean_is_near_the_karcher_mean(known, chart):
    other = fit_motion.chart_of(known, labels=19, rank=16, pose=8, mean="extrinsic")
    cosine = float(np.sum(np.asarray(chart.p) * np.asarray(other.p))) / 29
    assert 0.5 < cosine < 1
    with pytest.raises(ValueError, match="mean: expected"):
        fit_motion.chart_of(known, labels=19, mean="median")


def check(params):
    made = generators.sample(params, jax.random.key(0), 0, 4, np.zeros(8, np.float32))
    assert made.q.shape == (29, 68, 3) and all(np.isfinite(x).all() for x in made)


def test_the_gan_trains_with_every_term(examples, chart, tmp_path):
    config = motion.Config(width=16, blocks=1, noise=8, embedding=4)
    plan = fit_motion.GanPlan(steps=2, batch=8, critic_steps=2, reconstruction=1.0, length=0.1, geodesic=0.1)
    params = fit_motion.fit_gan(examples, chart, tmp_path, plan=plan, config=config)
    check(params)
    line = (tmp_path / "metrics.jsonl").read_text()
    assert all(name in line for name in ("reconstruction", "length", "geodesic", "slope"))
    last = fit_motion.fit_gan(examples, chart, tmp_path, plan=plan, config=config, average=False)
    assert np.any(last.weights["head"]["kernel"] != params.weights["head"]["kernel"])


def test_the_flow_trains_and_a_resumed_run_equals_an_uninterrupted_one(examples, chart, tmp_path):
    config = flow.Config(width=16, blocks=1, embedding=4)
    plan = fit_motion.FlowPlan(steps=20, batch=8)
    whole = fit_motion.fit_flow(examples, chart, tmp_path / "whole", plan=plan, config=config)
    check(whole)
    again = fit_motion.fit_flow(examples, chart, tmp_path / "whole", plan=plan, config=config)
    for a, b in zip(jax.tree.leaves(whole), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(a, b)
    with pytest.raises(ValueError, match="a run with another seed"):
        fit_motion.fit_flow(examples, chart, tmp_path / "whole", plan=plan, config=config, seed=1)
    assert np.any(whole.weights["head"]["kernel"] != 0)


def test_the_authors_gan_trains(known, chart, tmp_path):
    config = motion_reference.Config(width_divisor=16, noise=4)
    plan = fit_motion.REFERENCE._replace(steps=1, batch=2, critic_steps=1)
    params = fit_motion.fit_reference(known, chart, tmp_path, plan=plan, config=config)
    check(params)
    assert "reconstruction" in (tmp_path / "metrics.jsonl").read_text()


def test_starts_are_fitted_on_the_peaks(known, chart):
    found = fit_motion.fit_starts(chart, known)
    assert found.poses.shape[::2] == (19, 8) and float(found.count[1]) == 4
