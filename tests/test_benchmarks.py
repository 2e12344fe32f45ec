"""Benchmarks run on a tiny configuration, without their peers, and write what they promise."""

import json

import pytest

from benchmarks import _measure, lstm


def test_lstm(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(lstm, "torch", None)
    monkeypatch.setattr(lstm, "CHUNK", 3)
    monkeypatch.setattr(lstm, "SCAN", 2)
    monkeypatch.setattr(lstm.jax, "clear_caches", lambda: None)  # compiling twice is what takes the time
    config = lstm.Config(
        quick=True, whole=True, landmarks=(2,), batches=(2,), frames=6, hidden=4, networks=2, steps=6, square=16
    )
    _measure.report(lstm.run(config), tmp_path / "o" / "lstm.json")
    rows = json.loads((tmp_path / "o" / "lstm.json").read_text())["rows"]
    assert {(row["task"], row["side"]) for row in rows} == {
        ("product of 16", "facejax"),
        ("forward", "facejax"),
        ("gradient", "facejax"),
        ("training step", "facejax"),
        ("training step", "facejax, scanned"),
        ("step of 2", "facejax"),
        ("step of 2", "facejax, scanned"),
        ("step of 2", "facejax, one by one"),
        ("step of 2", "facejax, vmap"),
        ("follow", "facejax"),
        ("follow", "facejax, automatic"),
        ("follow, gradient", "facejax"),
        ("follow, gradient", "facejax, automatic"),
        ("6 steps", "facejax"),
    }
    assert all(row["median_ms"] >= row["min_ms"] > 0 and row["first_s"] > 0 for row in rows)
    printed = capsys.readouterr().out
    assert "[bench]" in printed and printed.count("\n| ") == 2 + len(rows)


def test_lstm_refuses_a_wrong_answer():
    lstm._check_equal({"a": [1.0, 2.0]}, {"a": [1.0, 2.0]})
    with pytest.raises(AssertionError):
        lstm._check_equal({"a": [1.0, 2.0]}, {"a": [1.0, 2.001]})


def test_lstm_counts_the_products():
    """A multiplication and an addition for every entry of every matrix."""
    config = lstm.Config(frames=3, hidden=40)
    entries = 4 * 40 * (6 + 40) + 2 * 4 * 40 * 80 + 40 * 6
    assert lstm._products(config, 6, 2) == pytest.approx(2e-9 * entries * 3 * 2)
