"""What a program may set before it uses JAX; in processes of their own, since it cannot be taken back."""

import subprocess
import sys

import pytest


def printed(code, **environment):
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment or None)
    assert found.returncode == 0, found.stderr
    return found.stdout.split()


def test_every_core_is_a_device():
    code = "import os, jax; from facejax import runtime; runtime.every_core(); n = len(os.sched_getaffinity(0))"
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
from facejax import runtime
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
