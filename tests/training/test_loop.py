"""The loop: the same numbers however often it is stopped, errors that name step and term, honest records."""

import io
import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from facejax.training import loop, metric_logger, sharding, steps

ROOT = Path(__file__).parents[2]
DATA = np.random.default_rng(0).standard_normal((50, 4)).astype(np.float32)
OPTIMISER = optax.adam(1e-2)


def loss(params, key, batch, constants):
    noise = 0.01 * jax.random.normal(key, batch.shape)
    error = jnp.mean(jnp.square((batch + noise) @ params["w"] - constants))
    return error, {"norm": jnp.sum(jnp.square(params["w"]))}


def start():
    return steps.init_supervised({"w": jnp.ones((4, 2))}, OPTIMISER, jax.random.key(3))


def batches(first, count):
    return DATA[loop.epoch_indices(7, len(DATA), 8)(first, count)]


def fit(folder, total, **options):
    step = steps.supervised(loss, OPTIMISER)
    return loop.run(step, start(), batches, folder, steps=total, constants=jnp.float32(0.5), chunk=4, **options)


def numbers(state):
    return [np.asarray(leaf) for leaf in jax.tree.leaves(state._replace(key=jax.random.key_data(state.key)))]


def entries(folder):
    return [{k: v for k, v in entry.items() if k != "seconds"} for entry in metric_logger.read(folder)]


def same(a, b):
    return all(np.array_equal(x, y) for x, y in zip(numbers(a), numbers(b), strict=True))


def test_supervised_steps_are_the_plain_loop(tmp_path):
    state = fit(tmp_path, 10)
    params, opt_state = start().params, start().opt_state
    values = []
    for i in range(10):
        key = jax.random.fold_in(jax.random.key(3), i)
        value, slope = jax.value_and_grad(lambda p: loss(p, key, batches(i, 1)[0], 0.5)[0])(params)  # noqa: B023
        updates, opt_state = OPTIMISER.update(slope, opt_state, params)
        params = optax.apply_updates(params, updates)
        values.append(float(value))
    np.testing.assert_allclose(state.params["w"], params["w"], rtol=1e-5)
    assert int(state.step) == 10
    got = entries(tmp_path)
    assert [entry["step"] for entry in got] == [4, 8, 10]
    means = [np.mean(values[a:b]) for a, b in [(0, 4), (4, 8), (8, 10)]]
    np.testing.assert_allclose([e["loss"] for e in got], means, rtol=1e-5)


def test_without_a_loop_the_steps_are_the_same(tmp_path):
    step = steps.supervised(loss, OPTIMISER)
    single = loop.run(
        step, start(), batches, tmp_path / "single", steps=6, constants=jnp.float32(0.5), chunk=1, save_steps=3
    )
    looped = fit(tmp_path / "looped", 6)
    np.testing.assert_allclose(single.params["w"], looped.params["w"], rtol=1e-6)
    assert [entry["step"] for entry in entries(tmp_path / "single")] == [1, 2, 3, 4, 5, 6]


def test_a_run_in_pieces_gives_the_same_bits(tmp_path):
    whole = fit(tmp_path / "whole", 20)
    for total in (8, 8, 12, 20):
        pieces = fit(tmp_path / "pieces", total)
    assert same(whole, pieces)
    assert entries(tmp_path / "whole") == entries(tmp_path / "pieces")
    assert same(fit(tmp_path / "pieces", 20), whole)


def test_the_callers_state_survives_the_run(tmp_path):
    state = start()
    loop.run(steps.supervised(loss, OPTIMISER), state, batches, tmp_path, steps=4, constants=jnp.float32(0))
    np.testing.assert_array_equal(state.params["w"], np.ones((4, 2)))


def test_entries_after_the_checkpoint_are_cut_and_a_torn_line_too(tmp_path):
    whole = fit(tmp_path / "whole", 16)
    fit(tmp_path / "torn", 8)
    with (tmp_path / "torn" / "metrics.jsonl").open("a") as file:
        file.write(json.dumps({"step": 12, "loss": -1.0}) + '\n{"step": 16, "lo')
    assert same(fit(tmp_path / "torn", 16), whole)
    assert entries(tmp_path / "torn") == entries(tmp_path / "whole")


def test_what_is_raised_is_not_lost_with_a_journal_that_cannot_be_closed(tmp_path):
    """On a full disk."""

    class Full:
        def close(self):
            raise OSError("no space left")

    for inner, outer in ((RuntimeError("more"), RuntimeError), (None, OSError)):
        record = metric_logger.MetricLogger(tmp_path, 0, 3)
        record._file.close()
        record._file = Full()
        with pytest.raises(outer), record:
            if inner:
                raise inner


def test_an_old_run_is_not_overwritten_unasked(tmp_path):
    fit(tmp_path, 4)
    with pytest.raises(ValueError, match="holds a run of 4 steps: resume it, or name another folder"):
        fit(tmp_path, 8, resume=False)


CHILD = """
import sys
sys.path.insert(0, {tests!r})
import test_loop
slowly = test_loop.batches
def batches(first, count):
    import time
    time.sleep(0.03)
    return slowly(first, count)
test_loop.batches = batches
test_loop.fit({folder!r}, 120, save_steps=4)
print("finished", flush=True)
"""


def child(folder):
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    code = CHILD.format(tests=str(Path(__file__).parent), folder=str(folder))
    return subprocess.Popen([sys.executable, "-c", code], env=environment, stdout=-1, stderr=-1, text=True)


def killed_after(folder, lines, number, pause=0.0):
    """Start a run, send `number` once its record holds more than `lines` lines, and return the exit code."""
    process, record = child(folder), Path(folder) / "metrics.jsonl"
    while process.poll() is None and (not record.exists() or record.read_text().count("\n") < lines):
        time.sleep(0.005)
    time.sleep(pause)
    process.send_signal(number)
    process.communicate()
    return process.returncode


def test_a_run_killed_at_odd_moments_resumes_to_the_same_bits(tmp_path):
    whole = fit(tmp_path / "whole", 120)
    random = np.random.default_rng(time.time_ns())  # the moments differ from run to run, the result may not
    for lines in (3, 14):
        assert killed_after(tmp_path / "killed", lines, signal.SIGKILL, random.uniform(0, 0.05)) == -signal.SIGKILL
    assert 0 < len(entries(tmp_path / "killed")) < 30
    assert same(fit(tmp_path / "killed", 120), whole)
    assert entries(tmp_path / "killed") == entries(tmp_path / "whole")


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 128 + 15), (signal.SIGINT, -2)])
def test_a_stop_signal_saves_and_leaves(tmp_path, number, code):
    assert killed_after(tmp_path, 5, number) == code
    with loop.Checkpoints(tmp_path / "checkpoints") as checkpoints:
        saved = checkpoints.latest()
    assert saved == entries(tmp_path)[-1]["step"] and saved < 120


def test_a_run_outside_the_main_thread_leaves_signals_alone(tmp_path):
    got = []
    thread = threading.Thread(target=lambda: got.append(fit(tmp_path, 4)))
    thread.start()
    thread.join()
    assert int(got[0].step) == 4


@pytest.mark.parametrize(
    ("at", "value", "saved", "message"),
    [
        (6, jnp.nan, "none", r"curse became nan in step 7; there is no checkpoint yet"),
        (6, jnp.inf, "some", r"curse became inf in step 7; the last good checkpoint is step 4"),
        (3, -2e6, "none", r"curse became -2000000.0 in step 4; there is no checkpoint yet"),
    ],
)
def test_a_loss_gone_wrong_stops_with_step_term_and_checkpoint(tmp_path, at, value, saved, message):
    def cursed(state, batch, constants):
        state = state._replace(step=state.step + 1)
        return state, {"fine": jnp.float32(1), "curse": jnp.where(state.step > at, value, 0.0)}

    with pytest.raises(loop.TrainingError, match=message):
        loop.run(cursed, start(), batches, tmp_path, steps=20, chunk=4, save_steps=4 if saved == "some" else None)
    assert all(entry["step"] <= at for entry in entries(tmp_path))


def test_epoch_indices_show_each_sample_once_an_epoch_in_an_order_of_its_own():
    indices = loop.epoch_indices(1, 10, 4)
    stream = indices(0, 25).ravel()
    epochs = stream.reshape(10, 10)
    assert all(sorted(epoch) == list(range(10)) for epoch in epochs)
    assert len({tuple(epoch) for epoch in epochs}) == 10
    assert indices(0, 25).shape == (25, 4) and indices(0, 25).dtype == np.int32
    assert not np.array_equal(stream, loop.epoch_indices(2, 10, 4)(0, 25).ravel())


@pytest.mark.parametrize(("size", "batch"), [(10, 4), (4, 10), (1, 1), (12, 4)])
def test_epoch_indices_depend_on_the_step_alone(size, batch):
    whole = loop.epoch_indices(5, size, batch)(0, 30)
    for first, count in [(0, 1), (7, 5), (29, 1), (3, 27)]:
        np.testing.assert_array_equal(loop.epoch_indices(5, size, batch)(first, count), whole[first : first + count])


def test_epoch_indices_refuse_nothing():
    with pytest.raises(ValueError, match="at least 1; got 0 and 4"):
        loop.epoch_indices(0, 0, 4)


def test_gathered_steps_take_indices(tmp_path):
    step = loop.gather_batches(steps.supervised(loss, OPTIMISER))
    held = (jnp.asarray(DATA), jnp.float32(0.5))
    indices = loop.epoch_indices(7, len(DATA), 8)
    state = loop.run(step, start(), indices, tmp_path / "indices", steps=8, constants=held, chunk=4)
    assert same(state, fit(tmp_path / "plain", 8))


def test_the_average_follows_the_parameters_and_changes_nothing_else():
    plain, state = steps.supervised(loss, OPTIMISER), start()
    step, other = steps.with_moving_average(plain, 0.9), state._replace(extra=state.params)
    average = np.asarray(state.params["w"], np.float64)
    for i in range(5):
        batch = batches(i, 1)[0]
        state, metrics = jax.jit(plain)(state, batch, 0.5)
        other, same_metrics = jax.jit(step)(other, batch, 0.5)
        average = 0.9 * average + 0.1 * np.asarray(state.params["w"])
        np.testing.assert_allclose(other.extra["w"], average, rtol=1e-6)
        assert same(state, other._replace(extra=())) and metrics.keys() == same_metrics.keys()
    assert np.abs(average - state.params["w"]).max() > 1e-3


def adversarial(optimiser, critic_steps):
    def generate(weights, constants, key, condition):
        return weights["g"][condition] + constants * jax.random.normal(key, (2,))

    def score(weights, constants, sample, condition):
        return jnp.tanh(sample @ weights["c"][condition]).sum()

    def terms(constants, fake, real, condition):
        return {"pull": 0.1 * jnp.mean(jnp.abs(fake - real))}

    players = steps.Players(optimiser, optimiser)
    step = steps.adversarial(generate, score, players, critic_steps=critic_steps, terms=terms, decay=0.9)
    weights = steps.Players({"g": jnp.zeros((3, 2))}, {"c": 0.5 * jnp.ones((3, 2, 4))})
    return step, steps.init_adversarial(weights, players, jax.random.key(0))


def test_an_adversarial_step_moves_the_critic_first_and_averages_the_generator():
    step, state = adversarial(optax.sgd(0.1), critic_steps=3)
    real, condition = jax.random.normal(jax.random.key(1), (12, 2)), jnp.arange(12) % 3
    after, metrics = jax.jit(step)(state, (real, condition), jnp.float32(0.0))
    assert set(metrics) == {"wasserstein", "slope", "adversarial", "pull"}
    critic, fake = state.params.critic["c"], jnp.zeros(2)
    chord_key = jax.random.split(jax.random.fold_in(jax.random.key(0), 0), 3)[1]
    for i, key in enumerate(jax.random.split(chord_key, 3)):
        rows = slice(4 * i, 4 * i + 4)

        def critic_loss(c, key=key, rows=rows):
            tau = jax.random.uniform(key, (4,))
            total = 0.0
            for t, x, label in zip(tau, real[rows], condition[rows], strict=True):
                slope = jax.grad(lambda y, label=label: jnp.tanh(y @ c[label]).sum())((1 - t) * x)
                total += jnp.tanh(fake @ c[label]).sum() - jnp.tanh(x @ c[label]).sum()
                total += 10.0 * (jnp.linalg.norm(slope) - 1.0) ** 2
            return total / 4

        critic = critic - 0.1 * jax.jit(jax.grad(critic_loss))(critic)
    np.testing.assert_allclose(after.params.critic["c"], critic, rtol=1e-4, atol=1e-6)

    def generator_loss(g):
        played = zip(real[8:], condition[8:], strict=True)
        return sum(-jnp.tanh(g[c] @ critic[c]).sum() / 4 + 0.1 * jnp.abs(g[c] - x).sum() / 8 for x, c in played)

    expected = -0.1 * jax.jit(jax.grad(generator_loss))(jnp.zeros((3, 2)))
    np.testing.assert_allclose(after.params.generator["g"], expected, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(after.extra["g"], 0.1 * after.params.generator["g"], rtol=1e-5)


def test_adversarial_batches_must_divide():
    step, state = adversarial(optax.sgd(0.1), critic_steps=5)
    with pytest.raises(ValueError, match="multiple of critic_steps = 5 samples; got 12"):
        step(state, (jnp.zeros((12, 2)), jnp.zeros(12, int)), jnp.float32(0.1))


def test_a_terminal_gets_a_bar_and_others_get_lines(tmp_path, monkeypatch, capsys):
    fit(tmp_path / "lines", 8)
    assert "step 8/8  loss " in capsys.readouterr().err

    class Terminal(io.StringIO):
        def isatty(self):
            return True

    monkeypatch.setattr(sys, "stderr", terminal := Terminal())
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "160")
    fit(tmp_path / "bar", 8)
    assert "8/8" in terminal.getvalue() and "step 8/8" not in terminal.getvalue()


def test_tensorboard_gets_every_entry_or_a_hint(tmp_path, monkeypatch):
    written = []

    class Writer:
        def __init__(self, folder):
            written.append(Path(folder).name)

        def add_scalar(self, name, value, step):
            written.append((name, step))

        def close(self):
            written.append("closed")

    module = type(sys)("tensorboardX")
    module.SummaryWriter = Writer
    monkeypatch.setitem(sys.modules, "tensorboardX", module)
    fit(tmp_path / "with", 8, tensorboard=True)
    assert written == ["tensorboard", *[(n, s) for s in (4, 8) for n in ("loss", "norm")], "closed"]
    monkeypatch.setitem(sys.modules, "tensorboardX", None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'facejax\[tensorboard\]'"):
        fit(tmp_path / "without", 8, tensorboard=True)


# Several models in one step.

DATASETS = np.random.default_rng(1).standard_normal((3, 20, 4)).astype(np.float32)


def apart(which, total, folder):
    """Train the models of `which` side by side; model i has data and constants of its own."""
    stacked = {"w": jnp.stack([jnp.full((4, 2), 1.0 + i) for i in which])}
    own = jnp.asarray([0.5 + i for i in which], jnp.float32)

    def step_loss(params, key, batch, constants):
        target, data = constants
        return loss(params, key, data[batch], target)

    def chosen(first, count):
        rows = [loop.epoch_indices(i, 20, 8)(first, count) + 20 * i for i in which]
        return np.stack(rows, axis=1)

    step = steps.vectorize_models(steps.supervised(step_loss, OPTIMISER), [f"m{i}" for i in which], which)
    state = steps.init_vectorized_models(stacked, OPTIMISER, jax.random.key(3))
    constants = (own, jnp.asarray(DATASETS.reshape(-1, 4)))
    return loop.run(step, state, chosen, folder, steps=total, constants=constants, chunk=4)


@pytest.mark.parametrize("backend", ["cpu", "gpu"])
def test_models_side_by_side_come_out_as_alone(tmp_path, monkeypatch, backend):
    monkeypatch.setattr(jax, "default_backend", lambda: backend)  # taking turns, or under vmap
    together = apart([0, 1, 2], 10, tmp_path / "together")
    assert int(together.step) == 10
    for i in range(3):
        alone = apart([i], 10, tmp_path / f"alone{i}")
        np.testing.assert_allclose(alone.params["w"][0], together.params["w"][i], rtol=1e-5, atol=1e-6)
    assert not np.allclose(together.params["w"][0], together.params["w"][1])
    rows = entries(tmp_path / "together")
    assert {"loss", "norm", "loss_m0", "loss_m1", "loss_m2", "step"} == set(rows[-1])
    assert rows[-1]["loss"] == pytest.approx(np.mean([rows[-1][f"loss_m{i}"] for i in range(3)]), rel=1e-5)


def test_models_side_by_side_resume_to_the_same_numbers(tmp_path):
    whole = apart([0, 2], 12, tmp_path / "whole")
    assert whole.params["w"].shape == (2, 4, 2)  # all of them, also where each has a device
    apart([0, 2], 8, tmp_path / "parts")
    assert same(apart([0, 2], 12, tmp_path / "parts"), whole)


def test_a_batch_shared_out_among_devices_gives_the_same_numbers():
    """A loss that is no mean over samples, and random numbers."""

    def uneven(params, key, batch, _):
        x, mask = batch
        noise = jax.random.normal(key, x.shape)
        return jnp.sum(mask * jnp.square((x + noise) @ params["w"])) / jnp.sum(mask), {"noise": jnp.mean(noise)}

    rng = np.random.default_rng(0)
    batch = jnp.asarray(rng.normal(size=(3, 8, 4)), jnp.float32), jnp.asarray(rng.random((3, 8, 1)) < 0.4, jnp.float32)
    state = steps.init_supervised({"w": jnp.ones((4, 2))}, OPTIMISER, jax.random.key(3))
    step = steps.supervised(uneven, OPTIMISER)
    shared = jax.jit(sharding.data_parallel(step, axis=1))
    one, several = state, state
    for _ in range(3):
        (one, expected), (several, found) = step(one, batch, ()), shared(several, batch, ())
        for a, b in zip(jax.tree.leaves((one[1:3], expected)), jax.tree.leaves((several[1:3], found)), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-6)
            assert b.sharding.is_fully_replicated and len(b.devices()) == jax.device_count()
    if jax.device_count() > 1:
        with pytest.raises(ValueError, match="a batch of 7 cannot be split evenly among 2 devices"):
            shared(state, jax.tree.map(lambda leaf: leaf[:, :7], batch), ())
        laid_out = []

        def seen(state, batch, constants):
            jax.debug.inspect_array_sharding(batch, callback=laid_out.append)
            return state, {}

        # An axis counted from the end is the same axis.
        jax.jit(sharding.data_parallel(seen, axis=-2))(state, jnp.zeros((3, 8, 4)), ())
        assert laid_out[0].shard_shape((3, 8, 4)) == (3, 8 // jax.device_count(), 4)
    with pytest.raises(ValueError, match=r"a batch of shape \(\) cannot be split"):
        sharding.data_parallel(step)(state, 0.5, ())
    with pytest.raises(ValueError, match="axis: expected 0 or more, got -1"):
        sharding.split_along(sharding.data_mesh(), -1)


def test_several_devices_share_models_and_batches():
    """The tests above once more, where two networks have a device each, and three have one for all."""
    flags = os.environ.get("XLA_FLAGS", "") + " --xla_force_host_platform_device_count=2"
    command = [sys.executable, "-m", "pytest", "-v", "-p", "no:xdist", __file__, "-k", "side_by_side or shared_out"]
    found = subprocess.run(command, env=os.environ | {"XLA_FLAGS": flags}, cwd=ROOT, capture_output=True, text=True)
    assert found.returncode == 0, found.stdout
    assert "4 passed" in found.stdout
