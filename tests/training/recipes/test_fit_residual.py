"""Training the two networks that see the face, on tiny balls: they learn, resume, and fall back on what is known."""

import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from facejax.data.mesh_subset import of_split
from facejax.mesh import hierarchy as mesh_hierarchy
from facejax.models.decoders import gpmm, gpmm_residual, linear, neural3dmm, residual
from facejax.training import loop, metric_logger
from facejax.training.recipes import fit_gpmm, fit_neural3dmm, fit_residual

PLAN = fit_residual.ResidualPlan(steps=80, batch=8)
NEURAL = fit_neural3dmm.Neural3DMMPlan(steps=20, batch=8)


@pytest.fixture(scope="module")
def train(ball_store):
    return of_split(ball_store, "train", size=20)


@pytest.fixture(scope="module")
def hierarchy(ball_store):
    template = ball_store.neutral.mean(axis=0, dtype=np.float64)
    return mesh_hierarchy.build(template, ball_store.faces, factors=(2, 2, 2, 2), lengths=3)


@pytest.fixture(scope="module")
def base(train):
    return fit_gpmm.fit(train, components=20)


@pytest.fixture(scope="module")
def often():
    """Checkpoints after every half of a run."""
    run = loop.run

    def halves(*args, steps, **options):
        return run(*args, steps=steps, **options | {"chunk": steps // 2, "save_steps": steps // 2})

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loop, "run", halves)
        yield


@pytest.fixture(scope="module")
def refined(train, hierarchy, base, often, tmp_path_factory):
    folder = tmp_path_factory.mktemp("residual")
    return folder, fit_residual.fit(train, hierarchy, folder, plan=PLAN, base=base)


@pytest.fixture(scope="module")
def neural(train, hierarchy, often, tmp_path_factory):
    folder = tmp_path_factory.mktemp("neural")
    return folder, fit_neural3dmm.fit(train, hierarchy, folder, plan=NEURAL)


def halfway(folder, steps):
    """A copy of a run as it was at its half."""
    there = folder.parent / f"{folder.name}-again"
    shutil.copytree(folder, there)
    shutil.rmtree(there / "checkpoints" / str(steps))
    assert (there / "checkpoints" / str(steps // 2)).exists()
    (there / "network.safetensors").unlink(missing_ok=True)
    return there


def same(a, b):
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_array_equal(x, y)


def distance(found, expected):
    return float(np.linalg.norm(found - expected, axis=-1).mean())


def whole(fitted, train, answers, rows):
    """What the network says of meshes, all of it."""
    opened = fitted.replace(network=fitted.network._replace(gate=jnp.ones(())))
    marks, vertices = train.read(rows)
    neutral = train.data.neutral[train.owner[rows]]
    return np.asarray(gpmm_residual.refine(opened, marks, answers[rows], neutral)), vertices


def test_the_network_learns_what_the_linear_answer_leaves_over(refined, train, base):
    _, fitted = refined
    answers = base.held_out(train)
    *_, (_, kept) = base.folds
    seen = np.setdiff1d(np.arange(train.count), kept)
    found, vertices = whole(fitted, train, answers, seen)
    assert distance(found, vertices) < 0.7 * distance(answers[seen], vertices)


def test_scale_is_measured_on_the_meshes_that_are_trained_on(refined, train, base):
    scale = refined[1].network.scale
    *_, (_, kept) = base.folds
    seen = np.setdiff1d(np.arange(train.count), kept)
    marks, vertices = train.read(seen)
    np.testing.assert_allclose(scale.face, train.data.neutral[train.subjects].mean(axis=0), atol=1e-4)
    np.testing.assert_allclose(scale.landmark_mean, marks.mean(axis=0), atol=1e-5)
    np.testing.assert_allclose(scale.landmark_std, (marks - marks.mean(axis=0)).std(), rtol=1e-4)
    np.testing.assert_allclose(scale.unit, np.sqrt(np.mean((vertices - base.held_out(train)[seen]) ** 2)), rtol=1e-3)


def test_the_gate_is_the_best_on_meshes_that_were_not_trained_on(refined, train, base):
    _, fitted = refined
    *_, (_, kept) = base.folds
    answers, rows = base.held_out(train), kept[::2]
    found, vertices = whole(fitted, train, answers, rows)
    errors = [distance(answers[rows] + g * (found - answers[rows]), vertices) for g in fit_residual.GATES]
    best = int(np.argmin(errors))
    expected = fit_residual.GATES[best] if errors[best] < fit_residual.MIN_RELATIVE_GAIN * errors[0] else 0.0
    assert float(fitted.network.gate) == expected > 0


def test_on_a_new_face_it_refines_the_linear_answer_and_with_a_closed_gate_is_that(refined, ball_store):
    _, fitted = refined
    neutral, marks, _ = of_split(ball_store, "test").person(1)
    linear_answer = np.asarray(linear.apply(gpmm.linear_map(fitted.base, neutral), marks))
    closed = fitted.replace(network=fitted.network._replace(gate=jnp.zeros(())))
    face = gpmm_residual.prepare(fitted, neutral)
    np.testing.assert_array_equal(gpmm_residual.apply(closed, face, marks), linear_answer)
    found = np.asarray(gpmm_residual.apply(fitted, face, marks))
    rest = np.broadcast_to(neutral, linear_answer.shape)
    expected = residual.apply(fitted.network, fitted.hierarchy, fitted.tables, marks, linear_answer, rest)
    np.testing.assert_allclose(found, expected, atol=1e-4)
    assert np.abs(found - linear_answer).max() > 1e-3


def test_a_resumed_run_equals_an_uninterrupted_one(refined, train, hierarchy, base):
    folder, fitted = refined
    same(fit_residual.fit(train, hierarchy, halfway(folder, PLAN.steps), plan=PLAN, base=base), fitted)


def test_a_finished_run_is_read_not_trained(refined, train, hierarchy, base, monkeypatch):
    folder, fitted = refined
    monkeypatch.setattr(loop, "run", None)
    same(fit_residual.fit(train, hierarchy, folder, plan=PLAN, base=base), fitted)


def test_a_folder_of_another_run_is_refused(refined, neural, train, hierarchy, base):
    for options in ({"seed": 1}, {"by": "labels"}, {"plan": PLAN._replace(soft=0.5)}):
        with pytest.raises(ValueError, match=f"a run with another {next(iter(options))}"):
            fit_residual.fit(train, hierarchy, refined[0], base=base, **{"plan": PLAN} | options)
    with pytest.raises(ValueError, match="a run with another meshes"):
        fit_residual.fit(train.thin(2), hierarchy, refined[0], plan=PLAN, base=base)
    for options in ({"seed": 1}, {"plan": NEURAL._replace(rate=1.0)}):
        with pytest.raises(ValueError, match=f"a run with another {next(iter(options))}"):
            fit_neural3dmm.fit(train, hierarchy, neural[0], **{"plan": NEURAL} | options)


def test_neural3dmm_learns_and_a_resumed_run_equals_an_uninterrupted_one(neural, train, hierarchy):
    folder, fitted = neural
    first, last = metric_logger.read(folder)
    assert last["error_mm"] < 0.8 * first["error_mm"]
    same(fit_neural3dmm.fit(train, hierarchy, halfway(folder, NEURAL.steps), plan=NEURAL), fitted)


def test_neural3dmms_scale_and_displacements(neural, train, ball_store):
    _, fitted = neural
    scale = fitted.params.scale
    faces = ball_store.neutral[train.subjects]
    marks, _ = train.read(np.arange(train.count))
    np.testing.assert_allclose(scale.face, faces.mean(axis=0), atol=1e-4)
    np.testing.assert_allclose(scale.face_std, np.sqrt(np.mean((faces - faces.mean(axis=0)) ** 2)), rtol=1e-4)
    np.testing.assert_allclose(scale.landmark_mean, marks.mean(axis=0), atol=1e-5)
    np.testing.assert_allclose(scale.landmark_std, (marks - marks.mean(axis=0)).std(), rtol=1e-4)
    neutral, marks, _ = of_split(ball_store, "test").person(1)
    found = fit_neural3dmm.apply(fitted, marks, neutral)
    assert len(marks) > fit_neural3dmm.BATCH
    for part in np.split(np.arange(len(marks)), [fit_neural3dmm.BATCH]):
        rest = np.broadcast_to(neutral, (len(part), *neutral.shape))
        positions = neural3dmm.apply(fitted.params, fitted.hierarchy, fitted.down, marks[part], rest)
        np.testing.assert_allclose(found[part], positions - neutral, atol=1e-3)
