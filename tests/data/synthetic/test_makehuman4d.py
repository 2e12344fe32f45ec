"""The dataset on disk, and the motions cut from it."""

import json

import numpy as np
import pytest

from facejax.data import dataset, motions
from facejax.data.synthetic import expression_recipes, makehuman, makehuman4d, performance, rig


def test_same_seed_same_bytes(tiny_spec, tiny_store, tmp_path):
    again = makehuman4d.prepare(tiny_spec, folder=tmp_path)
    for name in ("landmarks", "vertices", "neutral", "drawn"):
        assert (again.path / f"{name}.npy").read_bytes() == (tiny_store.path / f"{name}.npy").read_bytes()


def test_index_says_what_is_there(tiny_store, tiny_spec):
    assert [s["split"] for s in tiny_store.index["subjects"]] == ["train"] * 4 + ["validation", "test"]
    assert tiny_store.labels == expression_recipes.LABELS
    direct = [s for s in tiny_store.sequences if ">" in s.label]
    # The 39 pairs less the six that start or end at neutral, for validation and test alone.
    assert len(direct) == 2 * 33 and {s.subject for s in direct} == {4, 5}
    assert len(tiny_store.sequences) == 6 * 18 + len(direct)
    assert sum(s.frames for s in tiny_store.sequences) == len(tiny_store.landmarks)
    assert len(tiny_store.vertices) == tiny_spec.meshes


def test_frames_are_what_the_rig_poses(tiny_store, tiny_spec):
    sequence = tiny_store.sequences[20]
    person = makehuman.subject(sequence.subject)
    take = performance.perform(sequence.label, sequence.subject)
    posed = rig.pose(rig.build(person, level=tiny_spec.level), take.weights)
    stored = tiny_store.landmarks[sequence.start : sequence.start + sequence.frames]
    np.testing.assert_allclose(stored, posed[:, tiny_store.landmark_index], atol=1e-3)


def test_drawn_meshes_carry_their_landmarks(tiny_store):
    at, owner = tiny_store.meshes("train")
    assert set(owner) <= {0, 1, 2, 3} and len(at) > 10
    np.testing.assert_array_equal(
        tiny_store.vertices[at][:, tiny_store.landmark_index], tiny_store.landmarks[tiny_store.drawn[at]]
    )


def test_table_5_has_39_transitions_of_13_starts():
    assert len(makehuman4d.TABLE5_PAIRS) == 39 and len({a for a, _ in makehuman4d.TABLE5_PAIRS}) == 13
    assert all(a != b and {a, b} <= set(expression_recipes.LABELS) for a, b in makehuman4d.TABLE5_PAIRS)


def test_head_motion_is_rigid_and_leans_back(template):
    angle = np.array([[0.0, 0, 0], [0.2, 0.1, -0.05]], np.float32)
    moved = makehuman4d.rotate_head(np.stack([template.vertices] * 2), angle)
    np.testing.assert_allclose(moved[0], template.vertices, atol=1e-4)
    before = np.linalg.norm(template.vertices[:100] - template.vertices[100:200], axis=1)
    np.testing.assert_allclose(np.linalg.norm(moved[1, :100] - moved[1, 100:200], axis=1), before, atol=1e-3)
    tip = template.landmarks[30]
    back = makehuman4d.rotate_head(template.vertices[None], np.array([[0.2, 0, 0]]))[0]
    assert back[tip, 1] > template.vertices[tip, 1] and back[tip, 2] < template.vertices[tip, 2]


def test_halves_run_between_neutral_and_peak(tiny_store):
    found = motions.halves(tiny_store, "train")
    assert found.curves.shape == (4 * 18 * 2, 30, 68, 3)
    onset, offset = found.take(found.start == 0), found.take(found.end == 0)
    size = np.linalg.norm(onset.millimetres(), axis=-1).mean(axis=-1)
    assert np.all(size[:, 0] < 0.1) and np.all(size[:, -1] > 0.3)
    assert np.linalg.norm(offset.millimetres()[:, -1], axis=-1).mean() < 0.15


def test_interpolated_transitions_join_the_peaks(tiny_store):
    halves = motions.halves(tiny_store, "train")
    onsets = halves.take(halves.start == 0)
    found = motions.join(*motions.interpolated_transitions(onsets, 19, per_pair=3, reuse=1))
    assert len(found.curves) == 18 * 17 * 3
    first = found.take((found.start == 1) & (found.end == 2))
    ends = onsets.curves[onsets.end == 2][:, -1]
    nearest = np.abs(first.curves[:, -1][:, None] - ends[None]).max(axis=(2, 3)).min(axis=1)
    np.testing.assert_allclose(nearest, 0, atol=1e-5)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda path: (path / "index.json").unlink(), "index.json cannot be read"),
        (lambda path: (path / "landmarks.npy").write_bytes(b"x"), "landmarks.npy cannot be read"),
        (
            lambda path: np.save(path / "drawn.npy", np.zeros(3, np.int64)),
            r"drawn.npy has shape \(3,\), expected \(60,\)",
        ),
        (lambda path: (path / "index.json").write_text(json.dumps({"schema": 99})), "schema 99, expected 1"),
        (lambda path: (path / "index.json").write_text("[]"), "schema None, expected 1"),
    ],
)
def test_damaged_store_is_named(tiny_spec, tmp_path, damage, message):
    spec = tiny_spec._replace(subjects=3, level=0)
    path = makehuman4d.prepare(spec, folder=tmp_path).path
    damage(path)
    with pytest.raises(dataset.DatasetError, match=message):
        dataset.open_dataset(path)


def test_unknown_split_lists_the_known(tiny_store):
    with pytest.raises(dataset.DatasetError, match="train, validation, test"):
        tiny_store.subjects("dev")
