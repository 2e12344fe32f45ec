"""Run all benchmarks, each in a process of its own, or compare them with the committed baseline.

    python -m benchmarks [--quick] [--only NAME ...] [--runs N] [--publish] [--out FOLDER]
    python -m benchmarks compare [FILE.json ...] [--quick] [--only NAME ...]

The first writes FOLDER/NAME.json, table.md and sizes.png; with --publish also benchmarks/results and the baseline,
whose tolerances are estimated from --runs runs. The second runs the benchmarks, or reads the given result files, and
ends with exit code 1 where a ratio to a peer has fallen by more than its tolerance. Both need an otherwise idle
machine.
"""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import tyro

from benchmarks import _compare, _headline, _measure, _sizes
from facejax.io import atomic, errors

ROOT = Path(__file__).parents[1]
RESULTS = Path(__file__).with_name("results")
NAMES = ("srvf", "augment", "motion", "lstm", "decoder", "rbf", "linear", "pipeline", "data", "scale")


@dataclasses.dataclass(frozen=True)
class Config:
    """Options of a run."""

    quick: bool = False
    """Use fewer repeats, and measure no cost against size."""
    only: tuple[str, ...] = ()
    """Names of the benchmarks to run; by default all."""
    runs: int = 1
    """Number of runs, all but the last with --quick; the last is shown, all count for the baseline's tolerances."""
    publish: bool = False
    """Also write benchmarks/results and benchmarks/baseline.json."""
    name: str = "cpu"
    """Name of the published files; only `cpu` becomes the baseline."""
    out: Path = Path("runs/benchmarks")
    """Folder for the results."""


@dataclasses.dataclass(frozen=True)
class Compare:
    """Options of a comparison with the baseline."""

    given: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Result files of benchmarks; by default the benchmarks are run."""
    quick: bool = False
    """Use fewer repeats."""
    only: tuple[str, ...] = ()
    """Names of the benchmarks to run; by default all."""
    baseline: Path = _compare.BASELINE
    """Baseline file."""
    out: Path = Path("runs/benchmarks")
    """Folder for the results of a run."""


def main(arguments: list[str]) -> int:
    """Run the command line and return the exit code."""
    comparing = arguments[:1] == ["compare"]
    kind, rest = (Compare, arguments[1:]) if comparing else (Config, arguments)
    config = tyro.cli(kind, prog="python -m benchmarks" + " compare" * comparing, description=__doc__, args=rest)
    try:
        return compare(config) if comparing else everything(config)
    except (ValueError, RuntimeError, OSError) as error:
        print(f"benchmarks: {errors.one_line(error)}", file=sys.stderr)
        return 2


def everything(config: Config) -> int:
    """Run the benchmarks and write their results; return the exit code."""
    names = _chosen(config.only)
    if config.publish and (config.quick or config.only):
        raise ValueError("--publish needs a full run: leave out --quick and --only")
    if config.runs < 1 or (config.publish and config.runs < 2):
        raise ValueError(f"--runs: expected 1 or more, with --publish 2 or more, got {config.runs}")
    _writable(config.out)
    runs = [_run(names, config.out, config.quick or left > 0) for left in range(config.runs)[::-1]]
    documents = runs[-1]
    table, sizes = _written(documents, config.out)
    print("\n" + table)
    if config.publish:
        _publish(config, runs, table, sizes)
    return 0


def compare(config: Compare) -> int:
    """Compare with the baseline; return 1 where a ratio has fallen by more than its tolerance."""
    known = _compare.read(config.baseline)
    if config.given and (config.only or config.quick):
        raise ValueError("--only and --quick apply to a run, not to result files")
    if config.given:
        rows = _compare.rows_of(config.given)
    else:
        rows = [row for document in _run(_chosen(config.only), config.out, config.quick) for row in document["rows"]]
    print("\n" + _compare.table(rows, known["rows"]))
    fallen = _compare.slower(rows, known["rows"])
    if fallen:
        print(f"\nslower than {config.baseline.name} tolerates: {', '.join(fallen)}")
    return 1 if fallen else 0


def _writable(folder: Path) -> None:
    """Create the output folder. Raises `ValueError` where it is not writable, before anything is measured."""
    folder.mkdir(parents=True, exist_ok=True)
    if not os.access(folder, os.W_OK):
        raise ValueError(f"--out {folder}: not writable")


def _chosen(only: tuple[str, ...]) -> tuple[str, ...]:
    if unknown := [name for name in only if name not in NAMES]:
        raise ValueError(f"--only {' '.join(unknown)}: expected some of {', '.join(NAMES)}")
    return only or NAMES


def _run(names: tuple[str, ...], out: Path, quick: bool) -> list[dict[str, Any]]:
    """Run each benchmark in a process of its own, so that memory and caches are separate."""
    found = []
    for name in names:
        path = out / f"{name}.json"
        command = [sys.executable, "-m", f"benchmarks.{name}", "--json", str(path.absolute())] + ["--quick"] * quick
        print(f"benchmarks.{name}", file=sys.stderr, flush=True)
        if code := subprocess.run(command, cwd=ROOT, stdout=subprocess.DEVNULL).returncode:
            raise RuntimeError(f"benchmarks.{name} ended with exit code {code}; see its message above")
        found.append(json.loads(path.read_text()))
    return found


def _written(documents: list[dict[str, Any]], out: Path) -> tuple[str, list[dict]]:
    """Write the table and, where there are any, the plot of cost against size."""
    rows = [row for document in documents for row in document["rows"]]
    sizes = [row for document in documents for row in document["sizes"]]
    table = _measure.table(rows)
    if sizes:
        table += "\n\n" + _sizes.table(sizes)
        _sizes.plot(sizes, out / "sizes.png")
    table += "\n\n" + _made(documents) + "\n"
    with atomic.replace_file(out / "table.md") as temporary:
        temporary.write_text(table)
    return table, sizes


def _made(documents: list[dict[str, Any]]) -> str:
    about = documents[-1]["machine"]
    limits, versions = about["roofline"], about["versions"]
    libraries = ", ".join(f"{name} {version}" for name, version in versions.items())
    return (
        f"{about['cores']} cores of {about['processor']} ({about['device']}), {limits['gflop_per_s']:.0f} GFLOP/s, "
        f"{limits['gbyte_per_s']:.0f} GB/s; Python {about['python']}, {libraries}; commit {about['commit']}, "
        f"{about['date']}, {sum(document['seconds'] for document in documents) / 60:.0f} minutes."
    )


def _publish(config: Config, runs: list[list[dict[str, Any]]], table: str, sizes: list[dict]) -> None:
    _measure.write(RESULTS / f"{config.name}.json", {"benchmarks": runs[-1]})
    rows = [row for document in runs[-1] for row in document["rows"]]
    for name, text in ((config.name, table), (f"{config.name}_headline", _headline.table(rows) + "\n")):
        with atomic.replace_file(RESULTS / f"{name}.md") as temporary:
            temporary.write_text(text)
    _sizes.plot(sizes, RESULTS / f"{config.name}_sizes.png")
    if config.name == "cpu":
        rows = _compare.baseline([[row for document in run for row in document["rows"]] for run in runs])
        _measure.write(_compare.BASELINE, {"machine": runs[-1][-1]["machine"], "rows": rows})


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
