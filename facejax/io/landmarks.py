"""Readers of landmark files in several formats, and a writer.

  .json   `{"indices": [...]}` vertex indices from 0; `{"faces": [...], "weights": [[a, b, c], ...]}` barycentric, in
          the order of the triangle's corners; `{"points": [[x, y, z], ...]}`; or a bare list of indices or points.
          `names` is optional, other keys are ignored.
  .pp     MeshLab's PickedPoints: XML, one `<point x= y= z= name= active=>` each.
  .txt .csv .xyz .lnd .bnd   one landmark per line: `index`, `x y z`, or `index x y z` as in BU-4DFE, the same in all
          lines; separated by blanks, commas or semicolons; `#` begins a comment, blank lines are ignored.
  .npy .npz .pkl   FLAME's embedding (`facejax.io.flame_embedding`), for a mesh with FLAME's triangles.

Positions are in the mesh's unit. Files may be untrusted: sizes are bounded, and declarations in XML are rejected.
L landmarks, N vertices, F triangles.
"""

import json
import math
import os
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple
from xml.parsers import expat

import numpy as np
from numpy.typing import ArrayLike

from facejax.io import atomic, errors, flame_embedding

MAX_BYTES = 2**22
MAX_LANDMARKS = 10_000
VERTEX_TOLERANCE = 1e-3  # between a vertex and the position beside its index, relative to the mesh's diagonal
_KINDS = (("indices",), ("faces", "weights"), ("points",))
_ROW_FORMATS = {1: "index", 3: "x y z", 4: "index x y z"}


class LandmarkError(errors.FileError):
    """A landmark file cannot be used; the message names the file and the line or entry."""


class Landmarks(NamedTuple):
    """L landmarks of one mesh."""

    points: np.ndarray  # (L, 3) float64, in the mesh's unit
    # (L,) int32 vertex indices; None where the file does not contain any
    index: np.ndarray | None  # pyright: ignore[reportIncompatibleMethodOverride]
    names: tuple[str, ...] | None = None  # (L,)


def read(path: str | os.PathLike[str], vertices: ArrayLike | None = None, faces: ArrayLike | None = None) -> Landmarks:
    """Read the landmarks of a mesh in the format of the file's suffix.

    Args:
      path: the file.
      vertices: (N, 3) of the mesh; without them only files of positions can be read.
      faces: (F, 3) of the mesh; required for barycentric landmarks.

    Raises:
      LandmarkError: the file is missing, too large or damaged; a number is not finite; an index is out of range; a
        position is far from the mesh, or not at the vertex whose index is beside it.
    """
    path = Path(path)
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise LandmarkError(f"{path}: unknown landmark format {path.suffix!r}; expected {', '.join(_READERS)}")
    mesh = None if vertices is None else np.asarray(vertices, np.float64).reshape(-1, 3)
    try:
        if not path.is_file():
            raise LandmarkError(f"{path}: {'not a file' if path.exists() else 'no such file'}")
        size = path.stat().st_size
        if not 0 < size <= MAX_BYTES:
            raise LandmarkError(f"{path}: {size} bytes; expected 1 to {MAX_BYTES}")
        found = reader(path, mesh, faces)
        if mesh is not None:
            _check_distance(found.points, mesh)
    except LandmarkError:
        raise
    except OSError as error:
        raise LandmarkError(f"{path}: cannot be read: {error.strerror or error}") from error
    except ValueError as error:
        raise LandmarkError(f"{path}: {error}") from error
    return found


def write(
    path: str | os.PathLike[str], *, index: ArrayLike | None = None, points: ArrayLike | None = None,
    names: Sequence[str] | None = None,
) -> None:  # fmt: skip
    """Write vertex indices (L,) or positions (L, 3), and optional names (L,), as .json, atomically and without loss.

    Raises:
      ValueError: the suffix is not .json, not exactly one of `index` and `points` is given, or a shape is wrong.
    """
    path = Path(path)
    if path.suffix.lower() != ".json":
        raise ValueError(f"{path}: landmarks are written as .json, got {path.suffix!r}")
    if (index is None) == (points is None):
        raise ValueError(f"{path}: expected either index or points, not both or none")
    if points is None:
        values = np.asarray(index)
        if values.ndim != 1 or not len(values) or values.dtype.kind not in "iu" or values.min() < 0:
            raise ValueError(f"{path}: index must be (L,) integers of 0 or more, got {values.shape} {values.dtype}")
    else:
        values = np.asarray(points, np.float64)
        if values.ndim != 2 or values.shape[1] != 3 or not len(values) or not np.isfinite(values).all():
            raise ValueError(f"{path}: points must be (L, 3) and finite, got {values.shape}")
    record = {"indices" if points is None else "points": values.tolist()}
    if names is not None:
        record["names"] = _names(list(names), len(values))
    with atomic.replace_file(path) as temporary:
        temporary.write_text(json.dumps(record), encoding="utf-8")


def _read_json(path: Path, mesh: np.ndarray | None, faces: ArrayLike | None) -> Landmarks:
    try:
        record = json.loads(path.read_bytes().decode("utf-8-sig"))
    except UnicodeDecodeError:
        raise ValueError("not UTF-8 text") from None
    except (json.JSONDecodeError, RecursionError) as error:
        raise ValueError(f"not JSON: {error}") from None
    if isinstance(record, list):
        record = {"points" if record and isinstance(record[0], list) else "indices": record}
    kinds = [kind for kind in _KINDS if isinstance(record, dict) and any(key in record for key in kind)]
    if len(kinds) != 1 or not all(key in record for key in kinds[0]):
        keys = sorted(map(str, record))[:8] if isinstance(record, dict) else type(record).__name__
        raise ValueError(f'expected "indices", or "faces" and "weights", or "points", got {keys}')
    rows = [_list(record[key], key) for key in kinds[0]]
    if kinds[0] == ("indices",):
        index = np.array([_index(v, f"indices[{i}]", mesh) for i, v in enumerate(rows[0])], np.int32)
        assert mesh is not None  # `_index` raises without one
        found = Landmarks(mesh[index], index)
    elif kinds[0] == ("points",):
        points = [_numbers(v, f"points[{i}]") for i, v in enumerate(rows[0])]
        found = Landmarks(np.array(points, np.float64), None)
    else:
        if len(rows[0]) != len(rows[1]):
            raise ValueError(f"{len(rows[0])} faces but {len(rows[1])} weights")
        weights = np.array([_numbers(v, f"weights[{i}]") for i, v in enumerate(rows[1])], np.float64)
        found = Landmarks(_interpolate(rows[0], weights, mesh, faces), None)
    if "names" in record:
        found = found._replace(names=tuple(_names(record["names"], len(found.points))))
    return found


def _interpolate(face: list[Any], weights: np.ndarray, mesh: np.ndarray | None, faces: ArrayLike | None) -> np.ndarray:
    if mesh is None or faces is None:
        raise ValueError("barycentric landmarks need the mesh's vertices and faces")
    faces = np.asarray(faces)
    index = [_integer(v, f"faces[{i}]", len(faces), "triangles") for i, v in enumerate(face)]
    bad = np.flatnonzero(~(np.abs(weights.sum(1) - 1) <= 1e-3))
    if len(bad):
        raise ValueError(f"weights[{bad[0]}]: expected a sum of 1, got {weights[bad[0]].tolist()}")
    return np.einsum("lk,lkx->lx", weights, mesh[faces[index]])


def _read_embedding(path: Path, mesh: np.ndarray | None, faces: ArrayLike | None) -> Landmarks:
    face, weights = flame_embedding.read(path)
    if not 0 < len(face) <= MAX_LANDMARKS:
        raise ValueError(f"expected 1 to {MAX_LANDMARKS} landmarks, got {len(face)}")
    return Landmarks(_interpolate(face.tolist(), weights, mesh, faces), None)


def _read_pp(path: Path, mesh: np.ndarray | None, faces: ArrayLike | None) -> Landmarks:
    parser = expat.ParserCreate()
    tags, points, names = set(), [], []

    def start(tag: str, attributes: dict[str, str]) -> None:
        line = f"line {parser.CurrentLineNumber}"
        if not tags and tag != "PickedPoints":
            raise ValueError(f"{line}: expected PickedPoints, got {tag[:40]!r}")
        tags.add(tag)
        if tag != "point":
            return
        name = attributes.get("name", str(len(points)))
        # MeshLab keeps points that are named but not picked; skipping one would renumber all that follow.
        if attributes.get("active", "1") == "0":
            raise ValueError(f"{line}: point {name[:40]!r} is not active: pick it or delete it in MeshLab")
        missing = [axis for axis in "xyz" if axis not in attributes]
        if missing:
            raise ValueError(f"{line}: point {name[:40]!r} lacks {missing[0]}")
        points.append([_number(attributes[axis], line) for axis in "xyz"])
        names.append(name)

    # MeshLab writes a bare <!DOCTYPE PickedPoints>. Declarations could expand entities or read files: rejected.
    def doctype(name: str, system: str | None, public: str | None, has_subset: bool) -> None:
        if system or public or has_subset:
            raise ValueError(f"line {parser.CurrentLineNumber}: a DOCTYPE with declarations is not allowed")

    def entity(*_: Any) -> None:
        raise ValueError(f"line {parser.CurrentLineNumber}: entities are not allowed")

    parser.StartElementHandler, parser.StartDoctypeDeclHandler, parser.EntityDeclHandler = start, doctype, entity
    try:
        parser.Parse(path.read_bytes(), True)
    except (expat.ExpatError, LookupError) as error:
        raise ValueError(f"not XML: {error}") from None
    return Landmarks(np.array(_list(points, "points"), np.float64), None, tuple(names))


def _read_text(path: Path, mesh: np.ndarray | None, faces: ArrayLike | None) -> Landmarks:
    index, points, form = [], [], None
    for number, line in enumerate(path.read_bytes().decode("utf-8-sig", errors="replace").splitlines(), 1):
        words = [word for word in re.split(r"[\s,;]+", line.partition("#")[0]) if word]
        if not words:
            continue
        where = f"line {number}"
        form = len(words) if form is None else form
        if len(words) != form or form not in _ROW_FORMATS:
            formats = ", ".join(f"`{row}`" for row in _ROW_FORMATS.values())
            wanted = f"`{_ROW_FORMATS[form]}` as before" if form in _ROW_FORMATS else formats
            raise ValueError(f"{where}: expected {wanted}, got {len(words)} columns: {line.strip()[:60]!r}")
        if form != 3:
            if not re.fullmatch(r"[0-9]{1,9}", words[0]):
                raise ValueError(f"{where}: expected a vertex index of 0 or more, got {words[0][:40]!r}")
            index.append(_index(int(words[0]), where, mesh) if form == 1 or mesh is not None else int(words[0]))
        if form != 1:
            points.append([_number(word, where) for word in words[-3:]])
            if form == 4 and mesh is not None:
                vertex = mesh[index[-1]]
                if math.dist(points[-1], vertex) > VERTEX_TOLERANCE * _diagonal(mesh):
                    raise ValueError(
                        f"{where}: vertex {index[-1]} is at {vertex.tolist()}, not at {points[-1]}: the landmarks "
                        "belong to another mesh"
                    )
        if max(len(index), len(points)) > MAX_LANDMARKS:
            raise ValueError(f"{where}: more than {MAX_LANDMARKS} landmarks")
    _list(index or points, "landmarks")
    numbers = np.array(index, np.int32) if index else None
    if points:
        return Landmarks(np.array(points, np.float64), numbers)
    assert mesh is not None  # `_index` raises without one
    return Landmarks(mesh[numbers], numbers)


def _list(values: Any, what: str) -> list[Any]:
    if not isinstance(values, list) or not 0 < len(values) <= MAX_LANDMARKS:
        got = f"{len(values)}" if isinstance(values, list) else type(values).__name__
        raise ValueError(f"{what}: expected a list of 1 to {MAX_LANDMARKS} landmarks, got {got}")
    return values


def _names(values: Any, count: int) -> list[str]:
    if not isinstance(values, list) or len(values) != count or not all(isinstance(v, str) for v in values):
        raise ValueError(f"names: expected {count} strings, one for each landmark")
    return values


def _integer(value: Any, where: str, count: int, what: str) -> int:
    if isinstance(value, bool) or not isinstance(value, int):
        raise ValueError(f"{where}: expected an integer, got {str(value)[:40]!r}")
    if not 0 <= value < count:
        raise ValueError(f"{where}: {str(value)[:40]} is out of range; {what} are 0..{count - 1}")
    return value


def _index(value: Any, where: str, mesh: np.ndarray | None) -> int:
    if mesh is None:
        raise ValueError("landmarks given as vertex indices need the mesh's vertices")
    return _integer(value, where, len(mesh), "vertices")


def _numbers(value: Any, where: str) -> list[float]:
    if not isinstance(value, list) or len(value) != 3:
        raise ValueError(f"{where}: expected 3 numbers, got {str(value)[:60]!r}")
    return [_number(v, where) for v in value]


def _number(value: Any, where: str) -> float:
    try:
        number = math.nan if isinstance(value, (bool, list, dict)) or value is None else float(value)
    except (ValueError, OverflowError):
        number = math.nan
    # The square root of the largest float, so that squared distances are finite.
    if not abs(number) < 1e150:
        raise ValueError(f"{where}: expected a finite number, got {str(value)[:40]!r}")
    return number


def _check_distance(points: np.ndarray, mesh: np.ndarray) -> None:
    middle, diagonal = (mesh.min(0) + mesh.max(0)) / 2, _diagonal(mesh)
    distance = np.linalg.norm(points - middle, axis=1)
    far = int(np.argmax(distance))
    if distance[far] > max(diagonal, 1e-12):
        raise ValueError(
            f"landmark {far} is {distance[far]:.3g} away from the centre of a mesh whose diagonal is {diagonal:.3g}: "
            "another unit, or another mesh?"
        )


def _diagonal(mesh: np.ndarray) -> float:
    return float(np.linalg.norm(np.ptp(mesh, axis=0)))


_READERS: dict[str, Callable[[Path, np.ndarray | None, ArrayLike | None], Landmarks]] = {
    ".json": _read_json,
    ".pp": _read_pp,
    **dict.fromkeys((".txt", ".csv", ".xyz", ".lnd", ".bnd"), _read_text),
    **dict.fromkeys(flame_embedding.SUFFIXES, _read_embedding),
}
