"""Several devices and processes give the results of one device, and do not wait for lost processes."""

import json
import os
import signal
import socket
import sys
import time

import numpy as np
import pytest

from facejax.data import corpora
from facejax.inference import pipeline
from tests.faults import loops
from tests.faults._record import TRIES, outcome
from tests.faults.test_kills import LOOP, contents, finished, started

SHARED = [loop for loop in loops.LOOPS if loop != "expressions"]  # which shares out its networks, not its batches
# A step of this size down the gradient; the critic of a GAN takes several, which must stay where it was.
PLAIN = {loop: 0.01 if loop in ("gan", "reference") else 1.0 for loop in SHARED}


def port():
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return free.getsockname()[1]


def together(count, command):
    """So many processes of one job."""
    job = {"JAX_COORDINATOR_ADDRESS": f"127.0.0.1:{port()}", "JAX_NUM_PROCESSES": str(count)}
    return [started(command, **job, JAX_PROCESS_ID=str(number)) for number in range(count)]


def entries(folder):
    return [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]


@pytest.mark.parametrize("loop", [pytest.param(n, marks=[] if n in ("flow",) else pytest.mark.slow) for n in SHARED])
def test_gradients_of_four_devices_are_those_of_one(loop, tmp_path):
    found = []
    for devices in (1, 4):
        command = [sys.executable, LOOP, loop, tmp_path / str(devices), "--devices", devices, "--plain", PLAIN[loop]]
        finished(started([*command, "--save", tmp_path / f"{devices}.npz"]))
        with np.load(tmp_path / f"{devices}.npz") as saved:
            found.append([saved[name] for name in saved.files])
    for one, four in zip(*found, strict=True):
        np.testing.assert_allclose(four, one, atol=1e-6, rtol=1e-6)
    outcome("gradient of 4 devices", loop, 1, "that of one device to 1e-6")


def test_two_processes_train_as_one_and_another_number_goes_on(tmp_path):
    """Two processes of two devices; one is killed; one process alone, and then three, finish what they began."""
    command = [sys.executable, LOOP, "flow"]
    finished(started([*command, tmp_path / "alone"]))
    both = together(2, [*command, tmp_path / "both", "--devices", "2", "--distributed"])
    assert len({finished(process).split()[-1] for process in both}) == 1
    assert_alike(tmp_path / "both", tmp_path / "alone")
    for number, (lost, follow) in enumerate(((1, 1), (0, 4), (1, 2), (0, 1))[: 1 + TRIES]):
        folder = tmp_path / f"lost{number}"
        pair = together(2, [*command, folder, "--devices", "2", "--distributed", "--pause", "0.4"])
        while not (folder / "metrics.jsonl").exists() or len(entries(folder)) < 4:
            time.sleep(0.02)
            assert all(process.poll() is None for process in pair)
        os.killpg(pair[lost].pid, signal.SIGKILL)
        begun = time.monotonic()
        _, said = pair[1 - lost].communicate(timeout=60)
        took = time.monotonic() - begun
        assert pair[1 - lost].returncode not in (0, None)
        pair[lost].communicate()
        assert (
            "another process was lost" in said or "another task died" in said or "leader task was preempted" in said
        ), said
        left = entries(folder)[-1]["step"]
        assert left < loops.STEPS
        for process in together(follow, [*command, folder, "--distributed"]):
            finished(process)
        assert_alike(folder, tmp_path / "alone")
        outcome(
            "a process is lost",
            "either of two that train",
            1,
            "the other stops, and 1, 2 or 4 go on",
            seconds=took,
        )


@pytest.mark.slow
def test_models_of_ones_own_are_fitted_by_two_processes(tiny_store, tmp_path):
    command = [sys.executable, "-m", "facejax.cli", "fit", "--data", tiny_store.path, "--quick", "--out"]
    finished(started([*command, tmp_path / "alone.safetensors"]))
    pair = together(2, [*command, tmp_path / "both.safetensors", "--distributed"])
    # JAX's own lines of who is connected to whom stand first.
    said = [finished(process).splitlines()[-2:] for process in pair]
    assert said[0] == said[1] and said[0][-1] == str(tmp_path / "both.safetensors")
    for stage in ("motion", "meshes"):
        assert_alike(*(tmp_path / f"{name}.training" / stage for name in ("both", "alone")))
    one, two = (pipeline.load(tmp_path / f"{name}.safetensors") for name in ("alone", "both"))
    assert two.about["error_mm"] == pytest.approx(one.about["error_mm"], rel=0.01)
    outcome("2 processes", "facejax fit --distributed", 1, "the losses of one, and its errors on people held out")


@pytest.mark.slow
def test_networks_side_by_side_are_the_same_in_two_processes(tmp_path):
    command = [sys.executable, LOOP, "expressions"]
    alone = finished(started([*command, tmp_path / "alone"])).split()[-1]
    pair = together(2, [*command, tmp_path / "both", "--distributed"])
    assert {finished(process).split()[-1] for process in pair} == {alone}
    outcome("2 processes", "training expressions", 1, "the bits of one")


def assert_alike(folder, other):
    for a, b in zip(entries(folder), entries(other), strict=True):
        assert a["step"] == b["step"]
        np.testing.assert_allclose(a["loss"], b["loss"], rtol=2e-4)


GENERATE = [sys.executable, "-m", "facejax.cli", "generate", "--count", "24", "--shard", "4", "--frames", "6"]


def test_a_corpus_is_the_same_on_one_and_on_four_devices_and_of_two_processes(tmp_path):
    finished(started([*GENERATE, "--out", tmp_path / "one"]))
    finished(started([*GENERATE, "--out", tmp_path / "four"], XLA_FLAGS="--xla_force_host_platform_device_count=4"))
    for process in together(2, [*GENERATE, "--out", tmp_path / "two", "--distributed"]):
        finished(process)
    assert contents(tmp_path / "two") == contents(tmp_path / "one")
    one, four = (corpora.load(tmp_path / name) for name in ("one", "four"))
    for a, b in zip(one, four, strict=True):
        size = np.abs(a["landmarks"] - a["landmarks"][:, :1]).max()
        np.testing.assert_allclose(b["landmarks"], a["landmarks"], atol=1e-6 * np.abs(a["landmarks"]).max())
        assert size > 1
        np.testing.assert_array_equal(a["labels"], b["labels"])
    outcome("4 devices, 2 processes", "facejax generate --count", 1, "the same to 1e-6; the same bytes")
