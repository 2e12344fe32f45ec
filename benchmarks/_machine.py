"""What ran a benchmark: processor, threads, versions, commit, peak of memory."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import re
import resource
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import jax

from benchmarks import _roofline

PACKAGES = ("jax", "jaxlib", "numpy", "scipy", "optax", "torch", "scikit-learn", "fdasrsf", "trimesh")


def about() -> dict[str, Any]:
    """Of this process."""
    return {
        "processor": _processor(),
        "machine": platform.machine(),
        "cores": cores(),
        "device": jax.devices()[0].device_kind,
        "python": platform.python_version(),
        "versions": {name: found for name in PACKAGES if (found := _version(name))},
        "torch_threads": sys.modules["torch"].get_num_threads() if "torch" in sys.modules else None,
        "roofline": _roofline.measured()._asdict(),
        "peak_memory_mb": round(peak_mb()),
        "commit": _commit(),
        "date": time.strftime("%Y-%m-%d", time.gmtime()),
    }


def cores() -> int:
    """That this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def peak_mb() -> float:
    """Of this process's resident memory, in MB."""
    status = Path("/proc/self/status")
    if status.exists():  # Linux's `ru_maxrss` does not start anew with a process: it holds the parent's peak too
        return int(re.search(r"VmHWM:\s+(\d+)", status.read_text())[1]) / 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    found = re.search(r"model name\s*:\s*(.+)", info.read_text()) if info.exists() else None
    return found[1].strip() if found else platform.processor()


def _commit() -> str | None:
    """The checkout's commit, marked where files differ from it; None outside a checkout."""
    command = ["git", "describe", "--always", "--dirty", "--exclude=*"]
    try:
        found = subprocess.run(command, cwd=Path(__file__).parent, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return None
    return found.stdout.strip()
