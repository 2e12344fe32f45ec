"""Peak-to-peak transitions from neutral-to-peak motions: three implementations, and a pass over 300,000.

    python -m benchmarks.augment [--json FILE] [--quick]

* `transitions_1280`, between 1,440 onsets, at the "performed" pace: facejax; `decoded in full`, the plain
  implementation, which decodes every point of the geodesics; `NumPy`, facejax's algorithm in NumPy. Both are peers; all
  three must agree.
* `transitions_300000_PACE`: streamed in a process of its own, with its peak memory: `before_mb` once the data are
  loaded, `memory_mb` at the end. --quick makes a fifteenth of them.
* `select_306000`: selection of the 1,000 nearest transitions of every pair of labels, without computing all.

Cost against size: 128 to 8,192 transitions, 10 to 300 frames. About a minute, half with --quick.
"""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks import _measure, _sizes, _transitions
from facejax import augment

ROOT = Path(__file__).parents[1]


@dataclasses.dataclass(frozen=True)
class Config(_measure.Options):
    """Options of the benchmark."""

    labels: int = 19
    """Number of labels."""
    people: int = 80
    """Number of people, each performing all labels but neutral once."""
    steps: int = 29
    """Number of steps of a motion."""
    landmarks: int = 68
    """Number of landmarks."""
    compared: int = 1280
    """Number of transitions that all implementations make."""
    transitions: int = 300_000
    """Number of transitions in the pass."""
    along_transitions: tuple[int, ...] = (128, 512, 2048, 8192)
    """Numbers of transitions at which the cost is measured."""
    along_frames: tuple[int, ...] = (10, 30, 100, 300)
    """Numbers of frames at which the cost of 128 transitions is measured."""


def run(config: Config) -> _measure.Found:
    """Measure and return the rows."""
    sizes = {name: getattr(config, name) for name in ("labels", "people", "steps", "landmarks")}
    sides = _transitions.forms(*_transitions.problem(config.compared, **sizes))
    options = {"repeats": 3 if config.quick else 9, "items": config.compared, "unit": "transitions"}
    rows = [_measure.row(f"transitions_{config.compared}", sides, peers=["NumPy", "decoded in full"], **options)]
    count = config.transitions // 15 if config.quick else config.transitions
    rows += [_pass(count, pace, sizes) for pace in augment.TIME_WARPS]
    rows.append(_selection(config))
    return rows, [] if config.quick else _by_size(config, sizes)


def _pass(count: int, pace: str, sizes: dict[str, int]) -> _measure.Row:
    """Time one pass over many transitions in a process of its own."""
    found = apart(sizes | {"count": count, "pace": pace})
    seconds = found.pop("seconds")
    times = {"first_s": found.pop("first_s"), "min_s": seconds, "median_s": seconds}
    return _measure.lone(f"transitions_{count}_{pace}", times, items=count, unit="transitions", **found)


def apart(options: dict) -> dict[str, float]:
    command = [sys.executable, "-m", "benchmarks._transitions", json.dumps(options)]
    return json.loads(subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.PIPE).stdout)


def _selection(config: Config) -> _measure.Row:
    rng = np.random.default_rng(0)
    labels = np.repeat(np.arange(config.labels - 1), config.people)
    peaks = rng.normal(size=(len(labels), config.landmarks, 3))
    means = augment.prototypes(peaks, labels, classes=config.labels - 1)
    sides = {"facejax": lambda: augment.select(peaks, labels, means, per_pair=1000).pairs}
    count = (config.labels - 1) * (config.labels - 2) * 1000
    return _measure.row(f"select_{count}", sides, repeats=5, items=count, unit="transitions")


def _by_size(config: Config, sizes: dict[str, int]) -> list[dict]:
    def streamed(count: int, steps: int) -> Callable:
        motions, pairs = _transitions.problem(count, **sizes | {"steps": steps})
        walk = partial(augment.transitions, motions, pairs, frames=steps + 1, time_warp="performed")
        return lambda: [np.asarray(part) for part in walk()]

    rows = _sizes.along(
        "transitions", "transitions", config.along_transitions, lambda count: streamed(count, config.steps)
    )
    return rows + _sizes.along(
        "transitions_128", "frames", config.along_frames, lambda frames: streamed(128, frames - 1)
    )


if __name__ == "__main__":
    _measure.main("augment", Config, run)
