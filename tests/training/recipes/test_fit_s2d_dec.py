"""Training composed, on a tiny dataset and for a few steps: it runs, learns, resumes, and feeds the pipeline."""

import jax
import numpy as np
import pytest

from facejax.data.mesh_subset import of_split
from facejax.data.synthetic import makehuman
from facejax.evaluation import vertex_error
from facejax.mesh import hierarchy as mesh_hierarchy
from facejax.models.decoders import linear, s2d_dec
from facejax.training.recipes import fit_linear, fit_s2d_dec


@pytest.fixture(scope="module")
def hierarchy(template):
    return mesh_hierarchy.build(template.vertices, template.faces)


@pytest.fixture(scope="module")
def regions():
    mask = makehuman.template().face_mask
    return {"head": np.ones_like(mask), "face": mask}


def test_meshes_batch_select_and_fold(tiny_store):
    train = of_split(tiny_store, "train", size=7)
    sizes = [len(marks) for marks, _ in train]
    assert sum(sizes) == train.count and max(sizes) == 7
    marks, vertices = train.read(np.array([0, 3]))
    np.testing.assert_array_equal(vertices[:, tiny_store.landmark_index], marks)
    some = train.of_labels(["anger", "fear"])
    assert some.count + train.of_labels(["anger", "fear"], without=True).count == train.count
    for fit_on, held_out in train.folds(2):
        assert not set(fit_on.owner) & set(held_out.owner)
        assert fit_on.count + held_out.count == train.count


def test_decoder_learns_and_a_resumed_run_equals_an_uninterrupted_one(tiny_store, hierarchy, regions, tmp_path):
    train = of_split(tiny_store, "train")
    plan = fit_s2d_dec.S2DDecPlan(steps=60, batch=8, rate=2e-3)
    whole = fit_s2d_dec.fit(train, hierarchy, tmp_path / "whole", plan=plan)
    again = fit_s2d_dec.fit(train, hierarchy, tmp_path / "whole", plan=plan)
    for a, b in zip(jax.tree.leaves(whole), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(a, b)

    def mean(params):
        found = vertex_error.vertex_errors(lambda m: s2d_dec.apply(params, hierarchy, m), train, regions)
        return found["face"]["mean_mm"]

    with pytest.raises(ValueError, match="a run with another plan, seed"):
        fit_s2d_dec.fit(train, hierarchy, tmp_path / "whole", plan=plan._replace(steps=50), seed=1)
    untrained = s2d_dec.init(jax.random.key(0), hierarchy, scale=whole.scale)
    assert mean(whole) < 0.85 * mean(untrained)


def test_vertex_errors_are_those_of_the_plain_loop(tiny_store, regions):
    test = of_split(tiny_store, "test", size=3)
    shift = np.array([0.3, -0.4, 0.0])
    found = vertex_error.vertex_errors(lambda marks: np.concatenate([v for _, v in test])[: len(marks)], test, regions)
    batches = [v for _, v in test]
    first = np.concatenate(batches)
    distance = np.concatenate([np.linalg.norm(first[: len(b)] - b, axis=-1) for b in batches])
    for name, mask in regions.items():
        assert found[name]["mean_mm"] == pytest.approx(distance[:, mask].mean(), rel=1e-6)
        assert found[name]["std_mm"] == pytest.approx(distance[:, mask].std(), rel=1e-5)
    truth = iter([v for _, v in test])
    moved = vertex_error.vertex_errors(lambda marks: next(truth) + shift, test, regions)
    assert moved["head"]["mean_mm"] == pytest.approx(0.5, rel=1e-5)


def test_ridge_beats_no_motion_on_unseen_people(tiny_store, regions):
    train, test = of_split(tiny_store, "train"), of_split(tiny_store, "test")
    params, alpha = fit_linear.fit_linear(linear.ridge, train)
    assert alpha in fit_linear.ALPHAS
    mean = vertex_error.vertex_errors(lambda m: linear.apply(params, m), test, regions)["head"]["mean_mm"]
    still = vertex_error.vertex_errors(lambda m: np.zeros((len(m), 3260, 3)), test, regions)["head"]["mean_mm"]
    assert mean < 0.5 * still
