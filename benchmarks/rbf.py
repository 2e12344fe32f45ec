"""68 landmarks carried to 10,000 vertices over 135 frames: in one product, by SciPy, and with a system for each frame.

    python -m benchmarks.rbf [--json FILE] [--quick]

`full` is everything from a new face to its motion: fit, weights, warp. SciPy's RBFInterpolator takes all 405 channels
in one call. Seo & Luo (2021) solve for every frame: `refit_per_frame` is that, `scipy_per_frame` too. What is compared
gives the same displacements, which is checked first. Then the cost against the number of vertices, unless --quick.

SciPy's one call does the same sums in float64. With one BLAS thread (OPENBLAS_NUM_THREADS=1) it takes about as long as
`full`; where other work holds the cores, its many threaded calls wait for one another, and it takes several times as
long. About two minutes.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np
import tyro
from scipy.interpolate import RBFInterpolator

from benchmarks import _measure
from facejax.data import makehuman
from facejax.geometry import rbf

SIZES = (1_000, 3_000, 10_000, 30_000, 100_000)


@dataclasses.dataclass(frozen=True)
class Config:
    json: Path | None = None
    """Also write the rows here."""
    quick: bool = False
    """Fewer repeats, one size."""
    vertices: int = 10_000
    """Of the mesh."""
    frames: int = 135
    """Of the motion: SL21's sequences."""


def run(config: Config) -> list[dict]:
    """Rows of the table."""
    rest, vertices, moved = _problem(config.vertices, config.frames)
    found = rbf.fit(rest)
    weights = rbf.weights(found, vertices)
    once = {
        "full": lambda: rbf.apply(rbf.fit(rest), moved, vertices),
        "weights_and_warp": lambda: rbf.apply(found, moved, vertices),
        "warp": lambda: rbf.warp(weights, moved),
        "scipy_one_call": lambda: _scipy(rest, moved, vertices, found.unit),
    }
    units = [rbf.fit(rest + before).unit for before in _before(moved)]
    each = {
        "refit_per_frame": lambda: rbf.refit(rest, moved, vertices),
        "scipy_per_frame": lambda: _scipy_refit(rest, moved, vertices, units),
    }
    for group in (once, each):
        _check_equal(group)
    rows = _rows(once | each, 3 if config.quick else 9, vertices=config.vertices, frames=config.frames)
    for size in () if config.quick else SIZES:
        rows += _size(size, config.frames)
    return rows


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


def _check_equal(functions: dict[str, Callable]) -> None:
    """A fast wrong answer is no answer."""
    expected, *others = (np.asarray(function()) for function in functions.values())
    for other in others:
        np.testing.assert_allclose(other, expected, atol=1e-4)


def _rows(functions: dict[str, Callable], repeats: int, **about: int) -> list[dict]:
    found = _measure.interleaved(functions, repeats=repeats)
    full = found["full"]["median_s"]
    return [
        {
            "name": name,
            **about,
            **{key.replace("_s", "_ms"): 1e3 * value for key, value in times.items()},
            "ms_per_frame": 1e3 * times["median_s"] / about["frames"],
            "over_full": times["median_s"] / full,
        }
        for name, times in found.items()
    ]


def _size(size: int, frames: int) -> list[dict]:
    """`full`, its parts and SciPy's one call on another number of vertices."""
    rest, vertices, moved = _problem(size, frames)
    found = rbf.fit(rest)
    weights = jax.device_put(rbf.weights(found, vertices))
    functions = {
        "full": lambda: rbf.apply(rbf.fit(rest), moved, vertices),
        "warp": lambda: rbf.warp(weights, moved),
        "scipy_one_call": lambda: _scipy(rest, moved, vertices, found.unit),
    }
    return _rows(functions, 5, vertices=size, frames=frames)


if __name__ == "__main__":
    options = tyro.cli(Config, prog="python -m benchmarks.rbf", description=__doc__)
    _measure.report(run(options), options.json)
