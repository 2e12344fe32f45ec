"""Whole recordings for the expression networks: frame-to-frame steps, cut and padded to one length.

Curves are unitless displacements from neutral, as in `facejax.data.motions`. A block follows Seo and Luo 2021, Fig. 3:
the first input is zero, the targets are the inputs shifted left by one, the last target is zero. K sequences,
f entries of a block, F frames of the longest sequence, L landmarks.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from facejax.data import dataset, motions
from facejax.geometry import align
from facejax.landmarks import schemes

TAIL_FRAMES = 5  # zero steps after the end that count in training, so that a network learns to stop


class Sequences(NamedTuple):
    """K recordings. Beyond its end, a curve repeats its last frame."""

    curves: np.ndarray  # (K, F, L, 3) displacements from neutral, unitless
    frames: np.ndarray  # (K,) int32, true length of each
    neutral: np.ndarray  # (K, L, 3) neutral landmarks, centred and unitless
    label: np.ndarray  # (K,) int32, indices of the dataset's labels
    subject: np.ndarray  # (K,) int32
    scale: np.ndarray  # (K,) millimetres per unit

    def take(self, rows: np.ndarray) -> Sequences:
        """Return the sequences at indices, or selected by a mask."""
        return Sequences(*(field[rows] for field in self))


class Block(NamedTuple):
    """Training data of K sequences."""

    inputs: np.ndarray  # (K, f, L, 3) steps, the first of each sequence zero
    targets: np.ndarray  # (K, f, L, 3) the steps that follow
    mask: np.ndarray  # (K, f) bool, True for targets that count
    neutral: np.ndarray  # (K, L, 3)


def read(data: dataset.Dataset, split: str, labels: Sequence[str]) -> Sequences:
    """Read the recordings of a split that have one of the labels, in the dataset's order.

    Raises:
      ValueError: the split has no recording of a label.
    """
    rest = data.neutral[:, data.landmark_index]
    rows = [row for row in motions.recordings(data, split, direct=False) if row[0].label in set(labels)]
    if missing := set(labels) - {sequence.label for sequence, _, _ in rows}:
        raise ValueError(f"the dataset has no {split} recording of {', '.join(sorted(missing))}")
    longest = max(len(curve) for _, curve, _ in rows)
    curves = np.stack([_pad(curve, longest) for _, curve, _ in rows]).astype(np.float32)
    subject = np.array([sequence.subject for sequence, _, _ in rows], np.int32)
    scale = np.array([scale for _, _, scale in rows], np.float32)
    centred = rest[subject] - rest[subject].mean(axis=1, keepdims=True)
    return Sequences(
        curves,
        np.array([len(curve) for _, curve, _ in rows], np.int32),
        (centred / scale[:, None, None]).astype(np.float32),
        np.array([data.labels.index(sequence.label) for sequence, _, _ in rows], np.int32),
        subject,
        scale,
    )


def extend(sequences: Sequences, frames: int) -> Sequences:
    """Pad all curves to at least `frames` frames by repeating their last one."""
    return sequences._replace(curves=np.stack([_pad(curve, max(frames, len(curve))) for curve in sequences.curves]))


def join(*parts: Sequences) -> Sequences:
    """Concatenate recordings; shorter curves are padded."""
    longest = max(part.curves.shape[1] for part in parts)
    return Sequences(*(np.concatenate(fields) for fields in zip(*(extend(p, longest) for p in parts), strict=True)))


def mirror(sequences: Sequences) -> Sequences:
    """Reflect faces at the plane x = 0 and exchange left and right landmarks. Faces look along z.

    Raises:
      ValueError: the number of landmarks belongs to no scheme (`facejax.landmarks.schemes`).
    """
    swap = schemes.by_count(sequences.neutral.shape[1]).mirror
    across = np.array([-1, 1, 1], np.float32)
    return sequences._replace(curves=sequences.curves[:, :, swap] * across, neutral=sequences.neutral[:, swap] * across)


def remove_head_motion(sequences: Sequences, stable: Sequence[int] | None = None) -> Sequences:
    """Remove each frame's rigid motion: Procrustes alignment of the `stable` landmarks to the neutral ones.

    Seo and Luo 2021, 4.2, tried this and kept the head motion.

    Args:
      sequences: any.
      stable: landmarks that hardly move relative to the skull; by default those of the scheme
        (`facejax.landmarks.schemes`).

    Raises:
      ValueError: `stable` is not given and the number of landmarks belongs to no scheme.
    """
    rows = schemes.by_count(sequences.neutral.shape[1]).stable if stable is None else np.asarray(stable)
    rest = sequences.neutral[:, None]
    placed = sequences.curves + rest
    pose = align.procrustes(placed[:, :, rows], np.broadcast_to(rest, placed.shape)[:, :, rows])
    return sequences._replace(curves=np.asarray(align.apply(pose, placed)) - rest)


def block(sequences: Sequences, *, frames: int | None = None, tail: int = TAIL_FRAMES, masked: bool = True) -> Block:
    """Build the training block of f = `frames` entries; by default the longest sequence and its tail fit.

    Shorter sequences are padded with zero steps, longer ones are cut at the end.

    Args:
      sequences: K recordings.
      frames: entries of the block.
      tail: entries of the padding that count.
      masked: exclude the rest of the padding, and the final zero target of a sequence that was cut. Without it every
        target counts, as in the paper, whose networks mostly learn to predict zero motion.

    Raises:
      ValueError: `frames` is below 2 or `tail` negative.
    """
    steps = np.diff(sequences.curves, axis=1)
    count, available = sequences.frames - 1, steps.shape[1]
    size = available + 1 + tail if frames is None else frames
    if size < 2 or tail < 0:
        raise ValueError(f"expected frames of 2 or more and a tail of 0 or more, got {frames} and {tail}")
    padded = np.zeros((len(steps), size + 1, *steps.shape[2:]), np.float32)
    kept = min(available, size - 1)
    padded[:, 1 : 1 + kept] = steps[:, :kept]
    position = np.arange(size)
    mask = position < (count + tail)[:, None]
    mask &= ~((position == size - 1) & (count[:, None] >= size))
    return Block(padded[:, :-1], padded[:, 1:], mask | (not masked), sequences.neutral)


def _pad(curve: np.ndarray, frames: int) -> np.ndarray:
    return np.concatenate([curve, np.repeat(curve[-1:], frames - len(curve), axis=0)])
