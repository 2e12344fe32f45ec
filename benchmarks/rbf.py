"""RBF warps of 10,000 vertices by 68 landmarks over 135 frames, against SciPy and against a system for each frame.

    python -m benchmarks.rbf [--json FILE] [--quick]

* `rbf_135x10000`: everything from a new face to its motion: the system, the weights, all frames. SciPy's
  RBFInterpolator takes all 405 channels in one call. `weights and warp` leaves out the system; `warp` is the cost of
  another motion of the same face.
* `rbf_refit_135x10000`: the same against the method of Seo & Luo (2021), a new system for every frame, in SciPy. Its
  result differs, since it depends on the path, see `rbf.refit`. `refit` is facejax's implementation of it, and
  SciPy's is checked against it.

All others give the same displacements, which is checked first. SciPy works in float64 throughout, facejax in float64
up to the weights. Operations are those of two products, a vertex's weights (L + 4 by L) and its frames (L by 3 T);
bytes are those of the frames. Cost against size: 1,000 to 100,000 vertices, 10 to 1,000 frames. About a minute.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import jax
import numpy as np
from scipy.interpolate import RBFInterpolator

from benchmarks import _equal, _measure, _sizes
from facejax.data.synthetic import makehuman
from facejax.geometry import rbf


@dataclasses.dataclass(frozen=True)
class Config(_measure.Options):
    """Options of the benchmark."""

    vertices: int = 10_000
    """Number of vertices of the mesh."""
    frames: int = 135
    """Number of frames; that of SL21's sequences."""
    along_vertices: tuple[int, ...] = (1_000, 3_000, 10_000, 30_000, 100_000)
    """Numbers of vertices at which the cost is measured."""
    along_frames: tuple[int, ...] = (10, 30, 100, 300, 1000)
    """Numbers of frames at which the cost is measured."""


def run(config: Config) -> _measure.Found:
    """Measure and return the rows."""
    rest, vertices, moved = _problem(config.vertices, config.frames)
    found = rbf.fit(rest)
    weights = jax.device_put(rbf.weights(found, vertices))
    once = {
        "facejax": lambda: rbf.apply(rbf.fit(rest), moved, vertices),
        "weights and warp": lambda: rbf.apply(found, moved, vertices),
        "warp": lambda: rbf.warp(weights, moved),
        "SciPy": lambda: _scipy(rest, moved, vertices, found.unit),
    }
    units = [rbf.fit(rest + before).unit for before in _before(moved)]
    refit = lambda: rbf.refit(rest, moved, vertices)  # noqa: E731
    each = {"SciPy, each frame": lambda: _scipy_refit(rest, moved, vertices, units)}
    for side in list(once)[1:]:
        _equal.check(once["facejax"](), once[side](), tolerance=1e-5)
    _equal.check(refit(), each["SciPy, each frame"](), tolerance=1e-5)
    count, frames = len(rest), config.frames
    gflop = 2e-9 * config.vertices * ((count + 4) * count + count * 3 * frames)
    work = {"gflop": gflop, "gbyte": 12e-9 * config.vertices * frames}
    name, options = f"{frames}x{config.vertices}", {"items": frames, "unit": "frames", **work}
    repeats = 7 if config.quick else 25
    rows = [_measure.row(f"rbf_{name}", once, peers=["SciPy"], repeats=repeats, **options)]
    sides = {"facejax": once["facejax"], "refit": refit} | each
    rows.append(_measure.row(f"rbf_refit_{name}", sides, peers=list(each), repeats=5, **options))
    return rows, [] if config.quick else _by_size(config)


def _problem(count: int, frames: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return landmarks (68, 3) and surface points (count, 3) of MakeHuman's head, displacements (frames, 68, 3); mm."""
    shape = makehuman.template()
    rng = np.random.default_rng(0)
    corners = shape.vertices[shape.faces[rng.integers(len(shape.faces), size=count)]].astype(np.float64)
    points = np.einsum("nc,ncx->nx", rng.dirichlet(np.ones(3), count), corners)
    time = np.linspace(0, np.pi, frames + 2)[1:-1]
    moved = np.sin(time)[:, None, None] * 2 * rng.normal(size=(68, 3))
    return shape.vertices[shape.landmarks].astype(np.float64), points, moved.astype(np.float32)


def _before(moved: np.ndarray) -> np.ndarray:
    return np.concatenate([np.zeros_like(moved[:1]), moved[:-1]]).astype(np.float64)


def _scipy(rest: np.ndarray, moved: np.ndarray, vertices: np.ndarray, unit: float) -> np.ndarray:
    """Return the displacements (T, N, 3) of all frames by one call of SciPy."""
    channels = np.moveaxis(moved, 1, 0).reshape(len(rest), -1)
    peer = RBFInterpolator(rest, channels, kernel="multiquadric", epsilon=1 / unit, degree=1)
    return np.moveaxis(peer(vertices).reshape(len(vertices), -1, 3), 1, 0)


def _scipy_refit(rest: np.ndarray, moved: np.ndarray, vertices: np.ndarray, units: list[float]) -> np.ndarray:
    """`rbf.refit` with SciPy's interpolator for each frame."""
    at, out = vertices.copy(), []
    for before, here, unit in zip(_before(moved), moved, units, strict=True):
        at = at + RBFInterpolator(rest + before, here - before, kernel="multiquadric", epsilon=1 / unit, degree=1)(at)
        out.append(at - vertices)
    return np.stack(out)


def _by_size(config: Config) -> list[dict]:
    def whole(vertices: int, frames: int) -> Callable:
        rest, points, moved = _problem(vertices, frames)
        return lambda: rbf.apply(rbf.fit(rest), moved, points)

    rows = _sizes.along("rbf", "vertices", config.along_vertices, lambda count: whole(count, config.frames))
    return rows + _sizes.along("rbf", "frames", config.along_frames, lambda count: whole(config.vertices, count))


if __name__ == "__main__":
    _measure.main("rbf", Config, run)
