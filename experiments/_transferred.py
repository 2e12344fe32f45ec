"""The motion of one person's landmarks on another's face. OT23, 4.2.2."""

from __future__ import annotations

import numpy as np

from facejax.geometry import srvf


def transfer(moved: np.ndarray, source: np.ndarray, target: np.ndarray, index: np.ndarray) -> np.ndarray:
    """The source's motion (T, N, 3) as displacements (T, L, 3) of the target's landmarks, through its SRVF.

    `source` and `target` (N, 3) are the faces at rest, `index` (L,) the landmarks' vertices. The motion may start
    anywhere, so displacements are what is carried: the first one scaled to the face, and the way from there on by its
    point on the sphere and its length.
    """
    sizes = [np.linalg.norm(face[index] - face[index].mean(axis=0)) for face in (source, target)]
    unitless = ((moved - source)[:, index] / sizes[0]).astype(np.float32)
    q, log_length = srvf.encode(unitless)
    return np.asarray(srvf.decode(q, log_length, unitless[0])) * sizes[1]
