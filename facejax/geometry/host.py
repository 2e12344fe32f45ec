"""Geometry in NumPy, for code outside jit. Imports no JAX, so that worker processes that only read files start fast."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation


def procrustes(
    source: Float[np.ndarray, "K 3"], target: Float[np.ndarray, "K 3"]
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, " 3"], Float[np.ndarray, " 3"]]:
    """Return the rigid motion that minimises the squared distance of source (K, 3) to target (K, 3).

    Never a reflection (Kabsch 1976); `facejax.geometry.align.procrustes` is the JAX form. The rotation is float64.
    A point x maps to rotation @ (x - source_centroid) + target_centroid; in float32 this loses fewer digits than a
    rotation about the origin.

    Returns:
      rotation (3, 3) with determinant +1, source_centroid (3,), target_centroid (3,).
    """
    source_centroid, target_centroid = source.mean(axis=0), target.mean(axis=0)
    rotation = Rotation.align_vectors(target - target_centroid, source - source_centroid)[0]
    return rotation.as_matrix(), source_centroid, target_centroid
