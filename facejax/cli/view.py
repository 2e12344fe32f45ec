"""`facejax view`: show an animation or a mesh in a browser, as one HTML page."""

from __future__ import annotations

import webbrowser
from pathlib import Path

import numpy as np

from facejax import io
from facejax.cli import checks, outputs
from facejax.cli.arguments import View


def run(command: View) -> None:
    """Write the page, print its path, and open it."""
    page = write_page(command.file, command.out, fps=command.fps)
    outputs.report([page])
    if command.open:
        webbrowser.open(page.resolve().as_uri())


def write_page(path: Path, out: Path | None = None, *, fps: float | None = None) -> Path:
    """Write one HTML page of an animation or a mesh; return its path.

    A file that is a page already is returned as it is. `out` is the page, or a folder for it. Raises `ValueError` or
    `MeshError` for a file that cannot be shown.
    """
    page = checks.page_path(path, out)
    if path.suffix.lower() == ".html":
        return path
    vertices, triangles, extra = _animation(path)
    stored = extra.pop("fps", 30.0)
    rate = stored if fps is None else fps
    checks.check_fps(rate)
    outputs.make_output_folder(page.parent)
    io.save(page, vertices, triangles, fps=rate, title=path.stem, **extra)
    return page


def _animation(path: Path) -> tuple[np.ndarray, np.ndarray | None, dict]:
    if path.suffix.lower() != ".npz":
        mesh = io.load_mesh(path)
        if mesh.faces is None:
            raise ValueError(f"{path}: has no triangles; expected a mesh with faces")
        return mesh.vertices, mesh.faces, {}
    return io.meshes.read_animation(path)
