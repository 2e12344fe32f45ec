"""Choosing the morphable model's prior: what is held out is not learnt from, and the simpler of two alike is taken."""

import numpy as np
import pytest

from facejax.data.mesh_subset import of_split
from facejax.models.decoders import gpmm, gpmm_fit, linear
from facejax.training.recipes import fit_gpmm

COMPONENTS = 20


@pytest.fixture(scope="module")
def train(ball_store):
    return of_split(ball_store, "train", size=20)


@pytest.fixture(scope="module")
def fitted(train):
    return fit_gpmm.fit(train, components=COMPONENTS)


def distance(found, expected):
    return float(np.linalg.norm(found - expected, axis=-1).mean())


def test_all_priors_are_tried_and_the_best_is_carried(fitted):
    wanted = {(kind, s, n) for kind in (False, True) for s in fit_gpmm.SMOOTHNESS_GRID for n in fit_gpmm.NOISE_GRID}
    assert {(p.carried, p.smooth, p.noise) for p in fitted.errors_mm} == wanted
    # Expressions of the balls are made by deformation transfer.
    assert fitted.params.prior.carried
    least = {kind: min(e for p, e in fitted.errors_mm.items() if p.carried == kind) for kind in (False, True)}
    assert least[True] < 0.5 * least[False]


@pytest.mark.parametrize(("worth", "wanted"), [(0.0, (False, 0.0)), (1e9, None)], ids=["simplest", "best"])
def test_the_simpler_is_taken_unless_the_better_is_worth_it(train, monkeypatch, worth, wanted):
    monkeypatch.setattr(fit_gpmm, "MIN_RELATIVE_GAIN", worth)
    found = fit_gpmm.fit(train, components=COMPONENTS)
    error = found.errors_mm[found.params.prior]
    if wanted is None:
        assert error == min(found.errors_mm.values())
    else:
        assert (found.params.prior.carried, found.params.prior.smooth) == wanted
        assert error == min(e for p, e in found.errors_mm.items() if (p.carried, p.smooth) == wanted)


def test_what_is_fitted_is_the_model_of_all_meshes_under_that_prior(fitted, train, ball_store):
    people = [gpmm_fit.Person(*train.person(subject)) for subject in train.subjects]
    faces, at = ball_store.faces, ball_store.landmark_index
    expected = gpmm_fit.fit(people, faces, at, prior=fitted.params.prior, components=COMPONENTS)
    np.testing.assert_allclose(fitted.params.face, expected.face, rtol=1e-6)
    np.testing.assert_allclose(fitted.params.motion, expected.motion, rtol=1e-6)
    neutral, marks, vertices = of_split(ball_store, "test").person(1)
    found, same = (np.asarray(linear.apply(gpmm.linear_map(p, neutral), marks)) for p in (fitted.params, expected))
    np.testing.assert_allclose(found, same, atol=1e-2)
    assert distance(found, vertices) < 0.1 * distance(0, vertices)


@pytest.mark.parametrize("by", ["subjects", "labels"])
def test_answers_held_out_are_those_of_a_model_that_saw_nothing_alike(train, monkeypatch, by):
    """Plain and without the smooth prior: ridge regression of every second mesh of the others."""
    monkeypatch.setattr(fit_gpmm, "SMOOTHNESS_GRID", (0.0,))
    found = fit_gpmm.fit(train, by=by, carried=(False,))
    of = train.owner if by == "subjects" else train.labels
    answers = found.held_out(train)
    assert answers.shape == (train.count, 162, 3) and answers.dtype == np.float32
    for group in np.unique(of):  # four of either, and four folds
        others = train.rows(np.flatnonzero(of != group)[::2])
        params = linear.ridge.fit(others, alpha=found.params.prior.noise)
        marks, _ = train.read(np.flatnonzero(of == group))
        np.testing.assert_allclose(answers[of == group], linear.apply(params, marks), atol=1e-3)


@pytest.mark.parametrize("by", ["subjects", "labels"])
def test_folds_part_the_meshes_and_foresee_the_error(train, by):
    found = fit_gpmm.fit(train, by=by, components=COMPONENTS)
    rows = [rows for _, rows in found.folds]
    np.testing.assert_array_equal(np.sort(np.concatenate(rows)), np.arange(train.count))
    of = train.owner if by == "subjects" else train.labels
    assert all(not set(of[a].tolist()) & set(np.delete(of, a).tolist()) for a in rows)
    assert all(params.prior == found.params.prior for params, _ in found.folds)
    # The choice looks at a quarter of the vertices and at some frames.
    error = distance(found.held_out(train), train.read(np.arange(train.count))[1])
    assert error == pytest.approx(found.errors_mm[found.params.prior], rel=0.4)


def test_fewer_people_than_folds_are_held_out_one_by_one_and_one_is_refused(train):
    two = train.where(np.isin(train.owner, [0, 4]))
    found = fit_gpmm.fit(two, carried=(False,))
    assert len(found.folds) == 2 and np.isfinite(list(found.errors_mm.values())).all()
    with pytest.raises(ValueError, match="two or more subjects, got 1"):
        fit_gpmm.fit(train.where(train.owner == 4))
    with pytest.raises(ValueError, match="by: expected 'subjects' or 'labels', got 'people'"):
        fit_gpmm.fit(train, by="people")
