"""The PLY format: text, little and big endian. Positions and faces are read, other elements and properties skipped.

Functions raise plain ValueError; `meshes.read` adds the file's name.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
_ORDER = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_MAX_HEADER_BYTES = 1 << 16
MAX_ROWS = 1 << 23  # vertices, or triangles
_MAX_TEXT_BYTES = 1 << 26  # a number of two bytes of text takes eight in memory
_MAX_RAGGED_ROWS = 1 << 20  # rows of lists of different length, each of which becomes an array of its own


class _Property(NamedTuple):
    name: str
    kind: str
    length_kind: str | None  # type of a list's length; None for a scalar


class _Element(NamedTuple):
    name: str
    rows: int
    properties: list[_Property]


def read(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read vertices (N, 3) float64 and faces (F, 3) int64. Raises `ValueError` for a damaged file."""
    data = path.read_bytes()
    order, elements, start = _header(data)
    # Text and binary differ only in how the next numbers are read.
    source = _Binary(data, start, order) if order else _Text(data, start)
    with np.errstate(invalid="ignore"):  # the caller rejects invalid values and indices
        return _elements(source, elements)


def _elements(source: "_Binary | _Text", elements: list[_Element]) -> tuple[np.ndarray, np.ndarray]:
    vertices, faces = None, np.zeros((0, 3), np.int64)
    for element in elements:
        columns = _rows(source, element)
        if element.name == "vertex":
            missing = {"x", "y", "z"} - columns.keys()
            if missing:
                raise ValueError(f"element vertex lacks property {min(missing)}")
            vertices = np.stack([np.asarray(columns[axis], np.float64) for axis in "xyz"], -1)
        if element.name == "face":
            polygons = columns.get("vertex_indices", columns.get("vertex_index"))
            if polygons is None:
                raise ValueError("element face lacks the list vertex_indices")
            faces = _fans(polygons)
    if vertices is None:
        raise ValueError("has no element vertex")
    return vertices, faces


def write(path: Path, vertices: np.ndarray, faces: np.ndarray) -> None:
    """Write little-endian binary, in single precision for float32 vertices, else in double."""
    kind = "float" if vertices.dtype == np.float32 else "double"
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}"]
    header += [f"property {kind} {axis}" for axis in "xyz"]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header\n"]
    table = np.empty(len(faces), [("count", "u1"), ("corner", "<i4", 3)])
    table["count"], table["corner"] = 3, faces
    path.write_bytes("\n".join(header).encode() + vertices.astype(f"<{_TYPES[kind]}").tobytes() + table.tobytes())


def _header(data: bytes) -> tuple[str, list[_Element], int]:
    end = data.find(b"end_header", 0, _MAX_HEADER_BYTES)
    line_end = data.find(b"\n", end)
    if not data.startswith(b"ply") or end < 0 or line_end < 0:
        raise ValueError("not a PLY file (no header)")
    order, elements = None, []
    for line in data[:end].decode("latin1").splitlines()[1:]:
        word = line.split()
        try:
            if not word or word[0] in ("comment", "obj_info"):
                continue
            if word[0] == "format":
                order = _ORDER[word[1]]
            elif word[0] == "element":
                elements.append(_Element(word[1], int(word[2]), []))
            elif word[0] == "property" and word[1] == "list":
                elements[-1].properties.append(_Property(word[4], _TYPES[word[3]], _TYPES[word[2]]))
            elif word[0] == "property":
                elements[-1].properties.append(_Property(word[2], _TYPES[word[1]], None))
            else:
                raise KeyError(word[0])
        except (KeyError, IndexError, ValueError):
            raise ValueError(f"header line cannot be parsed: {line[:60]!r}") from None
    if order is None:
        raise ValueError("header names no format")
    for element in elements:
        # Every number takes a byte or more, so that a false count is found before memory is allocated.
        if not 0 <= element.rows <= len(data):
            raise ValueError(f"header claims {element.rows} rows of {element.name} in {len(data)} bytes")
        if element.name in ("vertex", "face") and element.rows > MAX_ROWS:
            raise ValueError(f"{element.rows} rows of {element.name}; at most {MAX_ROWS} are read")
    return order, elements, line_end + 1


def _rows(source: "_Binary | _Text", element: _Element) -> Mapping[str, np.ndarray | list[np.ndarray]]:
    """Return columns by name: arrays for scalars and for lists of equal length, Python lists for others."""
    if all(item.length_kind is None for item in element.properties):
        return source.table(element, {})
    first = source.copy().one_row(element) if element.rows else {}
    lengths = {item.name: len(first.get(item.name, ())) for item in element.properties if item.length_kind}
    # Nearly all files contain only triangles; the element is then a table that can be read at once.
    attempt = source.copy()
    try:
        columns = attempt.table(element, lengths)
    except ValueError:
        columns = None
    if columns is not None and all((columns[f"{name} length"] == k).all() for name, k in lengths.items()):
        source.at = attempt.at
        return columns
    if element.rows > _MAX_RAGGED_ROWS:
        raise ValueError(f"{element.rows} rows of {element.name} differ in length; at most {_MAX_RAGGED_ROWS} are read")
    lists: dict[str, list[np.ndarray]] = {item.name: [] for item in element.properties}
    for _ in range(element.rows):
        for name, values in source.one_row(element).items():
            lists[name].append(values)
    return lists


class _Binary:
    """A cursor in binary data."""

    def __init__(self, data: bytes, at: int, order: str):
        self.data, self.at, self.order = data, at, order

    def copy(self) -> "_Binary":
        return _Binary(self.data, self.at, self.order)

    def take(self, dtype: np.dtype | str, count: int, what: str) -> np.ndarray:
        need = np.dtype(dtype).itemsize * count
        if self.at + need > len(self.data):
            there = len(self.data) - self.at
            raise ValueError(f"ends early: {what} needs {need} bytes, {there} are left")
        self.at += need
        return np.frombuffer(self.data, dtype, count, self.at - need)

    def one_row(self, element: _Element) -> dict[str, np.ndarray]:
        row: dict[str, np.ndarray] = {}
        for item in element.properties:
            length = int(self.take(self.order + item.length_kind, 1, element.name)[0]) if item.length_kind else 1
            if length < 0:
                raise ValueError(f"a list of {element.name} has length {length}")
            values = self.take(self.order + item.kind, length, element.name)
            row[item.name] = values if item.length_kind else values[0]
        return row

    def table(self, element: _Element, lengths: dict[str, int]) -> dict[str, np.ndarray]:
        fields = []
        for item in element.properties:
            if item.length_kind:
                fields.append((f"{item.name} length", self.order + item.length_kind))
            fields.append((item.name, self.order + item.kind, (lengths[item.name],) if item.length_kind else ()))
        table = self.take(np.dtype(fields), element.rows, element.name)
        return {name: table[name] for name in table.dtype.names or ()}


class _Text:
    """A cursor in the numbers of a text file."""

    def __init__(self, data: bytes, start: int):
        if len(data) - start > _MAX_TEXT_BYTES:
            raise ValueError(f"{len(data)} bytes of text; at most {_MAX_TEXT_BYTES} are read: save it as binary")
        try:
            self.numbers = np.concatenate([np.array(words, np.float64) for words in _words(data, start)])
        except ValueError as error:
            raise ValueError(f"not a number: {str(error)[-60:]}") from None
        self.at = 0

    def copy(self) -> "_Text":
        other = object.__new__(_Text)
        other.numbers, other.at = self.numbers, self.at
        return other

    def take(self, count: int, what: str) -> np.ndarray:
        if self.at + count > len(self.numbers):
            there = len(self.numbers) - self.at
            raise ValueError(f"ends early: {what} needs {count} numbers, {there} are left")
        self.at += count
        return self.numbers[self.at - count : self.at]

    def one_row(self, element: _Element) -> dict[str, np.ndarray]:
        row: dict[str, np.ndarray] = {}
        for item in element.properties:
            length = self.take(1, element.name)[0] if item.length_kind else 1
            if not (0 <= length <= len(self.numbers) and length == int(length)):
                raise ValueError(f"a list of {element.name} has length {length:g}")
            values = self.take(int(length), element.name)
            row[item.name] = values if item.length_kind else values[0]
        return row

    def table(self, element: _Element, lengths: dict[str, int]) -> dict[str, np.ndarray]:
        widths = [1 + lengths[item.name] if item.length_kind else 1 for item in element.properties]
        table = self.take(element.rows * sum(widths), element.name).reshape(element.rows, sum(widths))
        columns, at = {}, 0
        for item, width in zip(element.properties, widths, strict=True):
            if item.length_kind:
                columns[f"{item.name} length"] = table[:, at]
                columns[item.name] = table[:, at + 1 : at + width]
            else:
                columns[item.name] = table[:, at]
            at += width
        return columns


def _words(data: bytes, start: int, size: int = 1 << 20) -> Iterator[list[bytes]]:
    """Yield the words of a text, a megabyte at a time, because as Python objects they take many times their size."""
    rest = b""
    for at in range(start, len(data), size):
        *whole, rest = (rest + data[at : at + size] + b"|").split()  # the mark ends a word that may continue
        rest = rest[:-1]
        yield whole
    yield [rest] if rest else []


def _fans(polygons: np.ndarray | list[np.ndarray]) -> np.ndarray:
    """Return triangles (F, 3) int64 of polygons: an array (P, k), or a list of arrays."""
    groups = [polygons] if isinstance(polygons, np.ndarray) else [polygon[None] for polygon in polygons]
    if (count := sum(len(group) * (group.shape[1] - 2) for group in groups)) > MAX_ROWS:
        raise ValueError(f"{count} triangles; at most {MAX_ROWS} are read")
    triangles = [np.zeros((0, 3), np.int64)]
    for group in groups:
        corners = group.shape[1]
        if group.shape[0] and corners < 3:
            raise ValueError(f"a face has {corners} corners, expected 3 or more")
        if group.dtype.kind == "f" and not np.equal(np.trunc(group), group).all():
            raise ValueError("a vertex index of a face is not an integer")
        if corners == 3:
            triangles.append(group.astype(np.int64))
            continue
        fan = [group[:, [0, i, i + 1]].astype(np.int64) for i in range(1, corners - 1)]
        triangles.append(np.stack(fan, 1).reshape(-1, 3) if fan else np.zeros((0, 3), np.int64))
    return np.concatenate(triangles)
