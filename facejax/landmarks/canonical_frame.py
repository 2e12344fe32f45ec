"""A user's neutral face, brought to the model's topology, millimetres, y up and z forward.

Accepted: a mesh of the model's own vertices, or a whole MakeHuman body (19,158 vertices with its helpers, 13,380
without), as MakeHuman and Blender's MPFB export it. Units and the up axis are recognised by comparing the landmarks
with the template's, and said aloud; the face stays where it is otherwise."""

from __future__ import annotations

import itertools
from importlib import resources
from typing import NamedTuple

import numpy as np

from facejax.geometry import align

UNITS = {"millimetres": 1.0, "centimetres": 10.0, "decimetres": 100.0, "metres": 1000.0}
SIZE_RANGE = (0.6, 1.7)  # of a face against the template, adult heads and children's
MAX_SHAPE_DISTANCE = 0.22  # distance from the template's shape; people have up to 0.11, left and right confused gives 0.24 and more
HEAD_RANGE = (100.0, 400.0)  # mm, the longest side of a head, or of a face alone, from chin to brow


class FaceError(ValueError):
    """Vertices or landmarks that do not form a head, or of no known unit or topology."""


class Topology(NamedTuple):
    """What a face is compared with."""

    vertices: np.ndarray  # (N, 3) the template at rest, mm
    landmark_index: np.ndarray  # (L,) vertices
    source_index: np.ndarray  # (N,) vertices of MakeHuman's body


class Face(NamedTuple):
    """vertices: (N, 3) float32 mm. notes: what was assumed, one line each."""

    vertices: np.ndarray
    notes: tuple[str, ...]


def fit(vertices: np.ndarray, topology: Topology, *, name: str = "the face") -> Face:
    """Bring vertices (V, 3) in any accepted topology, unit and axis order to the model's."""
    vertices, notes = np.asarray(vertices, np.float64), []
    count, bodies = len(topology.vertices), (13_380, 19_158)
    if vertices.ndim != 2 or vertices.shape[1] != 3:
        raise FaceError(f"{name}: vertices must be ({count}, 3), got {vertices.shape}")
    if len(vertices) in bodies and len(vertices) != count and len(topology.source_index):
        vertices = vertices[topology.source_index]
        notes.append(f"took the head's {count} vertices of a MakeHuman body")
    if len(vertices) != count:
        raise FaceError(
            f"{name}: {len(vertices)} vertices, expected {count} (the model's topology)"
            + (f", or {bodies[0]} or {bodies[1]} (a MakeHuman body)" if len(topology.source_index) else "")
            + "; `facejax data makehuman --sample DIR` writes faces to try"
        )
    bad = ~np.isfinite(vertices).all(axis=1)
    if bad.any():
        raise FaceError(f"{name}: vertex {int(np.argmax(bad))} is not finite: {vertices[np.argmax(bad)]}")
    marks = topology.landmark_index
    turn = _axes(vertices[marks], topology.vertices[marks], name)
    notes += axes_note(turn)
    millimetres, unit = infer_unit(centred_norm(vertices[marks]) / centred_norm(topology.vertices[marks]), name)
    notes += [f"read as {unit}"] if unit != "millimetres" else []
    return Face((vertices @ turn.T * millimetres).astype(np.float32), tuple(notes))


def align_to_template(points: np.ndarray, template: np.ndarray) -> tuple[np.ndarray, float]:
    """Rotation (3, 3) from the template's landmarks (C, 3) to a mesh's, and the mesh's size against the template's.

    Raises `ValueError` where the two are not alike.
    """
    spread, wanted = (float(np.linalg.norm(p - p.mean(axis=0))) for p in (points, template))
    shapes = ((p - p.mean(axis=0)) / s for p, s in ((points, spread), (template, wanted)))
    shape, target = (s.astype(np.float32) for s in shapes)
    fit = align.procrustes(target, shape, scaling=True)
    off = float(np.linalg.norm(np.asarray(align.apply(fit, target)) - shape))
    if off > MAX_SHAPE_DISTANCE:
        raise ValueError(
            f"its {len(points)} landmarks do not form a face (distance {off:.3f} of at most {MAX_SHAPE_DISTANCE}): are they "
            "in the order of the scheme, left and right as the subject has them?"
        )
    return np.asarray(fit.rotation, np.float64), spread / wanted


def template68() -> np.ndarray:
    """The 68 landmarks (68, 3) float64 of MakeHuman's average face at rest, in mm."""
    with resources.files("facejax.assets").joinpath("face68.npy").open("rb") as stream:
        return np.load(stream, allow_pickle=False).astype(np.float64)


def infer_unit(size: float, name: str) -> tuple[float, str]:
    """Millimetres of the unit in which a face of `size`, against the template's in millimetres, is a head's; its name.

    Raises `FaceError` where it is none.
    """
    for unit, millimetres in UNITS.items():
        if SIZE_RANGE[0] <= size * millimetres <= SIZE_RANGE[1]:
            return millimetres, unit
    raise FaceError(
        f"{name}: the face is {size:.3g} times as large as a head in millimetres; expected one in {', '.join(UNITS)}"
    )


def infer_head_unit(size: float, name: str) -> tuple[float, str]:
    """The same for a whole mesh, by the longest side of the box around it, where no landmarks are comparable."""
    for unit, millimetres in UNITS.items():
        if HEAD_RANGE[0] <= size * millimetres <= HEAD_RANGE[1]:
            return millimetres, unit
    low, high = HEAD_RANGE
    raise FaceError(
        f"{name}: {size:.3g} in size; expected a head of {low:g} to {high:g} mm, given in {', '.join(UNITS)}"
    )


def axis_rotations() -> list[np.ndarray]:
    """The 24 rotations (3, 3) that permute the axes."""
    found = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            turn = np.zeros((3, 3))
            turn[range(3), order] = signs
            if np.linalg.det(turn) > 0:
                found.append(turn)
    return found


def axes_note(turn: np.ndarray) -> list[str]:
    """What to say of a turn, one of `axis_rotations`: nothing where all stays as it is."""
    if np.array_equal(turn, np.eye(3)):
        return []
    return [f"turned so that y is up and z forward (new axes: {', '.join(_axis_name(row) for row in turn)})"]


def centred_norm(points: np.ndarray) -> float:
    """The norm of points (K, 3) about their centroid."""
    return float(np.linalg.norm(points - points.mean(axis=0)))


def _axes(points: np.ndarray, target: np.ndarray, name: str) -> np.ndarray:
    """Of the 24 rotations that permute the axes, the one under which the landmarks look most like the template's."""
    if centred_norm(points) == 0:
        raise FaceError(f"{name}: all landmarks coincide: this is no face")
    shape, wanted = ((p - p.mean(axis=0)) / centred_norm(p) for p in (points, target))
    nearest = min(axis_rotations(), key=lambda turn: np.linalg.norm(shape @ turn.T - wanted))
    best = np.linalg.norm(shape @ nearest.T - wanted)
    if best > 0.6:
        raise FaceError(
            f"{name}: its landmarks do not form a face (distance {best:.2f} of at most 0.6): the right number of "
            "vertices, but in another order?"
        )
    return nearest


def _axis_name(row: np.ndarray) -> str:
    at = int(np.argmax(np.abs(row)))
    return ("-" if row[at] < 0 else "") + "xyz"[at]
