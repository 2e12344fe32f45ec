"""How much memory PyTorch holds at once on the processor."""

from __future__ import annotations

import json
import tempfile
import warnings
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import torch


def peak_mb(call: Callable[[], Any], held: Iterable[torch.Tensor]) -> float:
    """Megabytes of the tensors that are held before a call, and of the most that it adds to them at one moment."""
    storages = {tensor.untyped_storage().data_ptr(): tensor.untyped_storage().nbytes() for tensor in held}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it warns of what was allocated before it began, and is freed now
        with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CPU], profile_memory=True) as found:
            call()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "trace.json")
        found.export_chrome_trace(str(path))
        events = json.loads(path.read_text())["traceEvents"]
    totals = [event["args"] for event in events if event["name"] == "[memory]"]
    if not totals:
        raise RuntimeError("the profile holds no allocation")
    before = totals[0]["Total Allocated"] - totals[0]["Bytes"]  # what earlier profiles saw and is still held
    return (sum(storages.values()) + max(total["Total Allocated"] for total in totals) - before) / 1e6
