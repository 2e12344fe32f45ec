"""Command line, output files and provenance record of all experiments.

An experiment has a frozen `Config` with `out`, `seed` and `publish`, and `run(config) -> metrics`. It writes
`runs/NAME/{config.json, metrics.json, table.md, *.png}`; with `--publish` also the committed results,
`experiments/results/NAME.{json,md,png}`, which the README quotes.
"""

from __future__ import annotations

import dataclasses
import json
import os
import platform
import shlex
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import jax
import numpy as np
import tyro

from facejax.cli import runtime
from facejax.evaluation import run_record
from facejax.io import atomic, errors

PREPARES = "The first run prepares makehuman4d in the user's cache: about 4 minutes and 0.8 GB per level."
RESULTS = Path(__file__).parent / "results"
Config = TypeVar("Config")


def main(name: str, config_type: type[Config], run: Callable[[Config], dict[str, Any]]) -> None:
    """Parse the command line, run the experiment and print its output folder.

    Invalid input ends with a one-line message on standard error and exit code 2.
    """
    description = sys.modules[run.__module__].__doc__
    if "meshes" in {field.name for field in dataclasses.fields(config_type)}:
        description += f"\n{PREPARES}"
    config = tyro.cli(config_type, prog=f"python -m experiments.{name}", description=description)
    runtime.configure()
    try:
        _check_publish(config)
        run(config)
    except (ValueError, RuntimeError, OSError) as error:
        print(f"experiments.{name}: {errors.one_line(error)}", file=sys.stderr)
        raise SystemExit(2) from error
    print(f"results in {config.out}")


def _check_publish(config: Any) -> None:
    """Raise `ValueError` where `--publish` is combined with options that shrink or change the experiment."""
    wrong = ["data", "first", "second", "speech", "quick"] + ["folds"] * (not getattr(config, "paper", False))
    given = [name for name in wrong if getattr(config, name, None)]
    if getattr(config, "publish", False) and given:
        raise ValueError(f"--publish needs the full experiment on makehuman4d: leave out --{', --'.join(given)}")


def record(config: Any, *, seconds: float, dataset: dict[str, Any] | None = None) -> dict[str, Any]:
    """Return the provenance of a result: command, commit, machine, seed, seconds, date and dataset."""
    module = sys.modules["__main__"].__spec__
    command = ["python", "-m", module.name] if module else ["python", Path(sys.argv[0]).name]
    return {
        "command": shlex.join(command + sys.argv[1:]),
        "commit": run_record.commit(RESULTS.parent) or "unknown",
        "machine": {
            "processor": run_record.processor(),
            "cores": os.cpu_count(),
            "device": jax.devices()[0].device_kind,
            "python": platform.python_version(),
            "jax": jax.__version__,
            "numpy": np.__version__,
        }
        | ({"trained_on": elsewhere} if (elsewhere := getattr(config, "trained_on", "")) else {}),
        "seed": config.seed,
        "seconds": round(seconds, 1),
        "date": time.strftime("%Y-%m-%d", time.gmtime()),
        "dataset": dataset,
    }


def finish(
    name: str,
    config: Any,
    metrics: dict[str, Any],
    *,
    made: dict[str, Any],
    table: str,
    figure: Path | None = None,
) -> None:
    """Write the config, the metrics with their provenance, and the table; with `--publish` the committed results too.

    Results of a run with `--paper` are published as NAME-paper, beside those of the default run.
    """
    out = Path(config.out)
    document = {**metrics, "made": made}
    write_text(out / "config.json", json.dumps(dataclasses.asdict(config), indent=1, default=_plain) + "\n")
    write_text(out / "metrics.json", json.dumps(document, indent=1, default=_plain) + "\n")
    source = f"`{made['command']}` in {made['seconds']:.0f} s (commit {made['commit']}, {made['date']})"
    body = f"{table}\n\nMade by {source}.\n"
    write_text(out / "table.md", body)
    if config.publish:
        name += "-paper" * getattr(config, "paper", False)
        write_text(RESULTS / f"{name}.json", json.dumps(document, indent=1, default=_plain) + "\n")
        write_text(RESULTS / f"{name}.md", body)
        if figure is not None:
            publish_file(figure, f"{name}{figure.suffix}")


def publish_file(path: Path, name: str) -> None:
    """Copy a file into `experiments/results` under the given name."""
    with atomic.replace_file(RESULTS / name) as temporary:
        temporary.write_bytes(path.read_bytes())


def save_figure(figure: Any, path: Path, *, dpi: int = 110) -> Path:
    """Write a matplotlib figure as PNG, close it, and return the path."""
    from matplotlib import pyplot

    with atomic.replace_file(path) as temporary:
        figure.savefig(temporary, dpi=dpi, format="png")
    pyplot.close(figure)
    return path


def markdown(header: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """Return a Markdown table; floats with three decimals."""

    def cell(value: Any) -> str:
        return f"{value:.3f}" if isinstance(value, float) else str(value)

    lines = ["| " + " | ".join(header) + " |", "|" + " --- |" * len(header)]
    return "\n".join(lines + ["| " + " | ".join(cell(v) for v in row) + " |" for row in rows])


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically."""
    with atomic.replace_file(path) as temporary:
        temporary.write_text(text)


def _plain(value: Any) -> Any:
    return value.tolist() if hasattr(value, "tolist") else str(value)
