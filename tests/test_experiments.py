"""Every experiment runs on a tiny configuration, and writes what it promises."""

import json

import numpy as np
import pytest

from experiments import (
    _datasets,
    _interpolation_eval,
    classification,
    composed,
    dataset_card,
    expression_lstm,
    generators,
    interpolation,
    motion_quality,
    pretrain,
    rbf_warp,
    specificity,
    unseen_subjects,
)
from facejax import augment
from facejax.data import motions, transitions
from facejax.data.synthetic import makehuman4d
from facejax.inference import expressions
from facejax.training.recipes import fit_gpmm, fit_linear

TINY = {"subjects": 6, "meshes": 260}


@pytest.fixture
def own_cache(tmp_path, monkeypatch):
    """Tiny datasets must not land in the user's cache; the assets are already loaded."""
    from facejax.data.synthetic import assets

    assets.load()
    # The choice of the linear maps' one weight is what takes the time; two candidates show that it works.
    monkeypatch.setattr(fit_linear, "ALPHAS", (1e-6, 1e-2))
    monkeypatch.setattr(fit_linear, "FOLDS", 2)
    monkeypatch.setenv("FACEJAX_CACHE", str(tmp_path / "cache"))


def check(out, *fields):
    metrics = json.loads((out / "metrics.json").read_text())
    assert set(fields) <= set(metrics)
    assert {"command", "commit", "machine", "seed", "seconds", "dataset"} <= set(metrics["made"])
    assert (out / "config.json").exists() and "|" in (out / "table.md").read_text()
    return metrics


def test_dataset_card(own_cache, tmp_path, monkeypatch):
    monkeypatch.setattr(_datasets, "FOLDS", 2)
    dataset_card.run(dataset_card.Config(out=tmp_path / "o", levels=(0,), **TINY))
    metrics = check(tmp_path / "o", "levels", "speed_mm_per_s")
    errors = metrics["levels"]["0"]["error_mm"]["subjects"]
    assert errors["ridge"]["head"] < 0.1 * metrics["levels"]["0"]["motion_mm"]["head"]
    assert {p.name for p in (tmp_path / "o").glob("*.png")} == {"dataset_card.png", "expressions.png", "levels.png"}


def test_unseen_subjects(own_cache, tmp_path):
    unseen_subjects.run(unseen_subjects.Config(out=tmp_path / "o", levels=(1,), steps=3, **TINY))
    rows = check(tmp_path / "o", "rows")["rows"]
    assert {(r["method"], r["region"]) for r in rows} == {
        (m, r) for m in ("ridge", "pca220", "s2d") for r in ("head", "face")
    }
    assert all(r["mean_mm"] > 0 for r in rows)


def test_pretrain(own_cache, tmp_path, monkeypatch):
    monkeypatch.setattr(transitions, "SPREAD_PER_PAIR", 2)
    monkeypatch.setattr(transitions, "CHART_PER_PAIR", 2)
    monkeypatch.setattr(fit_gpmm, "FOLDS", 2)
    monkeypatch.setattr(fit_gpmm, "SMOOTHNESS_GRID", (0.12,))
    monkeypatch.setattr(fit_gpmm, "NOISE_GRID", (1e-2,))
    config = pretrain.Config(out=tmp_path / "o", level=1, motion_steps=2, decoder_steps=2, **TINY)
    pretrain.run(config)
    metrics = check(tmp_path / "o", "error_mm", "seconds")
    assert metrics["error_mm"]["face"] > 0
    assert (tmp_path / "o" / "makehuman4d.safetensors").stat().st_size < 25e6


def test_expression_lstm(own_cache, tmp_path):
    variants = ("truth", "ours")
    config = expression_lstm.Config(out=tmp_path / "o", level=1, steps=2, variants=variants, **TINY)
    expression_lstm.run(config)
    metrics = check(tmp_path / "o", "chosen", "choice", "test", "train_seconds")
    assert set(metrics["choice"]) == set(variants) and metrics["chosen"] in variants
    assert all(row["whole_network"] > 0 for row in metrics["test"].values()) and len(metrics["test"]) == 6
    networks = expressions.load(tmp_path / "o" / "expressions.safetensors")
    assert networks.about["variant"] == metrics["chosen"]
    assert {p.name for p in (tmp_path / "o").glob("*.png")} == {"expression_lstm.png", "sheet.png"}


def test_the_choice_keeps_to_the_bounds_first():
    def rows(rest, whole, energy=1.0):
        row = {"next_network": 1, "next_velocity": 2, "next_mean": 2, "rest_velocity": 9, "rest_mean": 1}
        row |= {"rest_mean_steps": 2, "whole_mean": 1, "acceleration": 1.0}
        return {"anger": row | {"rest_network": rest, "whole_network": whole, "energy": energy}}

    table = {"truth": rows(0.5, 1.2), "ours": rows(0.7, 1.01), "coin": rows(0.6, 1.0, energy=0.7)}
    assert expression_lstm.choose(table) == "ours"
    assert expression_lstm.choose(table | {"ours, head kept": rows(0.1, 1.0)}) == "ours"
    assert expression_lstm.choose({"truth": rows(0.5, 1.2), "coin": rows(0.6, 1.1)}) == "truth"


def test_rbf_warp(own_cache, tmp_path):
    rbf_warp.run(rbf_warp.Config(out=tmp_path / "o", level=1, frames=10, quick=True, **TINY))
    metrics = check(tmp_path / "o", "chosen", "still", "test", "validation", "per_frame", "remeshed")
    errors = {(r["kernel"], r["affine"], r["lips"]): r["error_mm"]["face"] for r in metrics["test"] if r["falloff"]}
    assert max(errors.values()) < metrics["still"]["face"]
    assert metrics["remeshed"]["head_mm"] < 2 * metrics["remeshed"]["original_head_mm"]
    assert {p.name for p in (tmp_path / "o").glob("*.png")} == {
        "rbf_warp.png", "heat.png", "sequence.png", "faces.png",
    }  # fmt: skip


PEOPLE = {"level": 1, "people": 6, **TINY}


def test_generators(own_cache, tmp_path, monkeypatch):
    monkeypatch.setattr(transitions, "SPREAD_PER_PAIR", 2)
    monkeypatch.setattr(transitions, "CHART_PER_PAIR", 2)
    config = generators.Config(out=tmp_path / "o", variants=("gaussian", "flow"), seeds=(0, 1), flow_steps=2, **PEOPLE)
    generators.run(config)
    metrics = check(tmp_path / "o", "chosen", "validation", "real", "per_seed")
    assert metrics["chosen"] in ("gaussian", "flow")
    assert [metrics["validation"][name]["seeds"] for name in ("gaussian", "flow")] == [1, 2]
    before = (tmp_path / "o" / "flow-1.safetensors").stat().st_mtime_ns
    generators.run(config)  # nothing is trained again
    assert (tmp_path / "o" / "flow-1.safetensors").stat().st_mtime_ns == before
    with pytest.raises(ValueError, match='--variants: unknown "diffusion"; there are "gaussian", "flow"'):
        generators.run(generators.Config(out=tmp_path / "o", variants=("diffusion",)))


def test_the_generator_is_chosen_within_the_bounds_of_real_people():
    real = {"accuracy": 0.99}
    row = {"accuracy": 0.98, "specificity_all_mm": 1.0, "real_all_mm": 1.0, "diversity_ratio": 1.0}
    row |= {"acceleration_ratio": 1.0, "energy": 0.2}
    table = {"flow": row, "gan": row | {"energy": 0.1, "diversity_ratio": 0.7}, "gaussian": row | {"energy": 0.3}}
    assert generators.choose(table, real) == "flow"
    assert generators.choose({"gan": table["gan"]}, real) == "gan"
    for broken in ({"accuracy": 0.95}, {"specificity_all_mm": 1.2}, {"acceleration_ratio": 1.4}):
        assert not generators.within_bounds(row | broken, real)


def test_specificity(own_cache, tmp_path):
    specificity.run(specificity.Config(out=tmp_path / "o", samples=4, **PEOPLE))
    metrics = check(tmp_path / "o", "specificity_mm", "specificity_real_mm", "diversity_ratio", "acceleration_ratio")
    assert len(metrics["per_transition"]) == 39 and metrics["people"] == 7
    assert all(row["specificity_mm"] > 0 for row in metrics["per_transition"].values())


def test_classification(own_cache, tmp_path):
    classification.run(classification.Config(out=tmp_path / "o", samples=2, trees=10, **PEOPLE))
    metrics = check(tmp_path / "o", "accuracy_generated", "accuracy_real", "accuracy_unselected", "accuracy_direct")
    assert len(metrics["per_transition"]) == 39
    assert metrics["accuracy_real"] > 0.5 and metrics["accuracy_generated"] > 0.5


def test_composed(own_cache, tmp_path):
    composed.run(composed.Config(out=tmp_path / "o", samples=2, chains=1, **PEOPLE))
    metrics = check(tmp_path / "o", "davies_ratio", "from_neutral_at_the_end_mm", "joint_acceleration_ratio")
    assert metrics["from_neutral_at_the_end_mm"] < 1e-4 and metrics["gap_mm"] < 1e-4
    assert metrics["joint_acceleration_ratio"] < 0.01 < metrics["joint_acceleration_ratio_unmatched"]
    assert [len(curve) for curve in metrics["error_per_frame_mm"].values()] == [88] * 5
    assert {p.name for p in (tmp_path / "o").glob("*.png")} == {"composed.png", "chain.png"}


def test_interpolation(own_cache, tmp_path):
    config = interpolation.Config(out=tmp_path / "o", level=0, per_expression=2, people=1, trees=10, **TINY)
    interpolation.run(config)
    metrics = check(tmp_path / "o", "onsets", "peaks", "recognition", "transitions")
    rows = metrics["onsets"]["two expressions"]
    assert rows["sphere"]["length_ratio"] == pytest.approx(1, abs=1e-4) and rows["linear"]["length_ratio"] < 1
    ways = metrics["peaks"]["ways"]
    assert ways["linear, even"]["detour"] == pytest.approx(1, abs=1e-4)
    assert ways["linear, even"]["acceleration_ratio"] < 1e-3
    assert ways["sphere, performed"]["speed_rms"] < ways["sphere, even"]["speed_rms"]
    assert set(metrics["recognition"]) == set(ways) and metrics["transitions"] == 66
    assert {p.name for p in (tmp_path / "o").glob("*.png")} == {"interpolation.png", "sheet.png"}


def test_walks_are_those_of_the_library_and_takes_those_of_the_dataset(own_cache):
    data = makehuman4d.prepare(makehuman4d.Spec(0, **TINY))
    halves = _interpolation_eval.read_splits(data, ("train",))
    onsets = _interpolation_eval.onsets_only(halves)
    for pace in ("even", "performed"):
        (theirs,) = motions.interpolated_transitions(
            onsets, len(data.labels), per_pair=1, choice="spread", time_warp=pace
        )
        pairs = augment.balanced_pairs(onsets.end - 1, classes=len(data.labels) - 1, per_pair=1)
        mine = _interpolation_eval.peak_transitions(
            *(onsets.curves[side] for side in pairs.T), path="sphere", pace=pace
        )
        np.testing.assert_allclose(mine.curves, theirs.curves, atol=1e-6)
    direct = motions.direct_transitions(data, "test").take(np.arange(3))
    np.testing.assert_allclose(_interpolation_eval.perform_again(data, direct, take=0).curves, direct.curves, atol=1e-6)


@pytest.mark.slow
def test_motion_quality(tmp_path):
    motion_quality.run(motion_quality.Config(out=tmp_path / "o", samples=4))
    check(tmp_path / "o", "amplitude_ratio", "acceleration_ratio", "diversity_ratio")
