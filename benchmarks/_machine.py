"""Record of the machine and the software that ran a benchmark."""

from __future__ import annotations

import importlib.metadata
import platform
import re
import resource
import sys
import time
from pathlib import Path
from typing import Any

import jax

from benchmarks import _roofline
from facejax.evaluation import run_record

PACKAGES = ("jax", "jaxlib", "numpy", "scipy", "optax", "torch", "scikit-learn", "fdasrsf", "trimesh")


def about() -> dict[str, Any]:
    """Return the record of this process."""
    return {
        "processor": run_record.processor(),
        "machine": platform.machine(),
        "cores": run_record.usable_cores(),
        "device": jax.devices()[0].device_kind,
        "python": platform.python_version(),
        "versions": {name: found for name in PACKAGES if (found := _version(name))},
        "torch_threads": sys.modules["torch"].get_num_threads() if "torch" in sys.modules else None,
        "roofline": _roofline.measured()._asdict(),
        "peak_memory_mb": round(peak_mb()),
        "commit": run_record.commit(Path(__file__).parent),
        "date": time.strftime("%Y-%m-%d", time.gmtime()),
    }


def peak_mb() -> float:
    """Return the peak resident memory of this process in MB."""
    status = Path("/proc/self/status")
    if status.exists():  # Linux's `ru_maxrss` also holds the peak of the parent process
        return int(re.search(r"VmHWM:\s+(\d+)", status.read_text())[1]) / 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None
