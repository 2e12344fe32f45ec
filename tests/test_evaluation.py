"""Scores of expression networks: nothing is missed by the truth, and the rivals are what they say they are."""

import numpy as np
import pytest

from facejax import evaluation
from facejax.data import sequences
from facejax.models import sequence

L, F = 4, 14


def recordings(seed, count=5):
    rng = np.random.default_rng(seed)
    frames = rng.integers(11, F + 1, count).astype(np.int32)
    curves = np.cumsum(rng.normal(size=(count, F, L, 3)), axis=1).astype(np.float32)
    curves -= curves[:, :1]
    for curve, end in zip(curves, frames, strict=True):
        curve[end:] = curve[end - 1]
    scale = rng.uniform(150, 250, count).astype(np.float32)
    return sequences.Sequences(curves, frames, rng.normal(size=(count, L, 3)), np.ones(count), np.arange(count), scale)


@pytest.fixture
def all_knowing(monkeypatch):
    """A network that is right about everything."""
    held_out = recordings(1)
    monkeypatch.setattr(sequence, "generate", lambda params, neutral, prefix=None, *, frames: held_out.curves)
    monkeypatch.setattr(sequence, "predict", lambda params, steps, neutral: np.diff(held_out.curves, axis=1))
    return held_out


def test_the_truth_misses_nothing(all_knowing):
    found = evaluation.expression_scores(None, all_knowing, recordings(2), start="zero", prefix=6)
    for name in ("next_network", "rest_network", "whole_network"):
        assert found[name] == pytest.approx(0, abs=1e-4)
    assert found["energy"] == pytest.approx(1) and found["acceleration"] == pytest.approx(1)


def test_the_rivals_are_the_loops(all_knowing):
    train, prefix = recordings(2), 6
    found = evaluation.expression_scores(None, all_knowing, train, start="zero", prefix=prefix)
    mean = np.mean(train.curves, axis=0)
    wanted = {name: [] for name in found}
    for curve, end, scale in zip(all_knowing.curves, all_knowing.frames, all_knowing.scale, strict=True):

        def far(a, b, scale=scale):
            return scale * np.mean([np.linalg.norm(a[i] - b[i]) for i in range(L)])

        last = prefix - 1
        velocity = curve[last] - curve[last - 1]
        rows = {name: [] for name in wanted}
        for t in range(end):
            rows["whole_mean"].append(far(curve[t], mean[t]))
            if t >= 1:
                before = curve[t - 1] - curve[t - 2] if t >= 2 else 0 * curve[0]
                rows["next_velocity"].append(far(curve[t], curve[t - 1] + before))
                rows["next_mean"].append(far(curve[t], curve[t - 1] + mean[t] - mean[t - 1]))
            if t >= prefix:
                rows["rest_velocity"].append(far(curve[t], curve[last] + (t - last) * velocity))
                rows["rest_mean"].append(far(curve[t], mean[t]))
                rows["rest_mean_steps"].append(far(curve[t], curve[last] + mean[t] - mean[last]))
        for name, values in rows.items():
            if values:
                wanted[name].append(np.mean(values))
    for name, values in wanted.items():
        if values:
            assert found[name] == pytest.approx(np.mean(values), rel=1e-4), name


def test_the_strength_of_motion_is_over_the_recordings_own_frames(monkeypatch, all_knowing):
    doubled = 2 * all_knowing.curves
    monkeypatch.setattr(sequence, "generate", lambda params, neutral, prefix=None, *, frames: doubled)
    found = evaluation.expression_scores(None, all_knowing, recordings(2), start="zero", prefix=6)
    assert found["energy"] == pytest.approx(4, rel=1e-5) and found["acceleration"] == pytest.approx(2, rel=1e-5)
    assert 0 < found["energy_mean"] < 1 and 0 < found["acceleration_mean"] < 1


def test_the_mean_sequence_has_room_for_longer_ones():
    train = recordings(3)
    mean = evaluation.mean_sequence(train, F + 4)
    assert mean.curve.shape == (F + 4, L, 3) and mean.steps.shape == (F + 3, L, 3)
    np.testing.assert_allclose(mean.curve[F:], np.repeat(mean.curve[F - 1 : F], 4, axis=0), rtol=1e-5)
