"""The record of a run as it goes: a JSON line per entry, a progress bar, and TensorBoard if asked for."""

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

    Entries past step `done` are cut away first: a run that was killed wrote them after its last checkpoint.
    On a terminal there is a bar, elsewhere a line now and then, both on standard error. `tensorboard` needs
    the extra of that name.
    """

    def __init__(self, folder: str | os.PathLike, done: int, steps: int, *, tensorboard: bool = False):
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        self.path = folder / "metrics.jsonl"
        self._events = _event_writer(folder) if tensorboard else None
        _truncate(self.path, done)
        self._file = self.path.open("a", encoding="utf-8")
        self._steps = steps
        self._spoke = -float("inf")
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
            if kind is None:  # of a full disk, what has been raised already says more
                raise

    def write(self, step: int, metrics: dict[str, float], *, seconds: float) -> None:
        """Record `metrics` of the steps up to `step`, which took `seconds`."""
        # One call and one flush a line, so that a kill can only cut the last line short.
        self._file.write(json.dumps({"step": step, **metrics, "seconds": round(seconds, 4)}) + "\n")
        self._file.flush()
        if self._events:
            for name, value in metrics.items():
                self._events.add_scalar(name, value, step)
        note = "  ".join(f"{name} {value:.4g}" for name, value in metrics.items())
        if self._bar:
            self._bar.update(self._task, completed=step, note=note)
        elif time.monotonic() - self._spoke >= _QUIET or step >= self._steps:
            self._spoke = time.monotonic()
            print(f"step {step}/{self._steps}  {note}", file=sys.stderr, flush=True)


class NullLogger:
    """A journal that keeps nothing, for processes that only help."""

    def __enter__(self) -> "NullLogger":
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def write(self, step: int, metrics: dict[str, float], *, seconds: float) -> None:
        """Nothing."""


def read(folder: str | os.PathLike) -> list[dict[str, float]]:
    """The entries of a run, oldest first; a last line cut short by a kill is left out."""
    entries = []
    path = Path(folder) / "metrics.jsonl"
    for line in path.read_text(encoding="utf-8").splitlines() if path.exists() else []:
        try:
            entries.append(json.loads(line))
        except json.JSONDecodeError:
            break
    return entries


def claim_folder(folder: str | os.PathLike, what: dict[str, Any]) -> None:
    """Write down what a run folder is for; raise `ValueError` where it holds a run of something else.

    A checkpoint of the right shapes would else be resumed with another seed, plan or dataset.
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
        from tensorboardX import SummaryWriter
    except ImportError:
        raise ModuleNotFoundError("TensorBoard output needs: pip install 'facejax[tensorboard]'") from None
    return SummaryWriter(str(folder / "tensorboard"))
