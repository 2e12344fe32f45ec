"""Whole recordings for the expression networks: steps from frame to frame, cut and padded to one length.

Curves are displacements from neutral, unitless as in `facejax.data.motions`. A block is that of Seo and Luo 2021,
Fig. 3: the first input is zero, the targets are the inputs shifted left by one, the last target is zero. K sequences,
f entries of a block, F frames of the longest sequence, L landmarks.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from facejax.data import dataset, motions
from facejax.geometry import align
from facejax.landmarks import schemes

TAIL_FRAMES = 5  # frames of standing still after the end that a network learns from, so that it learns to stop


class Sequences(NamedTuple):
    """K recordings. Beyond its end a curve stands still at its last frame."""

    curves: np.ndarray  # (K, F, L, 3) displacements from neutral, unitless
    frames: np.ndarray  # (K,) int32, the true length of each
    neutral: np.ndarray  # (K, L, 3) landmarks at rest, centred and unitless
    label: np.ndarray  # (K,) int32, into the dataset's labels
    subject: np.ndarray  # (K,) int32
    scale: np.ndarray  # (K,) millimetres per unit

    def take(self, which: np.ndarray) -> Sequences:
        """The sequences at indices, or under a mask."""
        return Sequences(*(field[which] for field in self))


class Block(NamedTuple):
    """Training data of K sequences."""

    inputs: np.ndarray  # (K, f, L, 3) steps, the first of each sequence zero
    targets: np.ndarray  # (K, f, L, 3) the step that follows
    mask: np.ndarray  # (K, f) bool, the targets that count
    neutral: np.ndarray  # (K, L, 3)


def read(data: dataset.Dataset, split: str, labels: Sequence[str]) -> Sequences:
    """The recordings of a split's subjects under some labels, in the dataset's order.

    Raises `ValueError` for a label of which the split has no recording.
    """
    rest = data.neutral[:, data.landmark_index]
    found = [row for row in motions.recordings(data, split, direct=False) if row[0].label in set(labels)]
    if missing := set(labels) - {sequence.label for sequence, _, _ in found}:
        raise ValueError(f"the dataset has no {split} recording of {', '.join(sorted(missing))}")
    longest = max(len(curve) for _, curve, _ in found)
    curves = np.stack([_held(curve, longest) for _, curve, _ in found]).astype(np.float32)
    subject = np.array([sequence.subject for sequence, _, _ in found], np.int32)
    scale = np.array([scale for _, _, scale in found], np.float32)
    centred = rest[subject] - rest[subject].mean(axis=1, keepdims=True)
    return Sequences(
        curves,
        np.array([len(curve) for _, curve, _ in found], np.int32),
        (centred / scale[:, None, None]).astype(np.float32),
        np.array([data.labels.index(sequence.label) for sequence, _, _ in found], np.int32),
        subject,
        scale,
    )


def extend(sequences: Sequences, frames: int) -> Sequences:
    """The same with room for at least `frames` frames; curves stand still in the new ones."""
    return sequences._replace(curves=np.stack([_held(curve, max(frames, len(curve))) for curve in sequences.curves]))


def join(*parts: Sequences) -> Sequences:
    """All recordings, one after the other."""
    longest = max(part.curves.shape[1] for part in parts)
    return Sequences(*(np.concatenate(fields) for fields in zip(*(extend(p, longest) for p in parts), strict=True)))


def mirror(sequences: Sequences) -> Sequences:
    """The same people as in a mirror: what is left becomes right. Faces look along z, landmarks follow a known scheme.

    Raises `ValueError` for a number of landmarks that is no scheme's (`facejax.schemes`).
    """
    swap = schemes.by_count(sequences.neutral.shape[1]).mirror
    across = np.array([-1, 1, 1], np.float32)
    return sequences._replace(curves=sequences.curves[:, :, swap] * across, neutral=sequences.neutral[:, swap] * across)


def remove_head_motion(sequences: Sequences, stable: Sequence[int] | None = None) -> Sequences:
    """The same with every frame's rigid motion taken out: Procrustes of the `stable` landmarks onto those at rest.

    Seo and Luo 2021, 4.2, tried this and kept the head's motion. `stable` names landmarks that stay put in the head's
    own frame; by default those of the scheme (`facejax.schemes`). Raises `ValueError` for a number of landmarks that is
    no scheme's.
    """
    which = schemes.by_count(sequences.neutral.shape[1]).stable if stable is None else np.asarray(stable)
    rest = sequences.neutral[:, None]
    placed = sequences.curves + rest
    pose = align.procrustes(placed[:, :, which], np.broadcast_to(rest, placed.shape)[:, :, which])
    return sequences._replace(curves=np.asarray(align.apply(pose, placed)) - rest)


def block(sequences: Sequences, *, frames: int | None = None, tail: int = TAIL_FRAMES, masked: bool = True) -> Block:
    """The block of f = `frames` entries; by default the longest sequence and its tail fit.

    Shorter sequences are padded with zero steps, longer ones cut at the end. The mask leaves out the padding but its
    first `tail` steps, and the zero that stands for the step a cut takes away; without `masked` all counts, as in the
    paper, whose networks learn to stand still above all.
    """
    steps = np.diff(sequences.curves, axis=1)
    count, there = sequences.frames - 1, steps.shape[1]
    size = there + 1 + tail if frames is None else frames
    if size < 2 or tail < 0:
        raise ValueError(f"expected frames of 2 or more and a tail of 0 or more, got {frames} and {tail}")
    room = np.zeros((len(steps), size + 1, *steps.shape[2:]), np.float32)
    kept = min(there, size - 1)
    room[:, 1 : 1 + kept] = steps[:, :kept]
    place = np.arange(size)
    mask = place < (count + tail)[:, None]
    mask &= ~((place == size - 1) & (count[:, None] >= size))
    return Block(room[:, :-1], room[:, 1:], mask | (not masked), sequences.neutral)


def _held(curve: np.ndarray, frames: int) -> np.ndarray:
    return np.concatenate([curve, np.repeat(curve[-1:], frames - len(curve), axis=0)])
