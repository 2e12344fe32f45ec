"""A user's own meshes: trees of tiny balls, written here, read into stores."""

import json
import os

import numpy as np
import pytest
import trimesh

from facejax import io
from facejax.data import dataset, mesh_subset, motions
from facejax.data.importers import apex_detection, base, folder
from facejax.landmarks import canonical_frame

MARKS = [0, 20, 61, 99, 140]
CURVE = np.array([0, 0.02, 0.3, 0.7, 0.97, 1, 0.98, 0.6, 0.2, 0.03, 0], np.float32)  # a recording: how far it has gone


@pytest.fixture(scope="module")
def ball():
    """Vertices (162, 3) in mm, 200 across, and faces."""
    made = trimesh.creation.icosphere(subdivisions=2, radius=100)
    return np.asarray(made.vertices, np.float32), np.asarray(made.faces, np.int32)


def recording(ball, subject, expression, curve=CURVE):
    """Vertices (T, 162, 3) float32 of an expression of a subject, and the subject at rest (162, 3)."""
    rest = ball[0] * np.float32([1, 1 + 0.01 * subject, 1])
    way = np.random.default_rng(expression).normal(size=rest.shape).astype(np.float32)
    return rest + curve[:, None, None] * 5 * way, rest


@pytest.fixture
def capture(ball, tmp_path):
    """Six subjects with two expressions each, folders of PLY and NPZ files; the landmarks beside them."""
    root = tmp_path / "capture"
    for subject in range(6):
        own = root / f"S{subject}"
        smile, rest = recording(ball, subject, 1)
        io.meshes.write_sequence(own / "Big-Smile", smile, ball[1])
        np.savez(own / "anger.npz", vertices=recording(ball, subject, 2)[0], faces=ball[1])
        io.meshes.write(own / "neutral.ply", rest, ball[1])
    io.landmarks.write(tmp_path / "marks.json", index=MARKS)
    return root


def prepared(root, **options):
    """The store made of a tree beside it."""
    return folder.prepare(root, root.parent / "store", landmarks=root.parent / "marks.json", **options)


def test_both_layouts_come_back_exactly(capture, ball):
    seen = []
    data = prepared(capture, progress=lambda done, total: seen.append((done, total)))
    assert seen == [(i, 12) for i in range(1, 13)]
    assert data.labels == ("neutral", "anger", "big_smile") and data.index["notes"] == [
        f"read as millimetres: {capture / 'S0' / 'neutral.ply'} is 200 mm in size"
    ]
    assert [(s["name"], s["split"]) for s in data.index["subjects"]] == [
        (f"S{i}", split) for i, split in enumerate(["train"] * 4 + ["validation", "test"])
    ]
    assert [(s.subject, s.label) for s in data.sequences] == [(i, x) for i in range(6) for x in ("anger", "big_smile")]
    moved = np.concatenate([recording(ball, i, expression)[0] for i in range(6) for expression in (2, 1)])
    np.testing.assert_array_equal(data.vertices, moved)
    np.testing.assert_array_equal(data.landmarks, moved[:, MARKS])
    np.testing.assert_array_equal(data.neutral, [recording(ball, i, 1)[1] for i in range(6)])
    np.testing.assert_array_equal(data.faces, ball[1])
    np.testing.assert_array_equal(data.landmark_index, MARKS)
    np.testing.assert_array_equal(data.drawn, np.arange(len(moved)))
    assert {a.dtype for a in (data.vertices, data.landmarks, data.neutral)} == {np.dtype(np.float32)}
    assert {a.dtype for a in (data.faces, data.landmark_index)} == {np.dtype(np.int32)}


def test_index_says_what_is_there(capture):
    data = prepared(capture, rate=60)
    index = data.index
    assert (index["schema"], index["name"], index["version"], index["unit"]) == (dataset.SCHEMA, "folder", 1, "mm")
    assert index["rate"] == 60 and {s.duration for s in data.sequences} == {11 / 60}
    assert set(index["hashes"]) == set(index["shapes"]) == {f.stem for f in data.path.iterdir()} - {"index"}
    spec = index["spec"]
    assert spec["root"] == "capture" and spec["sequences"] == 12 and spec["frames"] == 132 and spec["vertices"] == 162
    # What determines the data is in the spec: other landmarks and other files are another spec.
    io.landmarks.write(capture.parent / "marks.json", index=MARKS[:4])
    fewer = folder.prepare(capture, capture.parent / "b", landmarks=capture.parent / "marks.json", rate=60)
    (capture / "S1" / "anger.npz").rename(capture / "S1" / "fear.npz")
    renamed = folder.prepare(capture, capture.parent / "c", landmarks=capture.parent / "marks.json", rate=60)
    assert len({json.dumps(x) for x in (spec, fewer.index["spec"], renamed.index["spec"])}) == 3
    assert fewer.index["spec"]["files_sha256"] == spec["files_sha256"] != renamed.index["spec"]["files_sha256"]


def test_the_rest_of_the_project_reads_it(capture):
    data = prepared(capture)
    halves = motions.halves(data, "train")
    assert halves.curves.shape == (4 * 2 * 2, 30, 5, 3) and set(halves.start) == {0, 1, 2}
    rise = halves.take(halves.start == 0).millimetres()
    reached = np.linalg.norm(rise, axis=-1).mean(axis=-1)
    assert np.all(reached[:, 0] < 0.05 * reached[:, -1]) and np.all(reached[:, -1] > 1)
    found = mesh_subset.of_split(data, "validation", "test")
    marks, moved = next(iter(found))
    assert moved.shape == (44, 162, 3) and found.labels.tolist() == (["anger"] * 11 + ["big_smile"] * 11) * 2
    np.testing.assert_array_equal(marks, moved[:, MARKS])


def test_a_draw_of_the_meshes(capture, ball):
    data = prepared(capture, max_meshes=50)
    assert data.vertices.shape == (50, 162, 3) and data.landmarks.shape == (132, 5, 3)
    assert np.all(np.diff(data.drawn) > 0) and len({s.subject for s in data.sequences}) == 6
    np.testing.assert_array_equal(data.vertices[:, MARKS], data.landmarks[data.drawn])
    again = folder.prepare(capture, capture.parent / "again", landmarks=capture.parent / "marks.json", max_meshes=50)
    assert again.index["hashes"] == data.index["hashes"]


@pytest.mark.parametrize("suffix", ["obj", "npz", "npy"])
def test_frames_of_every_format(capture, ball, suffix):
    for own in capture.iterdir():
        for path in (own / "Big-Smile").iterdir():
            vertices = io.load_mesh(path).vertices.astype(np.float32)
            path.unlink()
            if suffix == "npy":  # has no triangles: those of the others hold
                np.save(path.with_suffix(".npy"), vertices)
            else:
                io.meshes.write(path.with_suffix(f".{suffix}"), vertices, ball[1])
    data = prepared(capture)
    np.testing.assert_array_equal(data.vertices[11:22], recording(ball, 0, 1)[0])


def test_without_triangles_but_in_one_file(ball, tmp_path):
    for subject in range(2):
        (tmp_path / "root" / f"S{subject}").mkdir(parents=True)
        moved, rest = recording(ball, subject, 1)
        np.savez(tmp_path / "root" / f"S{subject}" / "smile.npz", vertices=moved)
        np.save(tmp_path / "root" / f"S{subject}" / "neutral.npy", rest)
    io.landmarks.write(tmp_path / "marks.json", index=MARKS)
    with pytest.raises(base.SourceError, match="root: no mesh has triangles"):
        prepared(tmp_path / "root")
    np.savez(tmp_path / "root" / "S1" / "smile.npz", vertices=moved, faces=ball[1])
    data = prepared(tmp_path / "root")
    np.testing.assert_array_equal(data.faces, ball[1])
    assert {s["split"] for s in data.index["subjects"]} == {"train"}
    assert "no subjects in the splits validation and test: 4 subjects or more are needed, got 2" in data.index["notes"]


def test_frames_and_subjects_are_in_natural_order(ball, tmp_path):
    moved, rest = recording(ball, 0, 1)
    for name in ("P10", "P9"):
        (tmp_path / "root" / name / "smile").mkdir(parents=True)
        io.meshes.write(tmp_path / "root" / name / "neutral.obj", rest, ball[1])
        for i, frame in enumerate(moved):
            io.meshes.write(tmp_path / "root" / name / "smile" / f"take2.frame{i}.ply", frame, ball[1])
    io.landmarks.write(tmp_path / "marks.json", index=MARKS)
    data = prepared(tmp_path / "root")
    np.testing.assert_array_equal(data.vertices, np.concatenate([moved, moved]))
    assert [s["name"] for s in data.index["subjects"]] == ["P9", "P10"]
    names = ["a", "a1", "a01", "a2b10", "a2b9", "a10", "B", "1"]
    assert sorted(names, key=base.natural_sort_key) == ["1", "a", "a01", "a1", "a2b9", "a2b10", "a10", "B"]


def test_a_missing_neutral_is_the_first_frame(capture, ball):
    (capture / "S3" / "neutral.ply").unlink()
    shifted = recording(ball, 3, 2)[0] + np.float32(0.5)
    np.savez(capture / "S3" / "anger.npz", vertices=shifted, faces=ball[1])
    data = prepared(capture)
    np.testing.assert_array_equal(data.neutral[3], shifted[0])
    assert "no neutral mesh, used the first frame of the first recording: S3" in data.index["notes"]


@pytest.mark.parametrize(("unit", "per"), [("metres", 1000), ("centimetres", 10), ("decimetres", 100)])
def test_units_are_recognised_and_said(capture, ball, unit, per):
    scaled(capture, ball, 1 / per)
    data = prepared(capture)
    np.testing.assert_allclose(data.vertices[:11], recording(ball, 0, 2)[0], atol=1e-4)
    assert data.index["notes"][0].startswith(f"read as {unit}: ") and data.index["spec"]["unit"] == unit


def test_a_unit_can_be_named(capture, ball):
    scaled(capture, ball, 2.0)  # 400 mm, the most that is taken for a head
    scaled(capture, ball, 1.01)
    with pytest.raises(base.SourceError, match=r"neutral.ply: size 404; expected a head .* name the unit"):
        prepared(capture)
    data = prepared(capture, unit="cm")
    assert np.ptp(data.neutral[0], axis=0).max() == pytest.approx(4040, rel=1e-3)
    with pytest.raises(base.SourceError, match="unit: expected mm, cm, m or None, got 'inch'"):
        folder.prepare(capture, capture / "x", landmarks="none", unit="inch")


def scaled(root, ball, by):
    """All meshes of a tree in another unit, as float64."""
    for path in root.rglob("*.ply"):
        io.meshes.write(path, io.load_mesh(path).vertices * by, ball[1])
    for path in root.rglob("*.npz"):
        np.savez(path, vertices=io.meshes.read_animation(path)[0] * np.float64(by), faces=ball[1])


def test_68_landmarks_tell_the_unit_of_any_mesh(template, tmp_path):
    points = template.vertices[template.landmarks]
    np.testing.assert_allclose(canonical_frame.template68(), points, atol=1e-4)
    # With shoulders the mesh is larger than a head; the landmarks are not. Three times as large, they are no face's.
    bust = np.concatenate([template.vertices, [[0, -700, 0]]]) / 1000
    rng = np.random.default_rng(0)
    (tmp_path / "root" / "S0").mkdir(parents=True)
    moved = bust + CURVE[:, None, None] * 0.005 * rng.normal(size=bust.shape)
    np.savez(tmp_path / "root" / "S0" / "smile.npz", vertices=moved, faces=template.faces)
    io.landmarks.write(tmp_path / "marks.json", index=template.landmarks)
    data = prepared(tmp_path / "root")
    assert data.index["spec"]["unit"] == "metres"
    np.testing.assert_array_equal(data.vertices, (moved * 1000).astype(np.float32))
    np.savez(tmp_path / "root" / "S0" / "smile.npz", vertices=moved * 3, faces=template.faces)
    with pytest.raises(base.SourceError, match=r"smile.npz: frame 0: the face is .* name the unit: mm, cm, m"):
        folder.prepare(tmp_path / "root", tmp_path / "b", landmarks=tmp_path / "marks.json")


def test_positions_go_to_the_nearest_vertices(capture, ball):
    points = recording(ball, 0, 1)[1][MARKS] + [0, 0.3, 0]
    io.landmarks.write(capture.parent / "marks.json", points=points)
    data = prepared(capture)
    np.testing.assert_array_equal(data.landmark_index, MARKS)
    assert data.landmark_index.dtype == np.int32
    assert any("positions moved to the nearest vertices, by 0.3 mm or less" in x for x in data.index["notes"])
    record = {"faces": [0, 5, 9, 200], "weights": [[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 0, 0]]}
    (capture.parent / "marks.json").write_text(json.dumps(record))
    data = folder.prepare(capture, capture.parent / "b", landmarks=capture.parent / "marks.json")
    np.testing.assert_array_equal(data.landmark_index, ball[1][record["faces"], [0, 1, 2, 0]])


def test_landmarks_on_one_vertex_are_said(capture):
    io.landmarks.write(capture.parent / "marks.json", index=[*MARKS, 20])
    assert any("1 of 6 landmarks share a vertex" in note for note in prepared(capture).index["notes"])


def test_what_lies_elsewhere_is_passed_over(capture, ball):
    io.meshes.write(capture / "S0" / "scan.ply", ball[0], ball[1])
    (capture / "S0" / "Big-Smile" / "000001.jpg").write_bytes(b"a picture")
    (capture / ".hidden").mkdir()
    (capture / "readme.txt").write_text("recorded on a Monday")
    data = prepared(capture)
    assert len(data.sequences) == 12
    assert data.index["notes"][1:] == ["skipped meshes outside recording folders: S0/scan.ply"]


@pytest.mark.parametrize(
    ("curve", "expected"),
    [
        # Neutral, apex, neutral; of frames at rest the nearest counts.
        ([0, 0.04, 0.5, 0.96, 1, 0.97, 0.5, 0.04, 0], (1, 3, 5, 7)),
        # Between its first and its last frame the apex may sink.
        ([0.01, 1, 0.5, 0.96, 0.2, 0.02], (0, 1, 3, 5)),
        # Never at rest: the ends.
        ([0.1, 0.5, 1, 0.5, 0.1], (0, 2, 2, 4)),
        # Begins at its apex; ends at it.
        ([1, 0.5, 0], (0, 0, 0, 2)),
        ([0, 0.5, 1], (0, 2, 2, 2)),
    ],
)
def test_events(curve, expected):
    rest, way = np.random.default_rng(0).normal(size=(2, 7, 3))
    assert apex_detection.detect(rest + np.array(curve)[:, None, None] * way, rest) == expected


def test_events_by_a_loop():
    rng = np.random.default_rng(1)
    for _ in range(50):
        curve, rest = rng.normal(size=(12, 4, 3)) * rng.uniform(0.001, 1, size=(12, 1, 1)) ** 3, np.zeros((4, 3))
        energy = [sum(np.sqrt(sum(x * x for x in mark)) for mark in frame) / 4 for frame in curve]
        apex = [t for t in range(12) if energy[t] >= 0.95 * max(energy)]
        onset, offset = 0, 11
        for t in range(apex[0]):
            onset = t if energy[t] < 0.05 * max(energy) else onset
        for t in range(11, apex[-1], -1):
            offset = t if energy[t] < 0.05 * max(energy) else offset
        assert apex_detection.detect(curve, rest) == (onset, apex[0], apex[-1], offset)


def test_a_recording_with_one_half_is_said_and_used(capture, ball):
    for own in capture.iterdir():  # from rest to the apex, and no way back
        np.savez(own / "anger.npz", vertices=recording(ball, int(own.name[1:]), 2, CURVE[:6])[0], faces=ball[1])
    data = prepared(capture)
    assert data.index["notes"][1:] == ["6 of 12 recordings do not end at rest: S0/anger, S1/anger, S2/anger and 3 more"]
    halves = motions.halves(data, "train")
    pairs = list(zip(halves.start.tolist(), halves.end.tolist(), strict=True))
    assert pairs == [(0, 1), (0, 2), (2, 0)] * 4 and np.all(halves.seconds > 0)


def _vertices(capture, ball):
    io.meshes.write(capture / "S4" / "Big-Smile" / "000007.ply", ball[0][:100])


def _faces(capture, ball):
    other = ball[1].copy()
    other[3] = other[3, [1, 2, 0]]
    io.meshes.write(capture / "S4" / "Big-Smile" / "000007.ply", ball[0], other)


def _fewer_faces(capture, ball):
    np.savez(capture / "S2" / "anger.npz", vertices=recording(ball, 2, 2)[0], faces=ball[1][:-1])


def _nan(capture, ball):
    moved = recording(ball, 2, 2)[0]
    moved[7, 30, 1] = np.nan
    np.savez(capture / "S2" / "anger.npz", vertices=moved, faces=ball[1])


def _nan_in_a_frame(capture, ball):
    vertices = ball[0].copy()
    vertices[30] = np.inf
    np.save(capture / "S2" / "neutral.npy", vertices)
    (capture / "S2" / "neutral.ply").unlink()


def _unit(capture, ball):
    io.meshes.write(capture / "S5" / "neutral.ply", ball[0] / 1000, ball[1])


def _cut(capture, ball):
    path = capture / "S5" / "Big-Smile" / "000003.ply"
    path.write_bytes(path.read_bytes()[:500])


def _both(capture, ball):
    np.savez(capture / "S1" / "big_smile.npz", vertices=recording(ball, 1, 1)[0])


def _neutrals(capture, ball):
    np.save(capture / "S1" / "neutral.npy", ball[0])


def _formats(capture, ball):
    io.meshes.write(capture / "S1" / "Big-Smile" / "000001.obj", ball[0], ball[1])


def _one(capture, ball):
    for path in sorted((capture / "S1" / "Big-Smile").iterdir())[1:]:
        path.unlink()


def _still(capture, ball):
    moved = np.stack([recording(ball, 1, 1)[1]] * 4)
    np.savez(capture / "S1" / "anger.npz", vertices=moved)


def _rate(capture, ball):
    np.savez(capture / "S1" / "anger.npz", vertices=recording(ball, 1, 1)[0], fps=60.0)


def _index(index):
    return lambda capture, ball: io.landmarks.write(capture.parent / "marks.json", index=index)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (_vertices, r"S4/Big-Smile/000007.ply: 100 vertices, expected 162 as in \S*S0/neutral.ply"),
        (_faces, r"S4/Big-Smile/000007.ply: triangle 3 is \[.*\], expected \[.*\] as in \S*S0/neutral.ply"),
        (_fewer_faces, r"S2/anger.npz: frame 0: 319 triangles, expected 320 as in \S*S0/neutral.ply"),
        (_nan, r"S2/anger.npz: frame 7: vertex 30 is not finite: \[.*nan.*\]"),
        (_nan_in_a_frame, r"S2/neutral.npy: vertex 30 is not finite"),
        (_unit, r"S5/neutral.ply: 0.001 times as large as \S*S0/neutral.ply"),
        (_cut, r"S5/Big-Smile/000003.ply: "),
        (_both, r"S1/big_smile.npz: duplicate recording 'big_smile', also Big-Smile"),
        (_neutrals, r"S1: two neutral meshes, neutral.npy and neutral.ply; expected one"),
        (_formats, r"S1/Big-Smile: frames in .obj and .ply, expected one format"),
        (_one, r"S1/Big-Smile: 1 frame, expected 2 or more"),
        (_still, r"S1/anger.npz: the recording contains no motion"),
        (_rate, r"S1/anger.npz: fps is 60, expected 30"),
        (lambda c, b: (c / "S1" / "empty").mkdir(), r"S1/empty: contains no frames; expected .ply, .obj, .npy, .npz"),
        (lambda c, b: (c / "S9").mkdir(), r"S9: contains no recordings"),
        (lambda c, b: (c / "S1" / "Neutral").mkdir(), r"S1/Neutral: the neutral face must be one mesh"),
        (lambda c, b: (c / "S1" / "a>b").mkdir(), r"S1/a>b: the name of a recording must not contain '>'"),
        (lambda c, b: np.savez(c / "S1" / "x.npz", vertices=b[0]), r"S1/x.npz: vertices must be \(T, N, 3\), got"),
        (lambda c, b: np.savez(c / "S1" / "x.npz", points=b[0]), r"S1/x.npz: contains no array 'vertices'"),
        (lambda c, b: (c / "S1" / "x.npz").write_bytes(b"PK cut"), r"S1/x.npz: "),
        (_index([0, 1, 2, 162]), r"marks.json: indices\[3\]: 162 is out of range; vertices are 0..161"),
        (_index([0, 1, 2]), r"marks.json: 3 landmarks, expected 4 or more"),
        (lambda c, b: (c.parent / "marks.json").unlink(), r"marks.json: no such file"),
        (lambda c, b: (c.parent / "store").mkdir(), r"store: already exists"),
        (lambda c, b: (c.parent / "store").symlink_to("nowhere"), r"store: already exists"),
    ],
)
def test_what_is_wrong_is_named_and_nothing_is_written(capture, ball, damage, message):
    damage(capture, ball)
    before = sorted(capture.parent.rglob("*"))
    with pytest.raises(base.SourceError, match=message):
        prepared(capture)
    assert sorted(capture.parent.rglob("*")) == before


def test_requests_that_cannot_be_met(capture, ball, tmp_path):
    marks = tmp_path / "marks.json"

    def told(root, out, **options):
        with pytest.raises(base.SourceError) as error:
            folder.prepare(root, out, landmarks=marks, **options)
        return str(error.value)

    (tmp_path / "file").write_text("here")
    assert "nowhere: no such folder" in told(tmp_path / "nowhere", tmp_path / "o")
    assert "file: not a folder" in told(tmp_path / "file", tmp_path / "o")
    assert "Big-Smile: contains no recordings" in told(capture / "S0", tmp_path / "o")  # one folder too deep
    assert "Big-Smile: contains no folders" in told(capture / "S0" / "Big-Smile", tmp_path / "o")
    assert "is inside the source folder" in told(capture, capture / "S0" / "store")
    assert f"{tmp_path / 'file'} is not a folder" in told(capture, tmp_path / "file" / "deeper" / "store")
    assert "rate: expected frames per second" in told(capture, tmp_path / "o", rate=float("nan"))
    assert "(--meshes): expected 1 or more" in told(capture, tmp_path / "o", max_meshes=0)
    point = tmp_path / "point"
    (point / "S0").mkdir(parents=True)
    np.savez(point / "S0" / "a.npz", vertices=np.ones((3, 162, 3)), faces=ball[1])
    assert "all vertices lie at one point" in told(point, tmp_path / "o")
    assert not (tmp_path / "o").exists()


def test_an_error_while_writing_leaves_nothing(capture, monkeypatch):
    """A file that changes between checking and writing, a full disk."""
    before = sorted(os.listdir(capture.parent))

    def change(done, total):
        if done == total // 2:
            (capture / "S5" / "Big-Smile" / "000003.ply").write_bytes(b"ply\n")

    with pytest.raises(base.SourceError, match=r"000003.ply"):
        prepared(capture, progress=change)
    assert sorted(os.listdir(capture.parent)) == before
