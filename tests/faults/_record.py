"""Records of how often each fault was tried, the outcomes, and peak memory; docs/faults.md shows the table.

FACEJAX_FAULT_TRIES and FACEJAX_FAULT_FILES are set by `make faults`; by default only a few tries are made. Outcomes are
appended to the file that FACEJAX_FAULT_RECORD names.
"""

from __future__ import annotations

import json
import os
from pathlib import Path

TRIES = int(os.environ.get("FACEJAX_FAULT_TRIES", 0))
FILES = int(os.environ.get("FACEJAX_FAULT_FILES", 0))


def outcome(fault: str, where: str, tries: int, came_of_it: str, **numbers: float) -> None:
    """Add a line. Numbers that `tests.faults.table` knows: refused, read, mb, seconds."""
    if path := os.environ.get("FACEJAX_FAULT_RECORD"):
        line = json.dumps({"fault": fault, "where": where, "tries": tries, "outcome": came_of_it} | numbers)
        with open(path, "a", encoding="utf-8") as file:
            file.write(line + "\n")


def peak_mb() -> float:
    """Return the peak memory of this process in MB.

    From /proc, which starts anew with the program: `getrusage` counts what the parent held when it forked.
    """
    status = Path("/proc/self/status").read_text()
    return int(status.split("VmHWM:")[1].split()[0]) / 1024
