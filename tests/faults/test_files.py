"""Untrusted files: they are rejected with their name or accepted, within bounds of time and memory."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.faults import bombs, fuzz
from tests.faults._record import FILES, outcome

SCRIPT = Path(fuzz.__file__)
QUICK = ("claimed_rows", "memo")  # of the large files


@pytest.mark.parametrize("name", fuzz.readers())
def test_damaged_files_are_refused_or_taken(name):
    if not FILES:
        found = fuzz.run(name, 60, 0)
    else:  # in a process of its own, whose memory is measured
        command = [sys.executable, SCRIPT, name, "--files", str(FILES)]
        done = subprocess.run(command, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr[-2000:]
        found = json.loads(done.stdout)
        assert found["peak_mb"] < 1000
    assert found["crashed"] == []
    assert found["refused"] > 0 and found["taken"] + found["refused"] == found["files"]
    assert found["slowest_s"] < 10
    outcome(
        "damaged file", name, found["files"], "", refused=found["refused"], read=found["taken"], mb=found["peak_mb"]
    )


@pytest.mark.parametrize("name", [pytest.param(n, marks=[] if n in QUICK else pytest.mark.slow) for n in bombs.BOMBS])
def test_a_file_made_to_take_memory_takes_less_than_a_gigabyte(name, tmp_path):
    command = [sys.executable, bombs.__file__, name, str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-2000:]
    found = json.loads(done.stdout)
    assert found["peak_mb"] < 1000 and "\n" not in found["said"], found
    read = int(found["said"] == "read")
    outcome("large on purpose", name, 1, "", refused=1 - read, read=read, mb=found["peak_mb"])
