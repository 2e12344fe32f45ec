"""Training the expression networks on a tiny dataset: alone as in company, resumed as in one go, and it learns."""

import jax
import numpy as np
import pytest

from facejax.data import sequences
from facejax.models import expression_lstm
from facejax.training.recipes import fit_expression_lstm
from facejax.training.recipes.fit_expression_lstm import PAPER, ExpressionPlan

SMALL = expression_lstm.Config(hidden=8, layers=2)
LABELS = ("anger", "surprise")


@pytest.fixture(scope="module")
def recordings(tiny_store):
    data = sequences.read(tiny_store, "train", LABELS)
    return data, {label: tiny_store.labels.index(label) for label in LABELS}


def leaves(params):
    return [np.asarray(leaf) for leaf in jax.tree.leaves(params)]


def test_alone_as_in_company_and_resumed_as_in_one_go(recordings, tmp_path):
    data, labels = recordings
    plan = ExpressionPlan(steps=6, batch=2)
    together = fit_expression_lstm.fit(data, tmp_path / "both", labels=labels, plan=plan, config=SMALL)
    again = fit_expression_lstm.fit(data, tmp_path / "both", labels=labels, plan=plan, config=SMALL)
    for a, b in zip(leaves(together), leaves(again), strict=True):
        np.testing.assert_array_equal(a, b)
    for i, label in enumerate(labels):
        only = {label: labels[label]}
        alone = fit_expression_lstm.fit(data, tmp_path / label, labels=only, plan=plan, config=SMALL)
        network = fit_expression_lstm.network(together, i)
        for a, b in zip(leaves(network), leaves(fit_expression_lstm.network(alone, 0)), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-6)
    with pytest.raises(ValueError, match="a run with another plan"):
        fit_expression_lstm.fit(data, tmp_path / "both", labels=labels, plan=plan._replace(noise=0.1), config=SMALL)


@pytest.mark.parametrize("start", expression_lstm.STARTS)
@pytest.mark.parametrize("feed", fit_expression_lstm.FEEDS)
def test_every_way_of_training_runs_and_learns(recordings, tmp_path, feed, start):
    data, labels = recordings
    config = SMALL._replace(start=start)
    plan = ExpressionPlan(steps=60, batch=4, rate=1e-2, feed=feed, noise=0.1, energy=0.0)
    params = fit_expression_lstm.fit(data, tmp_path, labels={"surprise": labels["surprise"]}, plan=plan, config=config)
    mine = data.take(data.label == labels["surprise"])
    block = sequences.block(mine)
    network = fit_expression_lstm.network(params, 0)
    neutral = block.neutral if start == "neutral" else None
    off = np.asarray(expression_lstm.predict(network, block.inputs, neutral)) - block.targets
    assert np.mean(off[block.mask] ** 2) < 0.8 * np.mean(block.targets[block.mask] ** 2)


def test_the_papers_plan():
    assert PAPER.feed == "truth" and PAPER.batch == 5 and PAPER.rate == 1e-3 and PAPER.final_rate == 1
    assert PAPER.path == PAPER.energy == PAPER.noise == 0 and PAPER.next_step == 1


def test_what_the_network_reads_while_it_learns():
    keys = jax.random.split(jax.random.key(0), 200)
    for feed in ("coin", "switch"):
        draw = jax.vmap(lambda key, share, f=feed: fit_expression_lstm._given(key, (4, 20), share, f), (0, None))
        assert draw(keys, 0.0).all(), "at the start of the run all is the truth"
        given = np.asarray(draw(keys, 0.5)).reshape(-1, 20)
        late = np.asarray(draw(keys, 1.0)).reshape(-1, 20)
        if feed == "coin":
            assert given.mean() == pytest.approx(0.5, abs=0.02) and not late.any()
        else:
            # Once on its own, on its own to the end; half of the sequences from the very start.
            assert (np.diff(given.astype(int), axis=1) <= 0).all() and late[:, 0].all()
            assert (late.sum(axis=1) == 1).mean() == pytest.approx(0.5 + 0.5 / 9, abs=0.05)
            assert late.sum(axis=1).max() == 9 and given.all(axis=1).mean() == pytest.approx(0.5, abs=0.05)


def test_a_label_without_recordings_and_an_unknown_feed(recordings, tmp_path):
    data, labels = recordings
    with pytest.raises(ValueError, match="no recording of 'fear'"):
        fit_expression_lstm.fit(data, tmp_path, labels={**labels, "fear": 15}, config=SMALL)
    with pytest.raises(ValueError, match="feed: expected one of truth, coin, switch"):
        fit_expression_lstm.fit(data, tmp_path, labels=labels, plan=ExpressionPlan(feed="luck"), config=SMALL)
