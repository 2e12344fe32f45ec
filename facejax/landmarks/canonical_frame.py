"""Transform a neutral face to the model's topology and the canonical frame: millimetres, y up, z forward.

Accepted: a mesh of the model's own vertices, or a whole MakeHuman body (19,158 vertices with its helpers, 13,380
without), as MakeHuman and Blender's MPFB export it. Unit and axes are inferred by comparing the landmarks with the
template's, and reported in notes; the position does not change. N vertices, L landmarks.
"""

from __future__ import annotations

import itertools
from importlib import resources
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Float64, Integer, Real

from facejax.geometry import align

UNITS = {"millimetres": 1.0, "centimetres": 10.0, "decimetres": 100.0, "metres": 1000.0}
SIZE_RANGE = (0.6, 1.7)  # of a face relative to the template: adults and children
# Distance from the template's landmarks, both normalised: people have up to 0.11, left and right exchanged 0.24.
MAX_SHAPE_DISTANCE = 0.22
MAX_AXES_DISTANCE = 0.6  # the same where only axes are permuted
HEAD_RANGE = (100.0, 400.0)  # mm, the longest side of the bounding box of a head, or of a face from chin to brow


class FaceError(ValueError):
    """Vertices or landmarks do not form a head, or have an unknown unit or topology."""


class Topology(NamedTuple):
    """The template that a face is compared with."""

    vertices: Real[np.ndarray, "N 3"]  # the template at rest, mm
    landmark_index: Integer[np.ndarray, " L"]  # vertices
    source_index: Integer[np.ndarray, " N"]  # vertices of MakeHuman's body, or empty


class Face(NamedTuple):
    """A face in the canonical frame."""

    vertices: Float32[np.ndarray, "N 3"]  # mm
    notes: tuple[str, ...]  # what was assumed, one line each


def fit(vertices: np.ndarray, topology: Topology, *, name: str = "the face") -> Face:
    """Transform vertices (V, 3) in any accepted topology, unit and axis order to the canonical frame.

    Raises:
      FaceError: another topology, a vertex that is not finite, an unknown unit, or landmarks that do not form a face.
    """
    vertices, notes = np.asarray(vertices, np.float64), []
    count, bodies = len(topology.vertices), (13_380, 19_158)
    if vertices.ndim != 2 or vertices.shape[1] != 3:
        raise FaceError(f"{name}: vertices must be ({count}, 3), got {vertices.shape}")
    if len(vertices) in bodies and len(vertices) != count and len(topology.source_index):
        vertices = vertices[topology.source_index]
        notes.append(f"used the {count} head vertices of a MakeHuman body")
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


def align_to_template(
    points: Real[np.ndarray, "C 3"], template: Real[np.ndarray, "C 3"]
) -> tuple[Float64[np.ndarray, "3 3"], float]:
    """Return the rotation (3, 3) from the template's landmarks (C, 3) to the points (C, 3), and their relative size.

    Raises:
      ValueError: the two shapes differ too much.
    """
    size, template_size = (float(np.linalg.norm(p - p.mean(axis=0))) for p in (points, template))
    shapes = ((p - p.mean(axis=0)) / s for p, s in ((points, size), (template, template_size)))
    shape, target = (s.astype(np.float32) for s in shapes)
    fit = align.procrustes(target, shape, scaling=True)
    distance = float(np.linalg.norm(np.asarray(align.apply(fit, target)) - shape))
    if distance > MAX_SHAPE_DISTANCE:
        raise ValueError(
            f"its {len(points)} landmarks do not form a face (distance {distance:.3f}, at most {MAX_SHAPE_DISTANCE}): "
            "are they in the order of the scheme, with the subject's left and right?"
        )
    return np.asarray(fit.rotation, np.float64), size / template_size


def template68() -> Float64[np.ndarray, "68 3"]:
    """Return the 68 landmarks (68, 3) float64 of MakeHuman's average face at rest, in mm."""
    with resources.files("facejax.assets").joinpath("face68.npy").open("rb") as stream:
        return np.load(stream, allow_pickle=False).astype(np.float64)


def infer_unit(size: float, name: str) -> tuple[float, str]:
    """Return a unit in millimetres and its name: the one in which a face has the size of a head.

    `size` is that of the face in its unit, relative to the template in mm. Raises `FaceError` where no unit fits.
    """
    for unit, millimetres in UNITS.items():
        if SIZE_RANGE[0] <= size * millimetres <= SIZE_RANGE[1]:
            return millimetres, unit
    raise FaceError(
        f"{name}: the face is {size:.3g} times as large as a head in millimetres; expected units: {', '.join(UNITS)}"
    )


def infer_head_unit(size: float, name: str) -> tuple[float, str]:
    """Return a unit in millimetres and its name, by the longest side of a mesh's bounding box.

    For meshes without comparable landmarks. Raises `FaceError` where no unit fits.
    """
    for unit, millimetres in UNITS.items():
        if HEAD_RANGE[0] <= size * millimetres <= HEAD_RANGE[1]:
            return millimetres, unit
    low, high = HEAD_RANGE
    raise FaceError(f"{name}: size {size:.3g}; expected a head of {low:g} to {high:g} mm, in {', '.join(UNITS)}")


def axis_rotations() -> list[Float64[np.ndarray, "3 3"]]:
    """Return the 24 rotations (3, 3) that permute the axes."""
    rotations: list[np.ndarray] = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            rotation = np.zeros((3, 3))
            rotation[range(3), order] = signs
            if np.linalg.det(rotation) > 0:
                rotations.append(rotation)
    return rotations


def axes_note(turn: Real[np.ndarray, "3 3"]) -> list[str]:
    """Return a note on an axis rotation; no note for the identity."""
    if np.array_equal(turn, np.eye(3)):
        return []
    return [f"turned so that y is up and z forward (new axes: {', '.join(_axis_name(row) for row in turn)})"]


def centred_norm(points: Real[np.ndarray, "K 3"]) -> float:
    """Return the norm of points (K, 3) about their centroid."""
    return float(np.linalg.norm(points - points.mean(axis=0)))


def _axes(points: np.ndarray, target: np.ndarray, name: str) -> np.ndarray:
    """Return the axis rotation under which the landmarks are closest to the template's."""
    if centred_norm(points) == 0:
        raise FaceError(f"{name}: all landmarks coincide")
    shape, wanted = ((p - p.mean(axis=0)) / centred_norm(p) for p in (points, target))
    nearest = min(axis_rotations(), key=lambda turn: np.linalg.norm(shape @ turn.T - wanted))
    best = np.linalg.norm(shape @ nearest.T - wanted)
    if best > MAX_AXES_DISTANCE:
        raise FaceError(
            f"{name}: its landmarks do not form a face (distance {best:.2f}, at most {MAX_AXES_DISTANCE}): are the "
            "vertices in another order?"
        )
    return nearest


def _axis_name(row: np.ndarray) -> str:
    at = int(np.argmax(np.abs(row)))
    return ("-" if row[at] < 0 else "") + "xyz"[at]
