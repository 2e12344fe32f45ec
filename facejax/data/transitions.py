"""What generators of motion learn from: a dataset's transitions, the chart fitted to them, and motions in it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from facejax.data import dataset, motions
from facejax.geometry import sphere, srvf
from facejax.models.motion import start_poses, tangent_pca

RANK = 128  # directions of motion, where there are enough motions to tell
PER_PAIR = 48  # interpolated transitions of each ordered pair: with 12 labels about the 6,740 of OT23
SPREAD = 400  # of each ordered pair where everybody meets everybody
CHARTED = 80  # of each, that a chart is fitted on


class Examples(NamedTuple):
    """Motions in a chart's coordinates, as the networks see them."""

    values: np.ndarray  # (M, 2 + R)
    start: np.ndarray  # (M,)
    end: np.ndarray  # (M,)
    pose: np.ndarray  # (M, D)


def transitions(
    data: dataset.Dataset,
    split: str,
    *,
    names: Sequence[str] | None = None,
    per_pair: int = PER_PAIR,
    reuse: int | None = 1,
    time_warp: str = "performed",
) -> motions.Motions:
    """OT23's set: halves, and the peak -> peak transitions nearest to the prototypes, between every two expressions.

    `names` as in `data.motions.halves`; `per_pair`, `reuse` and `time_warp` as in `data.motions.interpolated`.
    """
    halves = motions.halves(data, split, names=names)
    onsets = halves.take(halves.start == 0)
    count = len(data.labels if names is None else names)
    return motions.join(
        halves, *motions.interpolated(onsets, count, per_pair=per_pair, reuse=reuse, time_warp=time_warp)
    )


def all_pairs(
    data: dataset.Dataset,
    split: str,
    *,
    names: Sequence[str] | None = None,
    per_pair: int | None = SPREAD,
    time_warp: str = "performed",
    seed: int = 0,
) -> Iterator[motions.Motions]:
    """Halves, and unselected peak -> peak transitions in which everybody meets everybody, part by part."""
    halves = motions.halves(data, split, names=names)
    yield halves
    onsets = halves.take(halves.start == 0)
    count = len(data.labels if names is None else names)
    yield from motions.interpolated(onsets, count, per_pair=per_pair, choice="spread", time_warp=time_warp, seed=seed)


def fit_chart(
    known: motions.Motions, *, labels: int, rank: int = 128, pose: int = 32, mean: str = "karcher"
) -> tangent_pca.TangentPCA:
    """The chart of a training set, at the "karcher" mean of its motions, or their normalised "extrinsic" one.

    Its R = `rank` directions need more motions than that. Raises `ValueError` for labels beyond labels-1.
    """
    if (highest := max(known.start.max(), known.end.max())) >= labels:
        raise ValueError(f"labels: expected more than {highest}, the highest label of the motions; got {labels}")
    if mean not in ("karcher", "extrinsic"):
        raise ValueError(f'mean: expected "karcher" or "extrinsic", got {mean!r}')
    q, log_length = srvf.encode(jnp.asarray(known.curves))
    p = sphere.karcher_mean(q) if mean == "karcher" else sphere.extrinsic_mean(q)
    motion = tangent_pca.Motion(None, np.asarray(log_length), np.log(known.seconds))
    return tangent_pca.fit(
        np.asarray(p), np.asarray(sphere.log(p, q)), motion, known.start, known.end, known.curves[:, 0],
        labels=labels, rank=rank, pose=pose,
    )  # fmt: skip


def encode_examples(chart: tangent_pca.TangentPCA, parts: motions.Motions | Iterable[motions.Motions]) -> Examples:
    """Motions in a chart's coordinates; parts are forgotten one after the other."""
    rows = []
    for part in [parts] if isinstance(parts, motions.Motions) else parts:
        values, pose = _place(chart, part.curves, np.log(part.seconds), part.start, part.end)
        rows.append(Examples(np.asarray(values), part.start, part.end, np.asarray(pose)))
    return Examples(*(np.concatenate(fields) for fields in zip(*rows, strict=True)))


def balanced(start: np.ndarray, end: np.ndarray, seed: int = 0) -> np.ndarray:
    """Row numbers in which every (start, end) occurs as often as the most frequent one, for training."""
    pair = np.asarray(start) * (max(start.max(), end.max()) + 1) + np.asarray(end)
    most = np.bincount(pair).max()
    random = np.random.default_rng(seed)
    return np.concatenate([np.resize(random.permutation(np.flatnonzero(pair == one)), most) for one in np.unique(pair)])


def fit_starts(chart: tangent_pca.TangentPCA, known: motions.Motions) -> start_poses.StartPoses:
    """The peaks from which motions start when only a label is known, of the motions that start at one."""
    peaks = known.take((known.start == 0) & (known.end > 0))
    poses = jax.vmap(tangent_pca.encode_pose, (None, 0, 0))(
        chart, jnp.asarray(peaks.curves[:, -1]), jnp.asarray(peaks.end)
    )
    return start_poses.fit(np.asarray(poses), peaks.end, classes=len(chart.mean))


def default_rank(known: motions.Motions) -> int:
    """How many directions of motion to learn: a quarter as many as there are motions, where these are few.

    In directions that few of them take, the flow strays.
    """
    return min(RANK, len(known.start) // 4)


@jax.jit
def _place(chart, curves, log_seconds, start, end):
    q, log_length = srvf.encode(curves)
    values = jax.vmap(tangent_pca.encode, (None, 0, 0, 0, 0, 0))(
        chart, sphere.log(chart.p, q), log_length, log_seconds, start, end
    )
    return values, jax.vmap(tangent_pca.encode_pose, (None, 0, 0))(chart, curves[:, 0], start)
