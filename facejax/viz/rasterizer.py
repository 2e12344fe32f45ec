"""Rasterise triangles with a z-buffer in NumPy: find the nearest triangle of every sample.

Every triangle is cut into rows and every row into one span of samples: the work grows with the samples covered, not
with bounding boxes, and no Python loop runs over triangles. Barycentric coordinates and 1/depth are affine on the
screen, so that a row needs one value and one slope. N vertices, F triangles, S samples.
"""

from typing import NamedTuple

import numpy as np

# A key holds 1/depth in its high bits and the triangle in its low bits: the nearest triangle has the greatest key.
_BITS = 24
_LOW = (1 << _BITS) - 1


class Hits(NamedTuple):
    """The samples that are covered by a triangle.

    sample: (S,) index row * width + column, rising.
    face: (S,) visible triangle.
    inside: (3, S) screen barycentric coordinates, float32.
    """

    sample: np.ndarray
    face: np.ndarray
    inside: np.ndarray


def rasterize(points: np.ndarray, nearness: np.ndarray, faces: np.ndarray, size: tuple[int, int]) -> Hits:
    """Find the nearest triangle of every sample, front and back faces alike.

    Args:
      points: (N, 2) columns and rows; the sample (row i, column j) lies at (j, i).
      nearness: (N,) 1/depth; triangles with a corner at nearness <= 0 are skipped.
      faces: (F, 3), at most 2**24.
      size: (width, height).

    Raises:
      ValueError: too many triangles.
    """
    width, height = size
    if len(faces) > _LOW:
        raise ValueError(f"at most {_LOW} triangles can be drawn, got {len(faces)}")
    corner = faces.T
    x, y = points.T.astype(np.float64)[:, corner]
    depth = nearness.astype(np.float64)[corner]
    plane, good = _barycentric(x, y)
    good &= np.minimum.reduce(depth) > 0

    first = np.clip(np.ceil(np.minimum.reduce(y)), 0, height).astype(np.int64)
    last = np.clip(np.floor(np.maximum.reduce(y)), -1, height - 1).astype(np.int64)
    rows = np.where(good, np.maximum(last - first + 1, 0), 0)
    face = np.repeat(np.arange(len(faces)), rows)
    row = _count_up(rows) + first[face]

    left, right = _span(plane, face, row)
    left = np.clip(np.ceil(left - 1e-6), 0, width).astype(np.int64)
    right = np.clip(np.floor(right + 1e-6), -1, width - 1).astype(np.int64)
    length = np.maximum(right - left + 1, 0)

    scale = float((1 << 38) / max(nearness.max(initial=0), 1e-30))
    a, b, c = np.einsum("xcf,cf->xf", plane, depth * scale)
    start = b[face] * row + c[face] + a[face] * left
    step = _count_up(length)
    key = np.repeat(a[face], length)
    key *= step
    key += np.repeat(start, length)
    np.clip(key, 1, 1 << 38, out=key)
    key = key.astype(np.int64)
    key <<= _BITS
    key |= np.repeat(face, length)
    step += np.repeat(row * width + left, length)

    seen = np.zeros(width * height, np.int64)
    np.maximum.at(seen, step, key)
    sample = np.flatnonzero(seen)
    face = seen[sample] & _LOW
    row, column = np.divmod(sample.astype(np.int32), np.int32(width))
    a, b, c = np.take(plane[:, :2].astype(np.float32), face, axis=-1)
    inside = np.empty((3, len(sample)), np.float32)
    inside[:2] = a * column.astype(np.float32) + b * row.astype(np.float32) + c
    np.subtract(1, inside[0] + inside[1], out=inside[2])
    return Hits(sample, face, inside)


def _barycentric(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return coordinates as a x + b y + c: (3 of a b c, 3 corners, F), and (F,) whether the triangle has area."""
    xj, xk, yj, yk = x[[1, 2, 0]], x[[2, 0, 1]], y[[1, 2, 0]], y[[2, 0, 1]]
    area = (x[1] - x[0]) * (y[2] - y[0]) - (x[2] - x[0]) * (y[1] - y[0])
    good = np.abs(area) > 1e-9
    plane = np.stack([yj - yk, xk - xj, xj * yk - xk * yj])
    return plane / np.where(good, area, 1), good


def _span(plane: np.ndarray, face: np.ndarray, row: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the first and last columns at which all three coordinates of a face are >= 0 on a row."""
    left, right = np.full(len(face), -np.inf), np.full(len(face), np.inf)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        for a, b, c in plane.transpose(1, 0, 2):
            slope = a[face] + 0.0  # -0 would divide to the wrong infinity
            crossing = -(b[face] * row + c[face]) / slope
            # A level edge (slope 0) divides to +inf (row outside), -inf (inside) or nan (on it: all inside).
            np.fmax(left, np.where(slope >= 0, crossing, -np.inf), out=left)
            np.fmin(right, np.where(slope < 0, crossing, np.inf), out=right)
    return left, right


def _count_up(counts: np.ndarray) -> np.ndarray:
    """Return 0..counts[0]-1, 0..counts[1]-1, ... in one array."""
    ends = np.cumsum(counts)
    return np.arange(ends[-1] if len(ends) else 0) - np.repeat(ends - counts, counts)
