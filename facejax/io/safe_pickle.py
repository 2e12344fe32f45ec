"""A restricted unpickler for files of numbers, strings and NumPy arrays, such as those of VOCASET and FLAME.

Pickles can execute code. Only the functions that build NumPy arrays are allowed, replaced by versions that allocate no
more memory than the file has bytes; every other name is rejected before any code is executed.
"""

from __future__ import annotations

import codecs
import io
import math
import os
import pickle
import re
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any, ClassVar

import numpy as np

from facejax.io import errors

_DTYPE = re.compile(r"[<>|=]?(b1|[iu][1248]|f[248]|[SU]\d{1,4}|O8?)")
MAX_BYTES = 2**23  # an empty list of one byte in the file takes 64 in memory


class PickleError(errors.FileError):
    """A pickle cannot be read, or contains an object that is not allowed; the message names the file."""


def read(path: str | os.PathLike[str], *, encoding: str = "latin1") -> Any:
    """Read a pickle of dicts, lists and arrays.

    Args:
      path: the file.
      encoding: of strings pickled by Python 2.

    Raises:
      PickleError: the file is too large, damaged, or contains an object that is not allowed.
    """
    path = Path(path)
    try:
        if (size := path.stat().st_size) > MAX_BYTES:
            raise PickleError(f"{path}: {size} bytes, at most {MAX_BYTES} are read")
        with path.open("rb") as stream:
            return load(stream, encoding=encoding)
    except PickleError as error:
        raise PickleError(f"{path}: {error}") from error
    except OSError as error:
        raise PickleError(f"{path}: cannot be read: {error.strerror or error}") from error


def load(stream: IO[bytes], *, encoding: str = "latin1") -> Any:
    """Read a pickle from an open file, as `read`. Raises `PickleError` without the file's name."""
    data = stream.read(MAX_BYTES + 1)
    if len(data) > MAX_BYTES:
        raise PickleError(f"more than {MAX_BYTES} bytes")
    try:
        return _resolve(_Unpickler(io.BytesIO(data), encoding=encoding).load(), {})
    except PickleError:
        raise
    except Exception as error:  # a damaged pickle can raise anything
        raise PickleError(f"damaged: {type(error).__name__}: {error}") from error


class _Dtype:
    """A stand-in for NumPy's dtype, whose state could be set to values that crash the process."""

    def __init__(self, name: object, align: Any = False, copy: Any = False):
        if not (isinstance(name, str) and _DTYPE.fullmatch(name)):
            raise PickleError(f"contains an array with dtype {str(name)[:40]!r}, which is not allowed")
        self.name, self.order = name.lstrip("<>|="), "="

    def __setstate__(self, state: Any) -> None:
        if not (isinstance(state, tuple) and len(state) > 4 and state[1] in ("<", ">", "|", "=")):
            raise PickleError("contains a dtype with invalid state")
        if any(part is not None for part in state[2:5]):
            raise PickleError("contains a dtype with fields, which is not allowed")
        self.order = state[1]

    def numpy(self) -> np.dtype:
        return np.dtype(self.order.replace("|", "=") + self.name)


class _Array:
    """A stand-in for an array while it is read."""

    value: np.ndarray | None = None

    def __setstate__(self, state: Any) -> None:
        if not (isinstance(state, tuple) and len(state) == 5):
            raise PickleError("contains an array with invalid state")
        _, shape, dtype, fortran, data = state
        if not (isinstance(shape, tuple) and all(type(n) is int and n >= 0 for n in shape) and type(dtype) is _Dtype):
            raise PickleError("contains an array without shape or dtype")
        kind, count = dtype.numpy(), math.prod(shape)
        if kind.hasobject:
            if not isinstance(data, list) or len(data) != count:
                raise PickleError(f"contains an object array whose elements are not a list of {count}")
            self.value = np.empty(count, object)
            self.value[:] = data
        else:
            data = data.encode("latin1") if isinstance(data, str) else data
            if not isinstance(data, bytes) or len(data) != count * kind.itemsize:
                raise PickleError(
                    f"damaged: the data of an array {shape} of {kind} is not {count * kind.itemsize} bytes"
                )
            self.value = np.frombuffer(data, kind).copy()
        self.value = self.value.reshape(shape, order="F" if fortran else "C")


def _reconstruct(kind: Any, shape: Any, code: Any) -> _Array:
    """Return the empty array with which the pickle of an array begins."""
    if kind is not _Array or shape != (0,):
        raise PickleError("begins an array with another shape than (0,)")
    return _Array()


def _scalar(dtype: Any, data: Any) -> Any:
    data = data.encode("latin1") if isinstance(data, str) else data
    if type(dtype) is not _Dtype or dtype.numpy().hasobject or not isinstance(data, bytes):
        raise PickleError("contains a scalar without a numeric dtype")
    if len(data) != dtype.numpy().itemsize:
        raise PickleError(f"contains a scalar of {dtype.numpy()} in {len(data)} bytes")
    return np.frombuffer(data, dtype.numpy())[0]


def _resolve(found: Any, seen: dict[int, Any]) -> Any:
    """Replace stand-ins by their arrays, in containers of any depth."""
    if isinstance(found, _Array):
        if found.value is None:
            raise PickleError("contains an array without data")
        found = found.value
    if id(found) in seen:
        return seen[id(found)]
    if isinstance(found, dict):
        seen[id(found)] = found
        for key, value in list(found.items()):
            found[key] = _resolve(value, seen)
    elif isinstance(found, list):
        seen[id(found)] = found
        found[:] = [_resolve(value, seen) for value in found]
    elif isinstance(found, tuple):
        return tuple(_resolve(value, seen) for value in found)
    elif isinstance(found, np.ndarray) and found.dtype.hasobject:
        seen[id(found)] = found
        for at, value in np.ndenumerate(found):
            found[at] = _resolve(value, seen)
    elif isinstance(found, _Dtype | type) or callable(found):
        raise PickleError(f"contains a {type(found).__name__}, which is not allowed")
    return found


def _encode(text: str, encoding: str = "latin1") -> bytes:
    """Return bytes that a newer Python pickled as text for an older one."""
    if codecs.lookup(encoding).name != "iso8859-1":
        raise PickleError(f"contains bytes in the encoding {encoding!r}, which is not allowed")
    return text.encode("latin1")


_ALLOWED: dict[tuple[str, str], Callable[..., Any]] = {
    ("numpy", "ndarray"): _Array,
    ("numpy", "dtype"): _Dtype,
    ("_codecs", "encode"): _encode,
    ("collections", "OrderedDict"): OrderedDict,
}
for _core in ("numpy.core", "numpy._core"):
    _ALLOWED[f"{_core}.multiarray", "_reconstruct"] = _reconstruct
    _ALLOWED[f"{_core}.multiarray", "scalar"] = _scalar


_PurePython = pickle._Unpickler  # pyright: ignore[reportPrivateUsage] (it has no public name)


class _Unpickler(_PurePython):
    """Python's unpickler in Python: the C version allocates memory for any memo index that a pickle contains."""

    dispatch: ClassVar[dict[int, Any]] = dict(_PurePython.dispatch)
    stack: list[Any]

    def load_bytearray8(self) -> None:
        raise PickleError("contains a bytearray, which is not allowed")

    dispatch[pickle.BYTEARRAY8[0]] = load_bytearray8

    def load_build(self) -> None:
        # On any other object, such as a class, this could set attributes.
        if type(self.stack[-2]) not in (_Array, _Dtype):
            raise PickleError(f"sets the state of a {type(self.stack[-2]).__name__}")
        super().load_build()  # pyright: ignore[reportAttributeAccessIssue] (undocumented)

    dispatch[pickle.BUILD[0]] = load_build

    def find_class(self, module: str, name: str) -> Any:
        try:
            return _ALLOWED[module, name]
        except KeyError:
            raise PickleError(f"contains {module}.{name}, which is not allowed") from None

    def persistent_load(self, pid: Any) -> Any:
        raise PickleError("refers to an external object, which is not allowed")
