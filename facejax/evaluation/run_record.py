"""Facts about the checkout and the machine that experiments and benchmarks write beside their results."""

from __future__ import annotations

import os
import platform
import subprocess
from pathlib import Path


def commit(folder: Path) -> str | None:
    """Return the abbreviated commit hash of the Git checkout that holds `folder`; None outside a checkout.

    The hash ends with "-dirty" where tracked files differ from the commit.
    """
    command = ["git", "describe", "--always", "--dirty", "--exclude=*"]
    try:
        result = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return None
    return result.stdout.strip()


def processor() -> str:
    """Return the processor's model name, or its architecture where the system does not name the model."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def usable_cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
