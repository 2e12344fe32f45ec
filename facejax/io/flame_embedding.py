"""FLAME's landmark embedding: triangles and barycentric weights of 51 or 68 landmarks, in the formats of FLAME's files.

    landmark_embedding.npy        a pickled dict: `full_lmk_*` (68), or `static_lmk_*` (51), `dynamic_lmk_*` (79, 17)
    flame_static_embedding.pkl    `lmk_face_idx` and `lmk_b_coords`, 51
    *.npz                         arrays of these names

In FLAME the 17 contour landmarks depend on the head's rotation; here they are those of the frontal pose (row 0). The
contour then precedes the 51, as in the order of 68.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from facejax.io import npz, safe_pickle

SUFFIXES = (".npy", ".npz", ".pkl")
_NAMES = (
    ("full_lmk_faces_idx", "full_lmk_bary_coords"),
    ("static_lmk_faces_idx", "static_lmk_bary_coords"),
    ("lmk_face_idx", "lmk_b_coords"),
)
_CONTOUR = ("dynamic_lmk_faces_idx", "dynamic_lmk_bary_coords")


def read(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read triangles (L,) int64 and weights (L, 3) float64.

    Raises:
      ValueError: the file is damaged or not a landmark embedding.
      OSError: it cannot be read.
    """
    try:
        found = _read_arrays(path)
    except (safe_pickle.PickleError, OSError):
        raise
    except npz.DAMAGE_ERRORS as error:
        raise ValueError(str(error)) from error
    names = next((pair for pair in _NAMES if all(name in found for name in pair)), None)
    if names is None:
        raise ValueError(f"not a landmark embedding: contains {sorted(map(str, found))[:8]}")
    face, weights = (np.asarray(found[name]) for name in names)
    if names[0].startswith("full"):  # these have a leading axis of length 1
        face, weights = face.reshape(-1), weights.reshape(-1, 3)
    elif all(name in found for name in _CONTOUR):
        contour = [np.asarray(found[name]) for name in _CONTOUR]
        if contour[0].ndim != 2 or contour[1].shape != (*contour[0].shape, 3):
            raise ValueError(f"contour shapes do not match: {contour[0].shape} and {contour[1].shape}")
        face, weights = np.concatenate([contour[0][0], face]), np.concatenate([contour[1][0], weights])
    if face.ndim != 1 or weights.shape != (len(face), 3) or face.dtype.kind not in "iu" or weights.dtype.kind != "f":
        raise ValueError(
            f"{' and '.join(names)}: expected (L,) integers and (L, 3) floats, got {face.shape}, {weights.shape}"
        )
    return face.astype(np.int64), weights.astype(np.float64)


def _read_arrays(path: Path) -> dict[str, Any]:
    if path.suffix.lower() == ".npz":
        wanted = (*(name for pair in _NAMES for name in pair), *_CONTOUR)
        return npz.read_available(path, wanted)
    with path.open("rb") as stream:
        if path.suffix.lower() == ".npy":
            npz.skip_object_header(stream)
        found = safe_pickle.load(stream)
    if isinstance(found, np.ndarray) and found.shape == ():
        found = found.item()
    if not isinstance(found, dict):
        raise ValueError(f"not a landmark embedding: contains a {type(found).__name__}, expected a dict")
    return {str(name): np.asarray(value) for name, value in found.items() if isinstance(value, (np.ndarray, list))}
