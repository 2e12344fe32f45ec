"""What `experiments.interpolation` makes and measures: motions between two performed ones, and from peak to peak.

Everything is a displacement from neutral, unitless; measures take the millimetres per unit.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from facejax import augment, metrics
from facejax.data import dataset, motions
from facejax.data.synthetic import makehuman, performance, rig
from facejax.geometry import sphere, srvf

PATHS = ("sphere", "linear")
PACES = ("even", "minimum jerk", "performed")
WAYS = tuple((path, pace) for path in PATHS for pace in PACES)  # from one peak to another
TAUS = (0.25, 0.5, 0.75)  # places between two motions


class Walk(NamedTuple):
    """K motions from peak to peak."""

    curves: np.ndarray  # (K, T, L, 3)
    tau: np.ndarray  # (K, T): the share of the way that each frame has gone


def joined(data: dataset.Dataset, splits: Sequence[str], only=motions.halves) -> motions.Motions:
    """`motions.halves` or `motions.direct_transitions` of several splits."""
    return motions.join(*(only(data, split) for split in splits))


def onsets_of(halves: motions.Motions) -> motions.Motions:
    """Neutral -> peak alone."""
    return halves.take(halves.start == 0)


@partial(jax.jit, static_argnames="path")
def between(first: jax.Array, second: jax.Array, tau: jax.Array | float, *, path: str) -> jax.Array:
    """The motions (K, T, L, 3) at a fraction tau of the way between two: on the sphere, or frame by frame in 3D."""
    if path == "linear":
        return (1 - tau) * first + tau * second
    (q1, length1), (q2, length2) = srvf.encode(first), srvf.encode(second)
    start = (1 - tau) * first[:, 0] + tau * second[:, 0]
    return srvf.decode(sphere.geodesic(q1, q2, tau), (1 - tau) * length1 + tau * length2, start)


def walk(first: np.ndarray, second: np.ndarray, *, path: str, pace: str) -> Walk:
    """From the last frames of the onsets `first` to those of `second`, both (K, T, L, 3).

    On the "sphere": `augment.transition`. "linear": straight from peak to peak. `pace` "performed" is that of `second`,
    as in `augment.transitions`; "minimum jerk" is the one that hands and faces start and stop at.
    """
    frames = first.shape[1]
    (q1, length1), (q2, length2) = (srvf.encode(jnp.asarray(x)) for x in (first, second))
    time = np.linspace(0, 1, frames, dtype=np.float32)
    if pace == "performed":
        tau = np.asarray(srvf.arc_length_fraction(q2))
    else:
        tau = np.tile(time if pace == "even" else time**3 * (10 - 15 * time + 6 * time**2), (len(first), 1))
    if path == "sphere":
        ends = q1, length1, q2, length2, first[:, 0], second[:, 0]
        return Walk(np.asarray(augment.transition(*ends, tau, frames=frames)), tau)
    share = tau[..., None, None]
    return Walk((1 - share) * first[:, None, -1] + share * second[:, None, -1], tau)


def again(data: dataset.Dataset, found: motions.Motions, *, take: int = 1) -> motions.Motions:
    """Direct transitions performed by the same people once more. They are not in the dataset: it has take 0."""
    spec = data.index["spec"]
    curves = np.zeros_like(found.curves)
    for person in np.unique(found.subject):
        posed = rig.build(makehuman.subject(int(person), seed=spec["seed"]), level=spec["level"])
        mine = np.flatnonzero(found.subject == person)
        names = [(data.labels[found.start[k]], data.labels[found.end[k]]) for k in mine]
        weights = [performance.perform_direct(*pair, int(person), take=take, seed=spec["seed"]) for pair in names]
        skin = rig.pose(posed, np.concatenate(weights))[:, data.landmark_index]
        moved = skin - data.neutral[person][data.landmark_index]
        curves[mine] = moved.reshape(len(mine), -1, *moved.shape[1:]) / found.scale[mine, None, None, None]
    return found._replace(curves=curves)


def name(way: tuple[str, str]) -> str:
    """As tables call it."""
    return ", ".join(way)


def profile(curves: np.ndarray) -> np.ndarray:
    """Speed at each step over the mean speed, (K, T-1)."""
    speed = np.linalg.norm(np.diff(curves, axis=1), axis=-1).mean(axis=-1)
    return speed / speed.mean(axis=1, keepdims=True)


def detour(curves: np.ndarray) -> np.ndarray:
    """Length of the path over the distance of its ends, (K,); 1: straight."""
    steps = np.linalg.norm(np.diff(curves, axis=1), axis=(-2, -1)).sum(axis=1)
    return steps / np.linalg.norm(curves[:, -1] - curves[:, 0], axis=(-2, -1))


def halfway(curves: np.ndarray) -> np.ndarray:
    """How far from neutral the face is when half of the path is done, (K,), in mean distance of a landmark."""
    covered = np.cumsum(np.linalg.norm(np.diff(curves, axis=1), axis=(-2, -1)), axis=1)
    frame = 1 + np.argmin(np.abs(covered / covered[:, -1:] - 0.5), axis=1)
    return np.linalg.norm(curves[np.arange(len(curves)), frame], axis=-1).mean(axis=-1)


def against(made: Walk, direct: motions.Motions, scale: float) -> dict[str, Any]:
    """How near K motions are to directly performed ones between the same peaks.

    "aligned": moved so that both ends agree with the direct ones', in proportion to the way gone. Ratios: of means.
    """
    left = 1 - made.tau[..., None, None]
    first, last = (direct.curves[:, [k]] - made.curves[:, [k]] for k in (0, -1))
    aligned = made.curves + left * first + (1 - left) * last
    away, away_aligned = (_away(curves, direct.curves) * scale for curves in (made.curves, aligned))
    off = profile(made.curves) - profile(direct.curves)
    ends = np.linalg.norm(np.concatenate([first, last]), axis=-1).mean() * scale
    return {
        "distance_mm": float(away.mean()),
        "distance_aligned_mm": float(away_aligned.mean()),
        "ends_mm": float(ends),
        "each_aligned_mm": away_aligned,
        "speed_rms": float(np.sqrt((off**2).mean(axis=1)).mean()),
        "acceleration_ratio": _ratio(_acceleration, made.curves, direct.curves),
        "detour": float(detour(made.curves).mean()),
        "detour_ratio": _ratio(detour, made.curves, direct.curves),
        "halfway_ratio": _ratio(halfway, made.curves, direct.curves),
        "profile": profile(made.curves).mean(axis=0),
    }


def pairs_between(onsets: motions.Motions, count: int, seed: int) -> dict[str, np.ndarray]:
    """Index pairs (E * count, 2) of two people's onsets, `count` for each first expression, by what the second is."""
    random = np.random.default_rng(seed)
    drawn: dict[str, list] = {"same expression": [], "two expressions": []}
    for label in np.unique(onsets.end):
        for first in random.choice(np.flatnonzero(onsets.end == label), count):
            other = onsets.subject != onsets.subject[first]
            for kind, wanted in zip(drawn, (onsets.end == label, onsets.end != label), strict=True):
                drawn[kind].append((first, random.choice(np.flatnonzero(other & wanted))))
    return {kind: np.array(rows) for kind, rows in drawn.items()}


def cleanness(
    onsets: motions.Motions, noisy: np.ndarray, pairs: np.ndarray, path: str, pool: motions.Motions | None, scale: float
) -> dict[str, np.ndarray]:
    """How motions between two people's keep what the two have, and how far noise moves them, (tau, K) each.

    `noisy`: the onsets' curves with noise. With a pool of other people's onsets, also how near they are to real ones.
    """
    rows = []
    for tau in TAUS:
        first, second = (onsets.curves[column] for column in pairs.T)
        made = np.asarray(between(first, second, tau, path=path))
        row = {
            f"{name}_ratio": measure(made) / (measure(first) ** (1 - tau) * measure(second) ** tau)
            for name, measure in (("length", _length), ("peak", _peak), ("acceleration", _acceleration))
        }
        row["jitter_ratio"] = row["acceleration_ratio"] / row["length_ratio"]
        moved = np.asarray(between(*(noisy[column] for column in pairs.T), tau, path=path))
        row["noise_mm"] = scale * _away(moved, made)
        if pool is not None:
            row |= nearest(made, onsets.end[pairs[:, 0]], pool, scale)
        rows.append(row)
    return {name: np.stack([row[name] for row in rows]) for name in rows[0]}


def nearest(curves: np.ndarray, labels: np.ndarray, pool: motions.Motions, scale: float) -> dict[str, np.ndarray]:
    """The distance (K,) to the nearest motion of the same label in the pool: in mm, and as an angle on the sphere."""
    found = {"nearest_mm": np.zeros(len(curves)), "nearest_angle": np.zeros(len(curves))}
    for label in np.unique(labels):
        mine, known = curves[labels == label], pool.curves[pool.end == label]
        found["nearest_mm"][labels == label] = scale * np.asarray(metrics.nearest_distance(mine, known))
        q, p = (np.asarray(srvf.encode(jnp.asarray(x))[0]).reshape(len(x), -1) for x in (mine, known))
        cosine = q @ p.T / (curves.shape[1] - 1)
        found["nearest_angle"][labels == label] = np.arccos(np.clip(cosine, -1, 1)).min(axis=1)
    return found


def _length(curves: np.ndarray) -> np.ndarray:
    return np.asarray(srvf.length(jnp.asarray(curves)))


def _peak(curves: np.ndarray) -> np.ndarray:
    return np.linalg.norm(curves[:, -1], axis=(-2, -1))


def _acceleration(curves: np.ndarray) -> np.ndarray:
    return np.asarray(metrics.acceleration(jnp.asarray(curves)))


def _away(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Mean distance (K,) of a landmark."""
    return np.linalg.norm(a - b, axis=-1).mean(axis=(1, 2))


def _ratio(measure, a: np.ndarray, b: np.ndarray) -> float:
    return float(np.mean(measure(a)) / np.mean(measure(b)))
