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

MAX_RANK = 128  # directions of motion, where there are enough motions to tell
TRANSITIONS_PER_PAIR = 48  # interpolated transitions of each ordered pair: with 12 labels about the 6,740 of OT23
SPREAD_PER_PAIR = 400  # of each ordered pair where everybody meets everybody
CHART_PER_PAIR = 80  # of each, that a chart is fitted on


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
    label_names: Sequence[str] | None = None,
    per_pair: int = TRANSITIONS_PER_PAIR,
    reuse: int | None = 1,
    time_warp: str = "performed",
) -> motions.Motions:
    """OT23's set: halves, and the peak -> peak transitions nearest to the prototypes, between every two expressions.

    `label_names` as in `data.motions.halves`; `per_pair`, `reuse` and `time_warp` as in `data.motions.interpolated_transitions`.
    """
    halves = motions.halves(data, split, label_names=label_names)
    onsets = halves.take(halves.start == 0)
    count = len(data.labels if label_names is None else label_names)
    return motions.join(
        halves, *motions.interpolated_transitions(onsets, count, per_pair=per_pair, reuse=reuse, time_warp=time_warp)
    )


def all_pairs(
    data: dataset.Dataset,
    split: str,
    *,
    label_names: Sequence[str] | None = None,
    per_pair: int | None = SPREAD_PER_PAIR,
    time_warp: str = "performed",
    seed: int = 0,
) -> Iterator[motions.Motions]:
    """Halves, and unselected peak -> peak transitions in which everybody meets everybody, part by part."""
    halves = motions.halves(data, split, label_names=label_names)
    yield halves
    onsets = halves.take(halves.start == 0)
    count = len(data.labels if label_names is None else label_names)
    yield from motions.interpolated_transitions(onsets, count, per_pair=per_pair, choice="spread", time_warp=time_warp, seed=seed)


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


def balance_pairs(start: np.ndarray, end: np.ndarray, seed: int = 0) -> np.ndarray:
    """Row numbers in which every (start, end) occurs as often as the most frequent one, for training."""
    pair = np.asarray(start) * (max(start.max(), end.max()) + 1) + np.asarray(end)
    most = np.bincount(pair).max()
    random = np.random.default_rng(seed)
    return np.concatenate([np.resize(random.permutation(np.flatnonzero(pair == one)), most) for one in np.unique(pair)])


def fit_start_poses(chart: tangent_pca.TangentPCA, known: motions.Motions) -> start_poses.StartPoses:
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
    return min(MAX_RANK, len(known.start) // 4)


@jax.jit
def _place(chart, curves, log_seconds, start, end):
    q, log_length = srvf.encode(curves)
    values = jax.vmap(tangent_pca.encode, (None, 0, 0, 0, 0, 0))(
        chart, sphere.log(chart.p, q), log_length, log_seconds, start, end
    )
    return values, jax.vmap(tangent_pca.encode_pose, (None, 0, 0))(chart, curves[:, 0], start)
