"""Reader of binary glTF 2.0 (GLB): positions and triangles of the file's largest mesh, without animation.

The largest mesh is the one with the most triangles among those in the scene, the first of equals: for a face with eyes
and teeth, the face. Its primitives are joined in the file's order, shared positions once. The transforms of its node
and of the node's ancestors are applied, except for a skinned mesh, which glTF places by its joints. Morph targets,
skins and animations are ignored. Vertices that an exporter duplicated at texture seams remain duplicated. The unit of
glTF is the metre, y up.

Functions raise plain ValueError; `meshes.read` adds the file's name. Chunks, views and accessors are checked against
the file size before memory is allocated. Numbers in parentheses, such as (3.6.2), are sections of the specification.
"""

import json
import math
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

_Object = dict[str, Any]  # JSON of an untrusted file: values may have any type
_MAX_JSON_BYTES = 2**25  # a face with a minute of animation takes a quarter of a megabyte
_MAX_COUNT = 2**23  # vertices, or corners of triangles
_JSON, _BIN = 0x4E4F534A, 0x004E4942
_TYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_COLUMNS = {"SCALAR": 1, "VEC3": 3}
_TRIANGLES, _STRIP, _FAN = 4, 5, 6
_LISTS = ("scenes", "nodes", "meshes", "accessors", "bufferViews", "buffers")
# Required extensions that do not affect positions; compression, for example, does.
_SUPPORTED_EXTENSIONS = ("KHR_materials_", "KHR_texture_", "KHR_lights_", "KHR_mesh_quantization", "EXT_texture_")


def read(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read vertices (N, 3) float64 and faces (F, 3) int64. Raises `ValueError` for a damaged file."""
    document, binary = _chunks(path.read_bytes())
    try:
        foreign = [x for x in document.get("extensionsRequired", []) if not x.startswith(_SUPPORTED_EXTENSIONS)]
        if foreign:
            raise ValueError(f"unsupported extension {foreign[0]}: export without it")
        for key in _LISTS:
            items = document.setdefault(key, [])
            if not isinstance(items, list) or not all(isinstance(item, dict) for item in items):
                raise ValueError(f"{key} must be a list of objects")
        # Transforms in a hostile file may overflow; the caller rejects vertices that are not finite.
        with np.errstate(all="ignore"):
            mesh, matrix = _largest(document)
            vertices, faces = _join(document, binary, mesh)
            vertices = vertices @ matrix[:3, :3].T + matrix[:3, 3]
            # A mirroring transform reverses the orientation of triangles (3.7.4).
            mirrored = np.linalg.det(matrix[:3, :3]) < 0
    except KeyError as error:
        raise ValueError(f"invalid glTF: {error} is missing") from error
    except (TypeError, AttributeError, IndexError, OverflowError) as error:
        raise ValueError(f"invalid glTF: {error}") from error
    return vertices, faces[:, ::-1] if mirrored else faces


def _chunks(data: bytes) -> tuple[_Object, bytes]:
    """The document and its binary chunk (4.4)."""
    if len(data) < 20 or data[:4] != b"glTF":
        raise ValueError("is not a GLB file (no header)")
    version, size = struct.unpack_from("<II", data, 4)
    if version != 2:
        raise ValueError(f"unsupported glTF version {version}, expected 2")
    if size != len(data):
        raise ValueError(f"header claims {size} bytes, the file holds {len(data)}")
    chunks: list[tuple[int, int, int]] = []  # kind, start, length
    at = 12
    while at < size:
        if at + 8 > size:
            raise ValueError(f"ends early: {size - at} bytes where a chunk should begin")
        length, kind = struct.unpack_from("<II", data, at)
        if at + 8 + length > size:
            raise ValueError(f"ends early: a chunk needs {length} bytes, {size - at - 8} are left")
        chunks.append((kind, at + 8, length))
        at += 8 + length
    kind, at, length = chunks[0]
    if kind != _JSON or length > _MAX_JSON_BYTES:
        raise ValueError(
            f"first chunk must be JSON of at most {_MAX_JSON_BYTES} bytes, got type {kind:#x}, {length} bytes"
        )
    try:
        document = json.loads(data[at : at + length].decode("utf-8"))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"holds no JSON: {error}") from None
    if not isinstance(document, dict):
        raise ValueError(f"its JSON must be an object, got {type(document).__name__}")
    binary = b""
    if len(chunks) > 1 and chunks[1][0] == _BIN:
        binary = data[chunks[1][1] : chunks[1][1] + chunks[1][2]]
    return document, binary


def _largest(document: _Object) -> tuple[_Object, np.ndarray]:
    """Return the mesh with the most triangles, and its transform (4, 4) to the scene."""
    meshes = document["meshes"]
    counts = [_count(document, mesh) for mesh in meshes]
    # A file without nodes is a library of meshes without transforms.
    shown = list(_instances(document)) if document["nodes"] else [(i, np.eye(4)) for i in range(len(meshes))]
    best, matrix = max(shown, key=lambda entry: counts[entry[0]], default=(-1, np.eye(4)))
    if best < 0 or not counts[best]:
        raise ValueError("holds no triangles")
    if counts[best] > _MAX_COUNT // 3:
        raise ValueError(f"claims {counts[best]} triangles; at most {_MAX_COUNT // 3} are read")
    return meshes[best], matrix


def _instances(document: _Object) -> Iterator[tuple[int, np.ndarray]]:
    """Yield (mesh, transform) of every node of the scene that has a mesh, depth first (3.5.2)."""
    nodes, scenes = document["nodes"], document["scenes"]
    if scenes:
        roots = scenes[_integer(document.get("scene", 0), len(scenes), "scene")].get("nodes", [])
    else:
        below = {child for node in nodes for child in node.get("children", [])}
        roots = [i for i in range(len(nodes)) if i not in below]
    waiting, seen = [(i, np.eye(4)) for i in reversed(roots)], set()
    while waiting:
        i, above = waiting.pop()
        node = nodes[_integer(i, len(nodes), "node")]
        if i in seen:
            raise ValueError(f"node {i} has two parents, or is its own ancestor")
        seen.add(i)
        matrix = above @ _matrix(node)
        waiting += [(child, matrix) for child in reversed(node.get("children", []))]
        if "mesh" in node:
            yield _integer(node["mesh"], len(document["meshes"]), "mesh"), np.eye(4) if "skin" in node else matrix


def _matrix(node: _Object) -> np.ndarray:
    """Return a node's local transform: its matrix by columns, or translation * rotation * scale (3.5.2)."""
    if "matrix" in node:
        return np.array(_floats(node["matrix"], 16, "matrix")).reshape(4, 4).T
    matrix = np.eye(4)
    x, y, z, w = _floats(node.get("rotation", (0, 0, 0, 1)), 4, "rotation")
    matrix[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    matrix[:3, :3] *= _floats(node.get("scale", (1, 1, 1)), 3, "scale")
    matrix[:3, 3] = _floats(node.get("translation", (0, 0, 0)), 3, "translation")
    return matrix


def _count(document: _Object, mesh: _Object) -> int:
    """Return the number of triangles of a mesh that its accessors declare."""
    total = 0
    for primitive in mesh["primitives"]:
        if _drawn(primitive):
            corners = _accessor(document, primitive.get("indices", primitive["attributes"]["POSITION"]))["count"]
            total += corners // 3 if primitive.get("mode", _TRIANGLES) == _TRIANGLES else max(corners - 2, 0)
    return total


def _drawn(primitive: _Object) -> bool:
    """Return whether a primitive has positions, and consists of triangles, not of points or lines."""
    return primitive.get("mode", _TRIANGLES) in (_TRIANGLES, _STRIP, _FAN) and "POSITION" in primitive["attributes"]


def _join(document: _Object, binary: bytes, mesh: _Object) -> tuple[np.ndarray, np.ndarray]:
    parts, first, faces, total = [], {}, [np.zeros((0, 3), np.int64)], 0
    for primitive in mesh["primitives"]:
        if not _drawn(primitive):
            continue
        where = primitive["attributes"]["POSITION"]
        count = _accessor(document, where)["count"]
        if where not in first:
            if total + count > _MAX_COUNT:
                raise ValueError(f"claims more than {_MAX_COUNT} vertices")
            parts.append(_values(document, binary, where, "VEC3"))
            first[where] = total
            total += count
        index = np.arange(count)
        if "indices" in primitive:
            index = _values(document, binary, primitive["indices"], "SCALAR")[:, 0].astype(np.int64)
        if len(index) and index.max() >= count:
            raise ValueError(f"vertex index {index.max()} of a triangle is out of range; there are {count} vertices")
        faces.append(first[where] + _triangles(index, primitive.get("mode", _TRIANGLES)))
    return np.concatenate(parts), np.concatenate(faces)


def _triangles(index: np.ndarray, mode: int) -> np.ndarray:
    """Return the triangles (F, 3) of a list, strip or fan of indices (3.7.2.1)."""
    if mode == _TRIANGLES:
        if len(index) % 3:
            raise ValueError(f"{len(index)} corners, expected a multiple of 3")
        return index.reshape(-1, 3)
    if mode == _FAN:
        return np.stack([index[1:-1], index[2:], np.broadcast_to(index[:1], max(len(index) - 2, 0))], -1)
    at = np.arange(max(len(index) - 2, 0))
    odd = at % 2
    return np.stack([index[at], index[at + 1 + odd], index[at + 2 - odd]], -1)


def _accessor(document: _Object, which: Any) -> _Object:
    record = document["accessors"][_integer(which, len(document["accessors"]), "accessor")]
    _integer(record["count"], _MAX_COUNT + 1, "count of an accessor")
    return record


def _values(document: _Object, binary: bytes, which: int, shape: str) -> np.ndarray:
    """Return an accessor's values (count, columns), with sparse replacements applied (3.6.2)."""
    record = _accessor(document, which)
    kind, count, columns = _kind(record), record["count"], _COLUMNS[shape]
    if record["type"] != shape or (shape == "SCALAR" and kind.kind != "u"):
        raise ValueError(f"accessor {which} must be {shape}, got {record['type']} of {record['componentType']}")
    if "bufferView" in record:
        values = _view(document, binary, record, kind, count, columns).copy()
    else:
        values = np.zeros((count, columns), kind)
    if "sparse" in record:
        sparse = record["sparse"]
        changed = _integer(sparse["count"], count + 1, "count of a sparse accessor")
        index_kind = _kind(sparse["indices"])
        index = _view(document, binary, sparse["indices"], index_kind, changed, 1)[:, 0]
        if index_kind.kind != "u" or (changed and index.max() >= count):
            raise ValueError(f"accessor {which}: index of a sparse replacement is out of range")
        values[index] = _view(document, binary, sparse["values"], kind, changed, columns)
    if shape == "SCALAR":
        return values
    if record.get("normalized") and kind.kind in "iu":
        return np.maximum(values / np.iinfo(kind).max, -1.0)  # (3.11)
    return values.astype(np.float64)


def _kind(record: _Object) -> np.dtype:
    if record["componentType"] not in _TYPES:
        raise ValueError(f"componentType must be one of {', '.join(map(str, _TYPES))}, got {record['componentType']}")
    return np.dtype(_TYPES[record["componentType"]])


def _view(document: _Object, binary: bytes, place: _Object, kind: np.dtype, count: int, columns: int) -> np.ndarray:
    """Return `count` rows of the binary chunk at a place: a view and an offset in it."""
    views, buffers = document["bufferViews"], document["buffers"]
    view = views[_integer(place["bufferView"], len(views), "bufferView")]
    if _integer(view["buffer"], len(buffers), "buffer") != 0 or "uri" in buffers[0]:
        raise ValueError("data in external files is not supported: export as one GLB")
    start, offset = (_integer(x.get("byteOffset", 0), len(binary) + 1, "byteOffset") for x in (view, place))
    length, row = _integer(view["byteLength"], len(binary) - start + 1, "byteLength of a view"), columns * kind.itemsize
    stride = _integer(view.get("byteStride", row), 253, "byteStride")
    need = offset + (count - 1) * stride + row if count else 0
    if stride < row or need > length:
        raise ValueError(f"an accessor of {count} rows, {stride} bytes each, needs {need} bytes of a view of {length}")
    return np.ndarray((count, columns), kind, binary, start + offset if count else 0, (stride, kind.itemsize))


def _integer(value: Any, limit: int, what: str) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < limit:
        raise ValueError(f"{what} must be an integer in 0..{limit - 1}, got {str(value)[:40]}")
    return value


def _floats(values: Any, count: int, what: str) -> list[float]:
    if len(values) != count or not all(math.isfinite(value) for value in values):
        raise ValueError(f"{what} must be {count} finite numbers, got {str(values)[:60]}")
    return [float(value) for value in values]
