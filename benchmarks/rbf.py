"""68 landmarks carried to 10,000 vertices over 135 frames: in one product, by SciPy, and with a system for each frame.

    python -m benchmarks.rbf [--json FILE] [--quick]

* `rbf_135x10000`: everything from a new face to its motion: the system, weights, all frames. SciPy's RBFInterpolator
  takes all 405 channels in one call. `weights and warp` leaves out the system, `warp` is what another motion of the
  same face costs.
* `rbf_refit_135x10000`: the same beside Seo & Luo's (2021) way, a new system for every frame, by SciPy: another answer,
  which depends on the path, see `rbf.refit`. `refit` is ours of that kind, and what SciPy's is checked against.

All else gives the same displacements, which is checked first. SciPy's calls work in float64 throughout, ours in
float64 up to the weights. Operations are those of two products, a vertex's weights (L + 4 by L) and its frames (L by
3 T), bytes those of the frames. Costs against size: vertices 1,000 to 100,000 and frames 10 to 1,000. About a minute.
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
    """What to measure."""

    vertices: int = 10_000
    """Of the mesh."""
    frames: int = 135
    """Of the motion: SL21's sequences."""
    along_vertices: tuple[int, ...] = (1_000, 3_000, 10_000, 30_000, 100_000)
    """At which the cost is measured."""
    along_frames: tuple[int, ...] = (10, 30, 100, 300, 1000)
    """At which the cost is measured."""


def run(config: Config) -> _measure.Found:
    """Rows of the tables."""
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
    """Landmarks (68, 3) of MakeHuman's head, points (count, 3) of its surface, displacements (frames, 68, 3), mm."""
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
    """Displacements (T, N, 3) of all frames in one call."""
    channels = np.moveaxis(moved, 1, 0).reshape(len(rest), -1)
    peer = RBFInterpolator(rest, channels, kernel="multiquadric", epsilon=1 / unit, degree=1)
    return np.moveaxis(peer(vertices).reshape(len(vertices), -1, 3), 1, 0)


def _scipy_refit(rest: np.ndarray, moved: np.ndarray, vertices: np.ndarray, units: list[float]) -> np.ndarray:
    """`rbf.refit` with SciPy's interpolator for each step."""
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
