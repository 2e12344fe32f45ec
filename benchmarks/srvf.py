"""SRVF encoding, decoding and geodesic interpolation of 1,000 motions of 30 x 204, against fdasrsf and geomstats.

    python -m benchmarks.srvf [--json FILE] [--quick] [--geomstats PYTHON]

* `srvf_encode_decode`: motions to points on the sphere, and back.
* `geodesic`: the midpoints of 1,000 pairs of points.

fdasrsf takes one curve at a time. geomstats takes all at once; it needs an older NumPy and runs in an environment of
its own, in turns with facejax: `make geomstats` installs it in .venv-geomstats. `NumPy` is facejax's algorithm in
NumPy, to separate the effect of the library from that of the compiler. Both peers work in float64. Results are
checked first: geomstats agrees with facejax; fdasrsf uses central differences and the trapezoidal rule where facejax
and the paper's eq. 1 use forward differences, so that it reconstructs a smooth motion within a hundredth of its
extent. Bytes are those that must be read and written. Cost against size: 10 to 10,000 motions, 10 to 1,000 frames.
About a minute.
"""

from __future__ import annotations

import contextlib
import dataclasses
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import _equal, _measure, _sizes
from facejax.cli import runtime
from facejax.geometry import sphere, srvf

ROOT = Path(__file__).parents[1]


@dataclasses.dataclass(frozen=True)
class Config(_measure.Options):
    """Options of the benchmark."""

    motions: int = 1000
    """Number of motions."""
    frames: int = 30
    """Number of frames."""
    landmarks: int = 68
    """Number of landmarks."""
    geomstats: Path = ROOT / ".venv-geomstats" / "bin" / "python"
    """Python interpreter with geomstats installed; without it the peer is left out."""
    along_motions: tuple[int, ...] = (10, 100, 1000, 10_000)
    """Numbers of motions at which the cost is measured."""
    along_frames: tuple[int, ...] = (10, 30, 100, 300, 1000)
    """Numbers of frames at which the cost of 100 motions is measured."""


def run(config: Config) -> _measure.Found:
    """Measure and return the rows."""
    curves = smooth(config.motions, config.frames, config.landmarks)
    points, other = points_of(curves)
    tasks = {"encode_decode": round_trip(curves), "geodesic": lambda: halfway(points, other)}
    theirs = {"encode_decode": {}, "geodesic": {}}
    with contextlib.ExitStack() as stack:
        for name, found in _one_by_one(np.asarray(curves, np.float64)).items():
            theirs[name] |= found
        for name, found in stack.enter_context(_geomstats(config.geomstats, np.asarray(curves, np.float64))).items():
            theirs[name] |= found
        _check(curves, points, other, theirs)
        numpy = {"encode_decode": _numpy_round_trip(curves), "geodesic": _numpy_halfway(points, other)}
        rows, number = [], 4e-9 * curves.size
        for name, gbyte in (("encode_decode", 2 * number), ("geodesic", 3 * number)):
            sides = {"facejax": tasks[name], "NumPy": numpy[name]}
            _equal.check(sides["facejax"](), sides["NumPy"]())
            name_of = f"srvf_{name}" if name == "encode_decode" else name
            options = {"repeats": 5 if config.quick else 11, "items": config.motions, "unit": "motions"}
            rows.append(_measure.row(name_of, sides | theirs[name], peers=list(theirs[name]), gbyte=gbyte, **options))
    return rows, [] if config.quick else _by_size(config)


def smooth(motions: int, frames: int, landmarks: int) -> jax.Array:
    """Return random smooth motions (K, T, L, 3) in mm that return to their start."""
    rng = np.random.default_rng(0)
    tau = np.linspace(0, 1, frames)[:, None, None]
    parts = [np.sin(np.pi * k * tau) * rng.normal(size=(motions, 1, landmarks, 3)) / k for k in (1, 2, 3)]
    return jnp.asarray(10 * rng.normal(size=(motions, 1, landmarks, 3)) + sum(parts), jnp.float32)


def points_of(curves: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the motions' points on the sphere, and the same shifted by one, as second ends of geodesics."""
    points = srvf.encode(curves)[0]
    return points, jnp.roll(points, 1, axis=0)


def round_trip(curves: jax.Array) -> Callable[[], jax.Array]:
    """Return a function that encodes and decodes all motions."""
    there_and_back = jax.jit(lambda curves: srvf.decode(*srvf.encode(curves), curves[:, 0]))
    return lambda: there_and_back(curves)


@jax.jit
def halfway(first: jax.Array, second: jax.Array) -> jax.Array:
    """Return the midpoints of geodesics."""
    return sphere.geodesic(first, second, 0.5)


def _numpy_round_trip(curves: jax.Array) -> Callable[[], np.ndarray]:
    held = np.asarray(curves)

    def both() -> np.ndarray:
        steps = np.diff(held, axis=1)
        norms = np.sqrt(np.einsum("ktlc,ktlc->kt", steps, steps))
        lengths = norms.sum(axis=1)
        q = steps * np.sqrt(steps.shape[1] / (norms * lengths[:, None]))[..., None, None]
        pace = (lengths / steps.shape[1])[:, None] * np.sqrt(np.einsum("ktlc,ktlc->kt", q, q))
        moved = np.cumsum(q * pace[..., None, None], axis=1)
        return np.concatenate([held[:, :1], held[:, :1] + moved], axis=1)

    return both


def _numpy_halfway(first: jax.Array, second: jax.Array) -> Callable[[], np.ndarray]:
    p, q = np.asarray(first), np.asarray(second)

    def half() -> np.ndarray:
        angle = np.arccos(np.einsum("ktlc,ktlc->k", p, q) / p.shape[1])
        return (np.sin(angle / 2) / np.sin(angle))[:, None, None, None] * (p + q)

    return half


def _one_by_one(curves: np.ndarray) -> dict[str, dict[str, Callable]]:
    """Return fdasrsf's implementations, which take one curve (D, T) at a time; `curves` are (K, T, L, 3)."""
    try:
        from fdasrsf import curve_functions
    except ImportError:
        print('fdasrsf is not installed, the peer is left out: pip install ".[bench]" installs it.', file=sys.stderr)
        return {}
    flat = np.ascontiguousarray(curves.reshape(*curves.shape[:2], -1).transpose(0, 2, 1))

    def both() -> np.ndarray:
        found = []
        for curve in flat:
            q, length, _ = curve_functions.curve_to_q(curve)
            found.append(curve[:, :1] + length * curve_functions.q_to_curve(q))
        return np.stack(found)

    points = np.asarray(srvf.encode(jnp.asarray(curves, jnp.float32))[0], np.float64)
    points = np.ascontiguousarray(points.reshape(*points.shape[:2], -1).transpose(0, 2, 1))

    def half() -> np.ndarray:
        found = []
        for first, second in zip(points, np.roll(points, 1, axis=0), strict=True):
            angle = np.arccos(curve_functions.innerprod_q2(first, second))
            along = (second - np.cos(angle) * first) * (angle / np.sin(angle))
            found.append(curve_functions.elastic_shooting(first, 0.5 * along))
        return np.stack(found)

    return {"encode_decode": {"fdasrsf": both}, "geodesic": {"fdasrsf": half}}


@contextlib.contextmanager
def _geomstats(python: Path, curves: np.ndarray) -> Iterator[dict[str, dict[str, Callable]]]:
    """Start geomstats in a process that waits for tasks, and return its implementations."""
    if not python.exists():
        print(f"{python} is missing, the peer geomstats is left out: `make geomstats` installs it.", file=sys.stderr)
        yield {}
        return
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        np.save(folder / "curves.npy", curves.reshape(*curves.shape[:2], -1))
        command = [python, Path(__file__).with_name("_geomstats.py"), folder]
        environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
        # What `runtime.keep_memory` does for everybody in this process.
        environment |= {"MALLOC_MMAP_THRESHOLD_": str(1 << 30), "MALLOC_TRIM_THRESHOLD_": str(runtime.MAX_FREE_BYTES)}
        with subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
        ) as child:

            def ask(line: str) -> None:
                child.stdin.write(line + "\n")
                child.stdin.flush()
                if child.stdout.readline() != "done\n":
                    raise RuntimeError("the geomstats process has stopped; see its error above")

            if child.stdout.readline() != "ready\n":
                raise RuntimeError("the geomstats process did not start; see its error above")

            def saved(task: str) -> np.ndarray:
                ask(f"save {task}")
                return np.load(folder / f"{task}.npy")

            found = {}
            for task in ("encode_decode", "geodesic"):
                call = lambda task=task: ask(task)  # noqa: E731
                call.result = lambda task=task: saved(task)
                found[task] = {"geomstats": call}
            yield found
            child.stdin.close()


def _check(curves: jax.Array, points: jax.Array, other: jax.Array, theirs: dict) -> None:
    """Assert that the peers agree with facejax."""
    back, half = round_trip(curves)(), halfway(points, other)
    _equal.check(back, curves)
    for side, call in theirs["encode_decode"].items():
        if side == "geomstats":  # starts at the origin, without the first frame
            moved = (curves - curves[:, :1])[:, 1:]
            _equal.check(moved, call.result().reshape(moved.shape))
        else:
            found = call().transpose(0, 2, 1).reshape(curves.shape)
            _equal.check(curves - curves[:, :1], found - found[:, :1], tolerance=0.1)
    for side, call in theirs["geodesic"].items():
        found = call.result() * np.sqrt(points.shape[1]) if side == "geomstats" else call().transpose(0, 2, 1)
        _equal.check(half.reshape(len(half), -1), found.reshape(len(half), -1))


def _by_size(config: Config) -> list[dict]:
    def there(motions: int, frames: int) -> Callable:
        return round_trip(smooth(motions, frames, config.landmarks))

    def between(motions: int, frames: int) -> Callable:
        points = points_of(smooth(motions, frames, config.landmarks))
        return lambda: halfway(*points)

    rows = []
    for name, make in (("srvf_encode_decode", there), ("geodesic", between)):
        rows += _sizes.along(name, "motions", config.along_motions, lambda count, make=make: make(count, config.frames))
        rows += _sizes.along(f"{name}_100", "frames", config.along_frames, lambda count, make=make: make(100, count))
    return rows


if __name__ == "__main__":
    _measure.main("srvf", Config, run)
