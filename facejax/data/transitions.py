"""Training data of the motion generators: a dataset's transitions, the chart fitted to them, and motions encoded in it.

A chart is the tangent PCA of `facejax.models.motion.tangent_pca`. M motions, R directions of motion, D of poses.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from facejax.data import dataset, motions
from facejax.geometry import sphere, srvf
from facejax.models.motion import start_poses, tangent_pca

MAX_RANK = 128  # directions of motion, where there are enough motions to estimate them
TRANSITIONS_PER_PAIR = 48  # interpolated transitions of each ordered pair; about the 6,740 of OT23 for 12 labels
SPREAD_PER_PAIR = 400  # of each ordered pair in `all_pairs`
CHART_PER_PAIR = 80  # of each ordered pair, for fitting a chart


class Examples(NamedTuple):
    """Motions in the coordinates of a chart, the input of the networks."""

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
    """Return OT23's training set: halves, and for every two expressions the transitions nearest to the prototypes.

    `label_names` as in `motions.halves`; `per_pair`, `reuse` and `time_warp` as in `motions.interpolated_transitions`.
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
    """Yield halves, then peak -> peak transitions between all subjects, without selection.

    Arguments as in `transitions`.
    """
    halves = motions.halves(data, split, label_names=label_names)
    yield halves
    onsets = halves.take(halves.start == 0)
    count = len(data.labels if label_names is None else label_names)
    yield from motions.interpolated_transitions(
        onsets, count, per_pair=per_pair, choice="spread", time_warp=time_warp, seed=seed
    )


def fit_chart(
    known: motions.Motions, *, labels: int, rank: int = 128, pose: int = 32, mean: str = "karcher"
) -> tangent_pca.TangentPCA:
    """Fit the chart of a training set.

    Args:
      known: the motions.
      labels: K, the number of labels.
      rank: R; needs more motions than that.
      pose: D.
      mean: base point, the "karcher" mean of the motions or their normalised "extrinsic" mean.

    Raises:
      ValueError: a motion has a label above K - 1, or another `mean`.
    """
    if (highest := max(known.start.max(), known.end.max())) >= labels:
        raise ValueError(f"labels: expected more than {highest}, the highest label of the motions; got {labels}")
    if mean not in ("karcher", "extrinsic"):
        raise ValueError(f'mean: expected "karcher" or "extrinsic", got {mean!r}')
    q, log_length = srvf.encode(jnp.asarray(known.curves))
    p = sphere.karcher_mean(q) if mean == "karcher" else sphere.extrinsic_mean(q)
    motion = tangent_pca.Motion(q, np.asarray(log_length), np.log(known.seconds))  # pyright: ignore
    return tangent_pca.fit(
        np.asarray(p), np.asarray(sphere.log(p, q)), motion, known.start, known.end, known.curves[:, 0],
        labels=labels, rank=rank, pose=pose,
    )  # fmt: skip


def encode_examples(chart: tangent_pca.TangentPCA, parts: motions.Motions | Iterable[motions.Motions]) -> Examples:
    """Encode motions in a chart. Parts are consumed one at a time, so that memory holds one of them."""
    rows = []
    for part in [parts] if isinstance(parts, motions.Motions) else parts:
        values, pose = _place(chart, part.curves, np.log(part.seconds), part.start, part.end)
        rows.append(Examples(np.asarray(values), part.start, part.end, np.asarray(pose)))
    return Examples(*(np.concatenate(fields) for fields in zip(*rows, strict=True)))


def balance_pairs(start: np.ndarray, end: np.ndarray, seed: int = 0) -> np.ndarray:
    """Return row numbers in which every (start, end) occurs as often as the most frequent one.

    Args:
      start: labels (M,).
      end: labels (M,).
      seed: of the order of rows.
    """
    pair = np.asarray(start) * (max(start.max(), end.max()) + 1) + np.asarray(end)
    count = np.bincount(pair).max()
    random = np.random.default_rng(seed)
    return np.concatenate(
        [np.resize(random.permutation(np.flatnonzero(pair == one)), count) for one in np.unique(pair)]
    )


def fit_start_poses(chart: tangent_pca.TangentPCA, known: motions.Motions) -> start_poses.StartPoses:
    """Fit the distribution of peak poses given a label, from the ends of the onsets in `known`."""
    peaks = known.take((known.start == 0) & (known.end > 0))
    poses = jax.vmap(tangent_pca.encode_pose, (None, 0, 0))(
        chart, jnp.asarray(peaks.curves[:, -1]), jnp.asarray(peaks.end)
    )
    return start_poses.fit(np.asarray(poses), peaks.end, classes=len(chart.mean))


def default_rank(known: motions.Motions) -> int:
    """Return the number of directions to learn: a quarter of the motions, at most `MAX_RANK`.

    In directions supported by few motions the flow model diverges from the data.
    """
    return min(MAX_RANK, len(known.start) // 4)


@jax.jit
def _place(
    chart: tangent_pca.TangentPCA, curves: jax.Array, log_seconds: jax.Array, start: jax.Array, end: jax.Array
) -> tuple[jax.Array, jax.Array]:
    q, log_length = srvf.encode(curves)
    values = jax.vmap(tangent_pca.encode, (None, 0, 0, 0, 0, 0))(
        chart, sphere.log(chart.p, q), log_length, log_seconds, start, end
    )
    return values, jax.vmap(tangent_pca.encode_pose, (None, 0, 0))(chart, curves[:, 0], start)
