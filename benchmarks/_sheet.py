"""Synthetic test mesh of any size."""

from __future__ import annotations

import numpy as np


def grid(side: int) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (side^2, 3) and triangles of a curved square grid."""
    y, x = np.divmod(np.arange(side * side), side)
    vertices = np.stack([x, y, 5 * np.sin(x / 9) * np.cos(y / 7)], axis=1)
    i = np.arange(side * side).reshape(side, side)
    a, b, c, d = i[:-1, :-1].ravel(), i[:-1, 1:].ravel(), i[1:, 1:].ravel(), i[1:, :-1].ravel()
    return vertices, np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
