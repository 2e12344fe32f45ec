"""NPY and NPZ files from strangers: headers are held against the bytes before memory is taken; nothing is unpickled.

Functions raise plain ValueError, and what `zipfile` raises on damage; `facejax.io.meshes` adds the file's name.
"""

import math
import tokenize
import warnings
import zipfile
import zlib
from pathlib import Path

import numpy as np

MAX_BYTES = 2**28  # bytes of a file, or of the arrays in it; a head takes a quarter of a megabyte
_DIRECTORY = 2**20  # bytes of an archive's list of members, of which each takes ten times as many when it is read
# What the readers, and the zip and array parsers below them, raise on damaged input.
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
    """The wanted arrays that an NPZ holds; the first must be there."""
    with _open(path) as archive:
        names = _names(archive, wanted[0])
        found = {}
        whole = sum(archive.getinfo(f"{name}.npy").file_size for name in wanted if name in names)
        if whole > MAX_BYTES:
            raise ValueError(f"its arrays take {whole} bytes, more than {MAX_BYTES}")
        for name in wanted:
            if name in names:
                with archive.open(f"{name}.npy") as stream:
                    found[name] = _read(stream, archive.getinfo(f"{name}.npy").file_size, name)
    return found


def read_available(path: Path, names: tuple[str, ...]) -> dict[str, np.ndarray]:
    """Those of the named arrays that an NPZ holds."""
    with _open(path) as archive:
        there = {name[:-4] for name in archive.namelist() if name.endswith(".npy")}
    found = tuple(name for name in names if name in there)
    return read_npz(path, found) if found else {}


def npz_shape(path: Path, name: str) -> tuple[int, ...]:
    """The shape of an array that must be in an NPZ; its numbers are not read."""
    with _open(path) as archive:
        _names(archive, name)
        with archive.open(f"{name}.npy") as stream:
            return _header(stream, archive.getinfo(f"{name}.npy").file_size, name)[0]


def read_npy(path: Path) -> np.ndarray:
    """The array of an NPY file."""
    with path.open("rb") as stream:
        return _read(stream, path.stat().st_size, "array")


def map_npy(path: Path) -> np.ndarray:
    """The same as a memory map, of any size."""
    with path.open("rb") as stream:
        _header(stream, path.stat().st_size, "array", limit=None)
    return np.load(path, mmap_mode="r", allow_pickle=False)


def skip_object_header(stream) -> None:
    """Go to the pickle of an NPY file that holds one object. Raises `ValueError` for any other."""
    shape, _, dtype = _described(stream)
    if shape != () or not dtype.hasobject:
        raise ValueError(f"expected one object, got {shape} {dtype}")


def _open(path: Path) -> zipfile.ZipFile:
    """An archive with a short list of members, which `zipfile` reads whole before anything else."""
    with path.open("rb") as stream:
        stream.seek(max(0, path.stat().st_size - 2**16 - 64))
        tail = stream.read()
    end = tail.rfind(b"PK\5\6")
    if end >= 0 and (b"PK\6\7" in tail or int.from_bytes(tail[end + 12 : end + 16], "little") > _DIRECTORY):
        raise ValueError("lists too many members for an NPZ of a few arrays")
    return zipfile.ZipFile(path)


def _names(archive: zipfile.ZipFile, needed: str) -> set[str]:
    names = {name[:-4] for name in archive.namelist() if name.endswith(".npy")}
    if needed not in names:
        raise ValueError(f"holds no array {needed!r}, only {sorted(names)}")
    return names


def _read(stream, size: int, name: str) -> np.ndarray:
    """One .npy stream of a known size."""
    shape, fortran, dtype, need = _header(stream, size, name)
    return np.frombuffer(stream.read(need), dtype).reshape(shape, order="F" if fortran else "C")


def _header(stream, size: int, name: str, *, limit: int | None = MAX_BYTES) -> tuple[tuple[int, ...], bool, np.dtype, int]:
    """Shape, order, type and bytes that the header claims, held against the size."""
    if limit is not None and size > limit:
        raise ValueError(f"{name}: {size} bytes, more than {limit}")
    shape, fortran, dtype = _described(stream)
    if dtype.hasobject or dtype.kind not in "fiu":
        raise ValueError(f"{name}: must hold numbers, got {dtype}")
    need, there = math.prod(shape) * dtype.itemsize, size - stream.tell()
    if need != there:
        raise ValueError(f"{name}: {shape} {dtype} needs {need} bytes, the file holds {there}")
    return shape, fortran, dtype, need


def _described(stream) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Shape, order and type in a header."""
    version = np.lib.format.read_magic(stream)
    if version not in _HEADERS:
        raise ValueError(f"unknown array format {version}")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of how slow a header of Python 2 is
        return _HEADERS[version](stream)
