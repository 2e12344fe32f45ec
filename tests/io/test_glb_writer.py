"""glTF: read back independently, judged by Khronos' validator, opened in three.js."""

import json
import struct

import numpy as np
import pytest

from facejax.io import glb_writer
from facejax.viz import eyes_teeth, scene


def _parse(path):
    data = path.read_bytes()
    magic, version, size = struct.unpack_from("<4sII", data)
    assert (magic, version, size) == (b"glTF", 2, len(data))
    length, kind = struct.unpack_from("<I4s", data, 12)
    assert kind == b"JSON" and length % 4 == 0
    document = json.loads(data[20 : 20 + length])
    rest, kind = struct.unpack_from("<I4s", data, 20 + length)
    assert kind == b"BIN\0" and 28 + length + rest == len(data)
    return document, data[28 + length :]


def _values(document, binary, index) -> np.ndarray:
    """An accessor as float64, sparse or not, as the specification (3.6.2) says."""
    record = document["accessors"][index]
    kinds = {5123: ("<u2", 2), 5125: ("<u4", 4), 5126: ("<f4", 4)}
    kind, _ = kinds[record["componentType"]]
    columns = {"SCALAR": 1, "VEC3": 3}[record["type"]]

    def read(view, kind, count):
        view = document["bufferViews"][view]
        return np.frombuffer(binary, kind, count, view["byteOffset"])

    if "bufferView" in record:
        values = read(record["bufferView"], kind, record["count"] * columns).reshape(-1, columns).astype(float)
    else:
        values = np.zeros((record["count"], columns))
    if "sparse" in record:
        sparse = record["sparse"]
        index_kind, _ = kinds[sparse["indices"]["componentType"]]
        index = read(sparse["indices"]["bufferView"], index_kind, sparse["count"])
        assert (np.diff(index.astype(int)) > 0).all()
        values[index] = read(sparse["values"]["bufferView"], kind, sparse["count"] * columns).reshape(-1, columns)
    np.testing.assert_array_equal(values.min(0), record["min"])
    np.testing.assert_array_equal(values.max(0), record["max"])
    return values


def _replay(document, binary, key: int, mesh: int = 0, attribute: str = "POSITION") -> np.ndarray:
    """What a viewer shows at a key frame: base + sum of weight * target."""
    primitive = document["meshes"][mesh]["primitives"][0]
    sampler = document["animations"][0]["samplers"][0]
    weights = _values(document, binary, sampler["output"]).reshape(-1, len(primitive["targets"]))[key]
    result = _values(document, binary, primitive["attributes"][attribute])
    for weight, target in zip(weights, primitive["targets"], strict=True):
        result = result + weight * _values(document, binary, target[attribute])
    return result


@pytest.mark.parametrize("sparse", [True, False])
def test_every_frame_comes_back_in_metres(tmp_path, moving, sparse):
    vertices, faces = moving
    glb_writer.write(tmp_path / "face.glb", vertices, faces, fps=25, sparse=sparse)
    document, binary = _parse(tmp_path / "face.glb")
    index = _values(document, binary, document["meshes"][0]["primitives"][0]["indices"])
    np.testing.assert_array_equal(index.reshape(-1, 3), faces)
    times = _values(document, binary, document["animations"][0]["samplers"][0]["input"]).ravel()
    np.testing.assert_allclose(times, np.arange(len(vertices)) / 25, rtol=1e-7)
    for t, frame in enumerate(vertices):
        np.testing.assert_allclose(_replay(document, binary, t) * 1000, frame, atol=2e-5)
        normals = _replay(document, binary, t, attribute="NORMAL")
        np.testing.assert_allclose(normals, scene.normals(frame, faces), atol=1e-6)


def test_sparse_is_smaller_where_part_of_the_face_rests(tmp_path, moving):
    sizes = []
    for sparse in (True, False):
        glb_writer.write(tmp_path / "face.glb", *moving, normals=False, sparse=sparse)
        sizes.append((tmp_path / "face.glb").stat().st_size)
    assert sizes[0] < 0.8 * sizes[1]


def test_extras_captions_and_names(tmp_path, moving):
    vertices, faces = moving
    eye = eyes_teeth.eyeball((0, 20, 80), 12)
    ring = scene.Part(vertices[:, :50], np.array([[0, 1, 2]]), (1, 0, 0))
    captions = ((0, "neutral → joy"), (2, "joy"))
    glb_writer.write(tmp_path / "face.glb", vertices, faces, extras=(eye, ring), captions=captions, name="Ann")
    document, binary = _parse(tmp_path / "face.glb")
    assert [mesh["name"] for mesh in document["meshes"]] == ["Ann", "Ann part 1", "Ann part 2"]
    assert "targets" not in document["meshes"][1]["primitives"][0]
    assert [channel["target"]["node"] for channel in document["animations"][0]["channels"]] == [0, 2]
    assert document["animations"][0]["extras"]["captions"] == [[0, "neutral → joy"], [2, "joy"]]
    np.testing.assert_allclose(_replay(document, binary, 3, mesh=2) * 1000, vertices[3, :50], atol=2e-5)


def test_one_frame_is_a_still_mesh(tmp_path, moving):
    glb_writer.write(tmp_path / "face.glb", moving[0][2], moving[1])
    document, _ = _parse(tmp_path / "face.glb")
    assert "animations" not in document and "targets" not in document["meshes"][0]["primitives"][0]


def test_refuses_what_it_cannot_write(tmp_path, moving):
    vertices, faces = moving
    with pytest.raises(ValueError, match="at least one triangle"):
        glb_writer.write(tmp_path / "face.glb", vertices, faces[:0])
    with pytest.raises(ValueError, match="fps must be positive"):
        glb_writer.write(tmp_path / "face.glb", vertices, faces, fps=0)
    assert not list(tmp_path.iterdir())


def test_khronos_validator_has_nothing_to_say(tmp_path, moving, node):
    vertices, faces = moving
    resting = np.stack([vertices[0], vertices[0], vertices[1]])
    eye = eyes_teeth.eyeball((0, 20, 80), 12)
    cases = [
        (vertices, {}),
        (vertices, {"normals": False}),
        (vertices, {"sparse": False, "extras": (eye,), "captions": ((1, "→ <joy>"),)}),
        (vertices[0], {}),
        (resting, {"normals": False}),
    ]
    files = []
    for i, (frames, options) in enumerate(cases):
        files.append(str(tmp_path / f"{i}.glb"))
        glb_writer.write(files[-1], frames, faces, **options)
    for verdict in node("validate_glb.cjs", files, "gltf-validator"):
        assert (verdict["numErrors"], verdict["numWarnings"]) == (0, 0), verdict["messages"]


@pytest.mark.browser
def test_three_js_plays_the_same_motion(tmp_path, moving, browser):
    vertices, faces = moving
    glb_writer.write(tmp_path / "face.glb", vertices, faces, fps=10, extras=(eyes_teeth.eyeball((0, 20, 80), 12),))
    chosen = [0, 7, len(vertices[0]) - 1, int(vertices[0, :, 2].argmax())]
    job = {"file": str(tmp_path / "face.glb"), "times": [0, 0.1, 0.25, 0.3], "vertices": chosen}
    answer = browser("open_glb.cjs", job, "three")
    assert answer["errors"] == [] and answer["meshes"] == 3  # face, eye, and the light of the test page
    assert answer["duration"] == pytest.approx((len(vertices) - 1) / 10)
    between = (vertices[2] + vertices[3]) / 2
    expected = np.stack([vertices[0], vertices[1], between, vertices[3]])[:, chosen]
    np.testing.assert_allclose(np.array(answer["positions"]) * 1000, expected, atol=1e-3)
