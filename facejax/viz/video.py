"""Write videos: animated WebP and GIF with Pillow, MP4 with the ffmpeg of the extra `video`."""

import importlib.util
import os
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from PIL import Image

from facejax.io import atomic

FORMATS = (".webp", ".gif", ".mp4")


def write(path: str | os.PathLike[str], frames: ArrayLike, *, fps: float = 30.0, quality: int = 88) -> None:
    """Write pictures as a video, atomically. WebP and GIF loop and may merge equal frames; the timing is kept.

    Args:
      path: `.webp` (small, every browser), `.gif` (256 colours, times in hundredths of a second) or `.mp4`.
      frames: (T, height, width, 3) uint8.
      fps: frames per second.
      quality: 0 to 100, of WebP and MP4.

    Raises:
      ValueError: wrong shape, rate or suffix.
      ImportError: MP4 without imageio-ffmpeg.
      RuntimeError: ffmpeg failed.
    """
    path, frames = Path(path), np.asarray(frames)
    if frames.ndim != 4 or frames.shape[-1] != 3 or frames.dtype != np.uint8 or 0 in frames.shape:
        raise ValueError(f"frames must be (T, height, width, 3) uint8, got {frames.shape} {frames.dtype}")
    if not (np.isfinite(fps) and fps > 0):
        raise ValueError(f"fps must be positive, got {fps}")
    suffix = check(path)
    if suffix == ".mp4":
        with atomic.replace_file(path) as temporary:
            _write_mp4(temporary, frames, fps, quality)
        return
    first, *rest = [Image.fromarray(frame) for frame in frames]
    durations = _durations(len(frames), fps, 10 if suffix == ".gif" else 1)
    options: dict[str, Any] = {"quality": quality, "method": 4} if suffix == ".webp" else {"disposal": 1}
    with atomic.replace_file(path) as temporary:
        first.save(temporary, save_all=True, append_images=rest, duration=durations, loop=0, **options)


def check(path: str | os.PathLike[str]) -> str:
    """Return the suffix of a video that can be written on this machine; raise as `write` does otherwise."""
    suffix = Path(path).suffix.lower()
    if suffix not in FORMATS:
        raise ValueError(f"{path}: unknown video format {suffix!r}; expected {', '.join(FORMATS)}")
    if suffix == ".mp4" and importlib.util.find_spec("imageio_ffmpeg") is None:
        raise ImportError(f"{path}: MP4 needs imageio-ffmpeg: pip install 'facejax[video]'; .webp needs nothing")
    return suffix


def _durations(count: int, fps: float, unit: int) -> list[int]:
    """Return milliseconds per frame in whole units, rounded without accumulating errors."""
    ends = np.round(np.arange(count + 1) * 1000 / fps / unit).astype(int) * unit
    return np.maximum(np.diff(ends), unit).tolist()


def _write_mp4(path: Path, frames: np.ndarray, fps: float, quality: int) -> None:
    import imageio_ffmpeg  # pyright: ignore[reportMissingImports]

    # Most players need 4:2:0 colour, hence even sides: the last row or column is repeated where necessary.
    even = np.pad(frames, ((0, 0), (0, frames.shape[1] % 2), (0, frames.shape[2] % 2), (0, 0)), mode="edge")
    height, width = even.shape[1:3]
    source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", f"{fps:.6f}", "-i", "-"]
    # CRF 18 is visually lossless, 51 the worst.
    coding = ["-c:v", "libx264", "-crf", str(round(40 - quality / 4)), "-pix_fmt", "yuv420p"]
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-y", *source, *coding, "-movflags", "+faststart", str(path)]
    done = subprocess.run(command, input=even.tobytes(), capture_output=True)
    if done.returncode:
        last = done.stderr.decode(errors="replace").strip().splitlines()[-1:]
        raise RuntimeError(f"{path.suffix}: ffmpeg failed: {''.join(last)}")
