"""Every experiment runs on a tiny configuration, and writes what it promises."""

import json

import pytest

from experiments import (
    classification,
    dataset_card,
    expression_lstm,
    motion_quality,
    pretrain,
    rbf_warp,
    unseen_subjects,
)
from facejax import evaluation, expressions

TINY = {"subjects": 6, "meshes": 260}


@pytest.fixture
def own_cache(tmp_path, monkeypatch):
    """Tiny datasets must not land in the user's cache; the assets are already loaded."""
    from facejax.data import assets

    assets.load()
    # The choice of the linear maps' one weight is what takes the time; two candidates show that it works.
    monkeypatch.setattr(evaluation, "ALPHAS", (1e-6, 1e-2))
    monkeypatch.setattr(evaluation, "FOLDS", 2)
    monkeypatch.setenv("FACEJAX_CACHE", str(tmp_path / "cache"))


def check(out, *fields):
    metrics = json.loads((out / "metrics.json").read_text())
    assert set(fields) <= set(metrics)
    assert {"command", "commit", "machine", "seed", "seconds", "dataset"} <= set(metrics["made"])
    assert (out / "config.json").exists() and "|" in (out / "table.md").read_text()
    return metrics


def test_dataset_card(own_cache, tmp_path):
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


def test_pretrain(own_cache, tmp_path):
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
    assert expression_lstm.chosen(table) == "ours"
    assert expression_lstm.chosen(table | {"ours, head kept": rows(0.1, 1.0)}) == "ours"
    assert expression_lstm.chosen({"truth": rows(0.5, 1.2), "coin": rows(0.6, 1.1)}) == "truth"


def test_rbf_warp(own_cache, tmp_path):
    rbf_warp.run(rbf_warp.Config(out=tmp_path / "o", level=1, frames=10, quick=True, **TINY))
    metrics = check(tmp_path / "o", "chosen", "still", "test", "validation", "per_frame", "remeshed")
    errors = {(r["kernel"], r["affine"], r["lips"]): r["error_mm"]["face"] for r in metrics["test"] if r["falloff"]}
    assert max(errors.values()) < metrics["still"]["face"]
    assert metrics["remeshed"]["head_mm"] < 2 * metrics["remeshed"]["original_head_mm"]
    assert {p.name for p in (tmp_path / "o").glob("*.png")} == {
        "rbf_warp.png", "heat.png", "sequence.png", "faces.png",
    }  # fmt: skip


@pytest.mark.slow
def test_classification(tmp_path):
    classification.run(classification.Config(out=tmp_path / "o", samples=2, trees=20))
    metrics = check(tmp_path / "o", "accuracy_generated", "accuracy_real", "accuracy_direct")
    assert metrics["accuracy_real"] > 0.9


@pytest.mark.slow
def test_motion_quality(tmp_path):
    motion_quality.run(motion_quality.Config(out=tmp_path / "o", samples=4))
    check(tmp_path / "o", "amplitude_ratio", "acceleration_ratio", "diversity_ratio")
