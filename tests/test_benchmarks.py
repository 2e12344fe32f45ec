"""Benchmarks run on a tiny configuration, without their peers, and write what they promise."""

import json
import threading
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest

from benchmarks import (
    __main__,
    _compare,
    _equal,
    _headline,
    _machine,
    _measure,
    _roofline,
    _sizes,
    _timing,
    _torch,
    _transitions,
    _work,
    augment,
    data,
    decoder,
    linear,
    lstm,
    motion,
    pipeline,
    rbf,
    scale,
    srvf,
)
from facejax.data import transitions
from facejax.evaluation import run_record
from facejax.models.decoders import s2d_dec as s2d
from facejax.models.motion import flow_matching
from facejax.models.motion import motion3dgan as gan
from facejax.training import loop
from facejax.training.recipes import fit_motion


@pytest.fixture(autouse=True)
def brief(monkeypatch):
    """No rests, no turns, no second compilation, no peer, a roofline of one: what is tested is not how fast it is."""
    monkeypatch.setattr(_timing, "REST", 0.0)
    monkeypatch.setattr(_timing, "TURN", 0.0)
    monkeypatch.setattr(_measure.jax, "clear_caches", lambda: None)
    monkeypatch.setattr(_torch, "torch", None)
    monkeypatch.setattr(_roofline, "measured", lambda: _roofline.Roofline(1.0, 1.0))


def checked(found):
    """Rows by name, each with all that is promised."""
    rows, sizes = found
    for row in rows:
        assert row["median_s"] >= row["min_s"] > 0 and row["first_s"] > 0 and row["per_s"] > 0, row
        assert row["sides"]["facejax"]["median_s"] == row["median_s"]
        assert (row["peer"] is None) == (row["peer_median_s"] is None) == (row["ratio"] is None)
    assert all(row["size"] > 0 and row["median_s"] > 0 for row in sizes)
    json.dumps({"rows": rows, "sizes": sizes})
    return {row["name"]: row for row in rows}, {name for _, name in _sizes.curves(sizes)}


# How it is measured.


def test_functions_are_timed_in_turns():
    calls = []
    found = _timing.interleaved({name: lambda name=name: calls.append(name) for name in "ab"}, repeats=3)
    assert calls == list("abababab")  # the first calls stand apart
    assert set(found["a"]) == {"first_s", "min_s", "median_s"}


def test_short_work_is_repeated_within_its_turn(monkeypatch):
    monkeypatch.setattr(_timing, "TURN", 0.01)
    calls = []
    found = _timing.interleaved({"a": lambda: calls.append(0)}, repeats=1)
    assert len(calls) > 100 and found["a"]["median_s"] < 1e-3


def test_a_turn_waits_for_the_threads_of_the_one_before(monkeypatch):
    def spin(seconds):
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            pass

    monkeypatch.setattr(_timing, "REST", 0.01)
    thread = threading.Thread(target=spin, args=(0.2,))
    thread.start()
    _timing.settle()
    assert not thread.is_alive()
    monkeypatch.setattr(_timing, "PATIENCE", 0.05)
    thread = threading.Thread(target=spin, args=(1.0,))
    thread.start()
    _timing.settle()
    assert thread.is_alive()


def test_operations_are_those_of_the_matrix_products():
    a, b = jnp.ones((3, 5)), jnp.ones((5, 7))
    slope = jax.grad(lambda a, b: jnp.sum(jnp.square(jax.jit(jnp.matmul)(a, b))), argnums=(0, 1))
    repeated = lambda a, b: jax.lax.scan(lambda state, _: (state + a @ b, 0), jnp.zeros((3, 7)), length=4)  # noqa: E731
    each = 2e-9 * 3 * 5 * 7
    assert [_work.products(f, a, b) for f in (jnp.matmul, slope, repeated)] == pytest.approx([each, 3 * each, 4 * each])


def test_a_row_names_the_fastest_peer(monkeypatch):
    seconds = {"facejax": 2.0, "other": 0.1, "slow": 9.0, "fast": 6.0}
    times = {side: {"first_s": 1.0, "min_s": t, "median_s": t} for side, t in seconds.items()}
    monkeypatch.setattr(_timing, "interleaved", lambda functions, repeats: times)
    row = _measure.row(
        "work", dict.fromkeys(seconds, lambda: None), peers=["slow", "fast"], calls={"facejax": 2}, items=8, gflop=0.5
    )
    assert (row["peer"], row["peer_median_s"], row["median_s"], row["ratio"]) == ("fast", 6.0, 1.0, 6.0)
    assert (row["per_s"], row["roofline_share"]) == (8.0, 0.5)
    assert "`work`" in _measure.table([row]) and "fast: 6 s | 6.00x | 50%" in _measure.table([row])


def test_the_roofline_is_the_slower_of_its_two_limits(monkeypatch):
    monkeypatch.setattr(_roofline, "measured", lambda: _roofline.Roofline(100.0, 10.0))
    assert _roofline.share(2.0, gflop=100.0, gbyte=None) == pytest.approx(0.5)
    assert _roofline.share(2.0, gflop=100.0, gbyte=15.0) == pytest.approx(0.75)
    assert _roofline.share(2.0, gflop=None, gbyte=None) is None


def test_the_roofline_is_measured(monkeypatch):
    monkeypatch.undo()
    monkeypatch.setattr(_roofline, "SQUARE", 64)
    monkeypatch.setattr(_roofline, "ENTRIES", 1 << 12)
    assert all(limit > 0 for limit in _roofline.measured.__wrapped__())


def test_a_wrong_answer_is_refused():
    _equal.check({"a": [1.0, 2.0]}, {"a": [1.0, 2.0]})
    with pytest.raises(AssertionError):
        _equal.check({"a": [1.0, 2.0]}, {"a": [1.0, 2.001]})


def test_the_command_writes_rows_sizes_and_the_machine(tmp_path, monkeypatch, capsys):
    row = _measure.lone("work", {"first_s": 3.0, "min_s": 1.0, "median_s": 2.0}, unit="meshes", memory_mb=12.0)
    sizes = [{"name": "work", "axis": "batch", "size": n, "first_s": 1.0, "min_s": n, "median_s": n} for n in (1, 10)]
    run = lambda config: ([row], [] if config.quick else sizes)  # noqa: E731
    run.__module__ = __name__
    monkeypatch.setattr(_measure.runtime, "keep_memory", lambda: True)
    monkeypatch.setattr("sys.argv", ["work", "--json", str(tmp_path / "deep" / "work.json")])
    _measure.main("work", _measure.Options, run)
    written = json.loads((tmp_path / "deep" / "work.json").read_text())
    assert written["rows"] == [row] and written["sizes"] == sizes and written["benchmark"] == "work"
    assert {"processor", "cores", "versions", "roofline", "peak_memory_mb", "commit"} <= set(written["machine"])
    assert written["machine"]["cores"] == run_record.usable_cores()
    assert "batch^1.00" in capsys.readouterr().out


def test_the_command_refuses_in_one_line(tmp_path, monkeypatch, capsys):
    def run(config):
        raise ValueError("no such\nthing")

    monkeypatch.setattr(_measure.runtime, "keep_memory", lambda: True)
    monkeypatch.setattr("sys.argv", ["work", "--json", str(tmp_path / "work.json")])
    with pytest.raises(SystemExit) as left:
        _measure.main("work", _measure.Options, run)
    assert left.value.code == 2 and capsys.readouterr().err == "benchmarks.work: no such thing\n"
    assert not list(tmp_path.iterdir())


def test_exponents_of_powers(tmp_path):
    rows = [
        {"name": name, "axis": "frames", "size": n, "median_s": 1e-6 + 1e-6 * n**power}
        for name, power in (("a", 1), ("b", 2))
        for n in (10, 100, 1000, 10_000)
    ]
    found = {name: _sizes.exponent(curve) for (_, name), curve in _sizes.curves(rows).items()}
    assert found["a"] == pytest.approx(0.98, abs=0.05) and found["b"] == pytest.approx(2, abs=0.01)
    _sizes.plot(rows, tmp_path / "sizes.png")
    assert (tmp_path / "sizes.png").stat().st_size > 1000


# The baseline.


def ratio(name, value):
    return {"name": name, "ratio": value}


def test_a_baseline_tolerates_what_its_runs_differed_by():
    runs = [
        [ratio("steady", 4.0), ratio("noisy", 1.0), ratio("alone", None)],
        [ratio("steady", 4.0), ratio("noisy", 1.2)],
    ]
    found = _compare.baseline(runs)
    assert found["steady"] == {"ratio": 4.0, "tolerance": _compare.MIN_TOLERANCE, "runs": 2}
    assert found["noisy"]["tolerance"] == pytest.approx(1.5 * 0.2 / 1.1, abs=1e-3) and set(found) == {"steady", "noisy"}
    now = [ratio("steady", 3.3), ratio("noisy", 0.9), ratio("new", 2.0), ratio("alone", None)]
    assert _compare.slower(now, found) == ["steady"]
    table = _compare.table(now, found)
    assert "| `steady` | 3.30 | 4.00 | -18% | -15% | slower |" in table and "| `new` | 2.00 | | | | new |" in table


def test_compare_ends_with_the_verdict(tmp_path, capsys):
    known = tmp_path / "baseline.json"
    _measure.write(known, {"rows": {"work": {"ratio": 2.0, "tolerance": 0.2}}})
    for value, code in ((1.9, 0), (1.5, 1)):
        path = tmp_path / f"{value}.json"
        _measure.write(path, {"rows": [ratio("work", value)]})
        assert __main__.main(["compare", str(path), "--baseline", str(known)]) == code
    assert "slower than baseline.json tolerates: work" in capsys.readouterr().out
    (tmp_path / "broken.json").write_text("{}")
    assert __main__.main(["compare", str(tmp_path / "broken.json"), "--baseline", str(known)]) == 2
    assert __main__.main(["compare", "--baseline", str(tmp_path / "broken.json")]) == 2
    assert capsys.readouterr().err.count("\n") == 2


def test_all_benchmarks_run_in_processes_of_their_own(tmp_path, monkeypatch, capsys):
    row = _measure.lone("work", {"first_s": 3.0, "min_s": 1.0, "median_s": 2.0}) | {
        "ratio": 2.0,
        "peer": "a",
        "peer_median_s": 4.0,
    }
    sizes = [{"name": "work", "axis": "batch", "size": n, "median_s": n} for n in (1, 10)]
    started = []

    def start(command, **options):
        started.append(command[2])
        about = _machine.about()
        _measure.write(Path(command[4]), {"rows": [row], "sizes": sizes, "seconds": 60.0, "machine": about})
        return type("Done", (), {"returncode": 0})

    monkeypatch.setattr(__main__.subprocess, "run", start)
    monkeypatch.setattr(run_record, "commit", lambda folder: "abc")
    monkeypatch.setattr(__main__, "RESULTS", tmp_path / "results")
    monkeypatch.setattr(_compare, "BASELINE", tmp_path / "baseline.json")
    assert __main__.main(["--out", str(tmp_path / "out"), "--publish", "--runs", "2"]) == 0
    assert started == 2 * [f"benchmarks.{name}" for name in __main__.NAMES]
    assert "commit abc" in (tmp_path / "results" / "cpu.md").read_text()
    assert (tmp_path / "results" / "cpu_sizes.png").exists() and (tmp_path / "out" / "sizes.png").exists()
    assert _compare.read(tmp_path / "baseline.json")["rows"]["work"]["runs"] == 2 * len(__main__.NAMES)
    assert __main__.main(["--publish", "--quick"]) == 2 and __main__.main(["--only", "nothing"]) == 2
    assert capsys.readouterr().err.count("benchmarks: ") == 2


def test_the_committed_baseline_and_results_are_whole():
    known = _compare.read(_compare.BASELINE)["rows"]
    rows = [
        row for part in json.loads((__main__.RESULTS / "cpu.json").read_text())["benchmarks"] for row in part["rows"]
    ]
    assert {row["name"] for row in rows if row["ratio"] is not None} == set(known)
    assert {"s2d_forward_b16", "s2d_forward_b1", "s2d_train_step_b16"} <= set(known)
    assert _measure.table(rows) in (__main__.RESULTS / "cpu.md").read_text()


def test_the_headline_is_that_of_the_record_and_shown_whole():
    """docs/benchmarks.md includes the tables of benchmarks/results; the README quotes rows (`test_readme`)."""
    page = (__main__.ROOT / "docs" / "benchmarks.md").read_text()
    for name in ("cpu_headline", "cpu", "h200_headline", "h200"):
        assert f'--8<-- "benchmarks/results/{name}.md"' in page
    parts = json.loads((__main__.RESULTS / "cpu.json").read_text())["benchmarks"]
    rows = [row for part in parts for row in part["rows"]]
    assert _headline.table(rows) == (__main__.RESULTS / "cpu_headline.md").read_text().strip()


# Each stage.


def test_decoder(monkeypatch):
    lone = _measure.lone("s2d_training_20000_meshes", {"first_s": 1.0, "min_s": 1.0, "median_s": 1.0})
    monkeypatch.setattr(decoder, "_training", lambda: lone)
    monkeypatch.setattr(decoder, "SCAN", 2)
    rows, curves = checked(decoder.run(decoder.Config(side=14, batch=2, vertices=(196,), batches=(1, 2))))
    tasks = ("forward", "gradient", "train_step")
    assert set(rows) == {
        "s2d_training_20000_meshes",
        "s2d_forward_b1",
        "s2d_gradient_b1",
        *(f"s2d_{x}_b2" for x in tasks),
    }
    assert set(rows["s2d_train_step_b2"]["sides"]) == {"facejax", "single"}
    assert curves == {"s2d_forward_b1", "s2d_forward"}


def test_decoder_counts_the_products():
    """Of every vertex of every level: its whole spiral times the kernel."""
    given = decoder.problem(14, 1)
    sizes, lengths = given.hierarchy.sizes, [spirals.shape[1] for spirals in given.hierarchy.spirals]
    total = 204 * 128 * sizes[4]
    for level, inward, outward in ((3, 128, 64), (2, 64, 32), (1, 32, 32), (0, 32, 16), (0, 16, 3)):
        total += sizes[level] * lengths[level] * inward * outward
    assert decoder.gflop(given.hierarchy, batch=3) == pytest.approx(3 * 2e-9 * total)


@pytest.mark.parametrize("way", ["rows", "sparse", "sums"])
def test_decoder_peer_takes_the_same_steps(monkeypatch, way):
    monkeypatch.setattr(_torch, "torch", pytest.importorskip("torch"))
    from benchmarks import _decoder_torch

    given = decoder.problem(14, 2)
    peer = _decoder_torch.Peer(given.params, given.hierarchy, **decoder.PLAN)
    marks, target, weights = decoder._data(given, 3)
    forward = peer.forward(way)
    _equal.check(s2d.apply(*given[:3]), peer.inference(forward, marks)())
    step, state = decoder.training_step(given)
    ours, theirs = decoder.stepped(step, state, given), peer.step(forward, marks, target, weights)
    for _ in range(3):
        _equal.check(ours()["loss"], theirs())


def test_lstm(monkeypatch):
    monkeypatch.setattr(lstm, "SCAN", 2)
    config = lstm.Config(quick=True, landmarks=2, batches=(2,), frames=6, hidden=4, networks=2)
    rows, _ = checked(lstm.run(config))
    assert set(rows) == {
        *(f"lstm_{task}_b2" for task in ("forward", "gradient", "train_step")),
        "lstm_train_step_x2_b2",
        "lstm_follow_b2",
        "lstm_follow_gradient_b2",
    }
    assert set(rows["lstm_train_step_x2_b2"]["sides"]) == {"facejax", "single", "one by one", "vmap"}


def test_lstm_counts_the_products():
    """A multiplication and an addition for every entry of every matrix."""
    config = lstm.Config(landmarks=2, frames=3, hidden=40)
    entries = 4 * 40 * (6 + 40) + 2 * 4 * 40 * 80 + 40 * 6
    assert lstm._products(config, 2) == pytest.approx(2e-9 * entries * 3 * 2)


def test_lstm_peer_takes_the_same_steps(monkeypatch):
    monkeypatch.setattr(_torch, "torch", pytest.importorskip("torch"))
    from benchmarks import _lstm_torch

    config = lstm.Config(landmarks=2, frames=6, hidden=4)
    data, weights = lstm._data(config, 2), lstm._weights(config, 0)
    peer, held = _lstm_torch.Peer(weights), [_torch.tensor(array) for array in data]
    _equal.check(lstm.lstm.forward(weights, data.x), peer.forward(held)())
    slope = jax.grad(lambda weights: lstm._loss(weights, None, data, ())[0])(weights)
    _equal.check(slope, _lstm_torch.as_weights(peer.gradient(held)()))


def test_srvf(tmp_path):
    config = srvf.Config(
        motions=6, frames=30, landmarks=3, geomstats=tmp_path / "none", along_motions=(2,), along_frames=(4,)
    )
    rows, curves = checked(srvf.run(config))
    assert set(rows) == {"srvf_encode_decode", "geodesic"}
    assert {"facejax", "NumPy"} <= set(rows["geodesic"]["sides"])
    assert curves == {"srvf_encode_decode", "srvf_encode_decode_100", "geodesic", "geodesic_100"}


def test_augment(monkeypatch):
    monkeypatch.setattr(augment, "apart", lambda options: _transitions.stream(**options))
    config = augment.Config(
        labels=3,
        people=8,
        steps=5,
        landmarks=4,
        compared=12,
        transitions=20,
        along_transitions=(8, 12),
        along_frames=(4,),
    )
    rows, _ = checked(augment.run(config))
    assert set(rows) == {"transitions_12", "transitions_20_even", "transitions_20_performed", "select_2000"}
    assert rows["transitions_20_even"]["memory_mb"] > 0


def test_rbf():
    rows, curves = checked(rbf.run(rbf.Config(vertices=50, frames=3, along_vertices=(50,), along_frames=(3,))))
    assert rows["rbf_3x50"]["peer"] == "SciPy" and rows["rbf_refit_3x50"]["peer"] == "SciPy, each frame"
    assert curves == {"rbf"}


def test_scale():
    sizes = {
        "side": 20,
        "meshes": 2,
        "frames": 6,
        "recordings": 2,
        "motions": 4,
        "sequences": (4, 600),
        "million": 1000,
    }
    rows, curves = checked(scale.run(scale.Config(**sizes)))
    assert set(rows) == {
        "s2d_step_devices", "lstm_step_devices", "corpus_devices", "corpus_4", "corpus_600", "corpus_1000",
    }  # fmt: skip
    assert all(row["efficiency"] > 0 for row in rows.values() if "devices" in row)
    assert rows["corpus_1000"]["simulated"] and curves == {"corpus"}
    less, more = (rows[name]["median_s"] for name in ("corpus_4", "corpus_600"))
    assert rows["corpus_1000"]["median_s"] == pytest.approx(more + 400 * (more - less) / 596)


def test_linear():
    rows, _ = checked(linear.run(linear.Config(vertices=340, meshes=120, components=60, atoms=20)))
    assert {name: row["peer"] for name, row in rows.items()} == {
        "pca_fit": "scikit-learn", "dictionary_fit": "scikit-learn", "pca_apply_b16": "NumPy",
    }  # fmt: skip


def test_pipeline(monkeypatch):
    monkeypatch.setattr(pipeline, "_fresh", lambda folder: (1.0, 500.0))
    rows, curves = checked(pipeline.run(pipeline.Config(quick=True, requests=(1,))))
    ways = ("", "_linear", "_s2d")
    fresh = {"fresh_process_empty_cache", "fresh_process_warm_cache"}
    assert set(rows) == {*(f"labels_to_meshes{way}_b1" for way in ways), "new_face", "sample_b64", "sample_b1"} | fresh
    assert not curves


def test_data(tiny_store, monkeypatch):
    monkeypatch.setattr(data.makehuman4d, "prepare", lambda: tiny_store)
    rows, _ = checked(data.run(data.Config(quick=True, vertices=5023, meshes=500)))
    assert set(rows) == {"mesh_batches_b16", "read_ply", "prepare_50"}


TINY = motion.Config(
    quick=True,
    gan=gan.Config(steps=5, landmarks=4, labels=3, noise=6, rank=8, pose=3, width=8, blocks=1, embedding=2),
    flow=flow_matching.Config(width=8, blocks=1, embedding=2),
    gan_plan=fit_motion.GanPlan(steps=20, batch=6, critic_steps=2),
    flow_plan=fit_motion.FlowPlan(steps=20, batch=6),
    reference_batch=1,
    width_divisor=16,
    motions=60,
    samples=2,
)


handed = motion.handed


def idle(fit, *args, **options):
    """What a fit hands over, but for its step: to compile those takes most of the time."""
    if fit is fit_motion.fit_reference:  # whose networks are large at any size
        state = loop.TrainState(jnp.int32(0), (), (), jax.random.key(0))
        run = motion.Run(None, state, jnp.arange(2), ())
    else:
        run = handed(fit, *args, **options)
    return run._replace(step=lambda state, rows, held: (state, {}))


@pytest.mark.parametrize("whole", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_motion(monkeypatch, whole):
    monkeypatch.setattr(motion, "SCAN", 2)
    monkeypatch.setattr(motion, "handed", handed if whole else idle)
    rows, _ = checked(motion.run(TINY))
    assert set(rows) == {"gan_step_b6", "flow_step_b6", "gan_reference_step_b1", "gan_sample_2", "flow_sample_2"}
    assert all(row["memory_mb"] > 0 for name, row in rows.items() if "step" in name)


@pytest.mark.parametrize(("name", "fit"), [("Gan", fit_motion.fit_gan), ("Flow", fit_motion.fit_flow)])
def test_motion_peer_takes_the_same_steps(name, fit, monkeypatch):
    monkeypatch.setattr(_torch, "torch", pytest.importorskip("torch"))
    from benchmarks import _motion_torch

    sizes = {field: getattr(TINY.gan, field) for field in ("labels", "steps", "landmarks")}
    known = _transitions.made_up(TINY.motions, **sizes)
    chart = transitions.fit_chart(known, labels=3, rank=8, pose=3)
    kind = name.lower()
    plan, config = getattr(TINY, f"{kind}_plan"), getattr(TINY, kind)
    run = motion.handed(fit, transitions.encode_examples(chart, [known]), chart, plan=plan, config=config)
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
