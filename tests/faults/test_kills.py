"""Training loops killed at random moments and restarted end with the same bits as uninterrupted ones."""

import hashlib
import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.data import captures
from tests.faults import loops
from tests.faults._record import TRIES, outcome

HERE = Path(__file__).parent
LOOP = HERE / "loops.py"
ROOT = HERE.parents[1]
QUICK = ("flow",)  # the loops that `make test` kills


def started(command, **environment):
    environment = os.environ | {"PYTHONPATH": str(ROOT), "JAX_PLATFORMS": "cpu"} | environment
    return subprocess.Popen(
        [str(part) for part in command], env=environment, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        text=True, start_new_session=True,
    )  # fmt: skip


def finished(process):
    out, err = process.communicate(timeout=600)
    assert process.returncode == 0, err
    return out


def killed(command, longest, *, after=""):
    """Start a command and kill it and its children within `longest` seconds; return whether it was still running.

    Seconds count from its first line with `after`.
    """
    process = started(command)
    for line in process.stdout if after else ():
        if after in line:
            break
    time.sleep(random.uniform(0, longest))
    alive = process.poll() is None
    if alive:
        os.killpg(process.pid, signal.SIGKILL)
    process.communicate()
    return alive


def newest(folder):
    return max((int(path.name) for path in (folder / "checkpoints").glob("[0-9]*") if path.name.isdigit()), default=0)


@pytest.mark.parametrize("loop", [pytest.param(n, marks=[] if n in QUICK else pytest.mark.slow) for n in loops.LOOPS])
def test_a_training_that_is_killed_ends_with_the_same_bits(loop, tmp_path):
    whole = finished(started([sys.executable, LOOP, loop, tmp_path / "whole"])).split()[-1]
    kills, rounds, tries = 0, 0, TRIES or 2
    while kills < tries:
        folder, rounds, last = tmp_path / f"killed{rounds}", rounds + 1, 0
        command = [sys.executable, LOOP, loop, folder, "--pause", "0.05"]
        while kills < tries:
            # Now and then before the first step, or while what was left behind is read.
            alive = killed(command, 0.6, after="begun" if random.random() < 0.8 else "")
            kills += alive
            assert newest(folder) >= last, "a checkpoint was lost"
            last = newest(folder)
            if not alive or last == loops.STEPS:
                break
        assert finished(started([sys.executable, LOOP, loop, folder])).split()[-1] == whole
    outcome("kill -9", f"training {loop}", kills, "resumed to the same bits")


def contents(folder):
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*")) if path.is_file()
    }  # fmt: skip


def until_done(command, folder, expected, tries, longest):
    """Kill and start again until a folder is made, so often that it was killed `tries` times; each as expected."""
    kills = 0
    while kills < tries:
        kills += killed([*command, folder], longest)
        if (folder / "index.json").exists():
            assert contents(folder) == expected
            subprocess.run(["rm", "-r", folder], check=True)
    finished(started([*command, folder]))
    assert contents(folder) == expected
    return kills


def test_a_corpus_that_is_killed_has_no_gaps_and_no_duplicates(tmp_path):
    command = [
        sys.executable,
        "-m",
        "facejax.cli",
        "generate",
        "--count",
        "60",
        "--shard",
        "4",
        "--frames",
        "6",
        "--out",
    ]
    begun = time.monotonic()
    finished(started([*command, tmp_path / "whole"]))
    took = time.monotonic() - begun
    kills = until_done(command, tmp_path / "killed", contents(tmp_path / "whole"), TRIES or 2, took)
    outcome("kill -9", "facejax generate --count", kills, "the same bytes: no gap, no duplicate")


@pytest.mark.slow
def test_a_dataset_whose_preparation_is_killed_comes_out_the_same(tiny_store, tmp_path):
    captures.coma(tmp_path / "raw", tiny_store)
    marks = tmp_path / "marks.json"
    marks.write_text(json.dumps({"indices": tiny_store.landmark_index.tolist()}))
    command = [sys.executable, "-m", "facejax.cli", "data", "prepare", "coma", "--root", tmp_path / "raw"]
    command += ["--landmarks", marks, "--workers", "2", "--out"]
    begun = time.monotonic()
    finished(started([*command, tmp_path / "whole"]))
    took = time.monotonic() - begun
    kills = until_done(command, tmp_path / "killed", contents(tmp_path / "whole"), TRIES or 5, took)
    outcome("kill -9", "facejax data prepare", kills, "the same bytes")
