"""Mesh files: exact round trips, foreign dialects; a bad file is refused in one clear line."""

import struct

import numpy as np
import pytest
import trimesh

from facejax.io import meshes


def _tetrahedron():
    vertices = np.random.default_rng(0).normal(size=(4, 3)) * 100
    return vertices, np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]], np.int32)


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".npz"])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_round_trip_is_exact(tmp_path, suffix, dtype):
    vertices, faces = _tetrahedron()
    vertices = vertices.astype(dtype)
    path = tmp_path / f"mesh{suffix}"
    meshes.write(path, vertices, faces)
    mesh = meshes.read(path)
    assert mesh.vertices.dtype == np.float64 and mesh.faces.dtype == np.int32
    np.testing.assert_array_equal(mesh.vertices.astype(dtype), vertices)
    np.testing.assert_array_equal(mesh.faces, faces)
    assert [entry.name for entry in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".npz"])
def test_a_mesh_without_faces(tmp_path, suffix):
    vertices, _ = _tetrahedron()
    meshes.write(tmp_path / f"points{suffix}", vertices)
    mesh = meshes.read(tmp_path / f"points{suffix}")
    assert mesh.faces is None
    np.testing.assert_array_equal(mesh.vertices, vertices)


def test_npy_holds_vertices(tmp_path):
    vertices, _ = _tetrahedron()
    np.save(tmp_path / "frame.npy", np.asfortranarray(vertices))
    np.testing.assert_array_equal(meshes.read(tmp_path / "frame.npy").vertices, vertices)


def test_an_animation_may_be_asked_for_without_faces(tmp_path):
    vertices, faces = _tetrahedron()
    np.savez(tmp_path / "bare.npz", vertices=np.stack([vertices] * 3))
    with pytest.raises(meshes.MeshError, match="has no triangles"):
        meshes.read_animation(tmp_path / "bare.npz")
    moved, none, extra = meshes.read_animation(tmp_path / "bare.npz", bare=True)
    assert moved.shape == (3, 4, 3) and none is None and extra == {}
    np.savez(tmp_path / "whole.npz", vertices=moved, faces=faces, fps=25)
    _, there, extra = meshes.read_animation(tmp_path / "whole.npz", bare=True)
    assert there.dtype == np.int32 and there.tolist() == faces.tolist() and extra == {"fps": 25}


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian"])
def test_reads_what_trimesh_writes(tmp_path, encoding):
    mesh = trimesh.creation.icosphere(subdivisions=2)
    (tmp_path / "ball.ply").write_bytes(trimesh.exchange.ply.export_ply(mesh, encoding=encoding.split("_")[0]))
    read = meshes.read(tmp_path / "ball.ply")
    np.testing.assert_allclose(read.vertices, mesh.vertices, rtol=1e-6, atol=1e-7)
    np.testing.assert_array_equal(read.faces, mesh.faces)


def test_trimesh_reads_what_we_write(tmp_path):
    ball = trimesh.creation.icosphere(subdivisions=2)
    for name in ("ball.ply", "ball.obj"):
        meshes.write(tmp_path / name, ball.vertices, ball.faces)
        read = trimesh.load(tmp_path / name, process=False, maintain_order=True)
        np.testing.assert_array_equal(read.vertices, ball.vertices)
        np.testing.assert_array_equal(read.faces, ball.faces)


def _ply(order: str, polygons, extra: bool) -> bytes:
    """A quad-and-triangle PLY by hand, with properties and an element that a reader must step over."""
    header = ["ply", f"format {order} 1.0", "comment by hand", "element vertex 5", "property float x"]
    header += ["property uchar red"] if extra else []
    header += ["property float y", "property float z", "element strip 1", "property list uchar short links"]
    header += [f"element face {len(polygons)}", "property list uchar int vertex_index"]
    header += ["property float quality"] if extra else []
    rows = []
    for i in range(5):
        rows.append([("f", i), *([("B", 7)] if extra else []), ("f", -i), ("f", i / 2)])
    rows.append([("B", 2), ("h", 9), ("h", -9)])
    for polygon in polygons:
        rows.append([("B", len(polygon)), *(("i", v) for v in polygon), *([("f", 0.5)] if extra else [])])
    head = ("\n".join(header) + "\nend_header\n").encode()
    if order == "ascii":
        return head + "\n".join(" ".join(str(value) for _, value in row) for row in rows).encode()
    sign = "<" if "little" in order else ">"
    return head + b"".join(struct.pack(sign + kind, value) for row in rows for kind, value in row)


@pytest.mark.parametrize("extra", [False, True])
@pytest.mark.parametrize("polygons", [[[0, 1, 2, 3], [2, 3, 4]], [[0, 1, 2], [2, 3, 4]], [[0, 1, 2, 3, 4]], []])
@pytest.mark.parametrize("order", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_ply_dialects(tmp_path, order, polygons, extra):
    path = tmp_path / "mesh.ply"
    path.write_bytes(_ply(order, polygons, extra))
    mesh = meshes.read(path)
    np.testing.assert_array_equal(mesh.vertices, [[i, -i, i / 2] for i in range(5)])
    fans = [[p[0], p[i], p[i + 1]] for p in polygons for i in range(1, len(p) - 1)]
    np.testing.assert_array_equal(np.zeros((0, 3)) if mesh.faces is None else mesh.faces, np.reshape(fans, (-1, 3)))


def test_every_cut_of_a_ply_is_refused(tmp_path):
    whole = _ply("binary_little_endian", [[0, 1, 2, 3], [2, 3, 4]], True)
    for length in range(len(whole)):
        (tmp_path / "cut.ply").write_bytes(whole[:length])
        with pytest.raises(meshes.MeshError, match=r"cut\.ply"):
            meshes.read(tmp_path / "cut.ply")


def test_obj_polygons_groups_and_negative_indices(tmp_path):
    path = tmp_path / "mesh.obj"
    path.write_text(
        "# made by hand\no thing\nv 0 0 0\nv 1 0 0 1.0\nv 1 1 0 0.5 0.5 0.5\nvt 0 0\nvn 0 0 1\ng first\n"
        "usemtl skin\nf 1/1/1 2/1/1 3/1/1 # a comment\nv 0 1 0\ng second\ns off\nf -4//1 -3//1 -2//1 -1//1\n"
        "f 1 2 \\\n 4\n"
    )
    mesh = meshes.read(path)
    np.testing.assert_array_equal(mesh.vertices, [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    np.testing.assert_array_equal(mesh.faces, [[0, 1, 2], [0, 1, 2], [0, 2, 3], [0, 1, 3]])


HEAD = "ply\nformat ascii 1.0\nelement vertex {n}\nproperty float x\nproperty float y\nproperty float z\n"
FACE = "element face 1\nproperty list uchar int vertex_indices\n"
BAD = {
    "empty.ply": (b"", "0 bytes"),
    "noise.ply": (b"\x00\x01\x02", "not a PLY"),
    "huge.ply": (
        (HEAD.format(n=10**12) + "end_header\n0 0 0\n").encode(),
        "claims 1000000000000 rows of vertex",
    ),
    "cut.ply": (
        (HEAD.format(n=3) + "end_header\n0 0 0\n0 0").encode(),
        "ends early: vertex needs 9 numbers, 5",
    ),
    "none.ply": ((HEAD.format(n=0) + "end_header\n").encode(), "contains no vertices"),
    "nan.ply": (
        (HEAD.format(n=2) + "end_header\n0 0 0\n0 nan 1\n").encode(),
        r"vertex 1 is not finite: \[0.0, nan",
    ),
    "far.ply": (
        (HEAD.format(n=3) + FACE + "end_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 3\n").encode(),
        r"triangle 0 is \[0, 1, 3\]; vertices are 0..2",
    ),
    "two.ply": (
        (HEAD.format(n=3) + FACE + "end_header\n0 0 0\n1 0 0\n0 1 0\n2 0 1\n").encode(),
        "2 corners",
    ),
    "word.ply": ((HEAD.format(n=1) + "end_header\n0 0 zero\n").encode(), "not a number"),
    "kind.ply": (
        b"ply\nformat ascii 1.0\nelement vertex 1\nproperty quad x\nend_header\n",
        "property quad x",
    ),
    "axis.ply": (
        b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n0\n",
        "lacks property y",
    ),
    "form.ply": (b"ply\nformat utf 1.0\nend_header\n", "format utf"),
    "long.ply": (
        (HEAD.format(n=1) + FACE + "end_header\n0 0 0\n99999999 0 0 0\n").encode(),
        "has length 1e\\+08",
    ),
    "word.obj": (b"v 0 0 zero\n", "line 1: cannot be parsed"),
    "short.obj": (b"v 0 0\n", "line 1"),
    "zero.obj": (b"v 0 0 0\nf 0 1 1\n", "line 2"),
    "far.obj": (b"v 0 0 0\nf 1 1 2\n", "triangle 0"),
    "back.obj": (b"v 0 0 0\nf -1 -1 -2\n", "triangle 0"),
    "inf.obj": (b"v 0 0 0\nv inf 0 0\n", "vertex 1 is not finite"),
    "none.obj": (b"# nothing\n", "contains no vertices"),
    "noise.npz": (b"PK\x03\x04", "noise.npz"),
    "noise.npy": (b"\x93NUMPY\x09\x00", "noise.npy"),
    "noise.glb": (b"glTF\x02", "not a GLB"),
    "mesh.stl": (b"solid", r"unknown mesh format '.stl'; expected \.ply, \.obj, \.glb, \.npz, \.npy"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_files_say_what_is_wrong(tmp_path, name):
    content, message = BAD[name]
    (tmp_path / name).write_bytes(content)
    with pytest.raises(meshes.MeshError, match=message) as caught:
        meshes.read(tmp_path / name)
    assert name in str(caught.value) and "\n" not in str(caught.value)


def test_missing_and_unreadable(tmp_path):
    with pytest.raises(meshes.MeshError, match="no such file"):
        meshes.read(tmp_path / "absent.ply")
    (tmp_path / "folder.ply").mkdir()
    with pytest.raises(meshes.MeshError, match="not a file"):
        meshes.read(tmp_path / "folder.ply")


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"points": np.zeros((2, 3))}, "no array 'vertices'"),
        ({"vertices": np.zeros((2, 2))}, r"must be \(N, 3\), got \(2, 2\)"),
        ({"vertices": np.zeros((0, 3))}, "contains no vertices"),
        ({"vertices": np.array([[{}, 1, 2]], dtype=object)}, "expected numbers, got object"),
        ({"vertices": np.zeros((2, 3)), "faces": np.zeros((1, 3))}, r"faces must be \(F, 3\) integers"),
    ],
)
def test_bad_archives(tmp_path, arrays, message):
    np.savez(tmp_path / "mesh.npz", **arrays)
    with pytest.raises(meshes.MeshError, match=message):
        meshes.read(tmp_path / "mesh.npz")


def test_an_array_header_that_claims_too_much(tmp_path):
    with (tmp_path / "mesh.npy").open("wb") as stream:
        header = {"descr": "<f8", "fortran_order": False, "shape": (2 * 10**11, 3)}
        np.lib.format.write_array_header_1_0(stream, header)
        stream.write(bytes(48))
    with pytest.raises(meshes.MeshError, match="needs 4800000000000 bytes, the file contains 48"):
        meshes.read(tmp_path / "mesh.npy")


@pytest.mark.filterwarnings("ignore::UserWarning")  # numpy's own remark on the array header
@pytest.mark.parametrize("name", ["mesh.npy", "mesh.npz", "mesh.ply", "mesh.obj"])
def test_no_damage_escapes_as_another_error(tmp_path, name):
    vertices, faces = _tetrahedron()
    path = tmp_path / name
    if name.endswith("npy"):
        np.save(path, vertices)
    else:
        meshes.write(path, vertices, faces)
    whole, rng = path.read_bytes(), np.random.default_rng(3)
    outcomes = set()
    for _ in range(300):
        data = bytearray(whole)
        for at in rng.integers(len(data), size=rng.integers(1, 6)):
            data[at] = rng.integers(256)
        path.write_bytes(bytes(data[: rng.integers(len(data) // 2, len(data) + 1)]))
        try:
            outcomes.add(type(meshes.read(path)))
        except meshes.MeshError as error:
            outcomes.add(type(error))
    assert meshes.MeshError in outcomes


def test_sequences_appear_whole_and_replace_their_own_kind_only(tmp_path):
    vertices, faces = _tetrahedron()
    frames = np.stack([vertices, vertices + 1, vertices + 2]).astype(np.float32)
    folder = tmp_path / "out" / "motion"
    meshes.write_sequence(folder, frames, faces)
    meshes.write_sequence(folder, frames[:2], faces)
    assert sorted(entry.name for entry in folder.iterdir()) == ["000001.ply", "000002.ply"]
    np.testing.assert_array_equal(meshes.read(folder / "000002.ply").vertices, frames[1])
    assert [entry.name for entry in folder.parent.iterdir()] == ["motion"]
    (folder / "notes.txt").write_text("mine")
    with pytest.raises(ValueError, match=r"notes\.txt"):
        meshes.write_sequence(folder, frames, faces)
    assert (folder / "notes.txt").read_text() == "mine"


def test_a_failed_write_leaves_the_old_file(tmp_path):
    vertices, faces = _tetrahedron()
    path = tmp_path / "mesh.ply"
    meshes.write(path, vertices, faces)
    before = path.read_bytes()
    with pytest.raises(ValueError, match=r"faces must be \(F, 3\) integers"):
        meshes.write(path, vertices, faces.astype(float))
    assert path.read_bytes() == before and len(list(tmp_path.iterdir())) == 1
