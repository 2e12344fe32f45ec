"""Landmark schemes of 68, 66, 51 and 83 points, and the points that any two of them share.

Every point of a scheme has an anatomical name; points of two schemes correspond when their names are equal. Left and
right are the subject's, whatever the source calls them.

  68   iBUG 300-W, after Multi-PIE.
  66   the same without the corners of the inner lip, as in Saragih et al.'s trackers.
  51   68 without the 17 of the jaw.
  83   BU-3DFE and BU-4DFE (Binghamton), in the order of their .bnd files.

BU-3DFE's order is not published as a list. Deep-MVLM's notes on the database (docs/BU-3DFE_landmark_info.txt) name 19
of the 83: eye corners and lids, alae, subnasale, the corners and middles of the lips, the chin. menpo's
`face_bu3dfe_83` gives the groups and the sides; what the database calls the left eye lies at the left of the picture
and is the subject's right. The rest, direction included, is inferred from the points that Deep-MVLM's network for this
scheme places on a freely licensed head (assets/test2_bu3dfe.txt of cvjena/mvlm), beside 68 points on the same head. The
contour, except the chin's number, and the spacing of its points are inferred only.

Accuracy of the correspondence between 68 and 83: corners of eyes and lips coincide. Lids have two points at thirds
against three at quarters; brows are one line against a closed outline, whose upper edge is used; the alae are placed
further out in 83: a few millimetres. The 83 have no bridge, tip or base of the nose; the contours of both follow the
jaw at different intervals and share the chin only. L landmarks, C shared ones.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from jaxtyping import Int32

GROUPS = ("jaw", "brows", "nose", "eyes", "lips")
# Brows are numbered from the nose, jaw and contour from the chin, lips from the middle.
_OUTER_LIP = (
    "right lip corner",
    "right upper lip 2",
    "right upper lip 1",
    "upper lip",
    "left upper lip 1",
    "left upper lip 2",
    "left lip corner",
    "left lower lip 2",
    "left lower lip 1",
    "lower lip",
    "right lower lip 1",
    "right lower lip 2",
)
_INNER_LIP = (
    "right inner lip corner",
    "right inner upper lip",
    "inner upper lip",
    "left inner upper lip",
    "left inner lip corner",
    "left inner lower lip",
    "inner lower lip",
    "right inner lower lip",
)
# From the outer corner of the right eye and from the inner corner of the left: clockwise in a picture of the face.
_RIGHT_EYE = ("outer corner", "upper outer", "upper inner", "inner corner", "lower inner", "lower outer")
_LEFT_EYE = ("inner corner", "upper inner", "upper outer", "outer corner", "lower outer", "lower inner")
_IBUG = (
    *(f"right jaw {i}" for i in range(8, 0, -1)),
    "chin",
    *(f"left jaw {i}" for i in range(1, 9)),
    *(f"right brow {i}" for i in range(5, 0, -1)),
    *(f"left brow {i}" for i in range(1, 6)),
    "nose bridge 1",
    "nose bridge 2",
    "nose bridge 3",
    "nose tip",
    "right nose wing",
    "right nose nostril",
    "nose base",
    "left nose nostril",
    "left nose wing",
    *(f"right eye {place}" for place in _RIGHT_EYE),
    *(f"left eye {place}" for place in _LEFT_EYE),
    *_OUTER_LIP,
    *_INNER_LIP,
)
# Both eyes and both brows run from the inner end over the upper edge to the outer end and back below: mirror images.
_BU_EYE = (
    "inner corner",
    "upper inner",
    "upper middle",
    "upper outer",
    "outer corner",
    "lower outer",
    "lower middle",
    "lower inner",
)
_BU_BROW = ("1", "2", "3", "4", "5", "lower 5", "lower 4", "lower 3", "lower 2", "lower 1")
_BU_NOSE = ("side 1", "side 2", "side 3", "wing", "rim", "nostril")  # from the eye down and to the middle
_BU = (
    *(f"right eye {place}" for place in _BU_EYE),
    *(f"left eye {place}" for place in _BU_EYE),
    *(f"right brow {place}" for place in _BU_BROW),
    *(f"left brow {place}" for place in _BU_BROW),
    *(f"right nose {place}" for place in _BU_NOSE),
    *(f"left nose {place}" for place in reversed(_BU_NOSE)),
    *_OUTER_LIP,
    *_INNER_LIP,
    *(f"right contour {i}" for i in range(7, 0, -1)),
    "chin",
    *(f"left contour {i}" for i in range(1, 8)),
)
_WORDS = {"jaw": ("jaw", "chin", "contour"), "brows": ("brow",), "nose": ("nose",), "eyes": ("eye",), "lips": ("lip",)}


# Points that hardly move relative to the skull: nose bridge, eye corners, the contour beside the ears.
_STABLE = (
    *(f"nose bridge {i}" for i in (1, 2, 3)),
    *(f"{side} eye {corner} corner" for side in ("right", "left") for corner in ("inner", "outer")),
    *(f"{side} jaw {i}" for side in ("right", "left") for i in (7, 8)),
    *(f"{side} contour 7" for side in ("right", "left")),
)


class Scheme(NamedTuple):
    """L landmarks in order."""

    name: str
    points: tuple[str, ...]  # (L,) anatomical names, no two alike
    groups: dict[str, Int32[np.ndarray, " n"]]  # of each of `GROUPS`; empty where a scheme has none
    mirror: Int32[np.ndarray, " L"]  # index of the mirrored point; a point of the middle is its own
    stable: Int32[np.ndarray, " n"]  # points that hardly move relative to the skull


def by_count(count: int) -> Scheme:
    """Return the scheme with `count` landmarks. Raises `ValueError` for an unsupported number."""
    if count not in _SCHEMES:
        raise ValueError(f"unsupported number of landmarks: {count} (supported: {', '.join(map(str, _SCHEMES))})")
    return _build(count)


def common(source: int, target: int) -> tuple[Int32[np.ndarray, " C"], Int32[np.ndarray, " C"]]:
    """Convert between landmark schemes, such as dlib's 68 and 51: return the indices (C,) of shared points in each.

    In the order of the source. 68 and 51 share 51; 68 and 83 share 47; 51 and 83 share 46; 66 shares 49 with 51 and 45
    with 83.

    Raises:
      ValueError: an unsupported number of landmarks.
    """
    first, second = by_count(source), by_count(target)
    position = {point: i for i, point in enumerate(second.points)}
    pairs = [(i, position[point]) for i, point in enumerate(first.points) if point in position]
    index = np.array(pairs, np.int32)
    return index[:, 0], index[:, 1]


def mirror_name(point: str) -> str:
    """Return the name of a point's mirror image."""
    side, _, rest = point.partition(" ")
    return {"left": f"right {rest}", "right": f"left {rest}"}.get(side, point)


@functools.cache
def _build(count: int) -> Scheme:
    name, points = _SCHEMES[count]
    words = [set(point.split()) for point in points]
    groups = {group: _index(i for i, w in enumerate(words) if w & set(_WORDS[group])) for group in GROUPS}
    mirror = _index(points.index(mirror_name(point)) for point in points)
    return Scheme(name, points, groups, mirror, _index(i for i, point in enumerate(points) if point in _STABLE))


def _index(values: Iterable[int]) -> np.ndarray:
    # Cached and shared between callers: read-only.
    index = np.fromiter(values, np.int32)
    index.flags.writeable = False
    return index


_INNER_CORNERS = ("right inner lip corner", "left inner lip corner")
_SCHEMES = {
    51: ("iBUG without jaw", _IBUG[17:]),
    66: ("iBUG without the inner lip's corners", tuple(p for p in _IBUG if p not in _INNER_CORNERS)),
    68: ("iBUG", _IBUG),
    83: ("BU-3DFE", _BU),
}
