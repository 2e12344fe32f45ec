"""Motions for Motion3DGAN, cut from a 4D dataset: displacements from neutral, unitless, 30 frames each.

Unitless: divided by the centred Frobenius norm of the subject's neutral landmarks, which is returned so that
figures can be given in millimetres. Halves are neutral -> peak (onset to the start of the apex) and peak -> neutral
(end of the apex to offset), resampled uniformly in time; OT23, 4.1."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from facejax import augment
from facejax.data import store
from facejax.geometry import srvf

FRAMES = 30


class Motions(NamedTuple):
    """K motions. `start` and `end` index the dataset's labels, of which 0 is neutral."""

    curves: np.ndarray  # (K, T, L, 3) displacements from neutral, unitless
    start: np.ndarray  # (K,) int32
    end: np.ndarray  # (K,) int32
    subject: np.ndarray  # (K,) int32, of the start where two subjects were combined
    scale: np.ndarray  # (K,) millimetres per unit

    def take(self, which: np.ndarray) -> Motions:
        """The motions at indices, or under a mask."""
        return Motions(*(field[which] for field in self))

    def millimetres(self) -> np.ndarray:
        """The curves in millimetres."""
        return self.curves * self.scale[:, None, None, None]


def halves(data: store.Store, split: str, *, frames: int = FRAMES) -> Motions:
    """Every neutral -> peak and peak -> neutral motion of a split's subjects."""
    rows = []
    for sequence, curve, scale in recordings(data, split, direct=False):
        label = data.labels.index(sequence.label)
        rise = curve[sequence.onset : sequence.apex_start + 1]
        fall = curve[sequence.apex_end : sequence.offset + 1]
        rows.append((_resample(rise, frames), 0, label, sequence.subject, scale))
        rows.append((_resample(fall, frames), label, 0, sequence.subject, scale))
    return _stack(rows)


def directs(data: store.Store, split: str, *, frames: int = FRAMES) -> Motions:
    """The directly performed peak -> peak transitions of a split; no capture set has them, evaluation only."""
    rows = []
    for sequence, curve, scale in recordings(data, split, direct=True):
        start, end = (data.labels.index(name) for name in sequence.label.split(">"))
        rows.append((_resample(curve, frames), start, end, sequence.subject, scale))
    return _stack(rows)


def interpolated(onsets: Motions, labels: int, *, per_pair: int, reuse: int | None, frames: int = FRAMES) -> Motions:
    """Peak -> peak transitions on the geodesics between onsets: the `per_pair` nearest to the prototypes.

    With `reuse`, no onset serves as the start, or as the end, of more than so many transitions of one pair.
    """
    q, log_length = srvf.encode(jnp.asarray(onsets.curves))
    motions = augment.Motions(q, log_length, jnp.asarray(onsets.curves[:, 0]))
    peaks = onsets.curves[:, -1]
    prototypes = np.zeros((labels, *peaks.shape[1:]))
    prototypes[1:] = augment.prototypes(peaks, onsets.end - 1, classes=labels - 1)
    chosen = augment.select(peaks, onsets.end, prototypes, per_pair=per_pair, reuse=reuse).pairs
    curves = np.concatenate([np.asarray(c) for c in augment.transitions(motions, chosen, frames=frames)])
    first, second = chosen.T
    return Motions(curves, onsets.end[first], onsets.end[second], onsets.subject[first], onsets.scale[first])


def join(*parts: Motions) -> Motions:
    """All motions, one after the other."""
    return Motions(*(np.concatenate(fields) for fields in zip(*parts, strict=True)))


def recordings(data: store.Store, split: str, *, direct: bool) -> Iterator[tuple[store.Sequence, np.ndarray, float]]:
    """Each sequence of a split, its displacements from neutral (T, L, 3), unitless, and the millimetres per unit."""
    members = set(data.subjects(split).tolist())
    rest = data.neutral[:, data.landmark_index]
    for sequence in data.sequences:
        if sequence.subject in members and (">" in sequence.label) == direct:
            landmarks = np.asarray(data.landmarks[sequence.start : sequence.start + sequence.frames])
            neutral = rest[sequence.subject]
            scale = float(np.linalg.norm(neutral - neutral.mean(axis=0)))
            yield sequence, (landmarks - neutral) / scale, scale


def _resample(curve: np.ndarray, frames: int) -> np.ndarray:
    # In NumPy: every sequence has its own length, and a jitted function would compile for each.
    place = np.linspace(0, len(curve) - 1, frames)
    low = np.minimum(place.astype(int), len(curve) - 2)
    weight = (place - low)[:, None, None].astype(np.float32)
    return curve[low] * (1 - weight) + curve[low + 1] * weight


def _stack(rows: list[tuple]) -> Motions:
    if not rows:
        raise ValueError("the dataset has no such motions in this split")
    curves, start, end, subject, scale = zip(*rows, strict=True)
    numbers = (np.array(x, np.int32) for x in (start, end, subject))
    return Motions(np.stack(curves).astype(np.float32), *numbers, np.array(scale, np.float32))
