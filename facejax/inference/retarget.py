"""Apply landmark motion to any mesh: its landmarks locate the face, radial basis functions interpolate the vertices.

    face = retarget.prepare(vertices, triangles, landmarks)
    moved = retarget.animate(face, curve)  # (T, N, 3) of (T, 68, 3)

The mesh may have any topology, unit and pose. Its landmarks may follow another scheme (`landmarks.schemes`) than the
motion's 68: the points that both have are used. A motion is given as displacements from neutral in the template's
frame, unitless (divided by the norm of the centred neutral landmarks). SL21, section 4.

N vertices, F triangles, L landmarks of the mesh, C landmarks that it shares with the motion, T frames.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from facejax.geometry import align, rbf
from facejax.geometry.precision import HIGHEST
from facejax.inference import checks, pipeline
from facejax.io.meshes import MeshError
from facejax.landmarks import canonical_frame, schemes
from facejax.mesh import graph, rbf_weights


class Face(NamedTuple):
    """A mesh that is prepared for animation; millimetres, in its own pose, but y up and z forward."""

    vertices: np.ndarray  # (N, 3) float32
    faces: np.ndarray  # (F, 3) int32
    landmarks: np.ndarray  # (L, 3) float32
    shared: tuple[np.ndarray, np.ndarray]  # (C,) indices into the motion's landmarks, (C,) into the mesh's
    rotation: np.ndarray  # (3, 3) float32, from the template's frame to the mesh's
    size: float  # mm, norm of the centred landmarks: one unit of the motion
    weights: np.ndarray  # (N, C) float32, see `rbf_weights.weights`
    notes: tuple[str, ...]  # what was assumed, one line each


def prepare(
    vertices: np.ndarray,
    triangles: np.ndarray,
    landmarks: np.ndarray,
    template: np.ndarray | None = None,
    *,
    pin: bool = True,
    name: str = "the mesh",
    **options: Any,
) -> Face:
    """Locate the face of a mesh by its landmarks, and compute the weights that animate it.

    Args:
      vertices: (N, 3) in any unit and pose.
      triangles: (F, 3).
      landmarks: (L, 3).
      template: (68, 3) landmarks in mm of the face in whose frame motions are given; default: the released models'.
      pin: keep rims fixed that are far from every landmark, such as the neck's.
      name: of the mesh, for error messages.
      options: of `rbf.fit` (kernel, sigma, smoothing).

    Raises:
      MeshError: landmarks of an unknown scheme, far off the mesh, or not those of a face; invalid options of `rbf.fit`.
    """
    vertices, landmarks = np.asarray(vertices, np.float64), np.asarray(landmarks, np.float64)
    if template is None:
        head = pipeline.load().face
        template = head.vertices[head.landmark_index]
    try:
        shared = schemes.common(len(template), len(landmarks))
        points, wanted = landmarks[shared[1]], np.asarray(template, np.float64)[shared[0]]
        rbf_weights.check(landmarks, vertices)
        rotation, size = canonical_frame.align_to_template(points, wanted)
        weights, loose = _weights(vertices, triangles, points, shared[0], len(template), pin, options)
    except ValueError as error:
        raise MeshError(f"{name}: {error}") from error
    # Only the axes are permuted; the remaining pose is the mesh's own.
    turn = max(canonical_frame.axis_rotations(), key=lambda turn: np.trace(turn @ rotation))
    notes = canonical_frame.axes_note(turn)
    try:
        millimetres, unit = canonical_frame.infer_unit(size, name)
        notes += [f"read as {unit}"] if unit != "millimetres" else []
    except canonical_frame.FaceError:
        millimetres = 1 / size
        notes.append("unknown unit: scaled to the size of a head")
    if len(points) < len(template):
        notes.append(f"the mesh has {len(points)} of the motion's {len(template)} landmarks")
    if loose:
        notes.append(f"{loose} vertices belong to no triangle and do not move")
    norm = float(np.linalg.norm(template - template.mean(axis=0)))
    return Face(
        (vertices @ turn.T * millimetres).astype(np.float32),
        np.asarray(triangles, np.int32),
        (landmarks @ turn.T * millimetres).astype(np.float32),
        shared,
        (turn @ rotation).astype(np.float32),
        size * millimetres * norm,
        weights,
        tuple(notes),
    )


def animate(face: Face, curve: np.ndarray | jax.Array, *, intensity: float = 1.0, head: bool = False) -> jax.Array:
    """Animate a prepared mesh of any topology: vertices (..., T, N, 3) in mm from displacements (..., T, 68, 3).

    With `head`, the rigid motion of the landmarks that are fixed to the skull (`schemes.Scheme.stable`) is applied to
    all vertices; without, pinned rims hold the head back. Raises `ValueError` as `landmarks_of` does.
    """
    rest, marks = _at_rest(face), landmarks_of(face, curve, intensity=intensity)
    if not head:
        return _move(face.vertices, face.weights, marks - rest)
    own = np.isin(face.shared[1], schemes.by_count(len(face.landmarks)).stable)
    pose = align.procrustes(jnp.broadcast_to(rest, marks.shape)[..., own, :], marks[..., own, :])
    # To the head's own frame, where the neck is fixed; the rigid motion is applied to all vertices afterwards.
    undone = jnp.einsum("...ji,...lj->...li", pose.rotation, marks - pose.translation[..., None, :], precision=HIGHEST)
    moved = _move(face.vertices, face.weights, undone - rest)
    return align.apply(pose, moved)


def landmarks_of(face: Face, curve: np.ndarray | jax.Array, *, intensity: float = 1.0) -> jax.Array:
    """Return the moved shared landmarks (..., T, C, 3) in mm.

    Raises `ValueError` for a curve of another scheme, or an intensity outside 0..2.
    """
    least = int(face.shared[0].max()) + 1
    if np.ndim(curve) < 2 or np.shape(curve)[-1] != 3 or np.shape(curve)[-2] < least:
        raise ValueError(f"curve: expected (..., T, L, 3) with L of {least} or more, got {np.shape(curve)}")
    checks.check_intensity(intensity)
    return _at_rest(face) + intensity * face.size * jnp.asarray(curve)[..., face.shared[0], :] @ face.rotation.T


def _at_rest(face: Face) -> jax.Array:
    return jnp.asarray(face.landmarks[face.shared[1]])


@jax.jit
def _move(vertices: jax.Array, weights: jax.Array, displacements: jax.Array) -> jax.Array:
    return vertices + rbf.warp(weights, displacements)


def _weights(
    vertices: np.ndarray,
    triangles: np.ndarray,
    points: np.ndarray,
    names: np.ndarray,
    count: int,
    pin: bool,
    options: dict[str, Any],
) -> tuple[np.ndarray, int]:
    """Return weights (N, C) of the points (C, 3), and the number of vertices without a triangle.

    Coincident vertices are merged first: texture seams are not rims, and paths along the mesh cross them.
    """
    used, same, faces = graph.weld(vertices, triangles)
    lips = _lips(schemes.by_count(count).points, names)
    reach = rbf_weights.REACH if pin else np.inf
    found = rbf_weights.weights(vertices[used], faces, points, lips=lips, reach=reach, **options)
    weights = np.where(same[:, None] >= 0, found[same], 0).astype(np.float32)
    return weights, int(np.sum(same < 0))


def _lips(points: tuple[str, ...], which: np.ndarray) -> tuple[list[int], list[int]] | None:
    """Return upper and lower lip points without corners among `which` of a scheme; None where one has none."""
    names = [points[i] for i in which]
    upper, lower = ([i for i, name in enumerate(names) if f"{side} lip" in name] for side in ("upper", "lower"))
    return (upper, lower) if upper and lower else None
