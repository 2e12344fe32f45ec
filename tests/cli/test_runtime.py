"""What a program may set before it uses JAX; in processes of their own, since it cannot be taken back."""

import subprocess
import sys

import pytest

from facejax.cli import runtime


def printed(code, **environment):
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment or None)
    assert found.returncode == 0, found.stderr
    return found.stdout.split()


def test_every_core_is_a_device():
    code = "import os, jax; from facejax.cli import runtime; runtime.use_all_cores(); n = len(os.sched_getaffinity(0))"
    if not sys.platform.startswith("linux"):
        pytest.skip("no affinity here")
    devices, cores = map(int, printed(f"{code}; print(len(jax.devices()), n)"))
    assert devices == cores


def test_freed_memory_stays_with_the_process():
    """Pages of a large array are faulted in at every turn, and only once where memory is kept."""
    if not sys.platform.startswith("linux"):
        pytest.skip("glibc's allocator is not here")
    code = """
import resource, numpy as np
from facejax.cli import runtime
told = {keep} and runtime.keep_memory()
faults = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_minflt
np.ones(10_000_000, np.float32)
before = faults()
for _ in range(5):
    np.ones(10_000_000, np.float32)
print(told, faults() - before)
"""
    told, kept = printed(code.format(keep=True))
    _, given_back = printed(code.format(keep=False))
    if told == "False":
        pytest.skip("another C library than glibc")
    assert int(kept) < 0.1 * int(given_back)


@pytest.mark.parametrize(
    ("told", "message"),
    [
        ({"ADDRESS": "localhost:1"}, "expected all of JAX_COORDINATOR_ADDRESS"),
        ({"ADDRESS": "localhost:1", "NUM": "two", "ID": "0"}, "the last two whole numbers"),
        ({"ADDRESS": "nonsense", "NUM": "2", "ID": "0"}, "expected host:port, got nonsense"),
        ({"ADDRESS": "localhost:99999999", "NUM": "2", "ID": "0"}, "expected host:port"),
        ({"ADDRESS": "nowhere.invalid:9000", "NUM": "2", "ID": "1"}, "nowhere.invalid is an unknown host"),
    ],
)
def test_a_job_that_cannot_be_joined_is_refused_at_once(told, message, monkeypatch):
    names = {"ADDRESS": "JAX_COORDINATOR_ADDRESS", "NUM": "JAX_NUM_PROCESSES", "ID": "JAX_PROCESS_ID"}
    for name, variable in names.items():
        monkeypatch.delenv(variable, raising=False)
        if name in told:
            monkeypatch.setenv(variable, told[name])
    with pytest.raises(ValueError, match=message):
        runtime.join_distributed()


def test_without_a_job_there_is_nothing_to_join():
    code = "from facejax.cli import runtime\ntry: runtime.join_distributed()\nexcept ValueError as error: print(error)"
    said = " ".join(printed(code))
    assert said.startswith("no job to join") and said.endswith(
        "set JAX_COORDINATOR_ADDRESS, JAX_NUM_PROCESSES, JAX_PROCESS_ID"
    )
