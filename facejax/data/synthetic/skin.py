"""Wrinkles and bulges of compressed skin.

A group of furrows has, on the template, a mask, a coordinate s (millimetres across its furrows) and a profile: a wave
for the forehead and crow's feet, a single fold for the nasolabial line. On a posed face, the stretch along the gradient
of s is measured per triangle; where it is below 1, the profile is added along the normal, deeper with age. Bulges
depend on the loss of area. Both depend only on the face, its age and its pose, and are zero at rest.

Wavelengths are limited by the mesh to three edges or more (edges are 8 mm on the forehead, 3 mm around the eyes).
N vertices, F triangles, M = N + vertices of the props, T frames.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np
from scipy import sparse

from facejax.data.synthetic import assets, makehuman
from facejax.geometry.interpolation import smoothstep

YOUNG, OLD = 20.0, 80.0
SLACK = 0.03  # compression at which wrinkles begin
STIFFNESS = 7.0  # tanh(STIFFNESS x compression): three quarters of the depth at 14 %
BULGE_SMOOTHING = 3  # iterations of averaging the area loss over neighbours


class Furrow(NamedTuple):
    """One group of furrows on the template."""

    mask: np.ndarray  # (N,) 0..1
    across: np.ndarray  # (N,) millimetres
    wavelength: float  # millimetres; 0 for a single fold at across = 0
    depth: tuple[float, float]  # millimetres at 20 and at 80 years


class Pattern(NamedTuple):
    """The furrows and bulges of the template; each triangle belongs to the group with the largest mask."""

    furrows: tuple[Furrow, ...]
    owner: np.ndarray  # (F,) group of each triangle
    flesh: np.ndarray  # (N,) millimetres of bulge at full compression
    to_vertices: sparse.csr_array  # (N, F) averages over a vertex's triangles
    smooth: sparse.csr_array  # (N, N) averages over a vertex and its neighbours


class Skin(NamedTuple):
    """The skin parameters of a subject."""

    rest_area: np.ndarray  # (F,)
    along: np.ndarray  # (F, 2) unit direction across the furrows, in the basis of the triangle's two edges
    height: np.ndarray  # (N,) signed millimetres of the furrows at full compression
    flesh: np.ndarray  # (N,)


def build(subject: makehuman.Subject) -> Skin:
    """Compute a subject's skin: the template's pattern, with individual phases and a depth that depends on age."""
    faces, pattern = assets.load().faces, template_pattern()
    vertices = subject.vertices.astype(np.float64)
    age = np.clip((subject.age - YOUNG) / (OLD - YOUNG), 0, 1)
    # The phase is seeded by the subject's shape, so that the same face always wrinkles alike.
    rng = np.random.default_rng(np.frombuffer(subject.neutral.tobytes()[:64], np.uint32))
    height = np.zeros(len(vertices))
    for furrow in pattern.furrows:
        depth = furrow.depth[0] + age * (furrow.depth[1] - furrow.depth[0])
        height += depth * furrow.mask * _profile(furrow, rng.uniform(0, 2 * np.pi))
    return Skin(
        rest_area=_areas(vertices[None], faces)[0].astype(np.float32),
        along=_directions(vertices, faces, pattern).astype(np.float32),
        height=height.astype(np.float32),
        flesh=(pattern.flesh * (1 - 0.3 * age)).astype(np.float32),
    )


def add_wrinkles(skin: Skin, vertices: np.ndarray) -> np.ndarray:
    """Add wrinkles and bulges to the skin of posed vertices (T, M, 3)."""
    faces, pattern = assets.load().faces, template_pattern()
    n = len(skin.height)
    first, second = (vertices[:, faces[:, i]] - vertices[:, faces[:, 0]] for i in (1, 2))
    normal = np.cross(first, second)
    area = 0.5 * np.linalg.norm(normal, axis=-1)
    stretch = np.linalg.norm(first * skin.along[:, :1] + second * skin.along[:, 1:], axis=-1)
    compression = _average(pattern.to_vertices, 1.0 - stretch)
    loss = _average(pattern.to_vertices, 1.0 - area / skin.rest_area)
    for _ in range(BULGE_SMOOTHING):
        loss = _average(pattern.smooth, loss)
    lift = skin.height * _response(compression) + skin.flesh * _response(loss)
    outward = np.stack([_average(pattern.to_vertices, normal[..., i]) for i in range(3)], axis=-1)
    outward /= np.maximum(np.linalg.norm(outward, axis=-1, keepdims=True), 1e-12)
    moved = vertices.copy()
    moved[:, :n] += lift[..., None] * outward
    return moved


@functools.cache
def template_pattern() -> Pattern:
    """Return furrows and bulges, placed by the template's landmarks."""
    shape = makehuman.template()
    v, mark = shape.vertices.astype(np.float64), shape.vertices[shape.landmarks].astype(np.float64)
    front = smoothstep(v[:, 2], -5, 15)

    def spot(centre: np.ndarray, radius: float) -> np.ndarray:
        return np.exp(-0.5 * (np.linalg.norm(v - centre, axis=1) / radius) ** 2) * front

    def middle(*indices: int) -> np.ndarray:
        return mark[list(indices)].mean(axis=0)

    y, x = v[:, 1], v[:, 0]
    brow = middle(19, 24)[1]
    forehead = (
        smoothstep(y, brow + 2, brow + 14)
        * smoothstep(-y, -brow - 62, -brow - 42)
        * smoothstep(-np.abs(x), -56, -34)
        * front
    )
    furrows = [
        Furrow(forehead, y, 21.0, (0.25, 1.0)),
        Furrow(spot(middle(21, 22) + [0, 3, 0], 9), x, 14.0, (0.3, 1.1)),
        Furrow(spot(middle(27, 28), 8), y, 10.0, (0.2, 0.7)),
        Furrow(spot(middle(8, 57), 10), y, 17.0, (0.3, 0.6)),
    ]
    for side, corner, lid, wing, mouth in ((-1, 36, (40, 41), 31, 48), (1, 45, (46, 47), 35, 54)):
        furrows.append(Furrow(spot(mark[corner] + [side * 11, 0, -5], 9), y, 9.0, (0.2, 0.9)))
        furrows.append(Furrow(spot(middle(*lid) + [0, -7, 0], 8), y, 9.0, (0.15, 0.6)))
        across, mask = _nasolabial(v, mark[wing] + [side * 7, 3, 0], mark[mouth] + [side * 10, 1, 0], side)
        furrows.append(Furrow(mask * front, across, 0.0, (0.5, 1.7)))
    flesh = 3.0 * (spot(middle(41, 48) + [-6, 2, 0], 16) + spot(middle(46, 54) + [6, 2, 0], 16))
    flesh += 1.5 * spot(middle(8, 57), 12) + 1.2 * spot(middle(51, 57), 14) + 0.6 * forehead
    masks = np.stack([f.mask for f in furrows])
    to_vertices, smooth = _averaging(shape.faces, len(v))
    owner = masks[:, shape.faces].mean(axis=-1).argmax(axis=0)
    return Pattern(tuple(furrows), owner, flesh, to_vertices, smooth)


def _nasolabial(v: np.ndarray, start: np.ndarray, end: np.ndarray, side: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the signed distance from the line nose wing -> mouth corner (outward positive), and its mask."""
    axis = (end - start)[:2]
    length = float(np.linalg.norm(axis))
    axis = axis / length
    offset = v[:, :2] - start[:2]
    along = offset @ axis
    across = side * (offset @ np.array([-axis[1], axis[0]])) * np.sign(-axis[1])
    mask = smoothstep(along, -4, 6) * smoothstep(-along, -length - 8, -length + 4) * np.exp(-0.5 * (across / 12.0) ** 2)
    return across, mask


def _profile(furrow: Furrow, phase: float) -> np.ndarray:
    s = furrow.across
    if furrow.wavelength:
        return np.cos(2 * np.pi * s / furrow.wavelength + phase)
    return np.exp(-(((s - 9) / 6.0) ** 2)) - np.exp(-((s / 4.0) ** 2))


def _directions(vertices: np.ndarray, faces: np.ndarray, pattern: Pattern) -> np.ndarray:
    """Return the unit gradient of each triangle's group coordinate, in the basis of its two edges, (F, 2)."""
    across = np.stack([f.across for f in pattern.furrows])[pattern.owner[:, None], faces]
    first, second = (vertices[faces[:, i]] - vertices[faces[:, 0]] for i in (1, 2))
    gram = np.stack(
        [
            np.stack([(first * first).sum(-1), (first * second).sum(-1)], axis=-1),
            np.stack([(first * second).sum(-1), (second * second).sum(-1)], axis=-1),
        ],
        axis=-2,
    )
    gradient = np.linalg.solve(gram, (across[:, 1:] - across[:, :1])[..., None])[..., 0]
    length = np.sqrt(np.einsum("fi,fij,fj->f", gradient, gram, gradient))
    return gradient / np.maximum(length, 1e-9)[:, None]


def _response(compression: np.ndarray) -> np.ndarray:
    """Return the response to compression in 0..1: 0 for stretched skin, smooth at the onset, saturating."""
    folded = np.maximum(compression, 0.0)
    return np.tanh(STIFFNESS * folded * folded / (folded + SLACK))


def _averaging(faces: np.ndarray, count: int) -> tuple[sparse.csr_array, sparse.csr_array]:
    rows, columns = faces.ravel(), np.repeat(np.arange(len(faces)), 3)
    incidence = sparse.csr_array((np.ones(len(rows)), (rows, columns)), shape=(count, len(faces)))
    neighbours = ((incidence @ incidence.T) > 0).astype(float)
    return _normalise_rows(incidence), _normalise_rows(neighbours)


def _normalise_rows(matrix: sparse.csr_array) -> sparse.csr_array:
    scale = sparse.diags_array(1 / np.asarray(matrix.sum(axis=1)).ravel())
    return sparse.csr_array(scale @ matrix, dtype=np.float32)


def _average(matrix: sparse.csr_array, values: np.ndarray) -> np.ndarray:
    """Apply an operator (A, B) to values (T, B): (T, A)."""
    return (matrix @ values.T).T


def _areas(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    a, b, c = (vertices[:, faces[:, i]] for i in range(3))
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=-1)
