"""Registration noise: the error of fitting a template to scans, smooth over the surface, independent in every frame.

A field is a sum of Gaussian bumps at centres spread over the template, with random heights, scaled so that the
displacement of every vertex is `sigma` millimetres in root mean square. N vertices, C centres.
"""

from __future__ import annotations

import functools

import numpy as np

from facejax.data.synthetic import makehuman
from facejax.mesh import graph

WIDTH = 15.0  # millimetres, geodesic
SPACING = 1.2  # centres per width
MAX_SIGMA_MM = 2.0  # millimetres


def field(frames: int, rng: np.random.Generator, *, sigma: float) -> np.ndarray:
    """Sample displacements (frames, N, 3) float32, mm. Raises `ValueError` for a sigma outside 0..2 mm."""
    check_sigma(sigma)
    basis = _basis()
    heights = rng.standard_normal((frames, 3, basis.shape[1]), np.float32)
    return np.ascontiguousarray(np.moveaxis(heights @ basis.T, 1, 2)) * np.float32(sigma / np.sqrt(3))


def check_sigma(sigma: float) -> None:
    """Raise `ValueError` for a sigma outside 0..2 mm."""
    if not 0 <= sigma <= MAX_SIGMA_MM:
        raise ValueError(f"noise must lie in 0..{MAX_SIGMA_MM:g} mm, got {sigma}")


@functools.cache
def _basis() -> np.ndarray:
    """Return the bumps (N, C); the squares of every row sum to 1, so that each vertex has the same variance."""
    shape = makehuman.template()
    distance = [graph.geodesic(shape.vertices, shape.faces, np.array([0]))]
    nearest = distance[0]
    # Farthest point sampling, until the surface is covered.
    while nearest.max() > WIDTH / SPACING:
        distance.append(graph.geodesic(shape.vertices, shape.faces, np.array([np.argmax(nearest)])))
        nearest = np.minimum(nearest, distance[-1])
    bumps = np.exp(-0.5 * (np.stack(distance, axis=1) / WIDTH) ** 2)
    return (bumps / np.linalg.norm(bumps, axis=1, keepdims=True)).astype(np.float32)
