"""Models of one's own, from a store to an animation; and datasets that nothing can be learnt from."""

import jax
import numpy as np
import pytest

from facejax.cli import main
from facejax.data import transitions
from facejax.evaluation import vertex_error
from facejax.inference import pipeline
from facejax.training.recipes import fit_bundle, fit_gpmm, fit_motion, fit_residual

PLANS = fit_bundle.Plans(fit_motion.FlowPlan(steps=2, batch=8), fit_residual.ResidualPlan(steps=2, batch=4))


@pytest.fixture(scope="module")
def few():
    """Few candidates for the prior, few motions."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(transitions, "SPREAD_PER_PAIR", 2)
        patch.setattr(transitions, "CHART_PER_PAIR", 2)
        patch.setattr(fit_gpmm, "FOLDS", 2)
        patch.setattr(fit_gpmm, "SMOOTHNESS_GRID", (0.12,))
        patch.setattr(fit_gpmm, "NOISE_GRID", (1e-2,))
        patch.setattr(fit_gpmm, "EVALUATED_PEOPLE", 1)
        yield


@pytest.fixture(scope="module")
def models(few, tiny_store, tmp_path_factory):
    return fit_bundle.fit(tiny_store, tmp_path_factory.mktemp("fit"), plans=PLANS)


def test_models_of_ones_own_generate_from_a_file(models, tiny_store, tmp_path):
    errors = vertex_error.model_errors(models, tiny_store)
    assert 0 < errors["head"] < errors["face"] < 0.3
    path = tmp_path / "own.safetensors"
    pipeline.save(path, models.replace(about=models.about | {"error_mm": errors}))
    read = pipeline.load(path)
    assert read.labels == tiny_store.labels and read.about["error_mm"] == errors
    neutral = np.asarray(tiny_store.neutral[5])
    for found in (read, models):
        marks = pipeline.landmarks(found, jax.random.key(0), ["neutral", "anger", "neutral"], neutral, frames=5)
        vertices = np.asarray(pipeline.meshes(found, marks, neutral))
        assert vertices.shape == (9, 3260, 3)
        np.testing.assert_allclose(vertices[-1], neutral, atol=0.2)
        # The mesh goes where the person's landmarks go.
        take = next(s for s in tiny_store.sequences if s.subject == 5 and s.label == "high_smile")
        marks = tiny_store.landmarks[take.start : take.start + take.frames]
        carried = np.asarray(pipeline.meshes(found, marks, neutral))[:, tiny_store.landmark_index]
        moved = np.linalg.norm(marks - neutral[tiny_store.landmark_index], axis=-1).mean()
        assert np.linalg.norm(carried - marks, axis=-1).mean() < 0.2 * moved
    assert path.stat().st_size < 25e6
    assert read.about["spec"]["level"] == 1 and read.about["data"] == "makehuman4d"


def test_few_motions_make_a_small_chart(tiny_store, tmp_path, monkeypatch):
    class Seen(Exception):
        pass

    def chart_of(known, *, labels, rank):
        raise Seen(len(known.start), labels, rank)

    monkeypatch.setattr(transitions, "fit_chart", chart_of)
    named = {label: tiny_store.labels.index(label) for label in ("neutral", "anger", "high_smile")}
    few = tiny_store._replace(
        index=tiny_store.index | {"labels": list(named)},
        sequences=tuple(s for s in tiny_store.sequences if s.label in named),
    )
    with pytest.raises(Seen) as seen:
        fit_bundle.fit(few, tmp_path)
    motions, labels, rank = seen.value.args
    assert labels == 3 and rank == motions // 4 < transitions.MAX_RANK
    with pytest.raises(Seen) as seen:
        fit_bundle.fit(tiny_store, tmp_path)
    assert seen.value.args[2] == transitions.MAX_RANK


def test_what_cannot_be_learnt_from_is_named(tiny_store):
    people = [person | {"split": "test" if i else "train"} for i, person in enumerate(tiny_store.index["subjects"])]
    with pytest.raises(ValueError, match="1 training subjects, expected 4 or more"):
        fit_bundle.check(tiny_store._replace(index=tiny_store.index | {"subjects": people}))
    without = tuple(s for s in tiny_store.sequences if s.label != "fear")
    with pytest.raises(ValueError, match="got 17, none of fear"):
        fit_bundle.check(tiny_store._replace(sequences=without))


def test_the_command_trains_and_says_what_it_made(few, tiny_store, tmp_path, monkeypatch, capsys):
    given = {}

    def fit(data, folder, *, plans, seed, device_mesh):
        assert device_mesh is None  # of one device
        given.update(data=data.path, folder=folder, plans=plans, seed=seed)
        return pipeline.load()

    monkeypatch.setattr(fit_bundle, "fit", fit)
    monkeypatch.setattr(vertex_error, "model_errors", lambda models, data: {"head": 0.0123, "face": 0.0456})
    out = tmp_path / "new" / "m.safetensors"
    main.main(["fit", "--data", str(tiny_store.path), "--out", str(out), "--quick", "--seed", "3"])
    assert "0.012 mm over the mesh, 0.046 mm over the face" in capsys.readouterr().out
    assert (
        given["seed"] == 3 and given["folder"] == out.with_suffix(".training") and given["plans"].residual.steps == 50
    )
    assert pipeline.load(out).about["error_mm"] == {"head": 0.0123, "face": 0.0456}
    for bad, said in (
        (["--data", str(tmp_path / "no")], "index.json cannot be read"),
        (["--out", "m.bin"], ".safetensors"),
    ):
        words = {"--data": str(tiny_store.path), "--out": str(out)} | dict([bad])
        with pytest.raises(SystemExit) as stopped:
            main.main(["fit", *[word for pair in words.items() for word in pair]])
        assert stopped.value.code == 2 and said in capsys.readouterr().err
