"""`facejax export`: write functions of the models for other programs."""

from __future__ import annotations

import importlib
import shlex
from types import ModuleType
from typing import Any

from facejax.cli import outputs, runtime
from facejax.cli.arguments import Export
from facejax.inference import pipeline


def run(command: Export) -> None:
    """Write the export and print the paths of its files."""
    if command.format == "web" and command.functions:
        raise ValueError("--functions: not supported by web, which always holds motion and decoder")
    if command.format != "web" and command.runtime is not None:
        raise ValueError(f"--runtime: for web only, not for {command.format}")
    exporter = _exporter(command.format)
    runtime.configure()
    options: dict[str, Any] = {"command": _again(command)}
    if command.functions:
        options["functions"] = command.functions
    if command.runtime is not None:
        options["runtime"] = command.runtime
    outputs.report(exporter.export(pipeline.load(command.model), command.out, **options))


def _exporter(name: str) -> ModuleType:
    """Return the module of a format. Raises `ValueError` where its packages are not installed."""
    try:
        return importlib.import_module(f"facejax.export.{name}")
    except ModuleNotFoundError as error:
        raise ValueError(f"export {name}: {error.name} is not installed; install facejax[{name}]") from error


def _again(command: Export) -> str:
    """Return the command line that writes the same export."""
    words = ["facejax", "export", command.format, "--out", str(command.out)]
    if command.model is not None:
        words += ["--model", str(command.model)]
    if command.functions:
        words += ["--functions", *command.functions]
    if command.runtime is not None:
        words += ["--runtime", str(command.runtime)]
    return shlex.join(words)
