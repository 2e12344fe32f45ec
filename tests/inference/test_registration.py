"""Registration of scans: truth that is known, any place and unit, holes; the command line."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from experiments import registration
from facejax import io
from facejax.data.synthetic import makehuman
from facejax.inference import registration as inference_registration
from facejax.inference import scans
from facejax.io.landmarks import LandmarkError
from facejax.io.meshes import MeshError
from facejax.mesh import closest_point
from tests.cli.test_main import run

SIZE = 1_500


@pytest.fixture(scope="module", autouse=True)
def few_people():
    """A smaller model of people, once."""
    scans.head_model.cache_clear()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scans, "PEOPLE", 60)
        scans.head_model()
        yield
    scans.head_model.cache_clear()


@pytest.fixture(scope="module")
def head():
    """A person that the model has not seen (N, 3), and the head in other vertices."""
    person = makehuman.subject(100).vertices.astype(np.float64)
    return person, *registration.cut(person, makehuman.template().faces, SIZE)


def scan_of(head, which, *, turn=np.eye(3), move=0.0):
    true, vertices, faces = head
    which = list(which)
    marks = true[makehuman.template().landmarks[which]]
    return scans.Scan("S100", vertices @ turn.T + move, faces, marks @ turn.T + move, np.asarray(which), 1.0, ())


@pytest.mark.parametrize("which", [range(68), registration.SEVEN], ids=["68", "7"])
def test_the_template_comes_to_lie_on_the_head(head, which):
    turn, move = Rotation.from_rotvec([0.4, 2.0, -0.5]).as_matrix(), np.array([100.0, -50, 30])
    found = scans.fit(scan_of(head, list(which), turn=turn, move=move))
    placed, template = (found.vertices - move) @ turn, makehuman.template()
    off = closest_point.closest_points(closest_point.surface(head[0], template.faces), placed).distance[
        template.face_mask
    ]
    apart = np.linalg.norm(placed - head[0], axis=1)[template.face_mask]
    assert off.mean() < 0.3 and apart.mean() < 1.5 and found.matched.mean() > 0.9
    # The way into the template's frame is the one that the vertices were moved by.
    np.testing.assert_allclose(found.rotation @ found.rotation.T, np.eye(3), atol=1e-6)
    there = found.vertices @ found.rotation.T + found.translation
    assert np.abs(there - scans.head_model().mean).mean() < 10


def test_triangles_may_run_the_other_way_round(head):
    true, vertices, faces = head
    a, b = (scans.fit(scan_of((true, vertices, f), registration.SEVEN)).vertices for f in (faces, faces[:, ::-1]))
    np.testing.assert_allclose(a, b, atol=0.05)


def test_a_motion_is_carried_to_the_scan(head):
    true, vertices, faces = head
    template = makehuman.template()
    found = scans.fit(scan_of(head, range(68)))
    hung = inference_registration.bind(found.vertices, template.faces, vertices, faces)
    # A smooth motion that is known everywhere.
    field = lambda x: 3 * np.sin(x / 40) @ np.array([[0, 1, 0], [0, 0, 1], [1, 0, 0.0]])  # noqa: E731
    carried = inference_registration.transfer_displacements(hung, np.stack([field(true), 2 * field(true)]))
    assert carried.shape == (2, len(vertices), 3)
    np.testing.assert_allclose(carried[1], 2 * carried[0], atol=1e-5)
    assert np.linalg.norm(carried[0] - field(vertices), axis=1).mean() < 0.2
    # What is far from the template stays where it is.
    far = inference_registration.bind(found.vertices, template.faces, vertices + [0, 0, 500.0], faces)
    assert not far.weights.any()


def test_shape_is_a_principal_component_analysis():
    rng = np.random.default_rng(0)
    rest = makehuman.template()
    people = rest.vertices + rng.normal(size=(5, 1, 1)) * rng.normal(size=rest.vertices.shape)
    found = inference_registration.fit_head_model(people, rest.faces, rest.landmarks, components=3)
    assert found.components.shape == (3, *rest.vertices.shape)
    flat = found.components.reshape(3, -1)
    gram = flat @ flat.T
    assert np.abs(gram - np.diag(np.diag(gram))).max() < 1e-6 * gram.max() and np.all(np.diff(np.diag(gram)) <= 0)
    with pytest.raises(ValueError, match="three or more that are not collinear"):
        inference_registration.fit(found, rest.vertices, rest.faces, np.eye(3)[:2], np.arange(2))


@pytest.fixture
def files(head, tmp_path):
    """A scan in metres, doubled along a seam, with seven landmarks."""
    true, vertices, faces = head
    seam = faces.copy()
    right = vertices[faces].mean(axis=1)[:, 0] > 0
    seam[right] += len(vertices)
    io.meshes.write(tmp_path / "scan.ply", np.concatenate([vertices, vertices]) / 1000, seam)
    points = true[makehuman.template().landmarks[list(registration.SEVEN)]] / 1000
    io.landmarks.write(tmp_path / "marks.json", points=points)
    return tmp_path / "scan.ply", tmp_path / "marks.json", points


def test_register_on_the_command_line(files, tmp_path, capsys, head):
    scan, marks, points = files
    code, printed, err = run(capsys, "register", scan, "--landmarks", marks, "--out", tmp_path / "o")
    assert code == 0, err
    assert "read as metres" in err and "7 of 68 landmarks are given" in err and "mean distance to the scan" in err
    names = ["scan-template.ply", "scan-landmarks.json", "scan-fit.json", "scan-fit.png"]
    assert printed.splitlines() == [str(tmp_path / "o" / name) for name in names]
    record = json.loads((tmp_path / "o" / "scan-fit.json").read_text())
    assert record["mean_mm"] < 0.3 and record["matched"] > 0.9 and record["landmarks_given"] == 7
    # In the scan's own place and unit.
    placed = io.load_mesh(tmp_path / "o" / "scan-template.ply").vertices * 1000
    assert np.linalg.norm(placed - head[0], axis=1).mean() < 2
    found = io.landmarks.read(tmp_path / "o" / "scan-landmarks.json")
    given = [found.names.index(name) for name in scans.SEVEN_LANDMARKS]
    assert np.linalg.norm(found.points[given] - points, axis=1).max() < 2e-3
    assert 0.9 < (tmp_path / "o" / "scan-fit.png").stat().st_size / 100_000 < 50


def test_generate_animates_the_scan_itself(files, tmp_path, capsys):
    scan, marks, _ = files
    options = ("--frames", 6, "--formats", "npz", "--out", tmp_path / "o")
    code, printed, err = run(
        capsys, "generate", "--face", scan, "--landmarks", marks, "--end", "mouth_open", *options
    )  # fmt: skip
    assert code == 0 and "read as metres" in err, err
    with np.load(printed.splitlines()[0]) as found:
        vertices, faces = found["vertices"], found["faces"]
    mesh = io.load_mesh(scan)
    assert vertices.shape == (6, len(mesh.vertices), 3)
    np.testing.assert_array_equal(faces, mesh.faces)
    moved = np.linalg.norm(vertices - vertices[0], axis=-1)
    assert moved[-1].max() > 5 and np.median(moved[-1]) < 1  # the jaw goes, the skull stays
    # The two sides of the seam stay together.
    half = len(mesh.vertices) // 2
    both = np.intersect1d(np.unique(faces) % half, np.arange(half))
    shared = both[np.isin(both, faces) & np.isin(both + half, faces)]
    np.testing.assert_allclose(vertices[:, shared], vertices[:, shared + half], atol=0.3)


def test_bad_scans_get_one_line(files, tmp_path, capsys, head):
    scan, marks, points = files

    def told(*arguments):
        code, printed, err = run(capsys, *arguments, "--out", tmp_path / "o")
        assert code == 2 and printed == "" and err.count("\n") == 1 and not (tmp_path / "o").exists()
        return err

    assert "requires --face: the scan that they belong to" in told(
        "generate", "--landmarks", marks, "--end", "mouth_open"
    )
    assert "grin" in told("generate", "--face", scan, "--landmarks", marks, "--end", "grin")
    io.landmarks.write(tmp_path / "mirrored.json", points=points[[3, 2, 1, 0, 4, 6, 5]])
    assert "with the subject's left and right?" in told("register", scan, "--landmarks", tmp_path / "mirrored.json")
    io.landmarks.write(tmp_path / "five.json", points=points[:5])
    assert "unsupported number of landmarks: 5 (supported: 51, 66, 68, 83)" in told(
        "register", scan, "--landmarks", tmp_path / "five.json"
    )
    names = ["nose tip", "right lip corner", "chin", "left lip corner", "somewhere"]
    io.landmarks.write(tmp_path / "named.json", points=points[[4, 5, 0, 6, 1]], names=names)
    with pytest.raises(MeshError, match="do not form a face"):  # the corner of an eye is no chin
        scans.read(scan, tmp_path / "named.json")
    io.landmarks.write(tmp_path / "three.json", points=points[4:], names=["nose tip", *scans.SEVEN_LANDMARKS[5:]])
    with pytest.raises(LandmarkError, match="3 landmarks with known names, expected 4 or more"):
        scans.read(scan, tmp_path / "three.json")
    wrong = [*scans.SEVEN_LANDMARKS[:6], "left mouth corner"]
    io.landmarks.write(tmp_path / "wrong.json", points=points, names=wrong)
    assert "ignored landmarks with unknown names: left mouth corner" in scans.read(scan, tmp_path / "wrong.json").notes
    io.landmarks.write(tmp_path / "twice.json", points=points[:3], names=["nose tip", "nose tip", "chin"])
    with pytest.raises(LandmarkError, match="duplicate landmark name"):
        scans.read(scan, tmp_path / "twice.json")
    np.save(tmp_path / "bare.npy", head[1])
    assert "has no triangles; expected a mesh with faces" in told(
        "register", tmp_path / "bare.npy", "--landmarks", marks
    )


def test_what_there_is_to_say_of_a_fit(head):
    true, vertices, faces = head
    front = faces[vertices[faces].mean(axis=1)[:, 2] > np.quantile(vertices[:, 2], 0.6)]
    half = scan_of((true, vertices, front), registration.SEVEN)
    said = scans.describe(scans.measure(half, scans.fit(half)))
    assert "the rest of the head is extrapolated: the scan has no surface there" in said
    off = scan_of(head, registration.SEVEN)
    off = off._replace(landmarks=off.landmarks + np.where(np.arange(7) % 2, 1, -1)[:, None] * [0, 0, 8.0])
    assert any("are the landmarks of this face?" in note for note in scans.bind_scan(off)[1])


def test_the_experiment(tmp_path):
    config = registration.Config(out=tmp_path, heads=1, sizes=(1_000,), kinds=("damaged",))
    rows = registration.run(config)["rows"]
    assert [(row["kind"], row["landmarks"]) for row in rows] == [("damaged", 68), ("damaged", 7)]
    for row in rows:
        assert 0 < row["surface_mm"] < row["correspondence_mm"] < 3 and 0 < row["carried_mm"] < row["motion_mm"]
    assert (tmp_path / "registration.png").exists() and (tmp_path / "table.md").exists()
    with pytest.raises(ValueError, match="unknown kind 'torn'"):
        registration.run(registration.Config(out=tmp_path, kinds=("torn",)))
