"""What all peers in PyTorch share. It comes with the extra `bench`; without it their rows are left out.

Where JAX runs on a GPU that PyTorch sees too, so do the peers.
"""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable, Mapping
from typing import Any

import jax
import numpy as np

from benchmarks import _machine

try:
    import torch
except ImportError:
    torch = None


@functools.cache
def device() -> str:
    """Of the peers."""
    return "cuda" if jax.default_backend() == "gpu" and torch.cuda.is_available() else "cpu"


def ready(threads: int | None = None) -> bool:
    """Whether PyTorch is here; it then takes so many threads, or one for every core."""
    if torch is None:
        print('PyTorch is not here and its rows are left out: pip install ".[bench]" brings it.', file=sys.stderr)
        return False
    torch.set_num_threads(threads or _machine.cores())
    torch.set_default_device(device())
    torch.set_float32_matmul_precision("highest")
    torch.backends.cudnn.allow_tf32 = False  # an LSTM's products would be of ten bits, whatever the line above says
    return True


def tensor(array: Any) -> Any:
    """A copy on the peers' device; integers as PyTorch wants indices."""
    array = array.detach().clone() if isinstance(array, torch.Tensor) else torch.tensor(np.asarray(array))
    keeps = array.is_floating_point() or array.dtype == torch.bool
    return (array if keeps else array.long()).to(device())


def waited(function: Callable[[], Any]) -> Callable[[], Any]:
    """The function, and the wait for a GPU to have done it."""
    if device() == "cpu":
        return function

    def call() -> Any:
        found = function()
        torch.cuda.synchronize()
        return found

    return call


def alone(function: Callable[[], Any]) -> Callable[[], Any]:
    """The function with one thread: for small products, or on a busy machine, that can be the faster way."""

    def call() -> Any:
        before = torch.get_num_threads()
        torch.set_num_threads(1)
        try:
            return function()
        finally:
            torch.set_num_threads(before)

    return call


def threaded(name: str, function: Callable[[], Any]) -> dict[str, Callable[[], Any]]:
    """The function as it is, and on a processor of several cores with one thread too."""
    found = {name: waited(function)}
    if device() == "cpu" and torch.get_num_threads() > 1:
        found[f"{name}, 1 thread"] = alone(function)
    return found


def compiled(ways: Mapping[str, Callable[[], Any]]) -> dict[str, Callable[[], Any]]:
    """Those of the compiled functions that compile here: torch.compile needs a C++ compiler."""
    found = {}
    for name, way in ways.items():
        try:
            way()
        except Exception as error:  # whatever the compiler raises: the row is then without it, and says so
            print(f"{name} is left out: {' '.join(str(error).split())[:200]}", file=sys.stderr)
        else:
            found[name] = waited(way)
    return found
