"""Selections of a dataset's meshes: whose they are, what they show, and that parts are parts."""

import numpy as np
import pytest

from facejax.data import dataset
from facejax.data.mesh_subset import of_split

SPLITS = ("train", "validation", "test")


def plain(data, at):
    """(subject, label, landmarks, vertices) of one stored mesh, from the sequences alone."""
    row = int(data.drawn[at])
    sequence = next(s for s in data.sequences if s.start <= row < s.start + s.frames)
    neutral = data.neutral[sequence.subject]
    marks = data.landmarks[row] - neutral[data.landmark_index]
    return sequence.subject, sequence.label, marks, data.vertices[at] - neutral


@pytest.mark.parametrize("splits", [("train",), ("validation", "train"), ("test", "train", "validation")])
def test_meshes_of_splits_are_those_of_the_plain_loop_in_stored_order(ball_store, splits):
    found = of_split(ball_store, *splits, size=10)
    wanted = [at for at in range(len(ball_store.vertices)) if split_of(ball_store, at) in splits]
    np.testing.assert_array_equal(found.indices, wanted)
    batches = list(found)
    assert [len(marks) for marks, _ in batches[:-1]] == [10] * (len(batches) - 1) and len(batches[-1][0]) <= 10
    marks, vertices = (np.concatenate(part) for part in zip(*batches, strict=True))
    subjects, labels, *moved = zip(*(plain(ball_store, at) for at in wanted), strict=True)
    np.testing.assert_array_equal(found.owner, subjects)
    np.testing.assert_array_equal(found.labels, labels)
    np.testing.assert_allclose(marks, moved[0], atol=1e-5)
    np.testing.assert_allclose(vertices, moved[1], atol=1e-5)
    np.testing.assert_array_equal(found.subjects, sorted(set(subjects)))
    assert found.count == len(wanted)


def split_of(data, at):
    return data.index["subjects"][plain(data, at)[0]]["split"]


def test_all_splits_are_all_meshes(ball_store):
    np.testing.assert_array_equal(of_split(ball_store, *SPLITS).indices, np.arange(len(ball_store.vertices)))
    assert sum(of_split(ball_store, split).count for split in SPLITS) == len(ball_store.vertices)


def test_a_person_has_a_face_and_all_of_its_meshes(ball_store):
    train = of_split(ball_store, "train")
    total = 0
    for subject in train.subjects:
        neutral, marks, vertices = train.person(subject)
        np.testing.assert_array_equal(neutral, ball_store.neutral[subject])
        mine = [i for i in range(train.count) if train.owner[i] == subject]
        for found, expected in zip((marks, vertices), train.read(np.array(mine)), strict=True):
            np.testing.assert_array_equal(found, expected)
        total += len(vertices)
    assert total == train.count
    few = train.rows(np.array([0, 2]))
    assert len(few.person(few.subjects[0])[1]) == np.sum(few.owner == few.subjects[0])


def test_rows_and_every_so_manieth(ball_store):
    train = of_split(ball_store, "train")
    at = np.array([3, 4, 11])
    for found, expected in zip(train.rows(at).read(np.array([2, 0])), train.read(np.array([11, 3])), strict=True):
        np.testing.assert_array_equal(found, expected)
    for step in (1, 3, 1000):
        np.testing.assert_array_equal(train.thin(step).indices, train.indices[::step])
        np.testing.assert_array_equal(train.thin(step).owner, train.owner[::step])
    assert train.rows(at).thin(2).count == 2 and train.size == train.thin(2).size


@pytest.mark.parametrize("count", [2, 3, 4])
@pytest.mark.parametrize("by", ["subjects", "labels"])
def test_folds_hold_out_each_mesh_once_and_nothing_alike_is_fitted(ball_store, by, count):
    train = of_split(ball_store, "train", size=9)
    folds = train.folds(count, by=by)
    assert len(folds) == count
    for fit_on, held_out in folds:
        of = [set((part.owner if by == "subjects" else part.labels).tolist()) for part in (fit_on, held_out)]
        assert of[1] and not of[0] & of[1]
        np.testing.assert_array_equal(np.sort(np.concatenate([fit_on.indices, held_out.indices])), train.indices)
        assert fit_on.size == held_out.size == 9
    np.testing.assert_array_equal(np.sort(np.concatenate([held_out.indices for _, held_out in folds])), train.indices)


def test_folds_are_by_subjects_unless_said_and_one_each_of_few(ball_store):
    train = of_split(ball_store, "train")
    found = [set(held_out.owner.tolist()) for _, held_out in train.folds(9)]
    assert found == [{0}, {2}, {4}, {5}]
    for (_, found), (_, expected) in zip(train.folds(2), train.folds(2, by="subjects"), strict=True):
        np.testing.assert_array_equal(found.indices, expected.indices)


def test_wrong_folds_and_splits_are_named(ball_store):
    train = of_split(ball_store, "train")
    with pytest.raises(ValueError, match="by: expected 'subjects' or 'labels', got 'people'"):
        train.folds(2, by="people")
    with pytest.raises(ValueError, match="2 or more folds and subjects, got 1 and 4"):
        train.folds(1)
    with pytest.raises(ValueError, match="2 or more folds and labels, got 3 and 1"):
        train.of_labels(["a"]).folds(3, by="labels")
    with pytest.raises(dataset.DatasetError, match="unknown split 'dev'"):
        of_split(ball_store, "train", "dev")
