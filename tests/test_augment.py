"""Augmentation: transitions against full decoding, streaming, and selection against the full product."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jax.test_util import check_grads

from facejax import augment
from facejax.geometry import sphere, srvf


@pytest.fixture
def x64():
    with jax.enable_x64(True):
        yield


def onsets(seed, count, frames=7, landmarks=4):
    """Smooth neutral -> peak curves (count, frames, landmarks, 3)."""
    random = np.random.default_rng(seed)
    tau = np.linspace(0, 1, frames)[:, None, None]
    start, peak, bend = (
        random.normal(size=(3, count, 1, landmarks, 3)) * np.asarray([1, 0.5, 0.2])[:, None, None, None, None]
    )
    return jnp.asarray(start + tau**2 * (3 - 2 * tau) * peak + np.sin(3 * tau) * tau * bend)


def encoded(curves):
    q, log_length = srvf.encode(curves)
    return augment.Motions(q, log_length, curves[:, 0])


def row(motions, k):
    return [field[k] for field in motions]


def arguments(motions, i, j):
    (q1, l1, s1), (q2, l2, s2) = row(motions, i), row(motions, j)
    return q1, l1, q2, l2, s1, s2


def loop_transition(q1, l1, q2, l2, s1, s2, frames):
    """Equation 10, each point decoded in full and its last frame kept, in NumPy."""
    q1, q2, s1, s2 = (np.asarray(x) for x in (q1, q2, s1, s2))
    theta = np.arccos(np.clip(np.sum(q1 * q2) / len(q1), -1, 1))
    rows = []
    for tau in np.linspace(0, 1, frames):
        q = (np.sin((1 - tau) * theta) * q1 + np.sin(tau * theta) * q2) / np.sin(theta)
        curve = [(1 - tau) * s1 + tau * s2]
        for step in q:
            speed = np.sqrt(np.sum(step**2))
            curve.append(curve[-1] + np.exp((1 - tau) * l1 + tau * l2) / len(q) * speed * step)
        rows.append(curve[-1])
    return np.stack(rows)


def test_transition_against_full_decoding(x64):
    motions = encoded(onsets(0, 2))
    args = arguments(motions, 0, 1)
    expected = loop_transition(*args, frames=9)
    np.testing.assert_allclose(augment.transition(*args, frames=9), expected, atol=1e-12)
    single = [jnp.asarray(x, jnp.float32) for x in args]
    np.testing.assert_allclose(augment.transition(*single, frames=9), expected, atol=1e-5)


def test_transition_goes_from_peak_to_peak_and_backwards(x64):
    curves = onsets(1, 2)
    motions = encoded(curves)
    there = augment.transition(*arguments(motions, 0, 1), frames=9)
    np.testing.assert_allclose(there[0], curves[0, -1], atol=1e-13)
    np.testing.assert_allclose(there[-1], curves[1, -1], atol=1e-13)
    np.testing.assert_allclose(augment.transition(*arguments(motions, 1, 0), frames=9), there[::-1], atol=1e-13)


def test_transition_to_itself_stays_at_the_peak(x64):
    curves = onsets(2, 1)
    still = augment.transition(*arguments(encoded(curves), 0, 0), frames=5)
    np.testing.assert_allclose(still, jnp.broadcast_to(curves[0, -1], still.shape), atol=1e-13)


def test_transition_gradients(x64):
    motions = encoded(onsets(3, 2, frames=5, landmarks=2))
    weights = np.random.default_rng(0).normal(size=(4, 2, 3))

    def loss(*args):
        return jnp.sum(weights * augment.transition(*args, frames=4))

    near = {"order": 1, "modes": ("fwd", "rev"), "eps": 1e-6, "atol": 1e-5, "rtol": 1e-5}
    check_grads(loss, arguments(motions, 0, 1), **near)
    opposite = arguments(motions, 0, 0)
    opposite = (opposite[0], opposite[1], -opposite[0], *opposite[3:])
    for args in (arguments(motions, 0, 0), opposite):
        gradients = jax.grad(loss, argnums=tuple(range(6)))(*args)
        assert all(np.isfinite(gradient).all() for gradient in gradients)


def test_transition_is_the_same_under_jit_vmap_eagerly_and_batched():
    motions = encoded(onsets(4, 6))
    first, second = (jax.tree.map(lambda x, k=k: x[k : k + 3], motions) for k in (0, 3))
    args = first.q, first.log_length, second.q, second.log_length, first.start, second.start
    batched = augment.transition(*args, frames=5)
    assert batched.shape == (3, 5, 4, 3)
    mapped = jax.vmap(lambda *one: augment.transition(*one, frames=5))(*args)
    np.testing.assert_allclose(batched, mapped, atol=1e-6)
    with jax.disable_jit():
        np.testing.assert_allclose(batched, augment.transition(*args, frames=5), atol=1e-6)


@pytest.mark.parametrize("chunk", [1, 3, 4, 100])
def test_transitions_stream_all_pairs_in_order(chunk):
    motions = encoded(onsets(5, 5))
    pairs = np.random.default_rng(1).integers(0, 5, (8, 2))
    parts = list(augment.transitions(motions, pairs, frames=6, chunk=chunk))
    assert [len(part) for part in parts[:-1]] == [chunk] * (len(parts) - 1)
    expected = [augment.transition(*arguments(motions, i, j), frames=6) for i, j in pairs]
    np.testing.assert_allclose(np.concatenate(parts), np.stack(expected), atol=1e-6)


def test_transitions_of_no_pairs_and_one_compilation_for_a_short_last_chunk():
    motions = encoded(onsets(6, 3))
    assert list(augment.transitions(motions, np.zeros((0, 2), int), frames=6)) == []
    augment._chunk.clear_cache()
    list(augment.transitions(motions, np.zeros((7, 2), int), frames=6, chunk=3))
    assert augment._chunk._cache_size() == 1


@pytest.mark.parametrize(
    ("pairs", "options", "match"),
    [
        ([[0, 3]], {}, r"indices in \[0, 3\), got 0 to 3"),
        ([[-1, 0]], {}, "got -1 to 0"),
        ([[0.0, 1.0]], {}, r"integers \(P, 2\), got float64"),
        ([0, 1], {}, r"\(P, 2\)"),
        ([[0, 1]], {"chunk": 0}, "chunk: expected at least 1"),
    ],
)
def test_transitions_name_wrong_pairs_before_any_work(pairs, options, match):
    with pytest.raises(ValueError, match=match):
        augment.transitions(encoded(onsets(7, 3)), np.asarray(pairs), **options)


def test_apex_and_halves_share_the_peak():
    random = np.random.default_rng(8)
    curve = random.normal(size=(4, 3)) + np.linspace(0, 1, 7)[:, None, None] ** 2 * random.normal(size=(4, 3))
    sequence = np.concatenate([curve, curve[-2::-1]])
    assert augment.apex(sequence) == 6
    rise, fall = augment.split_at_peak(sequence, 6, frames=7)
    np.testing.assert_allclose(rise, curve, atol=1e-6)
    np.testing.assert_allclose(fall, curve[::-1], atol=1e-6)
    rise, fall = augment.split_at_peak(np.stack([sequence, sequence]), np.asarray([6, 12]), frames=30)
    np.testing.assert_array_equal(rise[:, -1], sequence[[6, 12]].astype(np.float32))
    np.testing.assert_array_equal(fall[:, 0], rise[:, -1])
    np.testing.assert_array_equal(fall[1], np.broadcast_to(fall[1, 0], fall[1].shape))


def test_prototypes_against_a_loop():
    random = np.random.default_rng(2)
    peaks, labels = random.normal(size=(9, 4, 3)), np.asarray([0, 1, 2, 0, 1, 2, 2, 2, 0])
    expected = [sum(p for p, k in zip(peaks, labels, strict=True) if k == c) / np.sum(labels == c) for c in range(3)]
    np.testing.assert_allclose(augment.prototypes(peaks, labels, classes=3), expected, atol=1e-15)


def loop_select(peaks, labels, prototypes, per_pair, reuse):
    """Every pair formed and sorted, then taken nearest first."""
    squared = [np.sum((p - prototypes[k]) ** 2) for p, k in zip(peaks, labels, strict=True)]
    pairs, distances = [], []
    for a in range(len(prototypes)):
        for b in range(len(prototypes)):
            rows = [
                (squared[i] + squared[j], i, j)
                for i in range(len(peaks))
                for j in range(len(peaks))
                if a != b and labels[i] == a and labels[j] == b
            ]
            starts, ends, taken = {}, {}, 0
            for total, i, j in sorted(rows):
                free = reuse is None or (starts.get(i, 0) < reuse and ends.get(j, 0) < reuse)
                if free and taken < per_pair:
                    starts[i], ends[j], taken = starts.get(i, 0) + 1, ends.get(j, 0) + 1, taken + 1
                    pairs.append((i, j))
                    distances.append(np.sqrt(total))
    return pairs, distances


@settings(max_examples=150, deadline=None)
@given(
    seed=st.integers(0, 2**20),
    count=st.integers(0, 20),
    classes=st.integers(1, 4),
    per_pair=st.integers(1, 25),
    reuse=st.none() | st.integers(1, 6),
)
def test_select_against_the_full_product(seed, count, classes, per_pair, reuse):
    random = np.random.default_rng(seed)
    peaks, prototypes = random.normal(size=(count, 2, 3)), random.normal(size=(classes, 2, 3))
    labels = random.integers(0, classes, count)
    chosen = augment.select(peaks, labels, prototypes, per_pair=per_pair, reuse=reuse)
    pairs, distances = loop_select(peaks, labels, prototypes, per_pair, reuse)
    assert chosen.pairs.tolist() == [list(pair) for pair in pairs]
    np.testing.assert_allclose(chosen.distance, distances, rtol=1e-12)


def test_select_does_not_form_all_pairs():
    first, second = augment._candidates(100_000, 100_000, 40, None)
    assert len(first) < 200 and np.all((first + 1) * (second + 1) <= 40)
    assert len(augment._candidates(100_000, 100_000, 40, 3)[0]) <= 40 + 9


def test_select_on_ties_gives_the_lower_indices():
    chosen = augment.select(np.zeros((6, 2, 3)), np.asarray([1, 1, 0, 0, 0, 1]), np.zeros((2, 2, 3)), per_pair=2)
    assert chosen.pairs.tolist() == [[2, 0], [2, 1], [0, 2], [0, 3]]


@pytest.mark.parametrize(
    ("call", "match"),
    [
        (lambda p, k: augment.prototypes(p, k, classes=3), r"every class at least once, got none of classes \[2\]"),
        (lambda p, k: augment.prototypes(p, k, classes=1), r"\[0, 1\), got 0 to 1"),
        (lambda p, k: augment.prototypes(p, k[:1], classes=2), r"integers \(2,\)"),
        (lambda p, k: augment.prototypes(p[0], k, classes=2), r"peaks: expected \(K, L, 3\)"),
        (lambda p, k: augment.select(p, k, p, per_pair=0), "at least 1, got 0"),
        (lambda p, k: augment.select(p, k, p, per_pair=1, reuse=0), "got 1 and 0"),
        (lambda p, k: augment.select(p, k, p[:, :3], per_pair=1), "prototypes: expected"),
        (lambda p, k: augment.apex(p[0]), "T, L, 3"),
        (lambda p, k: augment.split_at_peak(p, 1, frames=1), "at least 2, got 1"),
        (lambda p, k: augment.transition(p, 0.0, p, 0.0, p[0], p[0], frames=1), "at least 2, got 1"),
        (lambda p, k: augment.transition(p, 0.0, p, 0.0, p[0], p[0, :2]), "start2: expected"),
    ],
)
def test_wrong_input_is_named(call, match):
    with pytest.raises(ValueError, match=match):
        call(np.ones((2, 4, 3), np.float32), np.asarray([0, 1]))


def test_the_path_is_a_geodesic_of_motions():
    motions = encoded(onsets(9, 2))
    q1, l1, q2, l2, s1, s2 = arguments(motions, 0, 1)
    halfway = srvf.decode(sphere.geodesic(q1, q2, 0.5), (l1 + l2) / 2, (s1 + s2) / 2)[-1]
    np.testing.assert_allclose(augment.transition(q1, l1, q2, l2, s1, s2, frames=3)[1], halfway, atol=1e-6)


def test_tau_walks_the_geodesic_and_the_performed_pace_is_the_share_covered():
    motions = encoded(onsets(6, 4))
    args = arguments(motions, 0, 1)
    even = augment.transition(*args, frames=9)
    np.testing.assert_allclose(augment.transition(*args, jnp.linspace(0, 1, 9), frames=9), even, atol=1e-6)
    back = augment.transition(*args, jnp.linspace(1, 0, 9), frames=9)
    np.testing.assert_allclose(back, even[::-1], atol=1e-6)
    pairs = np.array([[0, 1], [2, 3], [1, 0]])
    (found,) = augment.transitions(motions, pairs, frames=7, time_warp="performed")
    for (i, j), one in zip(pairs, found, strict=True):
        steps = np.linalg.norm(np.asarray(motions.q[j]).reshape(6, -1), axis=1) ** 2
        share = np.concatenate([[0], np.cumsum(steps) / steps.sum()])
        wanted = augment.transition(*arguments(motions, i, j), jnp.asarray(share), frames=7)
        np.testing.assert_allclose(one, wanted, atol=1e-5)
    with pytest.raises(ValueError, match="time_warp: expected one of"):
        augment.transitions(motions, pairs, time_warp="slow")
    with pytest.raises(ValueError, match=r"tau: expected \(..., 9\)"):
        augment.transition(*args, jnp.zeros(5), frames=9)


def test_another_number_of_frames_takes_the_performed_pace_between_its_frames():
    motions = encoded(onsets(6, 2))
    (found,) = augment.transitions(motions, np.array([[0, 1]]), frames=10, time_warp="performed")
    share = np.interp(np.linspace(0, 6, 10), np.arange(7), srvf.arc_length_fraction(motions.q[1]))
    wanted = augment.transition(*arguments(motions, 0, 1), jnp.asarray(share, jnp.float32), frames=10)
    np.testing.assert_allclose(found[0], wanted, atol=1e-5)


@pytest.mark.parametrize("sizes", [(4, 4, 4), (4, 6, 3)], ids=str)
@pytest.mark.parametrize("per_pair", [1, 4, 12, None], ids=str)
def test_spread_lets_everybody_serve_equally_often(sizes, per_pair):
    labels = np.random.default_rng(0).permutation(np.repeat(np.arange(3), sizes))
    pairs = augment.balanced_pairs(labels, classes=3, per_pair=per_pair)
    assert len({tuple(pair) for pair in pairs.tolist()}) == len(pairs)
    for a, b in ((a, b) for a in range(3) for b in range(3) if a != b):
        mine = pairs[(labels[pairs[:, 0]] == a) & (labels[pairs[:, 1]] == b)]
        total = sizes[a] * sizes[b]
        assert len(mine) == (total if per_pair is None else min(per_pair, total))
        for column, label in ((0, a), (1, b)):
            served = np.bincount(mine[:, column], minlength=len(labels))[labels == label]
            assert served.max() - served.min() <= 1
    with pytest.raises(ValueError, match="per_pair: expected at least 1"):
        augment.balanced_pairs(labels, classes=3, per_pair=0)


def test_one_of_each_is_held_out():
    start, end = np.array([0, 0, 1, 1, 1, 2]), np.array([1, 1, 0, 2, 0, 1])
    mask = augment.sample_per_pair(start, end)
    assert sorted(zip(start[mask].tolist(), end[mask].tolist(), strict=True)) == [(0, 1), (1, 0), (1, 2), (2, 1)]
    assert len({augment.sample_per_pair(start, end, seed=seed).tobytes() for seed in range(20)}) > 1
    with pytest.raises(ValueError, match="start, end: expected two"):
        augment.sample_per_pair(start, end[:3])
