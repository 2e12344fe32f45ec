"""Recordings as blocks: the layout of Seo and Luo's Fig. 3, cutting, padding, and what counts."""

import numpy as np
import pytest

from facejax.data import sequences
from facejax.landmarks import schemes


def made(lengths, landmarks=4, seed=0):
    rng = np.random.default_rng(seed)
    longest = max(lengths)
    curves = rng.normal(size=(len(lengths), longest, landmarks, 3)).astype(np.float32)
    curves[:, 0] = 0
    for curve, length in zip(curves, lengths, strict=True):
        curve[length:] = curve[length - 1]
    count = len(lengths)
    return sequences.Sequences(
        curves,
        np.array(lengths, np.int32),
        rng.normal(size=(count, landmarks, 3)).astype(np.float32),
        np.ones(count, np.int32),
        np.arange(count, dtype=np.int32),
        np.full(count, 200, np.float32),
    )


@pytest.mark.parametrize("landmarks", [4, 83])
def test_the_block_of_the_paper(landmarks):
    data = made([6, 9], landmarks)
    block = sequences.block(data, tail=2)
    assert block.inputs.shape == block.targets.shape == (2, 11, landmarks, 3)
    for k, length in enumerate(data.frames):
        steps = [data.curves[k, t + 1] - data.curves[k, t] for t in range(length - 1)]
        np.testing.assert_array_equal(block.inputs[k, 0], 0)
        for t, step in enumerate(steps):
            np.testing.assert_array_equal(block.inputs[k, t + 1], step)
            np.testing.assert_array_equal(block.targets[k, t], step)
        np.testing.assert_array_equal(block.targets[k, len(steps) :], 0)
        assert block.mask[k].sum() == len(steps) + 2 and block.mask[k, : len(steps) + 2].all()
    np.testing.assert_array_equal(block.inputs[:, 1:], block.targets[:, :-1])
    np.testing.assert_array_equal(block.targets[:, -1], 0)


def test_a_longer_sequence_is_cut_and_the_false_zero_does_not_count():
    data = made([6, 9])
    block = sequences.block(data, frames=7, tail=2)
    assert block.inputs.shape[1] == 7
    np.testing.assert_array_equal(block.targets[1, -1], 0)  # as in the paper, though the face went on
    np.testing.assert_array_equal(block.mask, [[True] * 7, [True] * 6 + [False]])
    assert sequences.block(data, frames=7, masked=False).mask.all()
    # One frame more, and the zero at the end is the truth.
    assert sequences.block(data, frames=9, tail=0).mask[1].sum() == 8


def test_a_block_with_room_is_padded():
    block = sequences.block(made([6, 9]), frames=20, tail=3)
    assert block.inputs.shape[1] == 20 and block.mask[1].sum() == 11
    np.testing.assert_array_equal(block.inputs[1, 9:], 0)


@pytest.mark.parametrize("options", [{"frames": 1}, {"tail": -1}])
def test_sizes_out_of_range(options):
    with pytest.raises(ValueError, match="frames of 2 or more"):
        sequences.block(made([6]), **options)


def test_recordings_of_a_dataset(tiny_store):
    data = sequences.read(tiny_store, "train", ["anger", "surprise"])
    assert len(data.frames) == 2 * 4 and data.curves.shape[1] == data.frames.max()
    assert set(data.label) == {tiny_store.labels.index("anger"), tiny_store.labels.index("surprise")}
    first = next(s for s in tiny_store.sequences if s.subject == data.subject[0] and s.label in ("anger", "surprise"))
    rest = tiny_store.neutral[first.subject][tiny_store.landmark_index]
    truth = tiny_store.landmarks[first.start : first.start + first.frames]
    np.testing.assert_allclose(rest + data.curves[0, : first.frames] * data.scale[0], truth, atol=1e-3)
    np.testing.assert_allclose(np.linalg.norm(data.neutral, axis=(1, 2)), 1, rtol=1e-5)
    np.testing.assert_allclose(data.neutral.mean(axis=1), 0, atol=1e-6)
    with pytest.raises(ValueError, match="no train recording of joy"):
        sequences.read(tiny_store, "train", ["anger", "joy"])


def turned(points, angle, shift):
    turn = np.array([[1, 0, 0], [0, np.cos(angle), -np.sin(angle)], [0, np.sin(angle), np.cos(angle)]])
    return points @ turn.T + shift


def test_head_motion_is_taken_out_and_nothing_else():
    data = made([5, 5], landmarks=6)
    # Two landmarks move in the head; the others stay.
    data.curves[..., :4, :] = 0
    placed = data.curves + data.neutral[:, None]
    nodding = np.stack([turned(placed[:, t], 0.05 * t, 0.02 * t) for t in range(5)], axis=1)
    moved = data._replace(curves=(nodding - data.neutral[:, None]).astype(np.float32))
    still = sequences.remove_head_motion(moved, stable=range(4))
    np.testing.assert_allclose(still.curves, data.curves, atol=1e-5)
    with pytest.raises(ValueError, match="unsupported number of landmarks: 6"):
        sequences.remove_head_motion(moved)


def test_extending_holds_the_last_frame():
    data = made([4, 6])
    longer = sequences.extend(data, 9).curves
    np.testing.assert_array_equal(longer[:, :6], data.curves)
    np.testing.assert_array_equal(longer[:, 6:], np.repeat(data.curves[:, 5:6], 3, axis=1))
    np.testing.assert_array_equal(sequences.extend(data, 3).curves, data.curves)


def test_a_mirror_swaps_the_sides_and_changes_nothing_else():
    data = made([5, 7], landmarks=68)
    other = sequences.mirror(data)
    mirror = schemes.by_count(68).mirror
    np.testing.assert_array_equal(other.curves[:, :, mirror], data.curves * [-1, 1, 1])
    for a, b in zip(sequences.mirror(other), data, strict=True):
        np.testing.assert_array_equal(a, b)
    with pytest.raises(ValueError, match="unsupported number of landmarks: 4"):
        sequences.mirror(made([5]))


def test_joined_recordings_have_the_longest_ones_room():
    both = sequences.join(made([4, 6]), made([9], seed=1))
    assert both.curves.shape == (3, 9, 4, 3) and both.frames.tolist() == [4, 6, 9]
    np.testing.assert_array_equal(both.curves[0, 6:], np.repeat(both.curves[0, 5:6], 3, axis=0))
