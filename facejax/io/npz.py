"""Readers of untrusted NPY and NPZ files: headers are checked against the file size first; nothing is unpickled.

Functions raise `DAMAGE_ERRORS` without the file's name, which `facejax.io.meshes` adds.
"""

import math
import tokenize
import warnings
import zipfile
import zlib
from pathlib import Path
from typing import IO

import numpy as np

MAX_BYTES = 2**28  # of a file, or of the arrays in it; a head takes a quarter of a megabyte
_MAX_DIRECTORY_BYTES = 2**20  # of an archive's directory, which takes ten times as much memory when parsed
# Raised by the readers, and by the zip and array parsers that they use, on damaged input.
DAMAGE_ERRORS = (
    ValueError,
    LookupError,
    EOFError,
    RuntimeError,
    SyntaxError,
    tokenize.TokenError,
    zipfile.BadZipFile,
    zlib.error,
)
_HEADERS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}


def read_npz(path: Path, wanted: tuple[str, ...]) -> dict[str, np.ndarray]:
    """Read those of the named arrays that an NPZ contains; the first is required."""
    with _open(path) as archive:
        names = _names(archive, wanted[0])
        found = {}
        whole = sum(archive.getinfo(f"{name}.npy").file_size for name in wanted if name in names)
        if whole > MAX_BYTES:
            raise ValueError(f"arrays of {whole} bytes, at most {MAX_BYTES} are read")
        for name in wanted:
            if name in names:
                with archive.open(f"{name}.npy") as stream:
                    found[name] = _read(stream, archive.getinfo(f"{name}.npy").file_size, name)
    return found


def read_available(path: Path, names: tuple[str, ...]) -> dict[str, np.ndarray]:
    """Read those of the named arrays that an NPZ contains, possibly none."""
    with _open(path) as archive:
        existing = {name[:-4] for name in archive.namelist() if name.endswith(".npy")}
    found = tuple(name for name in names if name in existing)
    return read_npz(path, found) if found else {}


def npz_shape(path: Path, name: str) -> tuple[int, ...]:
    """Return the shape of an array in an NPZ; its values are not read."""
    with _open(path) as archive:
        _names(archive, name)
        with archive.open(f"{name}.npy") as stream:
            return _header(stream, archive.getinfo(f"{name}.npy").file_size, name)[0]


def read_npy(path: Path) -> np.ndarray:
    """Read the array of an NPY file."""
    with path.open("rb") as stream:
        return _read(stream, path.stat().st_size, "array")


def map_npy(path: Path) -> np.ndarray:
    """Open the array of an NPY file as a memory map, of any size."""
    with path.open("rb") as stream:
        _header(stream, path.stat().st_size, "array", limit=None)
    return np.load(path, mmap_mode="r", allow_pickle=False)


def skip_object_header(stream: IO[bytes]) -> None:
    """Advance an NPY file with one object to its pickle. Raises `ValueError` for any other array."""
    shape, _, dtype = _parse_header(stream)
    if shape != () or not dtype.hasobject:
        raise ValueError(f"expected one object, got {shape} {dtype}")


def _open(path: Path) -> zipfile.ZipFile:
    """Open an archive after checking the size of its directory, which `zipfile` reads as a whole."""
    with path.open("rb") as stream:
        stream.seek(max(0, path.stat().st_size - 2**16 - 64))
        tail = stream.read()
    end = tail.rfind(b"PK\5\6")
    if end >= 0 and (b"PK\6\7" in tail or int.from_bytes(tail[end + 12 : end + 16], "little") > _MAX_DIRECTORY_BYTES):
        raise ValueError("archive with too many members")
    return zipfile.ZipFile(path)


def _names(archive: zipfile.ZipFile, needed: str) -> set[str]:
    names = {name[:-4] for name in archive.namelist() if name.endswith(".npy")}
    if needed not in names:
        raise ValueError(f"contains no array {needed!r}, only {sorted(names)}")
    return names


def _read(stream: IO[bytes], size: int, name: str) -> np.ndarray:
    """Read an NPY stream of a known size."""
    shape, fortran, dtype, need = _header(stream, size, name)
    return np.frombuffer(stream.read(need), dtype).reshape(shape, order="F" if fortran else "C")


def _header(
    stream: IO[bytes], size: int, name: str, *, limit: int | None = MAX_BYTES
) -> tuple[tuple[int, ...], bool, np.dtype, int]:
    """Return shape, Fortran order, dtype and bytes of the data, checked against the size of the stream."""
    if limit is not None and size > limit:
        raise ValueError(f"{name}: {size} bytes, at most {limit} are read")
    shape, fortran, dtype = _parse_header(stream)
    if dtype.hasobject or dtype.kind not in "fiu":
        raise ValueError(f"{name}: expected numbers, got {dtype}")
    need, rest = math.prod(shape) * dtype.itemsize, size - stream.tell()
    if need != rest:
        raise ValueError(f"{name}: {shape} {dtype} needs {need} bytes, the file contains {rest}")
    return shape, fortran, dtype, need


def _parse_header(stream: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Return shape, Fortran order and dtype."""
    version = np.lib.format.read_magic(stream)
    if version not in _HEADERS:
        raise ValueError(f"unsupported NPY version {version}")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # about slow headers written by Python 2
        return _HEADERS[version](stream)
