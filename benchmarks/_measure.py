"""Rows, command line and result files of the benchmarks.

Implementations that are compared run in turns in one process, since machines are noisy and drift; first calls are timed
separately, and the ratio of medians is reported. A row is

    {"name", "first_s", "min_s", "median_s", "per_s", "unit",   of facejax; first_s includes compilation
     "peer", "peer_median_s", "ratio",                          the fastest peer, and its time over ours
     "gflop", "roofline_share",                                 see `benchmarks._roofline`
     "sides": {name: {"first_s", "min_s", "median_s"}}}         of all implementations

with None where there is no peer or no count of operations. `calls` gives the number of repetitions of the work in one
call, for implementations that scan over it.
"""

from __future__ import annotations

import dataclasses
import json
import os
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import jax
import tyro

from benchmarks import _machine, _roofline, _sizes, _timing
from facejax.cli import runtime
from facejax.io import atomic, errors

OURS = "facejax"
Row = dict[str, Any]
Found = tuple[list[Row], list[Row]]  # rows, and rows of cost against size


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of every benchmark."""

    json: Path | None = None
    """JSON file to write the results to."""
    quick: bool = False
    """Use fewer repeats, and measure no cost against size."""


Chosen = TypeVar("Chosen", bound=Options)


def row(
    name: str,
    functions: Mapping[str, Callable[[], Any]],
    *,
    peers: Sequence[str] = (),
    repeats: int = 20,
    calls: Mapping[str, int] | None = None,
    items: int = 1,
    unit: str = "",
    gflop: float | None = None,
    gbyte: float | None = None,
    **about: Any,
) -> Row:
    """Time implementations in turns and return the row; `items`, `gflop` and `gbyte` are per repetition of the work."""
    jax.clear_caches()  # so that the first call includes compilation
    found = _timing.interleaved(functions, repeats=repeats)
    for side, count in (calls or {}).items():
        found[side] |= {key: found[side][key] / count for key in ("min_s", "median_s")}
    ours, peer = found[OURS], min(peers, key=lambda side: found[side]["median_s"], default=None)
    median = found[peer]["median_s"] if peer else None
    made = {"name": name, **ours, "per_s": items / ours["median_s"], "unit": unit}
    made |= {"peer": peer, "peer_median_s": median, "ratio": median / ours["median_s"] if peer else None}
    share = _roofline.share(ours["median_s"], gflop=gflop, gbyte=gbyte)
    made |= {"gflop": gflop, "roofline_share": share, **about, "sides": found}
    print(_summary(made), file=sys.stderr, flush=True)
    return made


def lone(name: str, times: Mapping[str, float], *, items: int = 1, unit: str = "", **about: Any) -> Row:
    """Return a row from times measured elsewhere, without a peer."""
    made = {"name": name, **times, "per_s": items / times["median_s"], "unit": unit}
    made |= dict.fromkeys(("peer", "peer_median_s", "ratio", "gflop", "roofline_share"))
    made |= {**about, "sides": {OURS: dict(times)}}
    print(_summary(made), file=sys.stderr, flush=True)
    return made


def main(name: str, config_type: type[Chosen], run: Callable[[Chosen], Found]) -> None:
    """Parse the command line, run the benchmark, print the tables and write the JSON file.

    Invalid input ends with a one-line message on standard error and exit code 2.
    """
    description = sys.modules[run.__module__].__doc__
    config = tyro.cli(config_type, prog=f"python -m benchmarks.{name}", description=description)
    if config.json is not None and (problem := _unwritable(config.json)):
        print(f"benchmarks.{name}: --json {config.json}: {problem}", file=sys.stderr)
        raise SystemExit(2)
    runtime.keep_memory()  # applies to the peers in this process as well
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else None
    begun = time.perf_counter()
    try:
        rows, sizes = run(config)
    except (ValueError, RuntimeError, OSError, AssertionError, IndexError, ZeroDivisionError) as error:
        said = f"the results of facejax and a peer differ: {error}" if isinstance(error, AssertionError) else str(error)
        print(f"benchmarks.{name}: {errors.one_line(said)}", file=sys.stderr)
        raise SystemExit(2) from None
    print(table(rows))
    if sizes:
        print("\n" + _sizes.table(sizes))
    if config.json is not None:
        about = {"seconds": round(time.perf_counter() - begun, 1), "load": load}
        write(config.json, {"benchmark": name, **about, "rows": rows, "sizes": sizes, "machine": _machine.about()})


def _unwritable(path: Path) -> str | None:
    """Return why a file cannot be written, or None; checked before anything is measured."""
    if path.is_dir():
        return "is a folder"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        return error.strerror
    return None if os.access(path.parent, os.W_OK) else "its folder is not writable"


def write(path: Path, document: Any) -> None:
    """Write a JSON file atomically."""
    with atomic.replace_file(path) as temporary:
        temporary.write_text(json.dumps(document, indent=1) + "\n")


def table(rows: Sequence[Row]) -> str:
    """Return rows as a Markdown table."""
    lines = ["| work | median | min | first call | rate | fastest peer | ratio | of the roofline |", "|" + " --- |" * 8]
    for made in rows:
        peer = f"{made['peer']}: {seconds(made['peer_median_s'])}" if made["peer"] else ""
        ratio = f"{made['ratio']:.2f}x" if made["ratio"] else ""
        share = f"{made['roofline_share']:.0%}" if made["roofline_share"] else ""
        times = " | ".join(seconds(made[key]) for key in ("median_s", "min_s", "first_s"))
        rate = f"{made['per_s']:,.4g} {made['unit']}/s" if made["unit"] else ""
        memory = f" ({made['memory_mb']:,.0f} MB)" if "memory_mb" in made else ""
        lines.append(f"| `{made['name']}`{memory} | {times} | {rate} | {peer} | {ratio} | {share} |")
    return "\n".join(lines)


def seconds(value: float) -> str:
    """Format a time with three significant digits in s, ms or us."""
    for unit, size in (("s", 1.0), ("ms", 1e-3)):
        if value >= size:
            return f"{value / size:.3g} {unit}"
    return f"{value * 1e6:.3g} us"


def _summary(made: Row) -> str:
    sides = (f"{side} {seconds(times['median_s'])}" for side, times in made["sides"].items())
    return f"{made['name']}: {', '.join(sides)}"
