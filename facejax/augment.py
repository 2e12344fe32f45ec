"""Synthesis of peak-to-peak transitions from recorded neutral-to-peak motions, and their selection.

A recorded sequence goes neutral -> peak -> neutral; a generator of transitions between any two expressions
also needs peak -> peak. Otberdout et al. 2023, section 4.1: follow the geodesic between the SRVFs of two
neutral-to-peak motions; every point on it is a motion, and their last frames, in order, are a transition from
the first peak to the second. Of the hundreds of thousands of pairs, those nearest to the mean peaks of their
two expressions ("prototypes") are kept.

The paper follows the geodesic at constant speed, so that its transitions start and stop abruptly. Here the speed may
also be that of the second recorded motion, which has an onset.

`split_at_peak`, `transition` and `transitions` are array functions. `prototypes`, `select`, `balanced_pairs` and
`sample_per_pair` choose data once, on the host, in NumPy: the number of rows that they return depends on the labels. In
signatures `_` is a size that the function compares itself, for a message of its own.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Float64, Int32, Integer, Real

from facejax.geometry import align, sphere, srvf
from facejax.geometry.precision import HIGHEST
from facejax.geometry.sphere import AnyArray

TIME_WARPS = ("even", "performed")


class Motions(NamedTuple):
    """K motions, encoded by `facejax.geometry.srvf.encode`, with their first frames."""

    q: Float[AnyArray, "K S L 3"]  # on the unit sphere; S = T-1
    log_length: Float[AnyArray, " K"]
    start: Float[AnyArray, "K L 3"]


class Selection(NamedTuple):
    """P pairs of motions: transition k goes from the peak of pairs[k, 0] to the peak of pairs[k, 1]."""

    pairs: Int32[np.ndarray, "P 2"]  # ordered by class of start, class of end, distance
    distance: Float64[np.ndarray, " P"]  # of (start, end) to the two prototypes, in the unit of the landmarks


@jax.jit
def apex(curve: Float[AnyArray, "... L 3"]) -> Integer[Array, " ..."]:
    """Return the frame (...) of a curve (..., T, L, 3) farthest from its first one, over all landmarks."""
    _check_curve(curve)
    away = jnp.sum((curve - curve[..., :1, :, :]) ** 2, axis=(-2, -1))
    return jnp.argmax(away, axis=-1)


@jax.jit(static_argnames=("frames",))
def split_at_peak(
    curve: Float[AnyArray, "*#lead T L 3"], peak: Integer[ArrayLike, "*#lead"], *, frames: int = 30
) -> tuple[Float[Array, "*lead {frames} L 3"], Float[Array, "*lead {frames} L 3"]]:
    """Cut a curve (..., T, L, 3) at the frame `peak` (...) into onset and offset, each (..., frames, L, 3).

    Both contain the peak; time is resampled evenly within each half. Raises `ValueError` for fewer than 2 frames.
    """
    _check_curve(curve)
    if frames < 2:
        raise ValueError(f"frames: expected at least 2, got {frames}")
    tau = jnp.linspace(0, 1, frames, dtype=curve.dtype)
    peak = jnp.asarray(peak, curve.dtype)[..., None]
    rest = curve.shape[-3] - 1 - peak
    return align.interpolate(curve, tau * peak), align.interpolate(curve, peak + tau * rest)


@jax.jit(static_argnames=("frames",))
def transition(
    q1: Float[AnyArray, "*#lead S L 3"],
    log_length1: Real[ArrayLike, "*#lead"],
    q2: Float[AnyArray, "*#lead S L 3"],
    log_length2: Real[ArrayLike, "*#lead"],
    start1: Float[AnyArray, "*#lead _ 3"],
    start2: Float[AnyArray, "*#lead _ 3"],
    tau: Float[AnyArray, "*#lead _"] | None = None,
    *,
    frames: int = 30,
) -> Float[Array, "*lead {frames} L 3"]:
    """Return landmarks (..., frames, L, 3) from the last frame of motion 1 to the last frame of motion 2.

    q1, q2 are (..., T-1, L, 3) on the unit sphere, log lengths (...), starts (..., L, 3). A frame is the last frame
    of the motion at a fraction tau in [0, 1] of the geodesic (eq. 10), its log-length and start interpolated
    linearly. `tau` (..., frames) gives the fractions; without it they are even, as in the paper.
    """
    # The last frame of a decoded motion is start + length / (T-1) * sum_t q_t |q_t|: the frames between are
    # not needed. On the geodesic q = a p + b w, with p = q1, w = log(q1, q2), a = cos(tau theta) and
    # b = sin(tau theta) / theta, |q_t|^2 = a^2 |p_t|^2 + 2ab <p_t, w_t> + b^2 |w_t|^2: three numbers per step
    # serve all values of tau, and the sum over t is one product of (frames, 2(T-1)) by (2(T-1), 3L).
    # Decoding each point of the geodesic in full takes 1,000 us a pair, this 70 (2 cores, chunks of 128).
    if frames < 2:
        raise ValueError(f"frames: expected at least 2, got {frames}")
    for name, start in (("start1", start1), ("start2", start2)):
        if jnp.shape(start)[-2:] != q1.shape[-2:]:
            raise ValueError(f"{name}: expected (..., {q1.shape[-2]}, 3), got shape {jnp.shape(start)}")
    w = sphere.log(q1, q2)
    theta = sphere.norm(w)
    tau = jnp.linspace(0, 1, frames, dtype=w.dtype) if tau is None else jnp.asarray(tau, w.dtype)
    if tau.shape[-1] != frames:
        raise ValueError(f"tau: expected (..., {frames}), one fraction per frame, got shape {tau.shape}")
    angle = theta[..., None] * tau
    a, b = jnp.cos(angle)[..., None], (tau * jnp.sinc(angle / jnp.pi))[..., None]
    flat = [jnp.reshape(x, (*x.shape[:-2], 3 * x.shape[-2])) for x in (q1, w)]  # a CPU is slow at rows of three
    pp, pw, ww = (jnp.sum(x * y, axis=-1)[..., None, :] for x, y in ((flat[0],) * 2, flat, (flat[1],) * 2))
    # Rounding may leave the square of a step that cancels just below 0; the root takes it as 0.
    pace = sphere.safe_sqrt(a**2 * pp + 2 * a * b * pw + b**2 * ww)
    moves = sum(
        jnp.einsum("...ft,...td->...fd", part * pace, x, precision=HIGHEST)
        for part, x in zip((a, b), flat, strict=True)
    )
    moves = jnp.asarray(moves)
    moves = moves.reshape(*moves.shape[:-1], *q1.shape[-2:])
    log_length = _between(tau, jnp.asarray(log_length1)[..., None], jnp.asarray(log_length2)[..., None])
    start = _between(tau[..., None, None], start1[..., None, :, :], start2[..., None, :, :])
    return start + (jnp.exp(log_length) / q1.shape[-3])[..., None, None] * moves


def transitions(
    motions: Motions, pairs: np.ndarray, *, frames: int = 30, time_warp: str = "even", chunk: int = 128
) -> Iterator[Float[Array, "n {frames} L 3"]]:
    """Yield the transitions (n, frames, L, 3) of the index pairs (P, 2), n <= chunk at a time, in order.

    `time_warp`: "even" in time, or "performed": the fraction of the geodesic at a frame is the fraction of its arc
    length that the second motion has covered by then. Memory does not grow with P. The last chunk is padded internally,
    so that all share one compilation. Raises `ValueError` on an unknown time warp or a malformed or out-of-range pair,
    before anything is computed.
    """
    pairs = np.asarray(pairs)
    count = len(motions.q)
    if pairs.ndim != 2 or pairs.shape[1] != 2 or not np.issubdtype(pairs.dtype, np.integer):
        raise ValueError(f"pairs: expected integers (P, 2), got {pairs.dtype} {pairs.shape}")
    if chunk < 1:
        raise ValueError(f"chunk: expected at least 1, got {chunk}")
    if time_warp not in TIME_WARPS:
        raise ValueError(f"time_warp: expected one of {TIME_WARPS}, got {time_warp!r}")
    if pairs.size and not (pairs.min() >= 0 and pairs.max() < count):
        raise ValueError(f"pairs: expected indices in [0, {count}), got {pairs.min()} to {pairs.max()}")
    return _stream(motions, pairs, frames, time_warp, min(chunk, max(len(pairs), 1)))


def prototypes(
    peaks: Real[AnyArray, "... L 3"], labels: Integer[AnyArray, " _"], *, classes: int
) -> Float64[np.ndarray, "{classes} L 3"]:
    """Return the mean peak (classes, L, 3) of each class, from peaks (K, L, 3) and labels (K,) in [0, classes).

    Raises `ValueError` where a class has no peak, and for labels out of range.
    """
    peaks, labels = _labelled(peaks, labels, classes)
    counts = np.bincount(labels, minlength=classes)
    if not counts.all():
        raise ValueError(
            f"labels: expected every class at least once, got none of classes {np.flatnonzero(counts == 0)}"
        )
    sums = np.zeros((classes, *peaks.shape[1:]))
    np.add.at(sums, labels, peaks)
    return sums / counts[:, None, None]


def select(
    peaks: Real[AnyArray, "... L 3"],
    labels: Integer[AnyArray, " _"],
    prototypes: Real[AnyArray, "C _ 3"],
    *,
    per_pair: int,
    reuse: int | None = None,
) -> Selection:
    """Select for each ordered pair of different classes the `per_pair` transitions nearest to the two prototypes.

    peaks are (K, L, 3), labels (K,), prototypes (classes, L, 3). The distance of a transition is the L2 norm
    of (start, end) - (prototype of start, prototype of end). With `reuse`, transitions are taken nearest
    first, each start and each end at most `reuse` times per pair: a few peaks close to their prototype would
    otherwise dominate the selection. Pairs with fewer transitions give all of them; a class may be absent.
    Ties go to the lower indices.
    """
    prototypes = np.asarray(prototypes, np.float64)
    peaks, labels = _labelled(peaks, labels, len(prototypes))
    if per_pair < 1 or (reuse is not None and reuse < 1):
        raise ValueError(f"per_pair, reuse: expected at least 1, got {per_pair} and {reuse}")
    if prototypes.shape[1:] != peaks.shape[1:]:
        raise ValueError(f"prototypes: expected (classes, *{peaks.shape[1:]}), got {prototypes.shape}")
    squared = np.sum((peaks - prototypes[labels]) ** 2, axis=(1, 2))
    members = [np.flatnonzero(labels == label) for label in range(len(prototypes))]
    members = [rows[np.argsort(squared[rows], kind="stable")] for rows in members]
    pairs, distances = [np.zeros((0, 2), np.int32)], [np.zeros(0)]
    for a, b in ((a, b) for a in range(len(members)) for b in range(len(members)) if a != b):
        first, second = _candidates(len(members[a]), len(members[b]), per_pair, reuse)
        first, second = members[a][first], members[b][second]
        total = squared[first] + squared[second]
        nearest = np.lexsort((second, first, total))[:per_pair]
        pairs.append(np.stack([first[nearest], second[nearest]], axis=1).astype(np.int32))
        distances.append(np.sqrt(total[nearest]))
    return Selection(np.concatenate(pairs), np.concatenate(distances))


def balanced_pairs(
    labels: Integer[AnyArray, " K"], *, classes: int, per_pair: int | None = None, seed: int = 0
) -> Int32[np.ndarray, "P 2"]:
    """Draw index pairs (P, 2) int32 of motions with labels (K,), for each ordered pair of different classes.

    `per_pair` distinct pairs of each (None, or more than exist: all), in which every start and every end occurs
    equally often, within one; the pairing is random. Ordered by class of start, class of end.
    """
    if per_pair is not None and per_pair < 1:
        raise ValueError(f"per_pair: expected at least 1, got {per_pair}")
    random = np.random.default_rng(seed)
    members = [np.flatnonzero(np.asarray(labels) == label) for label in range(classes)]
    pairs = [np.zeros((0, 2), np.int32)]
    for a, b in ((a, b) for a in range(classes) for b in range(classes) if a != b):
        first, second = random.permutation(members[a]), random.permutation(members[b])
        total = len(first) * len(second)
        if total:
            k = np.arange(total if per_pair is None else min(per_pair, total))
            # Both lists are cycled; when the pairing would repeat, one is shifted by one.
            turn = k // np.lcm(len(first), len(second))
            pairs.append(np.stack([first[k % len(first)], second[(k + turn) % len(second)]], axis=1).astype(np.int32))
    return np.concatenate(pairs)


def sample_per_pair(
    start: Integer[AnyArray, " K"], end: Integer[AnyArray, " _"], *, seed: int = 0
) -> Bool[np.ndarray, " K"]:
    """Return a mask (K,) that selects one random motion of each (start, end) that occurs: OT23's test set."""
    start, end = np.asarray(start), np.asarray(end)
    if start.shape != end.shape or start.ndim != 1:
        raise ValueError(f"start, end: expected two arrays (K,), got {start.shape} and {end.shape}")
    order = np.random.default_rng(seed).permutation(len(start))
    _, first = np.unique(np.stack([start, end], axis=1)[order], axis=0, return_index=True)
    mask = np.zeros(len(start), bool)
    mask[order[first]] = True
    return mask


def _candidates(starts: int, ends: int, count: int, reuse: int | None) -> tuple[np.ndarray, np.ndarray]:
    """Return ranks (M,) of start and end that contain the `count` nearest transitions, without the full product.

    A transition starts and ends at the two peaks themselves, so its squared distance is the sum of theirs:
    both classes are sorted, and rank (r, s) is at least as far as every (r' <= r, s' <= s).
    """
    if reuse is None:
        # (r, s) has (r+1)(s+1) - 1 others at least as near: those with (r+1)(s+1) <= count suffice, about
        # count log count of them.
        widths = np.minimum(count // np.arange(1, min(count, starts) + 1), ends)
        first = np.repeat(np.arange(len(widths)), widths)
        return first, np.arange(len(first)) - np.repeat(np.cumsum(widths) - widths, widths)
    # Nearest first, the starts and ends of ranks below `reuse` are all combined, which exhausts them, and the
    # next `reuse` ranks follow: square blocks along the diagonal, each no nearer than the one before.
    blocks = -(-count // reuse**2)
    ranks = np.arange(min(blocks * reuse, starts))
    first, second = np.repeat(ranks, reuse), (ranks[:, None] // reuse * reuse + np.arange(reuse)).reshape(-1)
    inside = second < ends
    return first[inside], second[inside]


def _between(tau: jax.Array, a: AnyArray, b: AnyArray) -> jax.Array:
    return jnp.asarray(a) + tau * (b - a)


@jax.jit(static_argnames=("frames", "pace"))
def _chunk(motions: Motions, pairs: jax.Array, *, frames: int, pace: str) -> jax.Array:
    first, second = (jax.tree.map(lambda x, rows=rows: x[rows], motions) for rows in pairs.T)
    tau = None
    if pace == "performed":
        share = srvf.arc_length_fraction(second.q)
        place = jnp.linspace(0, share.shape[-1] - 1, frames)
        tau = jax.vmap(lambda one: jnp.interp(place, jnp.arange(len(one)), one))(share)
    ends = first.q, first.log_length, second.q, second.log_length, first.start, second.start
    return transition(*ends, tau, frames=frames)


def _stream(motions: Motions, pairs: np.ndarray, frames: int, pace: str, chunk: int) -> Iterator[jax.Array]:
    for begin in range(0, len(pairs), chunk):
        rows = pairs[begin : begin + chunk]
        padded = np.pad(rows, ((0, chunk - len(rows)), (0, 0)))
        yield _chunk(motions, jnp.asarray(padded, jnp.int32), frames=frames, pace=pace)[: len(rows)]


def _check_curve(curve: AnyArray) -> None:
    if jnp.ndim(curve) < 3 or curve.shape[-1] != 3 or curve.shape[-3] < 2:
        raise ValueError(f"expected a curve (..., T, L, 3) with T >= 2, got shape {jnp.shape(curve)}")


def _labelled(peaks: AnyArray, labels: AnyArray, classes: int) -> tuple[np.ndarray, np.ndarray]:
    peaks, labels = np.asarray(peaks, np.float64), np.asarray(labels)
    if peaks.ndim != 3 or peaks.shape[-1] != 3:
        raise ValueError(f"peaks: expected (K, L, 3), got {peaks.shape}")
    if labels.shape != peaks.shape[:1] or not np.issubdtype(labels.dtype, np.integer):
        raise ValueError(f"labels: expected integers ({len(peaks)},), got {labels.dtype} {labels.shape}")
    if labels.size and not (labels.min() >= 0 and labels.max() < classes):
        raise ValueError(f"labels: expected [0, {classes}), got {labels.min()} to {labels.max()}")
    return peaks, labels
