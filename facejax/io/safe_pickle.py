"""Pickles of numbers, names and arrays alone: VOCASET and FLAME come as such.

A pickle is a program. Only what builds NumPy arrays is let through, in versions of our own that allocate no more than
the file holds; anything else is refused by its name before a line of it runs.
"""

from __future__ import annotations

import codecs
import io
import math
import os
import pickle
import re
from collections import OrderedDict
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from facejax.io import atomic

_DTYPE = re.compile(r"[<>|=]?(b1|[iu][1248]|f[248]|[SU]\d{1,4}|O8?)")
MAX_BYTES = 2**23  # bytes: an empty list of one byte takes 64


class PickleError(atomic.FileError):
    """A pickle cannot be read, or holds what is not let through; the message names the file."""


def read(path: str | os.PathLike, *, encoding: str = "latin1") -> Any:
    """What a pickle holds, in dicts, lists and arrays. `encoding` is of Python 2's strings. Raises `PickleError`."""
    path = Path(path)
    try:
        if (size := path.stat().st_size) > MAX_BYTES:
            raise PickleError(f"{path}: {size} bytes, more than {MAX_BYTES}")
        with path.open("rb") as stream:
            return load(stream, encoding=encoding)
    except PickleError as error:
        raise PickleError(f"{path}: {error}") from error
    except OSError as error:
        raise PickleError(f"{path}: cannot be read: {error.strerror or error}") from error


def load(stream, *, encoding: str = "latin1") -> Any:
    """The same from an open file. Raises `PickleError` without a name."""
    data = stream.read(MAX_BYTES + 1)
    if len(data) > MAX_BYTES:
        raise PickleError(f"more than {MAX_BYTES} bytes")
    try:
        return _plain(_Unpickler(io.BytesIO(data), encoding=encoding).load(), {})
    except PickleError:
        raise
    except Exception as error:  # a damaged pickle can raise anything
        raise PickleError(f"is damaged: {type(error).__name__}: {error}") from error


class _Dtype:
    """What stands for NumPy's dtype, whose own state can be set to what brings the process down."""

    def __init__(self, name: str, align: Any = False, copy: Any = False):
        if not (isinstance(name, str) and _DTYPE.fullmatch(name)):
            raise PickleError(f"holds an array of {str(name)[:40]!r}")
        self.name, self.order = name.lstrip("<>|="), "="

    def __setstate__(self, state: Any) -> None:
        if not (isinstance(state, tuple) and len(state) > 4 and state[1] in ("<", ">", "|", "=")):
            raise PickleError("holds a dtype in an unknown state")
        if any(part is not None for part in state[2:5]):
            raise PickleError("holds a dtype of several fields")
        self.order = state[1]

    def numpy(self) -> np.dtype:
        return np.dtype(self.order.replace("|", "=") + self.name)


class _Array:
    """What stands for an array until all of it is read."""

    value: np.ndarray | None = None

    def __setstate__(self, state: Any) -> None:
        if not (isinstance(state, tuple) and len(state) == 5):
            raise PickleError("holds an array in an unknown state")
        _, shape, dtype, fortran, data = state
        if not (isinstance(shape, tuple) and all(type(n) is int and n >= 0 for n in shape) and type(dtype) is _Dtype):
            raise PickleError("holds an array of no shape or dtype")
        kind, count = dtype.numpy(), math.prod(shape)
        if kind.hasobject:
            if not isinstance(data, list) or len(data) != count:
                raise PickleError(f"holds an array of {count} objects, and others")
            self.value = np.empty(count, object)
            self.value[:] = data
        else:
            data = data.encode("latin1") if isinstance(data, str) else data
            if not isinstance(data, bytes) or len(data) != count * kind.itemsize:
                raise PickleError(
                    f"is damaged: holds an array {shape} of {kind} in other than {count * kind.itemsize} bytes"
                )
            self.value = np.frombuffer(data, kind).copy()
        self.value = self.value.reshape(shape, order="F" if fortran else "C")


def _reconstruct(kind: Any, shape: Any, code: Any) -> _Array:
    """The empty array that every pickled one begins as."""
    if kind is not _Array or shape != (0,):
        raise PickleError("begins an array with other than (0,)")
    return _Array()


def _scalar(dtype: Any, data: Any) -> Any:
    data = data.encode("latin1") if isinstance(data, str) else data
    if type(dtype) is not _Dtype or dtype.numpy().hasobject or not isinstance(data, bytes):
        raise PickleError("holds a number of no dtype")
    if len(data) != dtype.numpy().itemsize:
        raise PickleError(f"holds a number of {dtype.numpy()} in {len(data)} bytes")
    return np.frombuffer(data, dtype.numpy())[0]


def _plain(found: Any, seen: dict[int, Any]) -> Any:
    """Arrays in place of what stood for them, in containers of any depth."""
    if isinstance(found, _Array):
        if found.value is None:
            raise PickleError("holds an array without numbers")
        found = found.value
    if id(found) in seen:
        return seen[id(found)]
    if isinstance(found, dict):
        seen[id(found)] = found
        for key, value in list(found.items()):
            found[key] = _plain(value, seen)
    elif isinstance(found, list):
        seen[id(found)] = found
        found[:] = [_plain(value, seen) for value in found]
    elif isinstance(found, tuple):
        return tuple(_plain(value, seen) for value in found)
    elif isinstance(found, np.ndarray) and found.dtype.hasobject:
        seen[id(found)] = found
        for at, value in np.ndenumerate(found):
            found[at] = _plain(value, seen)
    elif isinstance(found, _Dtype | type) or callable(found):
        raise PickleError(f"holds a {type(found).__name__} by itself")
    return found


def _encode(text: str, encoding: str = "latin1") -> bytes:
    """How newer Pythons write bytes for older ones."""
    if codecs.lookup(encoding).name != "iso8859-1":
        raise PickleError(f"encodes bytes as {encoding!r}")
    return text.encode("latin1")


_ALLOWED = {
    ("numpy", "ndarray"): _Array,
    ("numpy", "dtype"): _Dtype,
    ("_codecs", "encode"): _encode,
    ("collections", "OrderedDict"): OrderedDict,
}
for _core in ("numpy.core", "numpy._core"):
    _ALLOWED[f"{_core}.multiarray", "_reconstruct"] = _reconstruct
    _ALLOWED[f"{_core}.multiarray", "scalar"] = _scalar


class _Unpickler(pickle._Unpickler):
    """Python's own in Python: the one in C makes room for any number of a memo that a pickle names."""

    dispatch: ClassVar = dict(pickle._Unpickler.dispatch)

    def load_bytearray8(self) -> None:
        raise PickleError("holds a bytearray, which is not let through")

    dispatch[pickle.BYTEARRAY8[0]] = load_bytearray8

    def load_build(self) -> None:
        # Of anything else, a class say, attributes could be set.
        if type(self.stack[-2]) not in (_Array, _Dtype):
            raise PickleError(f"sets the state of a {type(self.stack[-2]).__name__}")
        super().load_build()

    dispatch[pickle.BUILD[0]] = load_build

    def find_class(self, module: str, name: str) -> Any:
        try:
            return _ALLOWED[module, name]
        except KeyError:
            raise PickleError(f"names {module}.{name}, which is not let through") from None

    def persistent_load(self, pid: Any) -> Any:
        raise PickleError("refers to something outside of it")
