"""Full disks: a one-line error, no partial files, and existing files unchanged."""

import os
import resource
import subprocess
import sys

import numpy as np
import pytest

from facejax import io
from facejax.io import weights
from tests.faults._record import outcome
from tests.faults.test_kills import LOOP, ROOT, contents, finished, newest, started

FACEJAX = [sys.executable, "-m", "facejax.cli"]


@pytest.fixture
def small():
    """No file of this process may grow beyond 4 kB, as if the disk ended there."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)

    def set_(size):
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))

    yield set_
    set_(soft)


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".npz", ".glb", ".html", ".safetensors"])
def test_a_file_that_does_not_fit_leaves_the_old_one(suffix, small, tmp_path):
    path = tmp_path / f"face{suffix}"
    rng = np.random.default_rng(0)

    def write(count):
        vertices = rng.normal(size=(count, 3)).astype(np.float32)
        if suffix == ".safetensors":
            weights.save(path, {"a": vertices})
        else:
            io.save(path, vertices, np.arange(count // 3 * 3, dtype=np.int32).reshape(-1, 3))

    write(30)
    before = contents(tmp_path)
    small(4096)
    with pytest.raises(OSError):
        write(3000)
    assert contents(tmp_path) == before


LIMITED = (
    "import os, resource, sys; resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[1]), resource.RLIM_INFINITY));"
    "os.execv(sys.executable, [sys.executable, *sys.argv[2:]])"
)


def within(size, command):
    """A Python command whose files may not grow beyond a size: its exit code and what it says."""
    environment = os.environ | {"PYTHONPATH": str(ROOT), "JAX_ENABLE_COMPILATION_CACHE": "false"}
    limited = [sys.executable, "-c", LIMITED, size, *command[1:]]
    done = subprocess.run(list(map(str, limited)), env=environment, cwd=ROOT, capture_output=True, text=True)
    return done.returncode, done.stderr


def test_a_corpus_that_does_not_fit_goes_on_where_there_is_room(tmp_path):
    command = [*FACEJAX, "generate", "--count", "12", "--shard", "4", "--frames", "6", "--out", tmp_path / "corpus"]
    code, said = within(4096, command)
    assert code == 2 and said.startswith("facejax: ") and said.count("\n") == 1, said
    assert not (tmp_path / "corpus" / "index.json").exists()
    assert not [path for path in (tmp_path / "corpus" / "shards").iterdir()]
    finished(started(command))
    outcome("a disk that is full", "facejax generate --count", 1, "one line; goes on when there is room")


def mounted(tmp_path, size):
    place = tmp_path / "disk"
    place.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(place)]
    if subprocess.run(command, capture_output=True).returncode:
        pytest.skip("a small disk can be made by root alone")
    return place


@pytest.mark.slow
def test_a_training_keeps_its_last_good_checkpoint_on_a_full_disk(tmp_path):
    """A disk that is filled up after some checkpoints; with room again, the run ends with the same bits."""
    whole = finished(started([sys.executable, LOOP, "flow", tmp_path / "whole"])).split()[-1]
    place = mounted(tmp_path, "3m")
    folder = place / "run"
    process = started([sys.executable, LOOP, "flow", folder, "--pause", "0.3"])
    try:
        while newest(folder) < 8:
            assert process.poll() is None, process.communicate()
        with (place / "filler").open("wb", buffering=0) as filler, pytest.raises(OSError):
            while True:
                filler.write(bytes(4096))
        said = process.communicate(timeout=120)[1]
        last = newest(folder)
        assert process.returncode and last >= 8
        assert f"the last good one is step {last}" in said or f"the last good checkpoint is step {last}" in said, said
        (place / "filler").unlink()
        assert finished(started([sys.executable, LOOP, "flow", folder])).split()[-1] == whole
    finally:
        if process.poll() is None:
            process.kill()
        process.communicate()
        subprocess.run(["umount", place], check=True)
    outcome("a disk that is full", "training", 1, "stops, names the last good checkpoint; resumed to the same bits")
