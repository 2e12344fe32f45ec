"""The layouts of the gated datasets, written here from MakeHuman faces, come back exactly; what is amiss is named."""

import collections
import json
import os
import pickle
import shutil
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from facejax.data import dataset, motions
from facejax.data.importers import apex_detection, base, ingest, registry, worker
from facejax.training.recipes import fit_bundle
from tests.data import captures
from tests.data.captures import CURVE, face, motion

FRAMES = len(CURVE)


@pytest.fixture
def marks(tmp_path, tiny_store):
    path = tmp_path / "marks.json"
    path.write_text(json.dumps({"indices": np.asarray(tiny_store.landmark_index).tolist()}))
    return path


@pytest.fixture
def capture(tmp_path, tiny_store):
    """Writes a layout and returns its root."""

    def write(layout, **options):
        getattr(captures, layout)(tmp_path / layout, tiny_store, **options)
        return tmp_path / layout

    return write


def prepared(root, marks, *, layout=None, out="store", **options):
    options = {"landmarks": marks} | options
    return registry.prepare(layout or root.name, root, root.parent / out, **options)


def millimetres(meshes, per, kind=np.float32):
    """What a file of a unit and a precision holds of meshes in mm."""
    return ((meshes / per).astype(kind).astype(np.float64) * per).astype(np.float32)


@pytest.mark.parametrize(
    ("layout", "people", "labels", "rate"),
    [
        ("coma", ["FaceTalk_170720_00137_TA", "FaceTalk_170721_00137_TA"], ["bareteeth", "cheeks_in", "mouth_up"], 60),
        ("d3dfacs", ["subject0", "subject1"], ["1+2", "12+25", "12+25"], 60),
    ],
)
def test_folders_come_back_exactly(capture, marks, tiny_store, layout, people, labels, rate):
    data = prepared(capture(layout), marks)
    assert [s["name"] for s in data.index["subjects"]] == people and data.index["name"] == layout
    assert [(s.subject, s.label) for s in data.sequences] == [(i, label) for i in range(2) for label in labels]
    assert data.labels == ("neutral", *sorted(set(labels))) and data.index["rate"] == rate
    moved = np.concatenate([motion(tiny_store, s, e) for s in range(2) for e in range(3)])
    text = np.arange(len(moved)) % FRAMES % 2 * (layout == "coma") > 0  # nine digits, which single precision rounds
    np.testing.assert_array_equal(data.vertices[~text], millimetres(moved, 1000)[~text])
    np.testing.assert_allclose(data.vertices[text], moved[text], atol=1e-5, rtol=0)
    np.testing.assert_array_equal(data.landmarks, data.vertices[:, tiny_store.landmark_index])
    np.testing.assert_array_equal(data.neutral, [data.vertices[0], data.vertices[3 * FRAMES]])
    np.testing.assert_array_equal(data.faces, tiny_store.faces)
    assert {s[4:8] for s in data.sequences} == {(1, 4, 5, 7)} and data.index["notes"][0].startswith("read as metres")
    assert motions.halves(data, "train").curves.shape == (12, 30, 68, 3)


def test_florence4d_comes_back_in_double_precision(capture, marks, tiny_store):
    people = marks.parent / "people.csv"
    people.write_text("subject, sex\nid0, female\nid1, male\n")
    data = prepared(capture("florence4d"), marks, people=people, workers=2)
    up = np.linspace(0, 1, 31)
    curve = np.concatenate([up, up[-2:0:-1]])
    # In natural order: frame 2 before frame 10.
    moved = np.concatenate([motion(tiny_store, s, e, curve) for s in range(2) for e in (1, 0)])
    np.testing.assert_array_equal(data.vertices, millimetres(moved, 1000, np.float64))
    assert {s[4:8] for s in data.sequences} == {(0, 30, 30, 59)}
    assert [s["sex"] for s in data.index["subjects"]] == ["female", "male"]


def test_vocaset_comes_back_exactly(capture, marks, tiny_store):
    root = capture("vocaset")
    data = prepared(root, marks, template=root.parent / "template.ply")
    moved = np.concatenate([motion(tiny_store, s, e) for s in range(2) for e in range(2)])
    np.testing.assert_array_equal(data.vertices, millimetres(moved, 1000))
    rest = np.stack([face(tiny_store, s) / 1000 for s in range(2)])
    np.testing.assert_array_equal(data.neutral, (rest * 1000).astype(np.float32))
    assert [s.label for s in data.sequences] == ["sentence01", "sentence02"] * 2 and data.index["rate"] == 60


def test_bu3dfe_leaves_out_who_has_no_neutral_mesh(capture, marks, tiny_store):
    data = prepared(capture("bu3dfe"), marks)
    assert [(s["name"], s["sex"]) for s in data.index["subjects"]] == [("F0001", "female"), ("M0001", "male")]
    assert any("skipped 1 of 3 people without a neutral mesh: F0002" in n for n in data.index["notes"])
    strengths = (0, 0.25, 0.5, 0.75, 1.0)
    moved = np.concatenate([motion(tiny_store, s, e, strengths) for s in (0, 2) for e in range(2)])
    np.testing.assert_array_equal(data.vertices, millimetres(moved, 1))
    assert {s[4:8] for s in data.sequences} == {(0, 4, 4, 4)}
    assert any("8 emotions are missing: F0001/fear" in note for note in data.index["notes"])


def test_bu4dfe_has_landmarks_alone(tmp_path, tiny_store):
    marks = captures.bu4dfe(tmp_path / "bu4dfe", tiny_store)
    data = registry.prepare("bu4dfe", tmp_path / "bu4dfe", tmp_path / "store")
    moved = np.concatenate([motion(tiny_store, s, e)[:, marks] for s in range(2) for e in range(2)])
    moved = moved + 3 * np.tile(CURVE, 4)[:, None, None]
    np.testing.assert_allclose(data.landmarks, moved, atol=2e-6)
    assert data.vertices.shape == (0, 83, 3) and data.faces.shape == (0, 3) and data.neutral.shape == (2, 83, 3)
    assert data.index["rate"] == 25 and data.labels == ("neutral", "angry", "happy")
    halves = motions.halves(data, "train")
    assert halves.curves.shape == (8, 30, 83, 3)
    with pytest.raises(dataset.DatasetError, match="contains only landmarks, expected meshes"):
        dataset.open_meshes(data.path)
    with pytest.raises(ValueError, match="contains only landmarks"):
        fit_bundle.check(data)


def test_tables_beside_a_dataset(capture, marks, tiny_store):
    root, folder = capture("d3dfacs"), marks.parent
    (folder / "labels.csv").write_text("# by hand\nsubject,recording,label\nsubject0,12+25_02,Grin\n")
    (folder / "people.csv").write_text("subject,split,age\nsubject0,test,30\n\nsubject1,train,40\n")
    header = "subject,recording,onset,apex_start,apex_end,offset\n"
    (folder / "cuts.csv").write_text(f"{header}subject1,1+2,0,3,6,8\n")
    tables = {"labels": folder / "labels.csv", "people": folder / "people.csv", "phases": folder / "cuts.csv"}
    data = prepared(root, marks, **tables)
    assert [s.label for s in data.sequences] == ["1+2", "12+25", "grin", "1+2", "12+25", "12+25"]
    assert [s[4:8] for s in data.sequences] == [(1, 4, 5, 7)] * 3 + [(0, 3, 6, 8)] + [(1, 4, 5, 7)] * 2
    assert data.people() == {"train": ["subject1"], "validation": [], "test": ["subject0"]}
    assert [s["age"] for s in data.index["subjects"]] == ["30", "40"]
    for name, text, message in (
        ("cuts", f"{header}subject1,1+3,0,3,6,8\n", "cuts.csv: line 2: subject 'subject1' has no recording '1[+]3'"),
        (
            "cuts",
            f"{header}subject1,1+2,0,3,6,9\n",
            r"cuts.csv: line 2: onset, .* must be ascending frame numbers in 0\.\.8, got \[0, 3, 6, 9\]",
        ),
        ("cuts", f"{header}subject1,1+2,0,x,6,8\n", "cuts.csv: line 2: apex_start: expected an integer, got 'x'"),
        (
            "cuts",
            f"{header}subject1,1+2,3,3,6,6\n",
            "cuts.csv: line 2: onset equals apex_start and apex_end equals offset",
        ),
        (
            "cuts",
            "subject,recording,onset\n",
            "cuts.csv: expected a row of column names and one or more rows of values, got 1",
        ),
        ("labels", "subject,recording,label\na,b\n", "labels.csv: line 2: 2 fields, expected 3"),
        ("labels", "subject,label\na,b\n", "labels.csv: line 1: expected columns subject, recording, label, got"),
        ("labels", "subject,recording,label\nsubject0,1+2,\n", "labels.csv: line 2: column label is empty"),
        ("labels", "subject,recording,label\nsubject0,1+2,a>b\n", "labels.csv: line 2: a label must not contain '>'"),
        ("people", "subject,split\nsubject0,dev\n", "people.csv: line 2: split: expected train, validation, test, got"),
        ("people", "subject,sex\nsubject0,f\n", "people.csv: line 2: sex: expected female or male, got 'f'"),
        ("people", "subject,split\nJane,test\n", "people.csv: line 2: unknown subject 'Jane'"),
    ):
        (folder / f"{name}.csv").write_text(text)
        with pytest.raises(base.SourceError, match=message):
            prepared(root, marks, out="other", **{"phases" if name == "cuts" else name: folder / f"{name}.csv"})
        assert not (folder / "other").exists()


def _missing(root, frame):
    frame.unlink()


def _cut(root, frame):
    frame.write_bytes(frame.read_bytes()[:-1000])


def _fewer(root, frame):
    frame.write_bytes(captures.ply(np.ones((100, 3)), [[0, 1, 2]]))


def _nan(root, frame):
    content = bytearray(frame.read_bytes())
    at = content.index(b"end_header\n") + 11 + 12 * 40 + 4
    content[at : at + 4] = np.float32(np.nan).tobytes()
    frame.write_bytes(content)


def _twice(root, frame):
    (frame.parent / "cheeks_in.5.ply").write_bytes(frame.read_bytes())


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (_missing, r"00137_TA/cheeks_in: frame 5 is missing, after cheeks_in.000004.ply; use --gaps to"),
        (_cut, r"cheeks_in.000005.ply: ends early: face needs \d+ bytes, \d+ are left"),
        (_fewer, r"cheeks_in.000005.ply: 100 vertices, expected 3260 as in \S*bareteeth.000001.ply"),
        (_nan, r"cheeks_in.000005.ply: vertex 40 is not finite: \[.*nan.*\] \(1 in all\)"),
        (_twice, r"cheeks_in.5.ply: duplicate frame number 5, also of cheeks_in.000005.ply"),
    ],
)
@pytest.mark.parametrize("workers", [1, 2])
def test_a_bad_frame_is_named_and_nothing_is_left(capture, marks, damage, message, workers):
    root = capture("coma")
    damage(root, root / "FaceTalk_170721_00137_TA" / "cheeks_in" / "cheeks_in.000005.ply")
    before = sorted(root.parent.rglob("*"))
    with pytest.raises(base.SourceError, match=message):
        prepared(root, marks, workers=workers)
    assert sorted(root.parent.rglob("*")) == before


def test_gaps_can_be_allowed(capture, marks):
    root = capture("coma")
    for number in (5, 6):
        (root / "FaceTalk_170721_00137_TA" / "cheeks_in" / f"cheeks_in.{number:06d}.ply").unlink()
    data = prepared(root, marks, gaps=True)
    assert [s.frames for s in data.sequences] == [9, 9, 9, 9, 7, 9]
    assert any("cheeks_in: frames 5 to 6 are missing, after cheeks_in.000004.ply" in n for n in data.index["notes"])


def test_a_frame_without_a_number_and_other_steps(capture, marks):
    take = capture("d3dfacs") / "subject1" / "1+2"
    (take / "1+2_mean.ply").write_bytes((take / "1+2_7.ply").read_bytes())
    with pytest.raises(
        base.SourceError, match=r"1\+2_mean.ply: name has no frame number, unlike other frames in the folder"
    ):
        prepared(take.parents[1], marks)
    (take / "1+2_mean.ply").unlink()
    for number in (8, 10, 12, 14):
        (take / f"1+2_{number}.ply").unlink()
    found = registry.scan("folder", take.parents[1])
    assert "frame numbers increase by 1, except in: subject1/1+2 (2)" in found.notes


def test_recordings_of_several_expressions_are_said(tmp_path, marks, tiny_store):
    (tmp_path / "root" / "S0").mkdir(parents=True)
    moved = np.concatenate([motion(tiny_store, 0, e) for e in (27, 27)])
    np.savez(tmp_path / "root" / "S0" / "rom.npz", vertices=moved, faces=tiny_store.faces)
    data = prepared(tmp_path / "root", marks, layout="folder")
    assert any("1 of 1 recordings return to rest more than once" in note for note in data.index["notes"])


def test_landmarks_and_units_that_do_not_fit(capture, marks, tmp_path, tiny_store):
    root = capture("coma")

    def told(**options):
        with pytest.raises(base.SourceError) as error:
            prepared(root, marks, **options)
        assert not (tmp_path / "store").exists()
        return str(error.value)

    assert "bareteeth.000001.ply: 0.2" in (text := told(unit="mm")) and "another unit?" in text
    assert "--landmarks is required by the coma importer" in told(landmarks=None)
    good = np.asarray(tiny_store.landmark_index)
    assert "workers: expected 1 or more, got 0" in told(workers=0)
    points = np.asarray(tiny_store.neutral[0])[good]
    marks.write_text(json.dumps({"points": points.tolist()}))  # millimetres, on meshes in metres
    assert "another unit" in told()
    marks.write_text(json.dumps({"points": (points / 1000 + [0, 0, 0.05]).tolist()}))
    assert "marks.json: landmark" in (text := told()) and "another mesh?" in text
    marks.write_text(json.dumps({"indices": [1, 2, 3, 3260]}))
    assert "marks.json: indices[3]: 3260 is out of range; vertices are 0..3259" in told()
    marks.write_text(json.dumps({"indices": [1, 2, 3]}))
    assert "marks.json: 3 landmarks, expected 4 or more" in told()
    assert "--template is not supported by the coma importer" in told(template=tmp_path)
    assert "unknown layout 'comma', expected one of folder, coma" in told(layout="comma")
    (root / "Jane").mkdir()
    assert "contains no recordings" in told()


def test_bnd_files_that_are_damaged(tmp_path, tiny_store):
    captures.bu4dfe(tmp_path / "bu4dfe", tiny_store)
    frame = tmp_path / "bu4dfe" / "M001" / "Angry" / "003.bnd"
    rows = frame.read_text().splitlines()
    for text, message in (
        ("\n".join(rows[:82]), r"003.bnd: 82 landmarks, expected 83"),
        ("\n".join([*rows[:4], "12 1.0 x 3.0", *rows[5:83]]), r"003.bnd: line 5: expected a finite number, got 'x'"),
        ("\n".join([*rows[:4], "12 1.0 nan 3.0", *rows[5:83]]), r"003.bnd: line 5: expected a finite number"),
        ("\n".join([*rows[:4], "12 1.0 3.0", *rows[5:83]]), r"003.bnd: line 5: expected `index x y z` as before"),
    ):
        frame.write_text(text)
        with pytest.raises(base.SourceError, match=message):
            registry.prepare("bu4dfe", tmp_path / "bu4dfe", tmp_path / "store")
        assert not (tmp_path / "store").exists()


def test_a_pickle_with_a_foreign_class_is_refused_before_it_runs(capture, marks):
    root = capture("vocaset")
    index = root / "subj_seq_to_idx.pkl"
    good = index.read_bytes()
    index.write_bytes(b"cos\nsystem\n(S'touch " + str(root / "ran").encode() + b"'\ntR.")
    with pytest.raises(
        base.SourceError, match=r"subj_seq_to_idx.pkl: contains (os|posix).system, which is not allowed"
    ):
        prepared(root, marks, template=root.parent / "template.ply")
    index.write_bytes(pickle.dumps(collections.Counter("no harm, but foreign")))
    with pytest.raises(base.SourceError, match=r"contains collections.Counter, which is not allowed"):
        prepared(root, marks, template=root.parent / "template.ply")
    assert not (root / "ran").exists()
    found = pickle.loads(good)
    del found["FaceTalk_1_TA"]["sentence02"][3]
    index.write_bytes(pickle.dumps(found))
    with pytest.raises(base.SourceError, match=r"FaceTalk_1_TA/sentence02: frame 3 is missing"):
        prepared(root, marks, template=root.parent / "template.ply")
    found["FaceTalk_1_TA"]["sentence02"][3] = 9_999
    index.write_bytes(pickle.dumps(found))
    with pytest.raises(base.SourceError, match=r"FaceTalk_1_TA/sentence02: frame 3 has row 9999, expected 0 to 35"):
        prepared(root, marks, template=root.parent / "template.ply")


def test_held_heads_come_back_to_where_they_were(tmp_path, marks, tiny_store):
    angle = np.linspace(0, 0.1, FRAMES)
    moved = motion(tiny_store, 0, 27)  # the lower lip: what is held stays put
    c, s, zero, one = np.cos(angle), np.sin(angle), np.zeros(FRAMES), np.ones(FRAMES)
    turn = np.array([[c, -s, zero], [s, c, zero], [zero, zero, one]]).transpose(2, 0, 1)
    (tmp_path / "root" / "S0").mkdir(parents=True)
    np.savez(tmp_path / "root" / "S0" / "smile.npz", vertices=moved @ turn + [0, 3, 1], faces=tiny_store.faces)
    loose = prepared(tmp_path / "root", marks, layout="folder", out="loose")
    held = prepared(tmp_path / "root", marks, layout="folder", out="held", remove_head_motion=True)
    off = [np.linalg.norm(np.diff(d.vertices[:, 3000], axis=0), axis=1).sum() for d in (loose, held)]
    true = moved + [0, 3, 1]
    np.testing.assert_allclose(held.vertices, true, atol=0.5)  # of 20 mm: the lip moves what should stay put a little
    assert off[1] < 0.05 * off[0]


def test_landmarks_that_are_no_face_are_said(capture, marks, tiny_store):
    marks.write_text(json.dumps({"indices": np.asarray(tiny_store.landmark_index)[::-1].tolist()}))
    data = prepared(capture("coma"), marks)
    assert any(
        "its 68 landmarks do not form a face" in note and "used without changes" in note for note in data.index["notes"]
    )


def test_jumps_are_named():
    curve = np.cumsum(np.full((40, 5, 3), 0.1), axis=0)
    curve[25:] += 4.0
    assert apex_detection.detect_jumps(curve) == [25] and apex_detection.detect_jumps(curve[:25]) == []


def test_the_same_bytes_by_any_number_of_processes_and_after_kills(capture, marks, tmp_path):
    """Killed at moments that differ, and run again: the same bytes as in one go."""
    root = capture("coma")
    whole = prepared(root, marks, out="whole")
    two = prepared(root, marks, out="two", workers=2)
    assert _bytes(whole) == _bytes(two)
    code = (
        "import sys; from pathlib import Path; from facejax.data.importers import registry\n"
        "print('begun', flush=True)\n"
        "registry.prepare('coma', Path(sys.argv[1]), Path(sys.argv[2]), landmarks=Path(sys.argv[3]),"
        " workers=int(sys.argv[4]), progress=lambda done, total: print(done, flush=True))"
    )
    killed = 0
    for pause, workers in ((0.0, 1), (0.05, 1)):
        command = [sys.executable, "-c", code, root, tmp_path / "killed", marks, str(workers)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, env=os.environ) as process:
            process.stdout.readline(), process.stdout.readline()
            time.sleep(pause)
            process.send_signal(signal.SIGKILL)
            killed += process.wait() == -signal.SIGKILL
    assert killed and (tmp_path / ".killed.part").exists() and not (tmp_path / "killed").exists()
    done = sorted((tmp_path / ".killed.part" / "done").glob("[0-9]*.npz"))
    assert done
    again = prepared(root, marks, out="killed")
    assert _bytes(again) == _bytes(whole) and not (tmp_path / ".killed.part").exists()


@pytest.mark.slow
def test_ten_kills_at_random_moments(tmp_path, marks, tiny_store):
    root, rng = tmp_path / "coma", np.random.default_rng(0)
    for _ in range(6):  # recordings enough that a kill falls into the reading
        captures.coma(tmp_path / "one", tiny_store)
        for person in (tmp_path / "one").iterdir():
            for take in person.iterdir():
                number = "abcdef"[len(list((root / person.name).glob("*"))) // 3]
                (root / person.name).mkdir(parents=True, exist_ok=True)
                take.rename(root / person.name / f"{take.name}_{number}")
            person.rmdir()
        (tmp_path / "one").rmdir()
    whole = prepared(root, marks, out="whole")
    command = [sys.executable, "-m", "facejax.cli", "data", "prepare", "coma", "--root", root, "--landmarks", marks]
    killed = 0
    for _ in range(10):
        with subprocess.Popen([*command, "--out", tmp_path / "killed", "--workers", "2"]) as process:
            time.sleep(rng.uniform(0.5, 3))
            process.send_signal(signal.SIGKILL)
            killed += process.wait() == -signal.SIGKILL
        if (tmp_path / "killed").exists():  # it was faster
            assert _bytes(dataset.open_dataset(tmp_path / "killed")) == _bytes(whole)
            shutil.rmtree(tmp_path / "killed")
    assert killed >= 3
    if not (tmp_path / "killed").exists():
        prepared(root, marks, out="killed")
    assert _bytes(dataset.open_dataset(tmp_path / "killed")) == _bytes(whole)


def test_another_request_does_not_go_on_with_what_was_done(capture, marks, tmp_path, monkeypatch):
    root = capture("coma")
    real, seen = worker.import_recording, []

    def stop(job, number):
        seen.append(number)
        if len(seen) == 3:
            raise KeyboardInterrupt
        real(job, number)

    monkeypatch.setattr(worker, "import_recording", stop)
    with pytest.raises(KeyboardInterrupt):
        prepared(root, marks)
    assert len(list((tmp_path / ".store.part" / "done").iterdir())) == 2
    monkeypatch.setattr(worker, "import_recording", lambda job, number: (seen.append(number), real(job, number)))
    prepared(root, marks, max_meshes=20)
    assert seen[3:] == [0, 1, 2, 3, 4, 5]


@pytest.mark.parametrize("trouble", [OSError("No space left on device"), RuntimeError("a process was lost")])
def test_trouble_that_is_not_of_the_recordings_loses_nothing(capture, marks, tmp_path, monkeypatch, trouble):
    root = capture("coma")
    whole, real, seen = prepared(root, marks, out="whole"), worker.import_recording, []

    def fail(job, number):
        if number == 2:
            raise trouble
        real(job, number)

    monkeypatch.setattr(worker, "import_recording", fail)
    with pytest.raises(type(trouble)):
        prepared(root, marks)
    assert not (tmp_path / "store").exists()
    monkeypatch.setattr(worker, "import_recording", lambda job, number: (seen.append(number), real(job, number)))
    assert _bytes(prepared(root, marks)) == _bytes(whole) and seen == [2, 3, 4, 5]


def _bytes(data: dataset.Dataset) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in data.path.iterdir()}


def test_notes_of_a_mean_rest(capture, marks):
    data = prepared(capture("coma"), marks, rest="mean")
    first = [np.mean([data.vertices[(3 * s + e) * FRAMES] for e in range(3)], axis=0) for s in range(2)]
    np.testing.assert_allclose(data.neutral, first, atol=1e-4)
    assert any("used the mean of the first frames" in note for note in data.index["notes"])
    assert data.index["version"] == ingest.VERSION
