"""What landmarks cannot see: how far from the truth the best of all methods would stay.

Two frames with near-equal landmarks and different meshes show what no function of the landmarks can get right. The
Gamma test (Stefansson et al. 1997): half the squared difference of neighbours' meshes, regressed on the squared
distance of their landmarks, meets distance zero at the variance that the landmarks leave open. What a good map left
over stands for the meshes: it differs less among neighbours for what the landmarks do tell, and the estimate is
steadier.

F frames, L landmarks, N vertices; millimetres, on the host.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

NEIGHBOURS = 10
# The mean length of a vector of three equal Gaussian coordinates, over its root mean square: sqrt(8 / (3 pi)).
MEAN_OVER_RMS = np.sqrt(8 / (3 * np.pi))


def nearest_pairs(
    landmarks: np.ndarray, group: np.ndarray, *, recording: np.ndarray | None = None, within_groups: bool = False,
    count: int = NEIGHBOURS,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Pairs (P, 2) of near frames by their landmarks (F, L, 3), and the squared distances (P,).

    Of different groups (F,), people say; or `within_groups`, of one group but not of one and the same `recording` (F,), a recording
    say. The `count` nearest such frames of each.
    """
    flat = np.asarray(landmarks, np.float64).reshape(len(landmarks), -1)
    found = []
    if within_groups:
        if recording is None:
            raise ValueError("pairs within a group need `apart`: frames of one recording are no two samples")
        for value in np.unique(group):
            mine = np.flatnonzero(group == value)
            found.append(mine[_nearest(flat[mine], recording[mine], count)])
    else:
        found.append(_nearest(flat, group, count))
    both = np.concatenate(found)
    if not len(both):
        raise ValueError("no two frames to compare: one group, or one recording of each")
    return both, np.sum((flat[both[:, 0]] - flat[both[:, 1]]) ** 2, axis=1)


def estimate(residuals: np.ndarray, pairs: np.ndarray, squared_distances: np.ndarray) -> np.ndarray:
    """The floor (N,) in mm, mean distance per vertex, of what a map left over (F, N, 3), from `nearest_pairs`."""
    gaps = np.zeros((len(pairs), residuals.shape[1]), np.float32)
    for low in range(0, len(pairs), 256):
        some = pairs[low : low + 256]
        gaps[low : low + 256] = 0.5 * np.sum((residuals[some[:, 0]] - residuals[some[:, 1]]) ** 2, axis=-1)
    # Near pairs say most about distance zero, and far ones pull the line: the nearer half decides.
    near = squared_distances <= np.median(squared_distances)
    x, y = squared_distances[near], gaps[near].astype(np.float64)
    slope = (x - x.mean()) @ (y - y.mean(axis=0)) / max(np.sum((x - x.mean()) ** 2), 1e-12)
    # A variance is not negative, and not below zero's slope: distance does not make meshes more alike.
    variance = np.where(slope > 0, y.mean(axis=0) - slope * x.mean(), y.mean(axis=0))
    return np.sqrt(np.maximum(variance, 0.0)) * MEAN_OVER_RMS


def _nearest(flat: np.ndarray, group: np.ndarray, count: int) -> np.ndarray:
    """(P, 2): each row with its `count` nearest rows of another group."""
    found = []
    for value in np.unique(group):
        mine, others = np.flatnonzero(group == value), np.flatnonzero(group != value)
        if len(others):
            near = cKDTree(flat[others]).query(flat[mine], k=min(count, len(others)))[1].reshape(len(mine), -1)
            found.append(np.stack([np.repeat(mine, near.shape[1]), others[near.ravel()]], axis=1))
    return np.concatenate(found) if found else np.empty((0, 2), np.int64)
