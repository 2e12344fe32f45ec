"""Transitions in a row: A to B to C, each drawn, started where the last one ended, and joined without a jolt.

The paper (OT23, 4.3) takes the end of one transition as the start of the next and leaves it at that. Three things are
added. The generator is told the pose that it starts from. What a pose cannot express fades along the path, so that
errors do not add up over a chain. And steps on both sides of a joint are made equal, so that neither position nor
speed jumps there.

Displacements from neutral, unitless; S samples, P transitions of T frames each, L landmarks.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from facejax.geometry import srvf
from facejax.models.motion import generators, start_poses, tangent_pca

REACH = 8  # frames on each side of a joint over which its correction fades


class Drawn(NamedTuple):
    """Transitions as they were generated, before they are put on one line of time."""

    curves: jax.Array  # (S, P, T, L, 3); each begins where the one before ends
    log_seconds: jax.Array  # (S, P)


def compose(
    generator: generators.Generator,
    beginnings: start_poses.StartPoses,
    key: jax.Array,
    labels: Sequence[int],
    *,
    samples: int = 1,
    frames: int | Sequence[int] | None = None,
) -> jax.Array:
    """Motions through label numbers A, B, C, ...: (S, F, L, 3), `frames` of each transition (by default as drawn).

    Sample i is the same whatever the number of samples. Labels are known when a function is traced, not traced
    themselves: `draw` takes traced ones. Raises `TypeError` for what is no generator, `ValueError` for fewer than two
    labels, one that the generator does not know, one that follows itself, no samples, or frames that do not fit.
    """
    generators.kind(generator)
    pairs = label_pairs(labels, classes=len(generator.chart.mean))
    drawn = draw(generator, beginnings, sample_keys(key, samples), pairs)
    count, length = drawn.curves.shape[1:3]
    each = [length if frames is None else frames] * count if np.ndim(frames) == 0 else frames
    if len(each) != count:
        raise ValueError(f"frames: expected one number, or {count} for {count} transitions, got {len(each)}")
    return join(drawn.curves, jnp.asarray(timeline(each, drawn=length)))


def label_pairs(labels: Sequence[int], *, classes: int | None = None) -> jax.Array:
    """The transitions (P, 2) through label numbers.

    Raises `ValueError` for names, a number outside 0..classes-1, or a label that follows itself.
    """
    labels = np.asarray(labels)
    if labels.ndim != 1 or len(labels) < 2:
        raise ValueError(f"labels: expected at least a start and an end, got {labels.tolist()}")
    if labels.dtype.kind not in "iu":
        raise ValueError(f"labels: expected numbers, got {labels.tolist()}; pipeline.label_indices makes them of names")
    outside = np.flatnonzero((labels < 0) | (labels >= (np.inf if classes is None else classes)))
    if outside.size:
        last = "" if classes is None else f" to {classes - 1}"
        raise ValueError(f"labels: number {outside[0] + 1} is {labels[outside[0]]}, expected one from 0{last}")
    if (same := np.flatnonzero(labels[1:] == labels[:-1])).size:
        raise ValueError(f"labels: number {same[0] + 2} repeats the one before; a transition needs two labels")
    return jnp.asarray(np.stack([labels[:-1], labels[1:]], axis=1), jnp.int32)


def sample_keys(key: jax.Array, samples: int) -> jax.Array:
    """One key for each sample (S,), of which the first ones do not depend on S."""
    if samples < 1:
        raise ValueError(f"samples must be 1 or more, got {samples}")
    return jax.vmap(jax.random.fold_in, (None, 0))(key, jnp.arange(samples))


@jax.jit
def draw(
    generator: generators.Generator, beginnings: start_poses.StartPoses, keys: jax.Array, pairs: jax.Array
) -> Drawn:
    """Draw transitions between labels `pairs` (P, 2), each from the end of the one before; one sample per key (S,).

    The first starts at a peak of its label, drawn from `beginnings`.
    """
    chart = jax.lax.stop_gradient(generator.chart)

    def one(key):
        first_key, key = jax.random.split(key)
        first = tangent_pca.decode_pose(chart, _beginning(generator, beginnings, first_key, pairs[0, 0]), pairs[0, 0])

        def transition(here, inputs):
            key, (start, end) = inputs
            curve, log_seconds = _transition(generator, beginnings, chart, key, here, start, end)
            return curve[-1], (curve, log_seconds)

        _, drawn = jax.lax.scan(transition, first, (jax.random.split(key, len(pairs)), pairs))
        return Drawn(*drawn)

    return jax.vmap(one)(keys)


@jax.jit
def join(curves: jax.Array, line: jax.Array) -> jax.Array:
    """Transitions (S, P, T, L, 3) on one line of time (F, P T), from `timeline`: (S, F, L, 3)."""
    samples, count, frames, *rest = curves.shape
    if line.shape[1] != count * frames:
        raise ValueError(f"line: expected (F, {count * frames}) for {count} x {frames} frames, got {line.shape}")
    return jnp.einsum("ft,stlc->sflc", line, curves.reshape(samples, count * frames, *rest))


def timeline(frames: Sequence[int], *, drawn: int = 30, reach: int = REACH) -> np.ndarray:
    """The matrix (F, P T) that puts P transitions of T = `drawn` frames on one line of time.

    Transition i gets `frames[i]` frames, joints are not repeated: F = 1 + sum(frames - 1). Frames between drawn ones
    lie on cubic curves (Catmull-Rom). The steps on both sides of a joint become equal, and what that changes fades over
    `reach` frames; first and last frames stay, and so does a joint's bend where two frames leave no room beside it. All
    of it is linear in the frames, hence one matrix, the same for all samples. Raises `ValueError` for fewer than two
    frames.
    """
    frames = [int(count) for count in frames]
    if not frames or min(frames) < 2 or drawn < 2:
        raise ValueError(f"frames: expected 2 or more for each transition, got {frames} of {drawn} drawn")
    ends = np.cumsum([0] + [count - 1 for count in frames])
    line = np.zeros((ends[-1] + 1, len(frames) * drawn))
    for i, count in enumerate(frames):
        line[ends[i] : ends[i + 1] + 1, :] = 0  # the joint is where both agree: the later one's
        line[ends[i] : ends[i + 1] + 1, i * drawn : (i + 1) * drawn] = _cubic(count, drawn)
    for i, joint in reversed(list(enumerate(ends[1:-1]))):
        bend = line[joint + 1] - 2 * line[joint] + line[joint - 1]
        # The half of a transition that is nearer to the joint, so that two corrections never meet: a middle frame
        # belongs to the joint that follows, which has had its turn.
        halves = (frames[i] - 1) // 2, (frames[i + 1] - (1 if joint == ends[-2] else 2)) // 2
        sides = [(sign, min(reach, half)) for sign, half in zip((-1, 1), halves, strict=True)]
        open_sides = [(sign, width) for sign, width in sides if width]
        for sign, width in open_sides:
            for k in range(1, width + 1):
                fade = k * ((width + 1 - k) / width) ** 2
                line[joint + sign * k] -= fade / len(open_sides) * bend
    return line.astype(np.float32)


def _beginning(generator, beginnings, key, label):
    if generators.uses_start_pose(generator):
        return start_poses.sample(beginnings, key, label)
    # A motion drawn for nobody in particular starts at the mean peak, as in the paper.
    return jnp.zeros_like(generator.chart.pose_scale)


def _transition(generator, beginnings, chart, key, here, start, end):
    pose = start_poses.clip_to_distribution(beginnings, tangent_pca.encode_pose(chart, here, start), start)
    motion = generators.sample(generator, key, start, end, pose)
    if not generators.uses_start_pose(generator):
        return srvf.decode(motion.q, motion.log_length, here), motion.log_seconds
    meant = tangent_pca.decode_pose(chart, pose, start)
    curve = srvf.decode(motion.q, motion.log_length, meant)
    covered = srvf.arc_length_fraction(motion.q)[:, None, None]
    # No jump, and no motion where there was none: what separates the two beginnings fades along the path. A way home
    # ends at neutral exactly, which no network can promise.
    curve = curve + (1 - covered) * (here - meant)
    return curve - jnp.where(end == 0, covered * curve[-1], 0), motion.log_seconds


def _cubic(count: int, drawn: int) -> np.ndarray:
    """Catmull-Rom interpolation (count, drawn) at even places; ends by linear extrapolation."""
    place = np.linspace(0, drawn - 1, count)
    low = np.minimum(place.astype(int), drawn - 2)
    x = place - low
    weights = np.stack([-x + 2 * x**2 - x**3, 2 - 5 * x**2 + 3 * x**3, x + 4 * x**2 - 3 * x**3, x**3 - x**2]) / 2
    padded = np.zeros((count, drawn + 2))
    rows = np.arange(count)
    for k, weight in enumerate(weights):
        padded[rows, low + k] += weight
    matrix = padded[:, 1:-1]
    # A frame before the first is 2 x0 - x1, one after the last likewise.
    matrix[:, 0] += 2 * padded[:, 0]
    matrix[:, 1] -= padded[:, 0]
    matrix[:, -1] += 2 * padded[:, -1]
    matrix[:, -2] -= padded[:, -1]
    return matrix
