"""Construction and evaluation of interpolated motions for `experiments.interpolation`.

Motions are interpolated between the onsets (neutral to peak) of two people, and transitions from peak to peak are
built from the onsets of one person. Curves are unitless displacements from neutral; `scale` gives the millimetres per
unit. A variant of a transition is a path, on the sphere of SRVFs or straight, and a pace, the timing along it.
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
from facejax.evaluation import motion_metrics
from facejax.geometry import sphere, srvf

PATHS = ("sphere", "linear")
PACES = ("even", "minimum jerk", "performed")
VARIANTS = tuple((path, pace) for path in PATHS for pace in PACES)
TAUS = (0.25, 0.5, 0.75)  # interpolation parameters between two motions
_MEASURES = {
    "length": motion_metrics.length,
    "peak": motion_metrics.end_norm,
    "acceleration": motion_metrics.acceleration,
}


class PeakTransitions(NamedTuple):
    """K transitions from peak to peak."""

    curves: np.ndarray  # (K, T, L, 3)
    tau: np.ndarray  # (K, T): fraction of the path covered at each frame


def read_splits(data: dataset.Dataset, splits: Sequence[str], read=motions.halves) -> motions.Motions:
    """Read the motions of several splits with `read` and join them."""
    return motions.join(*(read(data, split) for split in splits))


def onsets_only(halves: motions.Motions) -> motions.Motions:
    """Return the motions that start at neutral."""
    return halves.take(halves.start == 0)


@partial(jax.jit, static_argnames="path")
def interpolate(first: jax.Array, second: jax.Array, tau: jax.Array | float, *, path: str) -> jax.Array:
    """Interpolate between motions (K, T, L, 3) at the fraction tau, on the sphere of SRVFs or frame by frame in 3D."""
    if path == "linear":
        return (1 - tau) * first + tau * second
    (q1, length1), (q2, length2) = srvf.encode(first), srvf.encode(second)
    start = (1 - tau) * first[:, 0] + tau * second[:, 0]
    return srvf.decode(sphere.geodesic(q1, q2, tau), (1 - tau) * length1 + tau * length2, start)


def peak_transitions(first: np.ndarray, second: np.ndarray, *, path: str, pace: str) -> PeakTransitions:
    """Build transitions from the last frames of the onsets `first` to those of `second`, both (K, T, L, 3).

    Args:
        path: "sphere" is `augment.transition`; "linear" is the straight line from peak to peak.
        pace: "even"; "minimum jerk" (Flash & Hogan 1985); "performed", that of `second`, as in `augment.transitions`.
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
        return PeakTransitions(np.asarray(augment.transition(*ends, tau, frames=frames)), tau)
    share = tau[..., None, None]
    return PeakTransitions((1 - share) * first[:, None, -1] + share * second[:, None, -1], tau)


def perform_again(data: dataset.Dataset, found: motions.Motions, *, take: int = 1) -> motions.Motions:
    """Return another take of the direct transitions by the same people; the dataset holds take 0 alone."""
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


def variant_name(way: tuple[str, str]) -> str:
    """Return the name of a variant in tables and results."""
    return ", ".join(way)


def compare_with_direct(made: PeakTransitions, direct: motions.Motions, scale: float) -> dict[str, Any]:
    """Compare K transitions with the directly performed ones between the same peaks.

    "aligned" distances are those after a correction, linear in the covered fraction of the path, that makes both ends
    agree. Ratios are ratios of means.
    """
    left = 1 - made.tau[..., None, None]
    first, last = (direct.curves[:, [k]] - made.curves[:, [k]] for k in (0, -1))
    aligned = made.curves + left * first + (1 - left) * last
    away, away_aligned = (
        motion_metrics.mean_distance(curves, direct.curves) * scale for curves in (made.curves, aligned)
    )
    off = motion_metrics.speed_profile(made.curves) - motion_metrics.speed_profile(direct.curves)
    ends = np.linalg.norm(np.concatenate([first, last]), axis=-1).mean() * scale
    return {
        "distance_mm": float(away.mean()),
        "distance_aligned_mm": float(away_aligned.mean()),
        "ends_mm": float(ends),
        "each_aligned_mm": away_aligned,
        "speed_rms": float(np.sqrt((off**2).mean(axis=1)).mean()),
        "acceleration_ratio": motion_metrics.ratio_of_means(motion_metrics.acceleration, made.curves, direct.curves),
        "detour": float(motion_metrics.detour(made.curves).mean()),
        "detour_ratio": motion_metrics.ratio_of_means(motion_metrics.detour, made.curves, direct.curves),
        "halfway_ratio": motion_metrics.ratio_of_means(
            motion_metrics.displacement_at_half_path, made.curves, direct.curves
        ),
        "profile": motion_metrics.speed_profile(made.curves).mean(axis=0),
    }


def draw_pairs(onsets: motions.Motions, count: int, seed: int) -> dict[str, np.ndarray]:
    """Draw index pairs (E * count, 2) of two people's onsets, `count` for each expression of the first one.

    Returned by kind: "same expression" and "two expressions".
    """
    random = np.random.default_rng(seed)
    drawn: dict[str, list] = {"same expression": [], "two expressions": []}
    for label in np.unique(onsets.end):
        for first in random.choice(np.flatnonzero(onsets.end == label), count):
            other = onsets.subject != onsets.subject[first]
            for kind, wanted in zip(drawn, (onsets.end == label, onsets.end != label), strict=True):
                drawn[kind].append((first, random.choice(np.flatnonzero(other & wanted))))
    return {kind: np.array(rows) for kind, rows in drawn.items()}


def interpolation_scores(
    onsets: motions.Motions, noisy: np.ndarray, pairs: np.ndarray, path: str, pool: motions.Motions | None, scale: float
) -> dict[str, np.ndarray]:
    """Compare interpolated motions with the two motions they are made of, (TAUS, K) each.

    Ratios are to the geometric mean of the two, weighted by tau. `noisy` holds the onsets with noise added: "noise_mm"
    is the distance that the noise moves the interpolated motion. With a `pool` of other people's onsets, also the
    distance to the nearest real motion.
    """
    rows = []
    for tau in TAUS:
        first, second = (onsets.curves[column] for column in pairs.T)
        made = np.asarray(interpolate(first, second, tau, path=path))
        row = {
            f"{name}_ratio": measure(made) / (measure(first) ** (1 - tau) * measure(second) ** tau)
            for name, measure in _MEASURES.items()
        }
        row["jitter_ratio"] = row["acceleration_ratio"] / row["length_ratio"]
        moved = np.asarray(interpolate(*(noisy[column] for column in pairs.T), tau, path=path))
        row["noise_mm"] = scale * motion_metrics.mean_distance(moved, made)
        if pool is not None:
            row |= nearest_real(made, onsets.end[pairs[:, 0]], pool, scale)
        rows.append(row)
    return {name: np.stack([row[name] for row in rows]) for name in rows[0]}


def nearest_real(curves: np.ndarray, labels: np.ndarray, pool: motions.Motions, scale: float) -> dict[str, np.ndarray]:
    """Return the distance (K,) to the nearest pool motion of the same label, in mm and as an angle on the sphere."""
    found = {"nearest_mm": np.zeros(len(curves)), "nearest_angle": np.zeros(len(curves))}
    for label in np.unique(labels):
        mine, known = curves[labels == label], pool.curves[pool.end == label]
        found["nearest_mm"][labels == label] = scale * np.asarray(metrics.nearest_distance(mine, known))
        q, p = (np.asarray(srvf.encode(jnp.asarray(x))[0]).reshape(len(x), -1) for x in (mine, known))
        cosine = q @ p.T / (curves.shape[1] - 1)
        found["nearest_angle"][labels == label] = np.arccos(np.clip(cosine, -1, 1)).min(axis=1)
    return found
