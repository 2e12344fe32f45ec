"""The manifest of an export: a JSON file that describes its functions, and the checks of one that is read.

    manifest.json
      format, version            of the export: "stablehlo", 1
      facejax, jax, jaxlib       versions; also of the calling convention of `jax.export`
      date, compatibility        when it was written, and which JAX releases load it
      command, platforms         how to write it again, and where it runs
      labels, expressions        names of the indices that functions take
      weights                    file, sha256, and shape and dtype of each array
      functions                  by name: file, sha256, constraints, params, inputs, outputs

Inputs and outputs are lists of {"name", "shape", "dtype"}; sizes are numbers or symbolic dimensions such as
"30*transitions".
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from facejax.export.signature import Dimension, Function, Spec
from facejax.io import atomic, errors

FILE = "manifest.json"
VERSION = 1
MAX_BYTES = 2**20
MAX_FILE_BYTES = {".stablehlo": 2**27, ".safetensors": 2**32}
DTYPES = ("float32", "int32", "bool")
_NAME = re.compile(r"[A-Za-z0-9_./-]{1,200}")


class ExportError(errors.FileError):
    """An export is missing, damaged, or of another format."""


def check_folder(out: Path) -> None:
    """Raise `ValueError` for a folder that holds anything else than an export, which would be replaced."""
    if out.exists() and not out.is_dir():
        raise ValueError(f"{out}: not a folder; name another one with --out")
    if out.is_dir() and any(out.iterdir()):
        try:
            found = json.loads(_read_bytes(out / FILE))
            known = isinstance(found, dict) and isinstance(found["format"], str) and "functions" in found
        except (ValueError, KeyError, RecursionError):
            known = False
        if not known:
            raise ValueError(f"{out}: holds other files than an export; name an empty folder with --out")


def describe(function: Function) -> dict[str, Any]:
    """Return the entries of a function: constraints, params, inputs and outputs."""
    outputs = {
        name: Spec(tuple(n if isinstance(n, int) else Dimension.parse(str(n)) for n in found.shape), str(found.dtype))
        for name, found in function.outputs_spec().items()
    }
    return {
        "constraints": list(function.constraints),
        "params": list(function.params),
        "inputs": _rows(function.inputs),
        "outputs": _rows(outputs),
    }


def read(folder: Path) -> dict[str, Any]:
    """Read a manifest and check every field.

    Raises:
      ExportError: naming the file and the field.
    """
    path = folder / FILE
    try:
        found = json.loads(_read_bytes(path))
    except (ValueError, RecursionError) as error:
        raise ExportError(f"{path}: not a manifest of an export ({error}); export again") from error
    try:
        _check(found)
    except ValueError as error:
        raise ExportError(f"{path}: {error}; export again") from error
    return found


def specs(rows: list[dict[str, Any]]) -> dict[str, Spec]:
    """Return the arrays of a manifest's list, by name."""
    return {row["name"]: Spec(tuple(map(_size, row["shape"])), row["dtype"]) for row in rows}


def check_file(folder: Path, entry: Mapping[str, Any]) -> Path:
    """Return the path of a file of the export after comparing it with its hash.

    Raises:
      ExportError: a file that is missing, too large, or that has changed.
    """
    path = folder / entry["file"]
    try:
        size = path.stat().st_size
        if size > (most := MAX_FILE_BYTES[path.suffix]):
            raise ExportError(f"{path}: {size} bytes, expected {most} at most")
        digest = atomic.sha256(path)
    except OSError as error:
        raise ExportError(f"{path}: cannot be read ({error.strerror}); export again") from error
    if digest != entry["sha256"]:
        raise ExportError(f"{path}: damaged: its SHA-256 is not the one in {FILE}; copy it again, or export again")
    return path


def _read_bytes(path: Path) -> bytes:
    try:
        with open(path, "rb") as file:
            data = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise ExportError(f"{path}: cannot be read ({error.strerror}); expected the manifest of an export") from error
    if len(data) > MAX_BYTES:
        raise ExportError(f"{path}: more than {MAX_BYTES} bytes")
    return data


def _rows(arrays: Mapping[str, Spec]) -> list[dict[str, Any]]:
    return [
        {"name": name, "shape": [n if isinstance(n, int) else str(n) for n in spec.shape], "dtype": spec.dtype}
        for name, spec in arrays.items()
    ]


def _size(size: int | str) -> int | Dimension:
    return size if isinstance(size, int) else Dimension.parse(size)


def _check(found: Any) -> None:
    """Raise `ValueError` that names the first field that is missing or wrong."""
    _expect(isinstance(found, dict), "manifest", "an object", found)
    _expect(found.get("format") == "stablehlo", "format", "stablehlo", found.get("format"))
    _expect(found.get("version") == VERSION, "version", str(VERSION), found.get("version"))
    convention = found.get("calling_convention_version")
    _expect(type(convention) is int, "calling_convention_version", "a whole number", convention)
    for name in ("facejax", "jax", "jaxlib", "date", "compatibility", "command"):
        _expect(isinstance(found.get(name), str), name, "a text", found.get(name))
    for name in ("labels", "expressions", "platforms"):
        _check_names(name, found.get(name))
    weights, functions = found.get("weights"), found.get("functions")
    _check_stored("weights", weights, ".safetensors")
    arrays = weights.get("arrays")
    _expect(isinstance(arrays, dict), "weights.arrays", "an object", arrays)
    for name, row in arrays.items():
        _check_array(f"weights.arrays.{name}", row, symbolic=False)
    _expect(isinstance(functions, dict) and bool(functions), "functions", "an object of functions", functions)
    for name, entry in functions.items():
        where = f"functions.{name}"
        _check_stored(where, entry, ".stablehlo")
        _check_names(f"{where}.constraints", entry.get("constraints"))
        _check_names(f"{where}.params", entry.get("params"))
        for path in entry["params"]:
            _expect(path in arrays, f"{where}.params", "names of weights.arrays", path)
        for kind in ("inputs", "outputs"):
            rows = entry.get(kind)
            _expect(isinstance(rows, list) and bool(rows), f"{where}.{kind}", "a list of arrays", rows)
            for i, row in enumerate(rows):
                _check_array(f"{where}.{kind}.{i}", row, symbolic=True)
                _expect(isinstance(row.get("name"), str), f"{where}.{kind}.{i}.name", "a text", row.get("name"))
            _expect(len({row["name"] for row in rows}) == len(rows), f"{where}.{kind}", "different names", rows)


def _check_stored(where: str, entry: Any, suffix: str) -> None:
    """Check the file name and the hash of an entry; a file lies in the folder itself."""
    _expect(isinstance(entry, dict), where, "an object", entry)
    name, digest = entry.get("file"), entry.get("sha256")
    good = isinstance(name, str) and _NAME.fullmatch(name) and "/" not in name and Path(name).suffix == suffix
    _expect(bool(good), f"{where}.file", f"a file name that ends in {suffix}", name)
    good = isinstance(digest, str) and re.fullmatch(r"[0-9a-f]{64}", digest)
    _expect(bool(good), f"{where}.sha256", "64 hexadecimal digits", digest)


def _check_names(where: str, names: Any) -> None:
    good = isinstance(names, list) and all(isinstance(name, str) and 0 < len(name) <= 200 for name in names)
    _expect(good, where, "a list of names", names)


def _check_array(where: str, row: Any, *, symbolic: bool) -> None:
    _expect(isinstance(row, dict), where, "an object", row)
    _expect(row.get("dtype") in DTYPES, f"{where}.dtype", f"one of {', '.join(DTYPES)}", row.get("dtype"))
    shape = row.get("shape")
    _expect(isinstance(shape, list) and len(shape) <= 8, f"{where}.shape", "up to eight sizes", shape)
    for size in shape:
        if symbolic and isinstance(size, str):
            Dimension.parse(size)
        else:
            _expect(type(size) is int and 0 <= size < 2**31, f"{where}.shape", "sizes of 0 or more", size)


def _expect(good: bool, where: str, expected: str, found: Any) -> None:
    if not good:
        raise ValueError(f"{where}: expected {expected}, got {str(found)[:60]!r}")
