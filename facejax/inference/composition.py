"""Sequences of transitions A to B to C: generate each, start it where the last one ended, join them with C1 continuity.

OT23 (4.3) takes the end of one transition as the start of the next. Three things are added. The generator is
conditioned on the start pose. The part of the pose that its PCA cannot represent is blended out along the path, so that
errors do not accumulate over a sequence. And the steps on both sides of a joint are made equal, so that position and
velocity are continuous there.

Displacements from neutral, unitless; S samples, P transitions of T frames each, L landmarks, F frames in all.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from facejax.geometry import srvf
from facejax.geometry.precision import HIGHEST
from facejax.models.motion import generators, start_poses, tangent_pca

REACH = 8  # frames on each side of a joint over which its correction decays


class Noise(NamedTuple):
    """Random numbers of which one motion is a deterministic function; or of many, with leading axes."""

    choice: jax.Array  # () uniform in [0, 1), selects the peak at which the motion starts
    blur: jax.Array  # (D,) standard normal, blurs that peak
    transitions: jax.Array  # (P, n) standard normal, the generator's


class Drawn(NamedTuple):
    """Generated transitions, before they are joined on one timeline."""

    curves: jax.Array  # (S, P, T, L, 3); each starts where the previous one ends
    log_seconds: jax.Array  # (S, P)


def compose(
    generator: generators.Generator,
    starts: start_poses.StartPoses,
    key: jax.Array,
    labels: Sequence[int],
    *,
    samples: int = 1,
    frames: int | Sequence[int] | None = None,
) -> jax.Array:
    """Generate motions (S, F, L, 3) through label indices A, B, C, ...: chain several expressions, with C1 continuity.

    Sample i does not depend on the number of samples. Labels must be concrete when a function is traced; `draw` accepts
    traced ones.

    Args:
      generator: parameters of a motion generator.
      starts: distribution of start poses.
      labels: two or more label indices.
      frames: of every transition, or of each; default: as many as the generator has.

    Raises:
      TypeError: `generator` is not the parameters of a generator.
      ValueError: fewer than two labels, an unknown label, a label that repeats the previous one, no samples, or a wrong
        number of frames.
    """
    generators.kind(generator)
    pairs = label_pairs(labels, classes=len(generator.chart.mean))
    drawn = draw(generator, starts, sample_keys(key, samples), pairs)
    count, length = drawn.curves.shape[1:3]
    values = np.asarray(length if frames is None else frames)
    each = [values.item()] * count if values.ndim == 0 else values.tolist()
    if len(each) != count:
        raise ValueError(f"frames: expected one number, or {count} for {count} transitions, got {len(each)}")
    return join(drawn.curves, jnp.asarray(timeline(each, drawn=length)))


def label_pairs(labels: Sequence[int] | np.ndarray, *, classes: int | None = None) -> jax.Array:
    """Return the transitions (P, 2) int32 through label indices.

    Raises `ValueError` for names, an index outside 0..classes-1, or a label that repeats the previous one.
    """
    numbers = np.asarray(labels)
    if numbers.ndim != 1 or len(numbers) < 2:
        raise ValueError(f"labels: expected at least a start and an end, got {numbers.tolist()}")
    if numbers.dtype.kind not in "iu":
        raise ValueError(f"labels: expected indices, got {numbers.tolist()}; `models.labels.encode` converts names")
    outside = np.flatnonzero((numbers < 0) | (numbers >= (np.inf if classes is None else classes)))
    if outside.size:
        last = "" if classes is None else f" to {classes - 1}"
        raise ValueError(f"labels: number {outside[0] + 1} is {numbers[outside[0]]}, expected one from 0{last}")
    if (same := np.flatnonzero(numbers[1:] == numbers[:-1])).size:
        raise ValueError(f"labels: number {same[0] + 2} repeats the previous one; a transition needs two labels")
    return jnp.asarray(np.stack([numbers[:-1], numbers[1:]], axis=1), jnp.int32)


def sample_keys(key: jax.Array, samples: int) -> jax.Array:
    """Return one key for each sample (S,); the first ones do not depend on S. Raises `ValueError` for S below 1."""
    if samples < 1:
        raise ValueError(f"samples must be 1 or more, got {samples}")
    return jax.vmap(jax.random.fold_in, (None, 0))(key, jnp.arange(samples))


@jax.jit
def draw(generator: generators.Generator, starts: start_poses.StartPoses, keys: jax.Array, pairs: jax.Array) -> Drawn:
    """Generate transitions between label pairs (P, 2), each from the end of the previous one; one sample per key (S,).

    The first transition starts at a peak pose of its label, drawn from `starts`.
    """

    def one(key: jax.Array) -> Drawn:
        return generate(generator, starts, sample_noise(generator, starts, key, len(pairs)), pairs)

    return jax.vmap(one)(keys)


def sample_noise(
    generator: generators.Generator, starts: start_poses.StartPoses, key: jax.Array, transitions: int
) -> Noise:
    """Draw the random numbers of one motion of some transitions."""
    first_key, key = jax.random.split(key)
    choice_key, blur_key = jax.random.split(first_key)
    size, dtype = generators.noise_size(generator), generator.chart.mean.dtype
    keys = jax.random.split(key, transitions)
    return Noise(
        jax.random.uniform(choice_key, (), dtype),
        jax.random.normal(blur_key, starts.poses.shape[2:], dtype),
        jax.vmap(lambda key: jax.random.normal(key, (size,), dtype))(keys),
    )


@jax.jit
def generate(generator: generators.Generator, starts: start_poses.StartPoses, noise: Noise, pairs: jax.Array) -> Drawn:
    """Return the transitions between label pairs (P, 2) that belong to noise, as one sample: `draw` without a key."""
    chart = jax.lax.stop_gradient(generator.chart)
    first = tangent_pca.decode_pose(chart, _start_pose(generator, starts, noise, pairs[0, 0]), pairs[0, 0])

    def transition(position: jax.Array, inputs: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, Any]:
        noise, (start, end) = inputs
        curve, log_seconds = _transition(generator, starts, chart, noise, position, start, end)
        return curve[-1], (curve, log_seconds)

    _, drawn = jax.lax.scan(transition, first, (noise.transitions, pairs))
    return Drawn(*drawn)


@jax.jit
def join(curves: jax.Array, matrix: jax.Array) -> jax.Array:
    """Join transitions (S, P, T, L, 3) by a matrix (F, P T) of `timeline`: (S, F, L, 3).

    Raises `ValueError` for a matrix of another size.
    """
    samples, count, frames, *rest = curves.shape
    if matrix.shape[1] != count * frames:
        raise ValueError(f"matrix: expected (F, {count * frames}) for {count} x {frames} frames, got {matrix.shape}")
    return jnp.einsum("ft,stlc->sflc", matrix, curves.reshape(samples, count * frames, *rest), precision=HIGHEST)


def timeline(frames: Sequence[int], *, drawn: int = 30, reach: int = REACH) -> np.ndarray:
    """Return the matrix (F, P T) that joins P transitions of T = `drawn` frames on one timeline.

    Transition i gets `frames[i]` frames; joints are not repeated: F = 1 + sum(frames - 1). Frames between generated
    ones are interpolated by cubic curves (Catmull-Rom). The steps on both sides of a joint become equal, and the
    correction decays over `reach` frames; first and last frames do not change, nor does a joint between transitions of
    two frames, which have no frame beside it. All of this is linear in the frames, hence one matrix for all samples.

    Raises:
      ValueError: fewer than two frames.
    """
    frames = [int(count) for count in frames]
    if not frames or min(frames) < 2 or drawn < 2:
        raise ValueError(f"frames: expected 2 or more for each transition, got {frames} of {drawn} generated")
    ends = np.cumsum([0] + [count - 1 for count in frames])
    matrix = np.zeros((ends[-1] + 1, len(frames) * drawn))
    for i, count in enumerate(frames):
        matrix[ends[i] : ends[i + 1] + 1, :] = 0  # at the joint both agree: use the later transition
        matrix[ends[i] : ends[i + 1] + 1, i * drawn : (i + 1) * drawn] = _cubic(count, drawn)
    for i, joint in reversed(list(enumerate(ends[1:-1]))):
        bend = matrix[joint + 1] - 2 * matrix[joint] + matrix[joint - 1]
        # Only the half of a transition that is nearer to the joint, so that corrections do not overlap: a middle frame
        # belongs to the next joint, which was corrected before.
        halves = (frames[i] - 1) // 2, (frames[i + 1] - (1 if joint == ends[-2] else 2)) // 2
        sides = [(sign, min(reach, half)) for sign, half in zip((-1, 1), halves, strict=True)]
        open_sides = [(sign, width) for sign, width in sides if width]
        for sign, width in open_sides:
            for k in range(1, width + 1):
                decay = k * ((width + 1 - k) / width) ** 2
                matrix[joint + sign * k] -= decay / len(open_sides) * bend
    return matrix.astype(np.float32)


def _start_pose(
    generator: generators.Generator, starts: start_poses.StartPoses, noise: Noise, label: jax.Array
) -> jax.Array:
    if generators.uses_start_pose(generator):
        return start_poses.generate(starts, noise.choice, noise.blur, label)
    # A generator without a start pose starts at the mean peak, as in the paper.
    return jnp.zeros_like(generator.chart.pose_scale)


def _transition(
    generator: generators.Generator,
    starts: start_poses.StartPoses,
    chart: tangent_pca.TangentPCA,
    noise: jax.Array,
    position: jax.Array,
    start: jax.Array,
    end: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    pose = start_poses.clip_to_distribution(starts, tangent_pca.encode_pose(chart, position, start), start)
    motion = generators.generate(generator, noise, start, end, pose)
    if not generators.uses_start_pose(generator):
        return srvf.decode(motion.q, motion.log_length, position), motion.log_seconds
    represented = tangent_pca.decode_pose(chart, pose, start)
    curve = srvf.decode(motion.q, motion.log_length, represented)
    progress = srvf.arc_length_fraction(motion.q)[:, None, None]
    # The difference of the two start poses is faded out along the path, so that there is no jump. A transition to
    # neutral ends at neutral exactly, which the network alone does not guarantee.
    curve = curve + (1 - progress) * (position - represented)
    return curve - jnp.where(end == 0, progress * curve[-1], 0), motion.log_seconds


def _cubic(count: int, drawn: int) -> np.ndarray:
    """Return Catmull-Rom interpolation (count, drawn) at equidistant times; ends by linear extrapolation."""
    place = np.linspace(0, drawn - 1, count)
    low = np.minimum(place.astype(int), drawn - 2)
    x = place - low
    weights = np.stack([-x + 2 * x**2 - x**3, 2 - 5 * x**2 + 3 * x**3, x + 4 * x**2 - 3 * x**3, x**3 - x**2]) / 2
    padded = np.zeros((count, drawn + 2))
    rows = np.arange(count)
    for k, weight in enumerate(weights):
        padded[rows, low + k] += weight
    matrix = padded[:, 1:-1]
    # A frame before the first is 2 x0 - x1; after the last likewise.
    matrix[:, 0] += 2 * padded[:, 0]
    matrix[:, 1] -= padded[:, 0]
    matrix[:, -1] += 2 * padded[:, -1]
    matrix[:, -2] -= padded[:, -1]
    return matrix
