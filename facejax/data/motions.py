"""Motions for Motion3DGAN, cut from a 4D dataset: unitless displacements from neutral of 30 frames each.

Unitless means divided by the centred Frobenius norm of the subject's neutral landmarks, which is returned as `scale`
so that results can be given in millimetres. Halves are neutral -> peak (onset to the start of the apex) and
peak -> neutral (end of the apex to offset), resampled uniformly in time (OT23, 4.1).

K motions, T frames, L landmarks.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from facejax import augment
from facejax.data import dataset
from facejax.geometry import srvf

FRAMES = 30


class Motions(NamedTuple):
    """K motions. `start` and `end` index the dataset's labels, of which 0 is neutral."""

    curves: np.ndarray  # (K, T, L, 3) displacements from neutral, unitless
    start: np.ndarray  # (K,) int32
    end: np.ndarray  # (K,) int32
    subject: np.ndarray  # (K,) int32; that of the start where two subjects were combined
    scale: np.ndarray  # (K,) millimetres per unit
    seconds: np.ndarray  # (K,) duration; where two subjects were combined, that of the second one's onset

    def take(self, rows: np.ndarray) -> Motions:
        """Return the motions at indices, or selected by a mask."""
        return Motions(*(field[rows] for field in self))

    def millimetres(self) -> np.ndarray:
        """Return the curves in millimetres, (K, T, L, 3)."""
        return self.curves * self.scale[:, None, None, None]


def halves(
    data: dataset.Dataset,
    split: str,
    *,
    label_names: Sequence[str] | None = None,
    frames: int = FRAMES,
    by: str = "time",
) -> Motions:
    """Return every neutral -> peak and peak -> neutral motion of a split's subjects.

    Args:
      data: an open dataset.
      split: "train", "validation" or "test".
      label_names: labels to use, neutral first; `start` and `end` index them. By default all of the dataset.
      frames: T.
      by: resample uniformly in "time", or in arc length ("arc"), which removes the timing.

    Raises:
      ValueError: the split has no such motions, or another `by`.
    """
    label_names = data.labels if label_names is None else tuple(label_names)
    rows = []
    for sequence, curve, scale in recordings(data, split, direct=False):
        if sequence.label not in label_names:
            continue
        label = label_names.index(sequence.label)
        rise = curve[sequence.onset : sequence.apex_start + 1]
        fall = curve[sequence.apex_end : sequence.offset + 1]
        for cut, start, end in ((rise, 0, label), (fall, label, 0)):
            if len(cut) > 1:  # a recording that begins or ends at its apex has one half
                rows.append((_resample(cut, frames, by), start, end, sequence.subject, scale, _seconds(sequence, cut)))
    return _stack(rows)


def direct_transitions(data: dataset.Dataset, split: str, *, frames: int = FRAMES) -> Motions:
    """Return the peak -> peak transitions of a split that were performed directly.

    Only synthetic datasets have them, so that they serve evaluation alone. Raises `ValueError` where there are none.
    """
    rows = []
    for sequence, curve, scale in recordings(data, split, direct=True):
        start, end = (data.labels.index(name) for name in sequence.label.split(">"))
        rows.append((_resample(curve, frames), start, end, sequence.subject, scale, _seconds(sequence, curve)))
    return _stack(rows)


def interpolated_transitions(
    onsets: Motions,
    labels: int,
    *,
    per_pair: int | None,
    reuse: int | None = None,
    choice: str = "prototypes",
    time_warp: str = "performed",
    pairs: Collection[tuple[int, int]] | None = None,
    seed: int = 0,
    frames: int = FRAMES,
    chunk: int = 4096,
) -> Iterator[Motions]:
    """Yield peak -> peak transitions along geodesics between onsets, in parts of at most `chunk` motions.

    Args:
      onsets: neutral -> peak motions.
      labels: number of labels, neutral included.
      per_pair: transitions of each ordered pair of expressions; None for all.
      reuse: with "prototypes", the number of transitions of one pair that an onset may start, or end; None for any.
      choice: "prototypes" takes the peaks nearest to the mean peaks of the two expressions (OT23), "spread" uses all
        subjects equally often.
      time_warp: as in `augment.transitions`.
      pairs: the (start, end) labels to return; None for all.
      seed: of the draw for "spread".
      frames: T.
      chunk: bounds the memory.

    Raises:
      ValueError: another `choice`.
    """
    if choice not in ("prototypes", "spread"):
        raise ValueError(f'choice: expected "prototypes" or "spread", got {choice!r}')
    q, log_length = srvf.encode(jnp.asarray(onsets.curves))
    motions = augment.Motions(q, log_length, jnp.asarray(onsets.curves[:, 0]))
    if choice == "spread":
        chosen = augment.balanced_pairs(onsets.end - 1, classes=labels - 1, per_pair=per_pair, seed=seed)
    else:
        peaks = onsets.curves[:, -1]
        prototypes = np.zeros((labels, *peaks.shape[1:]))
        prototypes[1:] = augment.prototypes(peaks, onsets.end - 1, classes=labels - 1)
        count = len(onsets.curves) ** 2 if per_pair is None else per_pair
        chosen = augment.select(peaks, onsets.end, prototypes, per_pair=count, reuse=reuse).pairs
    if pairs is not None:
        wanted = np.zeros((labels, labels), bool)
        wanted[tuple(np.array(sorted(pairs), int).reshape(-1, 2).T)] = True
        chosen = chosen[wanted[onsets.end[chosen[:, 0]], onsets.end[chosen[:, 1]]]]
    return _between(onsets, motions, chosen, frames, time_warp, chunk)


def _between(
    onsets: Motions, motions: augment.Motions, chosen: np.ndarray, frames: int, time_warp: str, chunk: int
) -> Iterator[Motions]:
    for low in range(0, len(chosen), chunk):
        pairs = chosen[low : low + chunk]
        curves = [np.asarray(c) for c in augment.transitions(motions, pairs, frames=frames, time_warp=time_warp)]
        first, second = pairs.T
        own = (onsets.end[first], onsets.end[second], onsets.subject[first], onsets.scale[first])
        yield Motions(np.concatenate(curves), *own, onsets.seconds[second])


def join(*parts: Motions) -> Motions:
    """Concatenate motions."""
    return Motions(*(np.concatenate(fields) for fields in zip(*parts, strict=True)))


def recordings(
    data: dataset.Dataset, split: str, *, direct: bool
) -> Iterator[tuple[dataset.Sequence, np.ndarray, float]]:
    """Yield each sequence of a split with its unitless displacements (T, L, 3) and the millimetres per unit.

    `direct` selects direct transitions, otherwise they are skipped.
    """
    members = set(data.subjects(split).tolist())
    rest = data.neutral[:, data.landmark_index]
    for sequence in data.sequences:
        if sequence.subject in members and (">" in sequence.label) == direct:
            landmarks = np.asarray(data.landmarks[sequence.start : sequence.start + sequence.frames])
            neutral = rest[sequence.subject]
            scale = float(np.linalg.norm(neutral - neutral.mean(axis=0)))
            yield sequence, (landmarks - neutral) / scale, scale


def _seconds(sequence: dataset.Sequence, part: np.ndarray) -> float:
    return (len(part) - 1) * sequence.duration / sequence.frames


def _resample(curve: np.ndarray, frames: int, by: str = "time") -> np.ndarray:
    # NumPy, because sequences differ in length and a jitted function would compile for each length.
    if by not in ("time", "arc"):
        raise ValueError(f'by: expected "time" or "arc", got {by!r}')
    position = np.linspace(0, len(curve) - 1, frames)
    if by == "arc":
        steps = np.linalg.norm(np.diff(curve.reshape(len(curve), -1), axis=0), axis=1)
        arc_length = np.append(0, np.cumsum(steps + 1e-12))
        position = np.interp(np.linspace(0, arc_length[-1], frames), arc_length, np.arange(len(curve)))
    low = np.minimum(position.astype(int), len(curve) - 2)
    weight = (position - low)[:, None, None].astype(np.float32)
    return curve[low] * (1 - weight) + curve[low + 1] * weight


def _stack(rows: list[tuple[np.ndarray, int, int, int, float, float]]) -> Motions:
    if not rows:
        raise ValueError("the dataset has no such motions in this split")
    curves, *labels, scale, seconds = zip(*rows, strict=True)
    numbers = (np.array(x, np.int32) for x in labels)
    sizes = (np.array(x, np.float32) for x in (scale, seconds))
    return Motions(np.stack(curves).astype(np.float32), *numbers, *sizes)
