"""The examples run on small settings and find what they say they find."""

import importlib.util
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from facejax.training import metric_logger

ROOT = Path(__file__).parents[1]
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))


def load(name):
    """Import examples/NAME.py as a module of its own."""
    spec = importlib.util.spec_from_file_location(f"example_{name}", ROOT / "examples" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # where dataclasses and pickle look it up
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_every_example_states_its_command_and_is_tested(path):
    text = path.read_text()
    assert f"    python examples/{path.name} --out runs/" in text
    assert len(text.splitlines()) <= 105
    assert f"test_{path.stem}" in globals(), f"{path.name} has no test here"


def test_srvf_curves(tmp_path, capsys):
    found = load("srvf_curves").main(out=tmp_path, count=6, frames=12)
    assert found["reconstruction_error"] < 1e-5 and found["geodesic_step_spread"] < 1e-5
    assert 0.5 < found["explained_by_two"] <= 1 and found["gradient_norm"] > 0
    with np.load(tmp_path / "curves.npz") as arrays:
        assert arrays["geodesic"].shape == (6, 12, 4, 3) and np.isfinite(arrays["extremes"]).all()
    assert str(tmp_path) in capsys.readouterr().out


def test_skeleton_wgan(tmp_path):
    found = load("skeleton_wgan").main(out=tmp_path, steps=50)
    assert metric_logger.read(tmp_path)[-1]["step"] == 50 and (tmp_path / "checkpoints").is_dir()
    # 32 of 64 by chance; 64 after 300 steps.
    assert found["nearest_recording_has_the_label"] > 0.6


def test_fit_targets(tmp_path):
    found = load("fit_targets").main(out=tmp_path, steps=12, frames=6)
    assert found["after_mm"] < 0.6 * found["before_mm"] and 0 < found["intensity"] < 2
    with np.load(tmp_path / "found.npz") as arrays:
        assert arrays["misses_mm"].shape == (12, 3) and np.isfinite(arrays["vertices"]).all()
    assert (tmp_path / "targets.png").is_file() and (tmp_path / "found.glb").is_file()


def test_spiral_decoder(tmp_path):
    found = load("spiral_decoder").main(out=tmp_path, steps=40)
    assert found["decoder"] < 0.9 * found["training mean"]
    assert (tmp_path / "predicted.ply").stat().st_size == (tmp_path / "true.ply").stat().st_size > 10_000


def test_lstm_prefix(tmp_path):
    found = load("lstm_prefix").main(out=tmp_path, steps=120)
    assert found["completed"] < 0.8 * found["last frame held"] < found["without prefix"]
    with np.load(tmp_path / "completed.npz") as arrays:
        np.testing.assert_allclose(arrays["completed"][:, :8], arrays["true"][:, :8], atol=1e-6)


def test_own_dataset(tmp_path):
    example = load("own_dataset")
    found = example.run(example.Config(out=tmp_path))
    assert found["ridge_mm"] < 0.5 * found["no_motion_mm"]
    (tmp_path / "recordings" / "X9-left.npy").write_bytes((tmp_path / "recordings" / "P0-left.npy").read_bytes())
    with pytest.raises(example.SourceError, match=r"X9-left.npy: unknown person 'X9', expected one of P0"):
        example.scan(tmp_path / "recordings")


def test_pipeline_on_devices(tmp_path):
    """In a process of its own, which may choose how many devices it has."""
    command = [sys.executable, ROOT / "examples" / "pipeline_on_devices.py", "--out", tmp_path, "--steps", "3"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    assert "4 devices, 8 motions on each per step" in done.stdout
    with np.load(tmp_path / "recogniser.npz") as arrays:
        assert arrays["in"].shape == (150, 64) and all(np.isfinite(arrays[name]).all() for name in arrays)
