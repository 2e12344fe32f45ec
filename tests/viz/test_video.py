"""Films read back: frame count, timing, pixels."""

import importlib.util
import subprocess
import sys

import numpy as np
import pytest
from PIL import Image

from facejax.viz import video


def _frames(count=5, height=24, width=32):
    rows = np.linspace(0, 255, height)[:, None] * np.ones(width)
    return np.stack([np.stack([rows, rows * 0 + 40 * t, 255 - rows], -1) for t in range(count)]).astype(np.uint8)


@pytest.mark.parametrize(("suffix", "unit", "error"), [(".webp", 1, 12), (".gif", 10, 30)])
def test_webp_and_gif_keep_frames_and_time(tmp_path, suffix, unit, error):
    frames = _frames()
    video.write(tmp_path / f"film{suffix}", frames, fps=30)
    with Image.open(tmp_path / f"film{suffix}") as read:
        assert read.n_frames == 5 and read.info["loop"] == 0
        durations = []
        for t in range(5):
            read.seek(t)
            read.load()
            durations.append(read.info["duration"])
            assert np.abs(np.asarray(read.convert("RGB"), int) - frames[t]).mean() < error
    assert all(value % unit == 0 for value in durations)
    assert sum(durations) == pytest.approx(5000 / 30, abs=unit / 2 + 0.5)
    assert len(list(tmp_path.iterdir())) == 1


def test_mp4(tmp_path):
    ffmpeg = pytest.importorskip("imageio_ffmpeg", reason="MP4 needs the extra `video` (imageio-ffmpeg)")
    frames = _frames(height=33, width=47)
    video.write(tmp_path / "film.mp4", frames, fps=25)
    command = [
        ffmpeg.get_ffmpeg_exe(),
        "-i",
        str(tmp_path / "film.mp4"),
        "-f",
        "rawvideo",
        "-pix_fmt",
        "rgb24",
        "-",
    ]
    done = subprocess.run(command, capture_output=True, check=True)
    pictures = np.frombuffer(done.stdout, np.uint8).reshape(-1, 34, 48, 3)
    assert len(pictures) == 5 and b"25 fps" in done.stderr and b"yuv420p" in done.stderr
    assert np.abs(pictures[2][:33, :47].astype(int) - frames[2]).mean() < 12


def test_mp4_without_ffmpeg_names_the_extra(tmp_path, monkeypatch):
    monkeypatch.delitem(sys.modules, "imageio_ffmpeg", raising=False)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ImportError, match=r"facejax\[video\]"):
        video.write(tmp_path / "film.mp4", _frames())
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("name", "frames", "fps", "message"),
    [
        ("film.avi", _frames(), 30, "unknown video format '.avi'"),
        ("film.webp", _frames().astype(float), 30, "uint8, got"),
        ("film.webp", _frames()[0], 30, "frames must be"),
        ("film.webp", _frames(), 0, "fps must be positive"),
    ],
)
def test_refusals(tmp_path, name, frames, fps, message):
    with pytest.raises(ValueError, match=message):
        video.write(tmp_path / name, frames, fps=fps)
