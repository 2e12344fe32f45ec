"""Interleaved timing of functions: first call, minimum and median.

Work shorter than a turn is repeated within it and counts with its mean, as in `timeit`.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping
from typing import Any

import jax

REST = 0.03  # seconds in which the process must be idle before the next turn
PATIENCE = 1.0  # seconds after which a turn starts anyway
# Seconds. Shorter work is repeated for this time, after a warm-up of the same length: idle cores are slow at first.
TURN = 0.03


def interleaved(functions: Mapping[str, Callable[[], Any]], *, repeats: int = 20) -> dict[str, dict[str, float]]:
    """Return first-call, minimum and median seconds of each function, including the wait for its results."""
    first = {name: _seconds(function) for name, function in functions.items()}
    times: dict[str, list[float]] = {name: [] for name in functions}
    for _ in range(repeats):
        for name, function in functions.items():
            settle()
            times[name].append(_turn(function))
    return {
        name: {"first_s": first[name], "min_s": min(steady), "median_s": statistics.median(steady)}
        for name, steady in times.items()
    }


def settle() -> None:
    """Wait until the threads of the previous function are idle.

    Threads of OpenBLAS and OpenMP spin for 0.1 s and more after their work and occupy a core meanwhile: directly after
    SciPy an RBF warp took 10 ms, a second later 5 ms.
    """
    begun = time.monotonic()
    while REST and time.monotonic() - begun < PATIENCE:
        spent = time.process_time()
        time.sleep(REST)
        if time.process_time() - spent < 0.1 * REST:
            return


def _turn(function: Callable[[], Any]) -> float:
    took = _seconds(function)
    count = int(TURN / took)
    if count == 0:
        return took
    for _ in range(count):
        jax.block_until_ready(function())
    begun = time.perf_counter()
    for _ in range(count):
        jax.block_until_ready(function())
    return (time.perf_counter() - begun) / count


def _seconds(function: Callable[[], Any]) -> float:
    begun = time.perf_counter()
    jax.block_until_ready(function())
    return time.perf_counter() - begun
