"""`facejax view`: show an animation or a mesh in a browser, as one HTML page."""

from __future__ import annotations

import webbrowser
from pathlib import Path

import numpy as np

from facejax import io
from facejax.cli import checks, outputs
from facejax.cli.arguments import View
from facejax.io import meshes


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
    rate = extra.get("fps", 30.0) if fps is None else fps
    checks.check_fps(rate)
    outputs.make_output_folder(page.parent)
    io.save(page, vertices, triangles, fps=rate, title=path.stem, landmarks=extra.get("landmarks"))
    return page


def _animation(path: Path) -> tuple[np.ndarray, np.ndarray, meshes.AnimationExtra]:
    if path.suffix.lower() != ".npz":
        mesh = io.load_mesh(path)
        if mesh.faces is None:
            raise ValueError(f"{path}: has no triangles; expected a mesh with faces")
        return mesh.vertices, mesh.faces, {}
    vertices, triangles, extra = meshes.read_animation(path)
    assert triangles is not None  # only a bare animation lacks them
    return vertices, triangles, extra
