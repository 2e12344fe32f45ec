"""Landmark files: every dialect gives the same landmarks; a bad file is refused in one clear line."""

import json

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from facejax.io import landmarks

INDEX = [3, 0, 5]
VERTICES = np.random.default_rng(0).normal(size=(6, 3)) * 80
FACES = np.array([[0, 1, 2], [2, 3, 4], [3, 4, 5]])
POINTS = VERTICES[INDEX]


def _write(folder, name, text):
    path = folder / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def _rows(form, separator=" "):
    rows = []
    for i, point in zip(INDEX, POINTS.tolist(), strict=True):
        words = {"index": [i], "xyz": point, "both": [i, *point]}[form]
        rows.append(separator.join(map(repr, words)))
    return rows


def _pp(points=POINTS, head="<!DOCTYPE PickedPoints>\n"):
    rows = [
        f' <point y="{y!r}" name="p{i}" z="{z!r}" active="1" x="{x!r}"/>' for i, (x, y, z) in enumerate(points.tolist())
    ]
    data = ' <DocumentData>\n  <User name="me"/>\n </DocumentData>\n'
    return f"{head}<PickedPoints>\n{data}" + "\n".join(rows) + "\n</PickedPoints>\n"


SAME = {
    "a.json": json.dumps({"indices": INDEX, "mesh": "a note"}),
    "b.json": json.dumps(INDEX),
    "c.json": json.dumps({"points": POINTS.tolist()}),
    "d.json": "\ufeff" + json.dumps(POINTS.tolist()),
    "e.json": json.dumps({"faces": [1, 0, 2], "weights": [[0, 1, 0], [1, 0, 0], [0, 0, 1.0]]}),
    "f.pp": _pp(),
    "g.pp": _pp(head='<?xml version="1.0" encoding="UTF-8"?>\n'),
    "h.txt": "# by hand\n\n3\n0 # the second\n5\n",
    "i.csv": "\n".join(_rows("xyz", ",")),
    "j.xyz": "\r\n".join(_rows("xyz", "; ")) + "\r\n",
    "k.LND": "\n".join(_rows("xyz", "\t")),
    # BU-4DFE: 83 rows and perhaps a blank one.
    "l.bnd": "\n".join(_rows("both")) + "\n\n",
}


@pytest.mark.parametrize("name", SAME)
def test_all_dialects_give_the_same_landmarks(tmp_path, name):
    found = landmarks.read(_write(tmp_path, name, SAME[name]), VERTICES, FACES)
    assert found.points.dtype == np.float64
    np.testing.assert_array_equal(found.points, POINTS)
    if name[0] in "abhl":
        assert found.index.dtype == np.int32
        np.testing.assert_array_equal(found.index, INDEX)
    else:
        assert found.index is None
    assert found.names == (("p0", "p1", "p2") if name.endswith(".pp") else None)


@pytest.mark.parametrize("name", ["c.json", "d.json", "f.pp", "i.csv", "l.bnd"])
def test_positions_need_no_mesh(tmp_path, name):
    found = landmarks.read(_write(tmp_path, name, SAME[name]))
    np.testing.assert_array_equal(found.points, POINTS)


@pytest.mark.parametrize("name", ["a.json", "e.json", "h.txt"])
def test_vertices_and_faces_need_a_mesh(tmp_path, name):
    with pytest.raises(landmarks.LandmarkError, match="need the mesh's vertices"):
        landmarks.read(_write(tmp_path, name, SAME[name]))


def test_barycentric_weights_mix_the_corners(tmp_path):
    path = _write(tmp_path, "mix.json", json.dumps({"faces": [2], "weights": [[0.5, 0.25, 0.25]], "names": ["cheek"]}))
    found = landmarks.read(path, VERTICES, FACES)
    np.testing.assert_allclose(found.points, [0.5 * VERTICES[3] + 0.25 * VERTICES[4] + 0.25 * VERTICES[5]])
    assert found.names == ("cheek",)


def test_what_we_write_comes_back_exactly(tmp_path):
    landmarks.write(tmp_path / "new" / "points.json", points=POINTS, names=["a", "b", "ç"])
    found = landmarks.read(tmp_path / "new" / "points.json", VERTICES)
    np.testing.assert_array_equal(found.points, POINTS)
    assert found.names == ("a", "b", "ç")
    landmarks.write(tmp_path / "index.json", index=np.array(INDEX, np.uint8))
    np.testing.assert_array_equal(landmarks.read(tmp_path / "index.json", VERTICES).index, INDEX)
    assert sorted(entry.name for entry in tmp_path.rglob("*.json")) == ["index.json", "points.json"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "either index or points"),
        ({"index": INDEX, "points": POINTS}, "either index or points"),
        ({"index": [0.5]}, r"index must be \(L,\) integers of 0 or more"),
        ({"index": [-1]}, "of 0 or more"),
        ({"points": POINTS[0]}, r"points must be \(L, 3\) and finite, got \(3,\)"),
        ({"points": POINTS * np.nan}, "finite"),
        ({"index": INDEX, "names": ["one"]}, "expected 3 strings"),
    ],
)
def test_refuses_to_write(tmp_path, options, message):
    with pytest.raises(ValueError, match=message):
        landmarks.write(tmp_path / "x.json", **options)
    with pytest.raises(ValueError, match=r"written as \.json, got '\.pp'"):
        landmarks.write(tmp_path / "x.pp", index=INDEX)
    assert not list(tmp_path.iterdir())


LAUGHS = '<!DOCTYPE PickedPoints [<!ENTITY a "ha"><!ENTITY b "&a;&a;&a;">]>\n'
BAD = {
    "empty.json": ("", "0 bytes; expected 1 to"),
    "large.txt": ("1\n" * 2**22, "8388608 bytes; expected 1 to 4194304"),
    "many.txt": ("1\n" * 10_001, "line 10001: more than 10000 landmarks"),
    "many.json": (json.dumps([0] * 10_001), "expected a list of 1 to 10000 landmarks, got 10001"),
    "other.doc": ("1", r"unknown landmark format '\.doc'; expected \.json, \.pp, \.txt"),
    "cut.json": ('{"indices": [1, 2', "not JSON"),
    "deep.json": ("[" * 200_000, "not JSON"),
    "bytes.json": (b"\xff\xfe\x00", "not UTF-8 text"),
    "none.json": ("[]", "expected a list of 1 to 10000 landmarks, got 0"),
    "word.json": ('"3"', r'expected "indices", or "faces" and "weights", or "points", got str'),
    "key.json": ('{"vertices": [1]}', r"got \['vertices'\]"),
    "half.json": ('{"faces": [1]}', r"got \['faces'\]"),
    "both.json": ('{"indices": [1], "points": [[0, 0, 0]]}', r"got \['indices', 'points'\]"),
    "fraction.json": ("[1, 2.0]", r"indices\[1\]: expected an integer, got '2\.0'"),
    "true.json": ("[true]", r"indices\[0\]: expected an integer, got 'True'"),
    "far.json": ("[0, 6]", r"indices\[1\]: 6 is out of range; vertices are 0\.\.5"),
    "minus.json": ("[-1]", r"indices\[0\]: -1 is out of range"),
    "huge.json": (f"[{10**400}]", r"indices\[0\]: 1000.* is out of range"),
    "nan.json": ("[[0, 0, NaN]]", r"points\[0\]: expected a finite number, got 'nan'"),
    "inf.json": ("[[0, 0, 1], [0, 1e999, 0]]", r"points\[1\]: expected a finite number, got 'inf'"),
    "big.json": (f"[[0, 0, {10**400}]]", r"points\[0\]: expected a finite number"),
    "text.json": ('[["0", 0, "x"]]', r"points\[0\]: expected a finite number, got 'x'"),
    "two.json": ("[[0, 0]]", r"points\[0\]: expected 3 numbers, got '\[0, 0\]'"),
    "mixed.json": ("[[0, 0, 0], 1]", r"points\[1\]: expected 3 numbers, got '1'"),
    "uneven.json": ('{"faces": [0, 1], "weights": [[1, 0, 0]]}', "2 faces but 1 weights"),
    "face.json": ('{"faces": [3], "weights": [[1, 0, 0]]}', r"faces\[0\]: 3 is out of range; triangles are 0\.\.2"),
    "sum.json": ('{"faces": [0], "weights": [[1, 1, 0]]}', r"weights\[0\]: expected a sum of 1, got \[1\.0, 1\.0"),
    "names.json": ('{"indices": [1, 2], "names": ["one"]}', "names: expected 2 strings"),
    "unit.json": ("[[0, 0, 90000]]", "landmark 0 is 9e.04 away from the centre of a mesh .*another unit"),
    "noise.pp": ("\x00\x01", "not XML"),
    "cut.pp": (_pp()[:150], "not XML"),
    "root.pp": ("<points><point x='1' y='1' z='1'/></points>", "line 1: expected PickedPoints, got 'points'"),
    "none.pp": ("<PickedPoints/>", "points: expected a list of 1 to 10000 landmarks, got 0"),
    "axis.pp": ("<PickedPoints>\n<point name='a' x='1' z='1'/></PickedPoints>", "line 2: point 'a' lacks y"),
    "nan.pp": ("<PickedPoints><point x='1' y='nan' z='1'/></PickedPoints>", "line 1: expected a finite number"),
    "idle.pp": (
        "<PickedPoints><point x='1' y='1' z='1' name='chin' active='0'/></PickedPoints>",
        "'chin' is not active",
    ),
    "laughs.pp": (_pp(head=LAUGHS), "line 1: a DOCTYPE with declarations is not allowed"),
    "laughs16.pp": (_pp(head=LAUGHS).encode("utf-16"), "a DOCTYPE with declarations is not allowed"),
    "outside.pp": (_pp(head='<!DOCTYPE PickedPoints SYSTEM "file:///etc/passwd">'), "DOCTYPE with declarations"),
    "columns.txt": ("1 2\n", "line 1: expected `index`, `x y z`, `index x y z`, got 2 columns: '1 2'"),
    "change.txt": ("# one\n1\n\n1 2 3\n", "line 4: expected `index` as before, got 3 columns: '1 2 3'"),
    "header.csv": ("x,y,z\n1,2,3\n", "line 1: expected a finite number, got 'x'"),
    "word.txt": ("1\none\n", "line 2: expected a vertex index of 0 or more, got 'one'"),
    "minus.txt": ("-1\n", "line 1: expected a vertex index"),
    "fraction.bnd": ("1.5 0 0 0\n", "line 1: expected a vertex index of 0 or more, got '1.5'"),
    "far.txt": ("5\n6\n", r"line 2: 6 is out of range; vertices are 0\.\.5"),
    "nan.xyz": ("0 0 nan\n", "line 1: expected a finite number, got 'nan'"),
    "only.txt": ("# nothing\n", "landmarks: expected a list of 1 to 10000 landmarks, got 0"),
    "moved.bnd": ("3 0 0 0\n", "line 1: vertex 3 is at .*landmarks belong to another mesh"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_files_say_what_is_wrong(tmp_path, name):
    content, message = BAD[name]
    with pytest.raises(landmarks.LandmarkError, match=message) as caught:
        landmarks.read(_write(tmp_path, name, content), VERTICES, FACES)
    assert name in str(caught.value) and len(str(caught.value)) < 400


def test_missing_and_folders(tmp_path):
    with pytest.raises(landmarks.LandmarkError, match=r"absent\.txt: no such file"):
        landmarks.read(tmp_path / "absent.txt", VERTICES)
    (tmp_path / "folder.txt").mkdir()
    with pytest.raises(landmarks.LandmarkError, match="not a file"):
        landmarks.read(tmp_path / "folder.txt", VERTICES)


ANYTHING = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=3),
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.dictionaries(st.sampled_from(["indices", "faces", "weights", "points", "names", "x"]), inner, max_size=4)
    ),
    max_leaves=12,
)
HOSTILE = settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


@HOSTILE
@given(value=ANYTHING)
def test_no_json_escapes_as_another_error(tmp_path, value):
    _survives(_write(tmp_path, "any.json", json.dumps(value)))


@HOSTILE
@given(name=st.sampled_from(["any.txt", "any.pp", "any.json"]), data=st.binary(min_size=1, max_size=60))
def test_no_bytes_escape_as_another_error(tmp_path, name, data):
    _survives(_write(tmp_path, name, data))


@HOSTILE
@given(at=st.integers(0, 10**6), new=st.sampled_from('0<>&"[]!x '))
def test_no_damage_to_xml_escapes_as_another_error(tmp_path, at, new):
    text = _pp()
    at %= len(text)
    _survives(_write(tmp_path, "any.pp", text[:at] + new + text[at + 1 :]))


def _survives(path):
    for mesh in ((VERTICES, FACES), (None, None)):
        try:
            found = landmarks.read(path, *mesh)
        except landmarks.LandmarkError as error:
            assert path.name in str(error)
        else:
            assert np.isfinite(found.points).all() and found.points.shape[1] == 3
