"""Reading GLB: our own exports come back, files built by hand say what they must, lies are refused."""

import json
import struct

import numpy as np
import pytest
import trimesh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from facejax import io
from facejax.io import meshes
from facejax.viz import eyes_teeth

SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
TWO = [0, 1, 2, 0, 2, 3]
KINDS = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}


class Builder:
    """A GLB by hand: one accessor for each array, and what is then changed in `document`."""

    def __init__(self):
        self.binary = b""
        self.document = {
            "asset": {"version": "2.0"},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0}],
            "meshes": [],
            "accessors": [],
            "bufferViews": [],
            "buffers": [{"byteLength": 0}],
        }

    def view(self, array, **extra) -> int:
        self.binary += bytes(-len(self.binary) % 4)
        view = {"buffer": 0, "byteOffset": len(self.binary), "byteLength": array.nbytes, **extra}
        self.document["bufferViews"].append(view)
        self.binary += array.tobytes()
        return len(self.document["bufferViews"]) - 1

    def accessor(self, array, kind=None, **extra) -> int:
        array = np.asarray(array) if kind is None else np.asarray(array, kind)
        record = {
            "bufferView": self.view(array),
            "componentType": KINDS[array.dtype.str[1:]],
            "count": len(array),
            "type": "SCALAR" if array.ndim == 1 else "VEC3",
        }
        self.document["accessors"].append(record | extra)
        return len(self.document["accessors"]) - 1

    def mesh(self, *primitives) -> "Builder":
        self.document["meshes"].append({"primitives": list(primitives)})
        return self

    def data(self) -> bytes:
        self.document["buffers"][0]["byteLength"] = len(self.binary)
        return _pack(json.dumps(self.document).encode(), self.binary)


def _pack(text: bytes, binary: bytes) -> bytes:
    text += b" " * (-len(text) % 4)
    binary += bytes(-len(binary) % 4)
    size = 12 + 8 + len(text) + (8 + len(binary) if binary else 0)
    data = struct.pack("<4sIIII", b"glTF", 2, size, len(text), 0x4E4F534A) + text
    return data + (struct.pack("<II", len(binary), 0x004E4942) + binary if binary else b"")


def _square(kind="u2", **extra) -> Builder:
    builder = Builder()
    primitive = {"attributes": {"POSITION": builder.accessor(SQUARE)}, "indices": builder.accessor(TWO, kind)}
    return builder.mesh(primitive | extra)


def _read(folder, builder):
    path = folder / "mesh.glb"
    path.write_bytes(builder if isinstance(builder, bytes) else builder.data())
    return meshes.read(path)


def test_our_own_animation_comes_back_as_its_first_frame_in_metres(tmp_path, moving):
    vertices, faces = moving
    eyes = (eyes_teeth.eyeball((-30, 20, 60), 12, sectors=8), eyes_teeth.eyeball((30, 20, 60), 12, sectors=8))
    for name, frames in (("film.glb", vertices[2:]), ("still.glb", vertices[2])):
        io.save(tmp_path / name, frames, faces, extras=eyes)
        mesh = io.load_mesh(tmp_path / name)
        assert mesh.vertices.dtype == np.float64 and mesh.faces.dtype == np.int32
        np.testing.assert_array_equal(mesh.faces, faces)
        np.testing.assert_allclose(mesh.vertices * 1000, vertices[2], rtol=1e-6, atol=1e-5)


@pytest.mark.parametrize("kind", ["u1", "u2", "u4"])
def test_indices_of_every_width(tmp_path, kind):
    mesh = _read(tmp_path, _square(kind))
    np.testing.assert_array_equal(mesh.vertices, SQUARE)
    np.testing.assert_array_equal(mesh.faces, [[0, 1, 2], [0, 2, 3]])


def test_more_vertices_than_16_bits_count(tmp_path):
    ball = trimesh.creation.icosphere(subdivisions=7)
    assert len(ball.vertices) > 2**16
    (tmp_path / "ball.glb").write_bytes(trimesh.Scene(ball).export(file_type="glb"))
    mesh = meshes.read(tmp_path / "ball.glb")
    np.testing.assert_array_equal(mesh.vertices, ball.vertices.astype(np.float32))
    np.testing.assert_array_equal(mesh.faces, ball.faces)


def test_node_transforms_are_applied_down_the_tree(tmp_path):
    builder = _square()
    half = np.sqrt(0.5)
    builder.document["scenes"] = [{"nodes": []}, {"nodes": [2]}]
    builder.document["scene"] = 1
    builder.document["nodes"] = [
        {"mesh": 0, "translation": [1, 2, 3], "scale": [2, 3, 4]},
        {"rotation": [0, 0, half, half], "children": [0]},
        # By columns: a tenth of the size, moved by 5 along z.
        {"matrix": [0.1, 0, 0, 0, 0, 0.1, 0, 0, 0, 0, 0.1, 0, 0, 0, 5, 1], "children": [1]},
    ]
    mesh = _read(tmp_path, builder)
    x, y, z = (SQUARE.astype(float) * [2, 3, 4] + [1, 2, 3]).T
    np.testing.assert_allclose(mesh.vertices, np.stack([-0.1 * y, 0.1 * x, 0.1 * z + 5], -1), atol=1e-7)
    np.testing.assert_array_equal(mesh.faces, [[0, 1, 2], [0, 2, 3]])
    peer = trimesh.load(tmp_path / "mesh.glb", process=False, force="mesh")
    np.testing.assert_allclose(mesh.vertices, peer.vertices, atol=1e-7)


def test_a_mirrored_node_turns_the_triangles_over(tmp_path):
    builder = _square()
    builder.document["nodes"][0]["scale"] = [-1, 1, 1]
    mesh = _read(tmp_path, builder)
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    assert np.all(np.cross(b - a, c - a)[:, 2] > 0)


def test_a_skinned_mesh_stays_where_its_joints_put_it(tmp_path):
    builder = _square()
    builder.document["nodes"][0] |= {"skin": 0, "translation": [9, 9, 9]}
    np.testing.assert_array_equal(_read(tmp_path, builder).vertices, SQUARE)


@pytest.mark.parametrize("base", [True, False])
def test_sparse_accessors(tmp_path, base):
    builder = _square()
    record = builder.document["accessors"][0]
    new = np.array([[5, 6, 7], [8, 9, 10]], np.float32)
    record["sparse"] = {
        "count": 2,
        "indices": {"bufferView": builder.view(np.array([1, 3], np.uint8)), "componentType": 5121},
        "values": {"bufferView": builder.view(new)},
    }
    expected = SQUARE.copy() if base else np.zeros((4, 3))
    expected[[1, 3]] = new
    if not base:
        del record["bufferView"]
    np.testing.assert_array_equal(_read(tmp_path, builder).vertices, expected)


def test_strided_offset_and_quantised_positions(tmp_path):
    builder = Builder()
    table = np.zeros((4, 10), np.int16)
    table[:, 3:6] = SQUARE * 32767
    view = builder.view(table.reshape(-1), byteStride=20)
    builder.document["accessors"].append(
        {"bufferView": view, "byteOffset": 6, "componentType": 5122, "normalized": True, "count": 4, "type": "VEC3"}
    )
    builder.document["extensionsRequired"] = ["KHR_mesh_quantization"]
    builder.mesh({"attributes": {"POSITION": 0}, "mode": 6})
    mesh = _read(tmp_path, builder)
    np.testing.assert_allclose(mesh.vertices, SQUARE)
    np.testing.assert_array_equal(mesh.faces, [[1, 2, 0], [2, 3, 0]])


def test_primitives_without_indices_and_strips(tmp_path):
    builder = Builder()
    mesh = _read(tmp_path, builder.mesh({"attributes": {"POSITION": builder.accessor(SQUARE[[0, 1, 2]])}}))
    np.testing.assert_array_equal(mesh.faces, [[0, 1, 2]])
    strip = _square(mode=5)
    strip.document["accessors"][1] |= {"count": 5}
    np.testing.assert_array_equal(_read(tmp_path, strip).faces, [[0, 1, 2], [1, 0, 2], [2, 0, 2]])


def test_primitives_of_one_mesh_are_joined_and_shared_positions_kept_once(tmp_path):
    builder = Builder()
    shared, other = builder.accessor(SQUARE), builder.accessor(SQUARE[:3] + 9)
    primitives = [
        {"attributes": {"POSITION": shared}, "indices": builder.accessor([0, 1, 2], "u2")},
        {"attributes": {"POSITION": other}},
        {"attributes": {"POSITION": shared}, "indices": builder.accessor([0, 2, 3], "u4")},
        {"attributes": {"POSITION": shared}, "mode": 1},
    ]
    mesh = _read(tmp_path, builder.mesh(*primitives))
    np.testing.assert_array_equal(mesh.vertices, np.concatenate([SQUARE, SQUARE[:3] + 9]))
    np.testing.assert_array_equal(mesh.faces, [[0, 1, 2], [4, 5, 6], [0, 2, 3]])


def test_the_mesh_with_most_triangles_that_the_scene_shows(tmp_path):
    builder = _square()
    ball = trimesh.creation.icosphere(subdivisions=1)
    position, index = builder.accessor(ball.vertices, "f4"), builder.accessor(ball.faces.ravel(), "u2")
    builder.mesh({"attributes": {"POSITION": position}, "indices": index})
    assert len(_read(tmp_path, builder).vertices) == 4  # the ball is in no scene
    builder.document["nodes"].append({"mesh": 1})
    builder.document["scenes"][0]["nodes"] = [0, 1]
    assert len(_read(tmp_path, builder).vertices) == len(ball.vertices)
    del builder.document["scenes"], builder.document["scene"]
    assert len(_read(tmp_path, builder).vertices) == len(ball.vertices)
    del builder.document["nodes"]
    assert len(_read(tmp_path, builder).vertices) == len(ball.vertices)


def _changed(change):
    builder = _square()
    change(builder.document)
    return builder.data()


def _set(*path, to):
    def change(document):
        place = document
        for step in path[:-1]:
            place = place[step]
        place[path[-1]] = to

    return lambda: _changed(change)


BAD = {
    "empty": (lambda: b"glTF", "is not a GLB file"),
    "text": (lambda: b"{}" * 20, "is not a GLB file"),
    "old": (lambda: b"glTF" + struct.pack("<II", 1, 40) + bytes(28), "unsupported glTF version 1, expected 2"),
    "longer": (lambda: _square().data() + b"more", "header claims .* bytes, the file holds"),
    "chunk": (
        lambda: b"glTF" + struct.pack("<IIII", 2, 24, 2**31, 0x4E4F534A) + b"{}  ",
        "a chunk needs 2147483648 bytes, 4 are left",
    ),
    "order": (lambda: b"glTF" + struct.pack("<IIII", 2, 24, 4, 0x004E4942) + bytes(4), "first chunk must be JSON"),
    "json": (lambda: _pack(b"{nothing", b""), "holds no JSON"),
    "deep": (lambda: _pack(b"[" * 100_000, b""), "holds no JSON"),
    "list": (lambda: _pack(b"[]", b""), "must be an object, got list"),
    "no mesh": (lambda: _pack(b'{"asset": {"version": "2.0"}}', b""), "holds no triangles"),
    "sections": (_set("nodes", to=3), "nodes must be a list of objects"),
    "draco": (
        _set("extensionsRequired", to=["KHR_draco_mesh_compression"]),
        "unsupported extension KHR_draco_mesh_compression",
    ),
    "elsewhere": (_set("buffers", 0, "uri", to="mesh.bin"), "data in external files is not supported"),
    "second buffer": (_set("bufferViews", 0, "buffer", to=1), "buffer must be an integer in 0..0, got 1"),
    "view": (_set("bufferViews", 0, "byteLength", to=47), "4 rows, 12 bytes each, needs 48 bytes of a view of 47"),
    "view end": (_set("bufferViews", 0, "byteLength", to=10**9), "byteLength of a view must be an integer in 0.."),
    "offset": (_set("accessors", 0, "byteOffset", to=-4), "byteOffset must be an integer"),
    "stride": (_set("bufferViews", 0, "byteStride", to=4), "4 rows, 4 bytes each"),
    "count": (_set("accessors", 0, "count", to=10**12), "count of an accessor must be an integer in 0.."),
    "float count": (_set("accessors", 0, "count", to=4.0), "count of an accessor must be an integer"),
    "kind": (_set("accessors", 0, "componentType", to=5124), "componentType must be one of 5120, .* got 5124"),
    "shape": (_set("accessors", 0, "type", to="VEC2"), "accessor 0 must be VEC3, got VEC2"),
    "index kind": (_set("accessors", 1, "componentType", to=5122), "accessor 1 must be SCALAR, got SCALAR of 5122"),
    "far": (_set("accessors", 0, "count", to=3), "vertex index 3 of a triangle is out of range; there are 3 vertices"),
    "odd": (_set("accessors", 1, "count", to=5), "5 corners, expected a multiple of 3"),
    "lines": (_set("meshes", 0, "primitives", 0, "mode", to=1), "holds no triangles"),
    "no primitives": (_set("meshes", 0, to={}), "'primitives' is missing"),
    "no position": (_set("meshes", 0, "primitives", 0, "attributes", to={}), "holds no triangles"),
    "which": (_set("meshes", 0, "primitives", 0, "indices", to=7), "accessor must be an integer in 0..1, got 7"),
    "node": (_set("scenes", 0, "nodes", to=[3]), "node must be an integer in 0..0, got 3"),
    "scene": (_set("scene", to=1), "scene must be an integer in 0..0, got 1"),
    "circle": (_set("nodes", 0, "children", to=[0]), "node 0 has two parents, or is its own ancestor"),
    "matrix": (_set("nodes", 0, "matrix", to=[1, 0, 0]), "matrix must be 16 finite numbers"),
    "word": (_set("nodes", 0, "scale", to=["a", 1, 1]), "invalid glTF"),
    "nan": (_set("nodes", 0, "scale", to=[float("nan"), 1, 1]), "scale must be 3 finite numbers"),
    "infinite": (_set("nodes", 0, to={"mesh": 0, "scale": [1e300] * 3, "translation": [1e308] * 3}), None),
    "overflow": (
        _set("nodes", to=[{"scale": [1e300] * 3, "children": [1]}, {"scale": [1e300] * 3, "mesh": 0}]),
        "vertex 0 is not finite",
    ),
    "sparse": (
        _set(
            "accessors",
            0,
            "sparse",
            to={
                "count": 1,
                "indices": {"bufferView": 0, "byteOffset": 15, "componentType": 5121},
                "values": {"bufferView": 0},
            },
        ),
        "accessor 0: index of a sparse replacement is out of range",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_files_say_what_is_wrong(tmp_path, name):
    make, message = BAD[name]
    if message is None:
        assert np.isfinite(_read(tmp_path, make()).vertices).all()
        return
    with pytest.raises(meshes.MeshError, match=message) as caught:
        _read(tmp_path, make())
    assert "mesh.glb" in str(caught.value) and "\n" not in str(caught.value)


def test_every_cut_is_refused(tmp_path):
    whole = _square().data()
    for length in range(len(whole)):
        with pytest.raises(meshes.MeshError, match=r"mesh\.glb"):
            _read(tmp_path, whole[:length])


HOSTILE = settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
VALUES = st.none() | st.integers(-2, 10**13) | st.floats() | st.sampled_from(["", "x", [], [0], {}, [[]], True])


@HOSTILE
@given(data=st.data())
def test_no_change_of_the_document_escapes_as_another_error(tmp_path, data):
    builder = _square()
    place = builder.document
    while True:
        key = data.draw(st.sampled_from(sorted(place) if isinstance(place, dict) else range(len(place))))
        if not isinstance(place[key], dict | list) or not place[key] or data.draw(st.integers(0, 4)) == 0:
            break
        place = place[key]
    place[key] = data.draw(VALUES)
    # The builder itself needs its buffer.
    packed = _pack(json.dumps(builder.document).encode(), builder.binary)
    try:
        mesh = _read(tmp_path, packed)
    except meshes.MeshError as error:
        assert "mesh.glb" in str(error)
    else:
        assert np.isfinite(mesh.vertices).all()


def test_no_damage_escapes_as_another_error(tmp_path):
    whole, rng = _square().data(), np.random.default_rng(4)
    outcomes = set()
    for _ in range(300):
        data = bytearray(whole)
        for at in rng.integers(len(data), size=rng.integers(1, 6)):
            data[at] = rng.integers(256)
        try:
            outcomes.add(type(_read(tmp_path, bytes(data))))
        except meshes.MeshError as error:
            outcomes.add(type(error))
    assert meshes.MeshError in outcomes
