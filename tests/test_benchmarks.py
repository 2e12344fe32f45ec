"""Benchmarks run on a tiny configuration, without their peers, and write what they promise."""

import json

import jax
import jax.numpy as jnp
import pytest

from benchmarks import _measure, _transitions, lstm, motion
from facejax import fit_motion, motion_examples, training
from facejax.models import flow
from facejax.models import motion as gan


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


TINY = motion.Config(
    quick=True,
    gan=gan.Config(steps=5, landmarks=4, labels=3, noise=6, rank=8, pose=3, width=8, blocks=1, embedding=2),
    flow=flow.Config(width=8, blocks=1, embedding=2),
    gan_plan=fit_motion.GanPlan(steps=20, batch=6, critic_steps=2),
    flow_plan=fit_motion.FlowPlan(steps=20, batch=6),
    reference_batch=1,
    width_divisor=16,
    motions=60,
    samples=2,
    people=8,
    compared=12,
    transitions=300,
)


handed = motion.handed


def idle(fit, *args, **options):
    """What a fit hands over, but for its step: to compile those takes most of the time."""
    if fit is fit_motion.fit_reference:  # whose networks are large at any size
        state = training.TrainState(jnp.int32(0), (), (), jax.random.key(0))
        run = motion.Run(None, state, jnp.arange(2), ())
    else:
        run = handed(fit, *args, **options)
    return run._replace(step=lambda state, rows, held: (state, {}))


@pytest.mark.parametrize("whole", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_motion(tmp_path, monkeypatch, capsys, whole):
    monkeypatch.setattr(motion, "torch", None)
    monkeypatch.setattr(motion, "SCAN", 2)
    monkeypatch.setattr(motion, "handed", handed if whole else idle)
    monkeypatch.setattr(motion, "_apart", lambda options: _transitions.stream(**options))
    _measure.report(motion.run(TINY), tmp_path / "motion.json")
    rows = json.loads((tmp_path / "motion.json").read_text())["rows"]
    sides = [(row["task"], row["side"]) for row in rows if "per_s" in row]
    assert sides == [
        ("GAN step", "facejax"),
        ("GAN step", "facejax, scanned"),
        ("flow step", "facejax"),
        ("flow step", "facejax, scanned"),
        ("reference step", "facejax, width / 16"),
        ("2 motions", "GAN"),
        ("2 motions", "flow"),
        ("12 transitions", "facejax"),
        ("12 transitions", "decoded in full"),
        ("12 transitions", "NumPy"),
        ("20 transitions", "facejax, even, streamed"),
        ("20 transitions", "facejax, performed, streamed"),
    ]
    assert all(row["per_s"] > 0 and row["first_s"] > 0 for row in rows if "per_s" in row)
    assert all(row["memory_mb"] > 0 for row in rows if row["task"].endswith("step"))
    weights = {row["side"]: row["weights"] for row in rows if row["task"] == "weights"}
    # Labels, stem with its bias, one block, head, skip.
    assert weights["GAN, generator"] == 2 * 3 * 2 + 14 * 8 + 9 * 8 + 9 * 10 + 6 * 10
    assert "[bench]" in capsys.readouterr().out


@pytest.mark.parametrize(("name", "fit"), [("Gan", fit_motion.fit_gan), ("Flow", fit_motion.fit_flow)])
def test_motion_peer_takes_the_same_steps(name, fit):
    pytest.importorskip("torch")
    from benchmarks import _motion_torch

    sizes = {field: getattr(TINY.gan, field) for field in ("labels", "steps", "landmarks")}
    known = _transitions.made_up(TINY.motions, **sizes)
    chart = motion_examples.chart_of(known, labels=3, rank=8, pose=3)
    kind = name.lower()
    plan, config = getattr(TINY, f"{kind}_plan"), getattr(TINY, kind)
    run = motion.handed(fit, motion_examples.examples_of(chart, [known]), chart, plan=plan, config=config)
    program, _ = motion.compiled(run)
    peer = getattr(_motion_torch, name)
    _motion_torch.check(peer(run.state, run.held, plan), program, run.state, run.rows, run.held)
    with pytest.raises(AssertionError):
        wrong = peer(run.state, run.held, plan._replace(rate=2 * plan.rate))
        _motion_torch.check(wrong, program, run.state, run.rows, run.held)


def test_memory_of_torch_is_what_a_call_holds_at_once():
    torch = pytest.importorskip("torch")
    from benchmarks import _torch_memory

    a = torch.ones(1000, 250)  # one megabyte

    def two():
        b = a + 1
        c = b + 1
        del b
        return c + 1

    assert _torch_memory.peak_mb(two, [a, a.T]) == pytest.approx(3.0, rel=1e-3)
    assert _torch_memory.peak_mb(lambda: a + 1, [a]) == pytest.approx(2.0, rel=1e-3)
