"""Helpers of the PyTorch peers. PyTorch comes with the extra `bench`; without it the peers are left out.

The peers run on a GPU where both JAX and PyTorch do.
"""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable, Mapping
from typing import Any

import jax
import numpy as np

from facejax.evaluation import run_record

try:
    import torch
except ImportError:
    torch = None


@functools.cache
def device() -> str:
    """Return the device of the peers."""
    return "cuda" if jax.default_backend() == "gpu" and torch.cuda.is_available() else "cpu"


def ready(threads: int | None = None) -> bool:
    """Configure PyTorch's device, precision and threads (default: one per core); return whether it is installed."""
    if torch is None:
        print('PyTorch is not installed, its peers are left out: pip install ".[bench]" installs it.', file=sys.stderr)
        return False
    torch.set_num_threads(threads or run_record.usable_cores())
    torch.set_default_device(device())
    torch.set_float32_matmul_precision("highest")
    torch.backends.cudnn.allow_tf32 = False  # cuDNN's LSTM ignores the line above and would use TF32
    return True


def tensor(array: Any) -> Any:
    """Return a copy on the peers' device; integers as int64, PyTorch's index type."""
    array = array.detach().clone() if isinstance(array, torch.Tensor) else torch.tensor(np.asarray(array))
    keeps = array.is_floating_point() or array.dtype == torch.bool
    return (array if keeps else array.long()).to(device())


def waited(function: Callable[[], Any]) -> Callable[[], Any]:
    """Return the function followed by a wait for the GPU."""
    if device() == "cpu":
        return function

    def call() -> Any:
        found = function()
        torch.cuda.synchronize()
        return found

    return call


def alone(function: Callable[[], Any]) -> Callable[[], Any]:
    """Return the function run with one thread, which can be faster for small products or on a busy machine."""

    def call() -> Any:
        before = torch.get_num_threads()
        torch.set_num_threads(1)
        try:
            return function()
        finally:
            torch.set_num_threads(before)

    return call


def threaded(name: str, function: Callable[[], Any]) -> dict[str, Callable[[], Any]]:
    """Return the function as it is and, on a processor with several cores, with one thread as well."""
    found = {name: waited(function)}
    if device() == "cpu" and torch.get_num_threads() > 1:
        found[f"{name}, 1 thread"] = alone(function)
    return found


def compiled(ways: Mapping[str, Callable[[], Any]]) -> dict[str, Callable[[], Any]]:
    """Return the functions that torch.compile can compile here; it needs a C++ compiler."""
    found = {}
    for name, way in ways.items():
        try:
            way()
        except Exception as error:  # of any type: the peer is left out with a message
            print(f"{name} is left out: {' '.join(str(error).split())[:200]}", file=sys.stderr)
        else:
            found[name] = waited(way)
    return found
