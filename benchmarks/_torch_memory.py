"""Peak memory of PyTorch calls on the CPU."""

from __future__ import annotations

import json
import tempfile
import warnings
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import torch


def peak_mb(call: Callable[[], Any], held: Iterable[torch.Tensor]) -> float:
    """Return the peak megabytes of a call: the tensors held before it, plus the most that it allocates at one time."""
    storages = {tensor.untyped_storage().data_ptr(): tensor.untyped_storage().nbytes() for tensor in held}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it warns about memory allocated before the profile
        with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CPU], profile_memory=True) as found:
            call()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "trace.json")
        found.export_chrome_trace(str(path))
        events = json.loads(path.read_text())["traceEvents"]
    totals = [event["args"] for event in events if event["name"] == "[memory]"]
    if not totals:
        raise RuntimeError("the profile holds no allocation")
    before = totals[0]["Total Allocated"] - totals[0]["Bytes"]  # seen by earlier profiles and still held
    return (sum(storages.values()) + max(total["Total Allocated"] for total in totals) - before) / 1e6
