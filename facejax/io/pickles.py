"""Pickles of numbers, names and arrays alone: VOCASET and FLAME come as such.

A pickle is a program. Only what builds NumPy arrays is let through, in versions of our own that allocate no more than
the file holds; anything else is refused by its name before a line of it runs.
"""

from __future__ import annotations

import codecs
import os
import pickle
from collections import OrderedDict
from pathlib import Path
from typing import Any

import numpy as np

LIMIT = 2**28  # bytes


class PickleError(ValueError):
    """A pickle cannot be read, or holds what is not let through; the message names the file."""


def read(path: str | os.PathLike, *, encoding: str = "latin1") -> Any:
    """What a pickle holds, in dicts, lists and arrays. `encoding` is of Python 2's strings. Raises `PickleError`."""
    path = Path(path)
    try:
        if (size := path.stat().st_size) > LIMIT:
            raise PickleError(f"{path}: {size} bytes, more than {LIMIT}")
        with path.open("rb") as stream:
            return load(stream, encoding=encoding)
    except PickleError as error:
        raise PickleError(f"{path}: {error}") from error
    except OSError as error:
        raise PickleError(f"{path}: cannot be read: {error.strerror or error}") from error


def load(stream, *, encoding: str = "latin1") -> Any:
    """The same from an open file. Raises `PickleError` without a name."""
    try:
        return _Unpickler(stream, encoding=encoding).load()
    except PickleError:
        raise
    except Exception as error:  # a damaged pickle can raise anything
        raise PickleError(f"is damaged: {type(error).__name__}: {error}") from error


def _reconstruct(kind: type, shape: tuple, code: Any) -> np.ndarray:
    """NumPy's own, for the empty array that every pickled one begins as."""
    if kind is not np.ndarray or shape != (0,):
        raise PickleError(f"begins an array with {shape}, expected (0,)")
    return np.ndarray.__new__(np.ndarray, (0,), np.int8)


def _encode(text: str, encoding: str = "latin1") -> bytes:
    """How newer Pythons write bytes for older ones."""
    if codecs.lookup(encoding).name != "iso8859-1":
        raise PickleError(f"encodes bytes as {encoding!r}")
    return text.encode("latin1")


_ALLOWED = {
    ("numpy", "ndarray"): np.ndarray,
    ("numpy", "dtype"): np.dtype,
    ("_codecs", "encode"): _encode,
    ("collections", "OrderedDict"): OrderedDict,
}
for _core in ("numpy.core", "numpy._core"):
    _ALLOWED[f"{_core}.multiarray", "_reconstruct"] = _reconstruct
    _ALLOWED[f"{_core}.multiarray", "scalar"] = np._core.multiarray.scalar


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        try:
            return _ALLOWED[module, name]
        except KeyError:
            raise PickleError(f"names {module}.{name}, which is not let through") from None

    def persistent_load(self, pid: Any) -> Any:
        raise PickleError("refers to something outside of it")
