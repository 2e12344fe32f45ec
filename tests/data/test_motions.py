"""Motions cut from recordings and made between them: marks, seconds, labels, who meets whom, and at what pace."""

from pathlib import Path

import numpy as np
import pytest

from facejax import augment
from facejax.data import dataset, motions

RATE = 30


def rise(t):
    return np.clip(t, 0, 1) ** 2 * (3 - 2 * np.clip(t, 0, 1))


def recorded(subjects=3, labels=("neutral", "a", "b", "c"), *, bend=0.3, direct=(), split="train"):
    """A made-up dataset: every subject performs every expression once, on four of six vertices.

    Sequences differ in length; `direct` are (start, end) that follow without neutral between. With bend 0 paths are
    straight.
    """
    rng = np.random.default_rng(0)
    neutral = 100 * rng.normal(size=(subjects, 6, 3))
    index = np.array([5, 0, 3, 1])
    kinds = 10 * rng.normal(size=(len(labels), 4, 3))
    peaks = {(s, k): kinds[k] + 2 * rng.normal(size=(4, 3)) for s in range(subjects) for k in range(1, len(labels))}
    sequences, rows, begin = [], [], 0
    for subject in range(subjects):
        for what in (*range(1, len(labels)), *direct):
            start, end = what if isinstance(what, tuple) else (0, what)
            onset, up, hold, down = 3, 7 + subject, 4, 9 - end % 3
            marks = np.cumsum([onset, up, hold, down])
            frames = int(marks[-1]) + 3
            t = np.arange(frames)
            up, down = rise((t - marks[0]) / up), rise((t - marks[2]) / down)
            first, second = peaks.get((subject, start), np.zeros((4, 3))), peaks[subject, end]
            weight = up if start else up - down
            curve = first + weight[:, None, None] * (second - first)
            curve = curve + bend * (weight * (1 - weight))[:, None, None] * second[:, ::-1]
            name = f"{labels[start]}>{labels[end]}" if start else labels[end]
            sequences.append(dataset.Sequence(subject, name, begin, frames, *marks.tolist(), frames / RATE))
            rows.append(neutral[subject, index] + curve)
            begin += frames
    return dataset.Dataset(
        Path("made-up"),
        {"labels": list(labels), "rate": RATE, "subjects": [{"split": split}] * subjects},
        tuple(sequences),
        np.zeros((0, 3), np.int32),
        neutral.astype(np.float32),
        np.concatenate(rows).astype(np.float32),
        np.zeros((0, 6, 3), np.float32),
        np.zeros(0, np.int64),
        index,
    )


@pytest.fixture(scope="module")
def data():
    return recorded()


@pytest.fixture(scope="module")
def onsets(data):
    halves = motions.halves(data, "train", frames=6)
    return halves.take(halves.start == 0)


def loop_cut(data, sequence, first, last, frames):
    """Frames evenly spaced from `first` to `last`, as displacements from neutral in millimetres."""
    rows = []
    for place in np.linspace(first, last, frames):
        low = min(int(place), sequence.frames - 2)
        a, b = data.landmarks[sequence.start + low].astype(float), data.landmarks[sequence.start + low + 1]
        rows.append(a + (place - low) * (b - a) - data.neutral[sequence.subject][data.landmark_index])
    return np.stack(rows)


def test_halves_are_cut_at_the_marks_and_counted_in_seconds(data):
    found = motions.halves(data, "train", frames=6)
    assert found.curves.shape == (3 * 3 * 2, 6, 4, 3)
    for k, sequence in enumerate(data.sequences):
        label = data.labels.index(sequence.label)
        rest = data.neutral[sequence.subject][data.landmark_index]
        norm = np.linalg.norm(rest - rest.mean(axis=0))
        up, down = (sequence.onset, sequence.apex_start), (sequence.apex_end, sequence.offset)
        for row, (first, last), pair in ((2 * k, up, (0, label)), (2 * k + 1, down, (label, 0))):
            curve = loop_cut(data, sequence, first, last, 6)
            np.testing.assert_allclose(found.millimetres()[row], curve, atol=1e-3)
            np.testing.assert_allclose(found.curves[row], curve / norm, atol=1e-5)
            assert (found.start[row], found.end[row], found.subject[row]) == (*pair, sequence.subject)
            assert found.scale[row] == pytest.approx(norm, rel=1e-6)
            assert found.seconds[row] == pytest.approx((last - first) / RATE, rel=1e-6)


def pace_of(curves):
    steps = np.linalg.norm(np.diff(curves, axis=1).reshape(*curves[:, 1:].shape[:2], -1), axis=-1)
    return steps / steps.mean(axis=1, keepdims=True)


def test_along_the_arc_the_pace_is_even_and_the_ends_are_the_same():
    straight, bent = (recorded(bend=bend) for bend in (0, 0.5))
    even, timed = (motions.halves(straight, "train", frames=6, by=by) for by in ("arc", "time"))
    np.testing.assert_allclose(pace_of(even.curves), 1, atol=1e-3)
    assert np.ptp(pace_of(timed.curves), axis=1).min() > 0.5
    np.testing.assert_allclose(even.curves[:, [0, -1]], timed.curves[:, [0, -1]], atol=1e-6)
    # Chords of a bend are shorter than its arcs.
    assert np.abs(pace_of(motions.halves(bent, "train", frames=6, by="arc").curves) - 1).max() < 0.1


def test_a_recording_that_stands_still_has_finite_halves(data):
    still = data._replace(landmarks=np.repeat(data.neutral[:1, data.landmark_index], len(data.landmarks), axis=0))
    still = still._replace(neutral=np.repeat(data.neutral[:1], 3, axis=0))
    for by in ("time", "arc"):
        np.testing.assert_array_equal(motions.halves(still, "train", by=by).curves, 0)


def test_names_choose_and_number_the_labels(data):
    found, whole = (
        motions.halves(data, "train", frames=6, label_names=("neutral", "c", "a")),
        motions.halves(data, "train"),
    )
    assert found.curves.shape == (3 * 2 * 2, 6, 4, 3)
    wanted = [{1: 2, 3: 1}[x] for x in whole.end.tolist() if x in (1, 3)]
    assert found.end[found.end > 0].tolist() == wanted
    assert found.start[found.end == 0].tolist() == wanted


def test_direct_transitions_are_kept_apart():
    data = recorded(direct=((1, 2), (3, 1)))
    found = motions.direct_transitions(data, "train", frames=6)
    assert [*zip(found.start.tolist(), found.end.tolist(), strict=True)] == [(1, 2), (3, 1)] * 3
    sequence = next(one for one in data.sequences if one.label == "a>b")
    curve = loop_cut(data, sequence, 0, sequence.frames - 1, 6)
    np.testing.assert_allclose(found.millimetres()[0], curve, atol=1e-3)
    assert found.seconds[0] == pytest.approx((sequence.frames - 1) / RATE)
    assert len(motions.halves(data, "train").start) == 3 * 3 * 2


def between(onsets, **options):
    return motions.join(*motions.interpolated_transitions(onsets, 4, frames=6, **options))


def rows_of(onsets, found):
    """Which onsets gave the start and the end of each transition, told by their peaks."""
    peaks = onsets.curves[:, -1].reshape(len(onsets.start), -1)
    tables = [np.abs(found.curves[:, at].reshape(len(found.start), 1, -1) - peaks).max(axis=-1) for at in (0, -1)]
    assert max(table.min(axis=1).max() for table in tables) < 1e-5
    return [table.argmin(axis=1) for table in tables]


def test_transitions_go_from_peak_to_peak_with_the_starts_person_and_the_ends_time(onsets):
    found = between(onsets, per_pair=None)
    first, second = rows_of(onsets, found)
    assert len({*zip(first.tolist(), second.tolist(), strict=True)}) == len(found.start) == 6 * 9
    np.testing.assert_array_equal(found.start, onsets.end[first])
    np.testing.assert_array_equal(found.end, onsets.end[second])
    np.testing.assert_array_equal(found.subject, onsets.subject[first])
    np.testing.assert_array_equal(found.scale, onsets.scale[first])
    np.testing.assert_array_equal(found.seconds, onsets.seconds[second])


def test_both_choices_are_those_of_the_selection(onsets):
    labels, peaks = onsets.end - 1, onsets.curves[:, -1]
    prototypes = augment.prototypes(peaks, labels, classes=3)
    nearest = augment.select(peaks, labels, prototypes, per_pair=2, reuse=1).pairs
    evenly = augment.balanced_pairs(labels, classes=3, per_pair=2, seed=5)
    for wanted, options in ((nearest, {"reuse": 1}), (evenly, {"choice": "spread", "seed": 5})):
        np.testing.assert_array_equal(np.stack(rows_of(onsets, between(onsets, per_pair=2, **options)), 1), wanted)


def test_time_warp_changes_the_way_and_not_the_ends(onsets):
    even, performed = (between(onsets, per_pair=1, time_warp=time_warp) for time_warp in ("even", "performed"))
    np.testing.assert_allclose(performed.curves[:, [0, -1]], even.curves[:, [0, -1]], atol=1e-5)
    # The onset is slow: what is performed moves less at first.
    first = [pace_of(found.curves)[:, 0] for found in (performed, even)]
    assert np.all(first[0] < 0.75 * first[1])


def test_only_what_is_wanted_and_in_parts_of_any_size(onsets):
    wanted = {(1, 3), (3, 2)}
    whole = between(onsets, per_pair=2)
    mask = np.array([pair in wanted for pair in zip(whole.start.tolist(), whole.end.tolist(), strict=True)])
    some = [*motions.interpolated_transitions(onsets, 4, per_pair=2, pairs=wanted, frames=6, chunk=3)]
    assert [len(part.start) for part in some] == [3, 1]
    for a, b in zip(motions.join(*some), whole.take(mask), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6)
    assert [*motions.interpolated_transitions(onsets, 4, per_pair=2, pairs=(), frames=6)] == []


@pytest.mark.parametrize(
    ("call", "match"),
    [
        (lambda data, onsets: motions.halves(data, "train", by="length"), 'by: expected "time" or "arc"'),
        (lambda data, onsets: motions.halves(data, "test"), "no such motions in this split"),
        (lambda data, onsets: motions.direct_transitions(data, "train"), "no such motions in this split"),
        (lambda data, onsets: motions.halves(data, "all"), "unknown split 'all'"),
        (lambda data, onsets: between(onsets, per_pair=1, choice="all"), 'choice: expected "prototypes" or "spread"'),
        (lambda data, onsets: between(onsets, per_pair=1, time_warp="slow"), "time_warp: expected one of"),
        (lambda data, onsets: between(onsets, per_pair=0, choice="spread"), "per_pair: expected at least 1, got 0"),
        (lambda data, onsets: between(onsets, per_pair=0), "per_pair, reuse: expected at least 1, got 0"),
        (lambda data, onsets: motions.interpolated_transitions(onsets, 5, per_pair=1), "every class at least once"),
    ],
)
def test_wrong_input_is_named(data, onsets, call, match):
    with pytest.raises(ValueError, match=match):
        call(data, onsets)
