"""Writer of animated faces as binary glTF 2.0 (GLB), for Blender, three.js, Unreal and other viewers.

Frame 0 is the mesh; every later frame is a morph target (its displacement from frame 0), and one animation sets the
weights of the targets one after another. The unit of glTF is the metre.
"""

import json
import os
import struct
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from facejax.io import atomic
from facejax.viz import scene, shading

_FLOAT, _UINT16, _UINT32 = 5126, 5123, 5125
_VERTEX_DATA, _INDEX_DATA = 34962, 34963
_Object = dict[str, Any]  # of JSON
_SHAPES = {1: "SCALAR", 3: "VEC3"}


def write(
    path: str | os.PathLike[str],
    vertices: ArrayLike,
    faces: ArrayLike,
    *,
    fps: float = 30.0,
    normals: bool = True,
    sparse: bool = True,
    name: str = "face",
    captions: scene.Captions = (),
    extras: Sequence[scene.PartLike] = (),
) -> None:
    """Write one animation, atomically.

    Args:
      path: the file.
      vertices: (T, N, 3) mm, or (N, 3) for a still face.
      faces: (F, 3).
      fps: frames per second.
      normals: store smooth normals for every frame; without them viewers use flat shading; halves the file size.
      sparse: store only the vertices that move, for each target where that is smaller.
      name: of the mesh and its node.
      captions: ((first frame, text), ...), stored in the animation's `extras` field.
      extras: further parts, see `scene.Part`.

    Raises:
      ValueError: arrays have wrong shapes, a part has no triangle, or the file would exceed 4 GiB.
    """
    film = scene.make(vertices, faces, fps=fps, captions=captions, extras=extras)
    for label, triangles in [
        ("faces", film.faces),
        *((f"extras[{i}]", p.faces) for i, p in enumerate(film.extras)),
    ]:
        if not len(triangles):
            raise ValueError(f"{label}: glTF needs at least one triangle")
    with atomic.replace_file(path) as temporary:
        temporary.write_bytes(_glb(*_document(film, str(name), normals, sparse)))


class _Buffers:
    """Buffer, views and accessors of a glTF document."""

    def __init__(self):
        self.data = bytearray()
        self.views: list[_Object] = []
        self.accessors: list[_Object] = []

    def view(self, array: np.ndarray, target: int | None = None) -> int:
        self.data += bytes(-len(self.data) % 4)
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": array.nbytes}
        self.views.append(view | ({"target": target} if target else {}))
        self.data += array.tobytes()
        return len(self.views) - 1

    def accessor(self, array: np.ndarray, target: int | None = None, *, sparse: bool = False) -> int:
        """Add values (n,) or (n, 3), float32 or unsigned, and return the index of their accessor."""
        kind = {"f4": _FLOAT, "u2": _UINT16, "u4": _UINT32}[array.dtype.str[1:]]
        columns = array.reshape(len(array), -1)
        record: _Object = {"componentType": kind, "count": len(array), "type": _SHAPES[columns.shape[1]]}
        record |= {"min": columns.min(0).tolist(), "max": columns.max(0).tolist()}
        moved = np.flatnonzero(columns.any(1)) if sparse else np.arange(len(array))
        index = moved.astype(_index_type(len(array)))
        if index.nbytes + array[moved].nbytes < array.nbytes:
            # An accessor without a view is zero; so is a target in which nothing moves.
            if len(moved):
                record["sparse"] = {
                    "count": len(moved),
                    "indices": {
                        "bufferView": self.view(index),
                        "componentType": _UINT16 if index.itemsize == 2 else _UINT32,
                    },
                    "values": {"bufferView": self.view(array[moved])},
                }
        else:
            record["bufferView"] = self.view(array, target)
        self.accessors.append(record)
        return len(self.accessors) - 1


def _document(film: scene.Scene, name: str, normals: bool, sparse: bool) -> tuple[_Object, bytes]:
    buffers, count = _Buffers(), len(film.vertices)
    skin = scene.Part(film.vertices, film.faces, np.asarray(scene.SKIN, np.float32), 0.3)
    meshes, materials, moving = [], [], []
    for i, part in enumerate([skin, *film.extras]):
        label = name if i == 0 else f"{name} part {i}"
        if part.vertices.ndim == 3 and len(part.vertices) > 1:
            moving.append(i)
        meshes.append(_mesh(buffers, part, label, i, normals, sparse))
        materials.append(_material(part, label))
    document = {
        "asset": {"version": "2.0", "generator": "facejax"},
        "scene": 0,
        "scenes": [{"nodes": list(range(len(meshes)))}],
        "nodes": [{"mesh": i, "name": mesh["name"]} for i, mesh in enumerate(meshes)],
        "meshes": meshes,
        "materials": materials,
    }
    if moving:
        times = buffers.accessor((np.arange(count) / film.fps).astype(np.float32))
        # At key t the weight of target t - 1 is one; frame 0 has none.
        weights = buffers.accessor(np.eye(count, dtype=np.float32)[:, 1:].ravel())
        document["animations"] = [
            {
                "name": "expression",
                "samplers": [{"input": times, "output": weights, "interpolation": "LINEAR"}],
                "channels": [{"sampler": 0, "target": {"node": i, "path": "weights"}} for i in moving],
                "extras": {"fps": film.fps, "captions": [list(caption) for caption in film.captions]},
            }
        ]
    buffers.data += bytes(-len(buffers.data) % 4)
    document["buffers"] = [{"byteLength": len(buffers.data)}]
    document["bufferViews"], document["accessors"] = buffers.views, buffers.accessors
    return document, bytes(buffers.data)


def _mesh(buffers: _Buffers, part: scene.Part, name: str, material: int, normals: bool, sparse: bool) -> _Object:
    frames = part.vertices if part.vertices.ndim == 3 else part.vertices[None]
    columns = {"POSITION": (frames / np.float32(1000)).astype(np.float32)}
    if normals:
        columns["NORMAL"] = scene.normals(frames, part.faces).astype(np.float32)
    attributes = {key: buffers.accessor(column[0], _VERTEX_DATA) for key, column in columns.items()}
    if np.ndim(part.colour) == 2:
        attributes["COLOR_0"] = buffers.accessor(shading.linear(np.asarray(part.colour)), _VERTEX_DATA)
    index = part.faces.ravel().astype(_index_type(frames.shape[1]))
    primitive: _Object = {
        "attributes": attributes,
        "indices": buffers.accessor(index, _INDEX_DATA),
        "material": material,
    }
    mesh: _Object = {"name": name, "primitives": [primitive]}
    if len(frames) > 1:
        primitive["targets"] = [
            {
                key: buffers.accessor(column[t] - column[0], _VERTEX_DATA, sparse=sparse)
                for key, column in columns.items()
            }
            for t in range(1, len(frames))
        ]
        mesh["weights"] = [0.0] * (len(frames) - 1)
        mesh["extras"] = {"targetNames": [f"frame {t}" for t in range(1, len(frames))]}
    return mesh


def _material(part: scene.Part, name: str) -> _Object:
    colour = shading.linear(np.asarray(part.colour)).tolist() if np.ndim(part.colour) == 1 else [1.0, 1.0, 1.0]
    surface = {
        "baseColorFactor": [*colour, 1.0],
        "metallicFactor": 0.0,
        "roughnessFactor": 0.85 - 0.6 * part.gloss,
    }
    return {"name": name, "pbrMetallicRoughness": surface, "doubleSided": True}


def _index_type(size: int) -> type:
    # The largest value of a type is glTF's primitive restart, not a vertex.
    return np.uint16 if size < 0xFFFF else np.uint32


def _glb(document: _Object, data: bytes) -> bytes:
    text = json.dumps(document, separators=(",", ":"), ensure_ascii=False).encode()
    text += b" " * (-len(text) % 4)
    size = 12 + 8 + len(text) + 8 + len(data)
    if size > 0xFFFFFFFF:
        raise ValueError(f"the animation takes {size} bytes; a GLB holds at most {0xFFFFFFFF}: write fewer frames")
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(data), 0x004E4942) + data
    return struct.pack("<III", 0x46546C67, 2, size) + chunks
