"""How benchmarks measure: warm-up, then repeats of several functions in turn, minimum and median.

Machines are noisy and drift: functions to compare are run interleaved in one process, and their ratio is the headline.
"""

from __future__ import annotations

import json
import os
import platform
import resource
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np


def interleaved(functions: dict[str, Callable[[], Any]], *, repeats: int = 20) -> dict[str, dict[str, float]]:
    """First-call, minimum and median seconds of each function; results are waited for."""
    first = {}
    for name, function in functions.items():
        begun = time.perf_counter()
        jax.block_until_ready(function())
        first[name] = time.perf_counter() - begun
    times: dict[str, list[float]] = {name: [] for name in functions}
    for _ in range(repeats):
        for name, function in functions.items():
            begun = time.perf_counter()
            jax.block_until_ready(function())
            times[name].append(time.perf_counter() - begun)
    return {
        name: {"first_s": first[name], "min_s": min(t), "median_s": statistics.median(t)} for name, t in times.items()
    }


def machine() -> dict[str, Any]:
    """What ran it."""
    return {
        "cores": os.cpu_count(),
        "machine": platform.machine(),
        "python": platform.python_version(),
        "jax": jax.__version__,
        "numpy": np.__version__,
        "device": jax.devices()[0].device_kind,
        "peak_memory_mb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024),
    }


def report(rows: list[dict[str, Any]], path: Path | None) -> None:
    """Print rows as a Markdown table; with a path, write them with the machine as JSON."""
    columns = list(dict.fromkeys(key for row in rows for key in row))
    print("| " + " | ".join(columns) + " |\n|" + " --- |" * len(columns))
    for row in rows:
        cells = [f"{row[c]:.4g}" if isinstance(row.get(c), float) else str(row.get(c, "")) for c in columns]
        print("| " + " | ".join(cells) + " |")
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps({"rows": rows, "machine": machine()}, indent=1) + "\n")
