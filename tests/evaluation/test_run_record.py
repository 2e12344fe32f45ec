"""Provenance of results: commit, processor, cores."""

import os
import re
import subprocess

from facejax.evaluation import run_record


def test_the_commit_is_marked_where_files_differ(tmp_path):
    assert run_record.commit(tmp_path) is None
    identity = ["-c", "user.name=a", "-c", "user.email=a@b.c"]
    (tmp_path / "file").write_text("1")
    for command in (["init", "-q"], ["add", "file"], [*identity, "commit", "-q", "-m", "first"]):
        subprocess.run(["git", *command], cwd=tmp_path, check=True, capture_output=True)
    assert re.fullmatch("[0-9a-f]{7,40}", run_record.commit(tmp_path))
    (tmp_path / "file").write_text("2")
    assert run_record.commit(tmp_path).endswith("-dirty")


def test_processor_and_cores():
    assert run_record.processor()
    assert 1 <= run_record.usable_cores() <= os.cpu_count()
