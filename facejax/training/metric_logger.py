"""Metrics of a training run: a JSON line per entry, a progress bar, and optionally TensorBoard."""

import json
import os
import sys
import time
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from facejax.io import atomic

_QUIET = 10.0  # seconds between two plain lines


class MetricLogger:
    """Appends to `folder/metrics.jsonl` and shows progress; a context manager.

    Entries after step `done` are removed first: a killed run wrote them after its last checkpoint. Progress goes to
    standard error, as a bar on a terminal and as occasional lines elsewhere. `tensorboard` requires the extra of that
    name.
    """

    def __init__(self, folder: str | os.PathLike[str], done: int, steps: int, *, tensorboard: bool = False):
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        self.path = folder / "metrics.jsonl"
        self._events = _event_writer(folder) if tensorboard else None
        _truncate(self.path, done)
        self._file = self.path.open("a", encoding="utf-8")
        self._steps = steps
        self._printed = -float("inf")
        self._bar = None
        if sys.stderr.isatty():
            columns = (
                TextColumn("{task.description}"),
                BarColumn(),
                MofNCompleteColumn(),
                TimeRemainingColumn(),
            )
            self._bar = Progress(*columns, TextColumn("{task.fields[note]}"), console=Console(stderr=True))
            self._task = self._bar.add_task(folder.name, total=steps, completed=done, note="")
            self._bar.start()

    def __enter__(self) -> "MetricLogger":
        return self

    def __exit__(self, kind: type | None, *_: object) -> None:
        if self._bar:
            self._bar.stop()
        try:
            self._file.close()
            if self._events:
                self._events.close()
        except OSError:
            if kind is None:  # do not replace an error already raised, such as a full disk
                raise

    def write(self, step: int, metrics: dict[str, float], *, seconds: float) -> None:
        """Append the metrics of the steps up to `step`, which took `seconds`."""
        # One write and one flush per line, so that a kill can truncate the last line only.
        self._file.write(json.dumps({"step": step, **metrics, "seconds": round(seconds, 4)}) + "\n")
        self._file.flush()
        if self._events:
            for name, value in metrics.items():
                self._events.add_scalar(name, value, step)
        note = "  ".join(f"{name} {value:.4g}" for name, value in metrics.items())
        if self._bar:
            self._bar.update(self._task, completed=step, note=note)
        elif time.monotonic() - self._printed >= _QUIET or step >= self._steps:
            self._printed = time.monotonic()
            print(f"step {step}/{self._steps}  {note}", file=sys.stderr, flush=True)


class NullLogger:
    """No-op logger for non-primary processes."""

    def __enter__(self) -> "NullLogger":
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def write(self, step: int, metrics: dict[str, float], *, seconds: float) -> None:
        """Do nothing."""


def read(folder: str | os.PathLike[str]) -> list[dict[str, float]]:
    """Return the entries of a run, oldest first; a truncated last line is skipped."""
    entries = []
    path = Path(folder) / "metrics.jsonl"
    for line in path.read_text(encoding="utf-8").splitlines() if path.exists() else []:
        try:
            entries.append(json.loads(line))
        except json.JSONDecodeError:
            break
    return entries


def claim_folder(folder: str | os.PathLike[str], what: dict[str, Any]) -> None:
    """Record the configuration of a run in its folder.

    Without it, a checkpoint of matching shapes could be resumed with another seed, plan or dataset.

    Raises:
      ValueError: the folder holds a run with another configuration, or its record is damaged.
    """
    path = Path(folder) / "run.json"
    what = json.loads(json.dumps(what))
    if path.exists():
        try:
            before = dict(json.loads(path.read_text()))
        except (ValueError, TypeError) as error:
            raise ValueError(f"{path} is damaged ({error}): name another folder") from error
        differs = sorted(name for name in what.keys() | before.keys() if what.get(name) != before.get(name))
        if differs:
            raise ValueError(f"{folder} holds a run with another {', '.join(differs)}: name another folder")
        return
    with atomic.replace_file(path) as temporary:
        temporary.write_text(json.dumps(what, indent=1) + "\n")


def _truncate(path: Path, done: int) -> None:
    kept = [entry for entry in read(path.parent) if entry["step"] <= done]
    with atomic.replace_file(path) as temporary:
        temporary.write_text("".join(json.dumps(entry) + "\n" for entry in kept), encoding="utf-8")


def _event_writer(folder: Path):
    try:
        from tensorboardX import SummaryWriter  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise ModuleNotFoundError("TensorBoard output needs: pip install 'facejax[tensorboard]'") from None
    return SummaryWriter(str(folder / "tensorboard"))
