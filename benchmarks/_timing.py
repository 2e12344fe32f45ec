"""Functions in turns: their first call apart, the least and the median of the others.

Work shorter than a turn is repeated within it and counts with its mean, as `timeit` has it.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping
from typing import Any

import jax

REST = 0.06  # seconds between turns: OpenBLAS and OpenMP keep threads spinning for up to 30 ms after their work
TURN = (
    0.03  # seconds: shorter work is repeated for so long, after as long untimed, since rested cores are slow at first
)


def interleaved(
    functions: Mapping[str, Callable[[], Any]], *, repeats: int = 20, rest: float = REST
) -> dict[str, dict[str, float]]:
    """First-call, minimum and median seconds of each function; results are waited for."""
    first = {name: _seconds(function) for name, function in functions.items()}
    times: dict[str, list[float]] = {name: [] for name in functions}
    for _ in range(repeats):
        for name, function in functions.items():
            time.sleep(rest)
            times[name].append(_turn(function))
    return {
        name: {"first_s": first[name], "min_s": min(steady), "median_s": statistics.median(steady)}
        for name, steady in times.items()
    }


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
