"""Distances of meshes are the plain loop's; of expression networks' scores, the truth misses nothing."""

import numpy as np
import pytest

from facejax.data import sequences
from facejax.data.mesh_subset import of_split
from facejax.evaluation import expression_error, vertex_error
from facejax.models import expression_lstm
from facejax.models.decoders import linear
from facejax.training.recipes import fit_linear

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
    monkeypatch.setattr(expression_lstm, "generate", lambda params, neutral, prefix=None, *, frames: held_out.curves)
    monkeypatch.setattr(expression_lstm, "predict", lambda params, steps, neutral: np.diff(held_out.curves, axis=1))
    return held_out


def test_the_truth_misses_nothing(all_knowing):
    found = expression_error.expression_scores(None, all_knowing, recordings(2), start="zero", prefix=6)
    for name in ("next_network", "rest_network", "whole_network"):
        assert found[name] == pytest.approx(0, abs=1e-4)
    assert found["energy"] == pytest.approx(1) and found["acceleration"] == pytest.approx(1)


def test_the_rivals_are_the_loops(all_knowing):
    train, prefix = recordings(2), 6
    found = expression_error.expression_scores(None, all_knowing, train, start="zero", prefix=prefix)
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
    monkeypatch.setattr(expression_lstm, "generate", lambda params, neutral, prefix=None, *, frames: doubled)
    found = expression_error.expression_scores(None, all_knowing, recordings(2), start="zero", prefix=6)
    assert found["energy"] == pytest.approx(4, rel=1e-5) and found["acceleration"] == pytest.approx(2, rel=1e-5)
    assert 0 < found["energy_mean"] < 1 and 0 < found["acceleration_mean"] < 1


def test_the_mean_sequence_has_room_for_longer_ones():
    train = recordings(3)
    mean = expression_error.mean_sequence(train, F + 4)
    assert mean.curve.shape == (F + 4, L, 3) and mean.steps.shape == (F + 3, L, 3)
    np.testing.assert_allclose(mean.curve[F:], np.repeat(mean.curve[F - 1 : F], 4, axis=0), rtol=1e-5)


def halved(landmarks, neutral):
    """A poor method: all vertices go along with the mean landmark, by half."""
    return neutral + 0.5 * landmarks.mean(axis=1, keepdims=True)


def masks(data):
    upper = data.neutral[0][:, 2] > 0
    return {"all": np.ones_like(upper), "upper": upper}


def test_distances_are_those_of_the_plain_loop(ball_store):
    test, regions = of_split(ball_store, "test", "validation"), masks(ball_store)
    found = vertex_error.distances(halved, test, regions)
    off = []
    for i in range(test.count):
        marks, vertices = (part[0] for part in test.read(np.array([i])))
        off.append([np.linalg.norm(0.5 * marks.mean(axis=0) - vertex) for vertex in vertices])
    off = np.asarray(off)
    assert found.count == test.count
    np.testing.assert_allclose(found.total, off.sum(axis=0), rtol=1e-5)
    np.testing.assert_allclose(found.squares, (off**2).sum(axis=0), rtol=1e-5)
    curves = found.cumulative()
    for row, mask in zip(curves, regions.values(), strict=True):
        assert found.mean_std(mask) == pytest.approx((off[:, mask].mean(), off[:, mask].std()), rel=1e-5)
        # A distance that lies on an edge but for rounding may fall on either side of it.
        expected = [np.mean(off[:, mask] < edge) for edge in vertex_error.BIN_EDGES]
        np.testing.assert_allclose(row, expected, atol=2 / off[:, mask].size)


def test_cumulative_curves_rise_to_one(ball_store):
    test, regions = of_split(ball_store, "test"), masks(ball_store)
    truth = test.person(test.subjects[0])[2]
    found = vertex_error.distances(lambda marks, neutral: neutral + 0.8 * truth, test, regions).cumulative()
    assert found.shape == (2, len(vertex_error.BIN_EDGES)) and np.all(np.diff(found, axis=1) >= 0)
    np.testing.assert_array_equal(found[:, -1], 1)
    assert 0 < found[0, 100] < 1
    far = vertex_error.distances(lambda marks, neutral: neutral + truth + 50, test, regions)
    assert not far.cumulative().any()  # all beyond the last edge


def test_parts_add_up_to_the_whole(ball_store):
    test, regions = of_split(ball_store, "test", "validation"), masks(ball_store)
    whole = vertex_error.distances(halved, test, regions)
    a, b = (vertex_error.distances(halved, test.where(np.arange(test.count) % 2 == i), regions) for i in (0, 1))
    for found, expected in zip(a.add(b), whole, strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-12)


def test_the_truth_is_off_by_the_landmarks_noise_alone(ball_store):
    test, regions = of_split(ball_store, "test"), masks(ball_store)
    at = ball_store.landmark_index

    def met(landmarks, neutral):
        """The given landmarks where they are, and the truth elsewhere."""
        true = test.person(test.subjects[0])[2]
        moved = np.pad(true, ((0, len(landmarks) - len(true)), (0, 0), (0, 0)), mode="edge")
        moved[:, at] = landmarks
        return neutral + moved

    assert vertex_error.distances(met, test, regions).mean_std(regions["all"])[0] == pytest.approx(0, abs=1e-5)
    found = [vertex_error.distances(met, test, regions, noise=0.7, seed=seed) for seed in (1, 1, 2)]
    np.testing.assert_array_equal(found[0].total, found[1].total)
    assert not np.array_equal(found[0].total, found[2].total)
    # The mean square of three coordinates' noise.
    mean_square = sum(each.squares[at].mean() / each.count for each in found[1:]) / 2
    assert mean_square == pytest.approx(3 * 0.7**2, rel=0.2)
    elsewhere = np.setdiff1d(np.arange(len(found[0].total)), at)
    np.testing.assert_allclose(found[0].total[elsewhere], 0, atol=1e-3)


def test_distances_of_nothing_are_refused(ball_store):
    nobody = of_split(ball_store, "test").rows(np.zeros(0, int))
    with pytest.raises(ValueError, match="meshes to measure on, got none"):
        vertex_error.distances(halved, nobody, masks(ball_store))


@pytest.mark.parametrize("by", ["subjects", "labels"])
def test_linear_maps_take_the_alpha_that_held_out_groups_like_best(ball_store, by):
    train = of_split(ball_store, "train")
    params, alpha = fit_linear.fit_linear(linear.ridge, train, by=by)
    errors = np.zeros(len(fit_linear.ALPHAS))
    thin = train.rows(np.arange(0, train.count, 3))
    of = thin.owner if by == "subjects" else thin.labels
    for group in np.unique(of):  # four of either, and four folds
        known, held_out = thin.where(of != group), thin.where(of == group)
        for i, candidate in enumerate(fit_linear.ALPHAS):
            fitted = linear.ridge.fit(known, alpha=candidate)
            errors[i] += sum(np.linalg.norm(linear.apply(fitted, m) - v, axis=-1).sum() for m, v in held_out)
    assert alpha == fit_linear.ALPHAS[int(np.argmin(errors))]
    expected = linear.ridge.fit(train, alpha=alpha)
    np.testing.assert_array_equal(params.factors[0], expected.factors[0])
