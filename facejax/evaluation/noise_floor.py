"""Irreducible error given the landmarks: a lower bound for the error of every decoder.

Two frames with nearly equal landmarks and different meshes show what no function of the landmarks can predict. The
Gamma test (Stefansson et al. 1997) regresses half the squared difference of neighbours' meshes on the squared distance
of their landmarks; the intercept estimates the variance unexplained by the landmarks. Residuals of a good decoder take
the place of the meshes: what the landmarks do predict is removed, and the estimate has less variance.

F frames, L landmarks, N vertices, P pairs; millimetres, on the host.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree

NEIGHBOURS = 10
# Mean length of an isotropic Gaussian vector in three dimensions, over its root mean square: sqrt(8 / (3 pi)).
MEAN_OVER_RMS = np.sqrt(8 / (3 * np.pi))


def nearest_pairs(
    landmarks: np.ndarray, group: np.ndarray, *, recording: np.ndarray | None = None, within_groups: bool = False,
    count: int = NEIGHBOURS,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Return pairs (P, 2) of frames that are close by their landmarks, and their squared distances (P,).

    Args:
      landmarks: (F, L, 3).
      group: (F,), such as people: frames of different groups are paired.
      recording: (F,), needed with `within_groups`.
      within_groups: pair frames of one group and of different recordings instead.
      count: number of nearest frames of each frame.

    Raises:
      ValueError: no pair is possible, or `recording` is missing.
    """
    flat = np.asarray(landmarks, np.float64).reshape(len(landmarks), -1)
    blocks = []
    if within_groups:
        if recording is None:
            raise ValueError("within_groups needs `recording`: frames of one recording are not independent")
        for value in np.unique(group):
            rows = np.flatnonzero(group == value)
            blocks.append(rows[_nearest(flat[rows], recording[rows], count)])
    else:
        blocks.append(_nearest(flat, group, count))
    pairs = np.concatenate(blocks)
    if not len(pairs):
        raise ValueError("no pairs: expected two groups, or two recordings of a group")
    return pairs, np.sum((flat[pairs[:, 0]] - flat[pairs[:, 1]]) ** 2, axis=1)


def estimate(residuals: np.ndarray, pairs: np.ndarray, squared_distances: np.ndarray) -> np.ndarray:
    """Estimate the irreducible error (N,) in mm, as mean distance per vertex.

    Args:
      residuals: (F, N, 3) of a decoder.
      pairs, squared_distances: of `nearest_pairs`.
    """
    gaps = np.zeros((len(pairs), residuals.shape[1]), np.float32)
    for low in range(0, len(pairs), 256):
        some = pairs[low : low + 256]
        gaps[low : low + 256] = 0.5 * np.sum((residuals[some[:, 0]] - residuals[some[:, 1]]) ** 2, axis=-1)
    # Only the nearer half of the pairs: distant ones bias the intercept.
    near = squared_distances <= np.median(squared_distances)
    x, y = squared_distances[near], gaps[near].astype(np.float64)
    slope = (x - x.mean()) @ (y - y.mean(axis=0)) / max(np.sum((x - x.mean()) ** 2), 1e-12)
    # Neither the variance nor the slope is negative: meshes do not become more similar with distance.
    variance = np.where(slope > 0, y.mean(axis=0) - slope * x.mean(), y.mean(axis=0))
    return np.sqrt(np.maximum(variance, 0.0)) * MEAN_OVER_RMS


def _nearest(flat: np.ndarray, group: np.ndarray, count: int) -> np.ndarray:
    """Return (P, 2): each row with its `count` nearest rows of another group."""
    found = []
    for value in np.unique(group):
        mine, others = np.flatnonzero(group == value), np.flatnonzero(group != value)
        if len(others):
            near = KDTree(flat[others]).query(flat[mine], k=min(count, len(others)))[1].reshape(len(mine), -1)
            found.append(np.stack([np.repeat(mine, near.shape[1]), others[near.ravel()]], axis=1))
    return np.concatenate(found) if found else np.empty((0, 2), np.int64)
