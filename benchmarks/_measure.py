"""How benchmarks measure: functions in turns, in one process, their first call apart from the steady time after it.

Machines are noisy and drift: what is to be compared runs in turns, and the ratio of medians is the headline. A row is

    {"name", "first_s", "min_s", "median_s", "per_s", "unit",   of our own way; first_s holds compilation
     "peer", "peer_median_s", "ratio",                          the fastest of the peers, and how much slower it is
     "gflop", "roofline_share",                                 see `benchmarks._roofline`
     "sides": {name: {"first_s", "min_s", "median_s"}}}         everybody

with None where there is no peer, or no count of operations. `calls` says how many times a side does the work in one
call, where it is timed scanned.
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
from facejax.io import atomic

OURS = "facejax"
Row = dict[str, Any]
Found = tuple[list[Row], list[Row]]  # works, and costs against size


@dataclasses.dataclass(frozen=True)
class Options:
    """What every benchmark understands."""

    json: Path | None = None
    """Also write the rows here."""
    quick: bool = False
    """Fewer repeats, and no costs against size."""


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
    """Time functions in turns, of which one is ours; a call makes so many items at so many operations and bytes."""
    jax.clear_caches()  # the first call compiles again what was compiled for the checks
    found = _timing.interleaved(functions, repeats=repeats)
    for side, count in (calls or {}).items():
        found[side] |= {key: found[side][key] / count for key in ("min_s", "median_s")}
    ours, peer = found[OURS], min(peers, key=lambda side: found[side]["median_s"], default=None)
    median = found[peer]["median_s"] if peer else None
    made = {"name": name, **ours, "per_s": items / ours["median_s"], "unit": unit}
    made |= {"peer": peer, "peer_median_s": median, "ratio": median / ours["median_s"] if peer else None}
    share = _roofline.share(ours["median_s"], gflop=gflop, gbyte=gbyte)
    made |= {"gflop": gflop, "roofline_share": share, **about, "sides": found}
    print(_told(made), file=sys.stderr, flush=True)
    return made


def lone(name: str, times: Mapping[str, float], *, items: int = 1, unit: str = "", **about: Any) -> Row:
    """A row of what was timed elsewhere, with no peer."""
    made = {"name": name, **times, "per_s": items / times["median_s"], "unit": unit}
    made |= dict.fromkeys(("peer", "peer_median_s", "ratio", "gflop", "roofline_share"))
    made |= {**about, "sides": {OURS: dict(times)}}
    print(_told(made), file=sys.stderr, flush=True)
    return made


def main(name: str, config_type: type[Chosen], run: Callable[[Chosen], Found]) -> None:
    """Parse the command line, measure, print the tables, write the file. Bad input: one line, exit code 2."""
    description = sys.modules[run.__module__].__doc__
    config = tyro.cli(config_type, prog=f"python -m benchmarks.{name}", description=description)
    if config.json is not None and (problem := _unwritable(config.json)):
        print(f"benchmarks.{name}: --json {config.json}: {problem}", file=sys.stderr)
        raise SystemExit(2)
    runtime.keep_memory()  # for the peers in this process too
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else None
    begun = time.perf_counter()
    try:
        rows, sizes = run(config)
    except (ValueError, RuntimeError, OSError, AssertionError, IndexError, ZeroDivisionError) as error:
        said = f"ours and a peer's differ: {error}" if isinstance(error, AssertionError) else str(error)
        print(f"benchmarks.{name}: {atomic.one_line(said)}", file=sys.stderr)
        raise SystemExit(2) from None
    print(table(rows))
    if sizes:
        print("\n" + _sizes.table(sizes))
    if config.json is not None:
        about = {"seconds": round(time.perf_counter() - begun, 1), "load": load}
        write(config.json, {"benchmark": name, **about, "rows": rows, "sizes": sizes, "machine": _machine.about()})


def _unwritable(path: Path) -> str | None:
    """Why a file cannot be written, asked before minutes are spent on it."""
    if path.is_dir():
        return "is a folder"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        return error.strerror
    return None if os.access(path.parent, os.W_OK) else "its folder is not writable"


def write(path: Path, document: Any) -> None:
    """A JSON file, whole or not at all."""
    with atomic.replace_file(path) as temporary:
        temporary.write_text(json.dumps(document, indent=1) + "\n")


def table(rows: Sequence[Row]) -> str:
    """Rows as Markdown."""
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
    """A time to three digits, in the unit that suits it."""
    for unit, size in (("s", 1.0), ("ms", 1e-3)):
        if value >= size:
            return f"{value / size:.3g} {unit}"
    return f"{value * 1e6:.3g} us"


def _told(made: Row) -> str:
    sides = (f"{side} {seconds(times['median_s'])}" for side, times in made["sides"].items())
    return f"{made['name']}: {', '.join(sides)}"
