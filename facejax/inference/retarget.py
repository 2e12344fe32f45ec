"""Landmark motion put on any mesh: its landmarks say where its face is, radial basis functions carry the rest.

    face = animation.prepare(vertices, triangles, landmarks)
    moved = animation.move(face, curve)  # (T, N, 3) of (T, 68, 3)

The mesh may have any topology, unit and pose. Its landmarks may follow another scheme (`facejax.schemes`) than the
motion's 68: the points that both know are used. A motion is given as displacements from neutral in the template's
frame, unitless (divided by the norm of the neutral landmarks about their centroid). Seo and Luo 2021, section 4.

N vertices, F triangles, L landmarks of the mesh, C landmarks that it shares with the motion, T frames.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from facejax.geometry import align, rbf
from facejax.inference import pipeline
from facejax.io.meshes import MeshError
from facejax.landmarks import canonical_frame, schemes
from facejax.mesh import graph, rbf_weights


class Face(NamedTuple):
    """A mesh that is ready to be moved; millimetres, its own pose but y up and z forward."""

    vertices: np.ndarray  # (N, 3) float32
    faces: np.ndarray  # (F, 3) int32
    landmarks: np.ndarray  # (L, 3) float32
    shared: tuple[np.ndarray, np.ndarray]  # (C,) of the motion's landmarks, (C,) of the mesh's
    rotation: np.ndarray  # (3, 3) float32, from the template's frame into the mesh's
    size: float  # millimetres of a motion's unit on this face
    weights: np.ndarray  # (N, C) float32, see `attachment.weights`
    notes: tuple[str, ...]  # what was assumed, one line each


def prepare(
    vertices: np.ndarray,
    triangles: np.ndarray,
    landmarks: np.ndarray,
    template: np.ndarray | None = None,
    *,
    pin: bool = True,
    name: str = "the mesh",
    **options,
) -> Face:
    """Find the face of a mesh (N, 3), (F, 3) by its landmarks (L, 3), against those of the template (68, 3) in mm.

    The template is the face in whose frame motions are given: by default that of the released models.
    With `pin` the rims that no landmark is near to, a neck's say, stay where they are. `options` go to `rbf.fit`
    (kernel, sigma, smoothing). Raises `MeshError`, naming `name`, for landmarks of an unknown scheme, far off the mesh,
    or not those of a face, and for what `rbf.fit` refuses.
    """
    vertices, landmarks = np.asarray(vertices, np.float64), np.asarray(landmarks, np.float64)
    if template is None:
        head = pipeline.load().face
        template = head.vertices[head.landmark_index]
    try:
        shared = schemes.common(len(template), len(landmarks))
        points, wanted = landmarks[shared[1]], np.asarray(template, np.float64)[shared[0]]
        rbf_weights.check(landmarks, vertices)
        rotation, size = canonical_frame.place(points, wanted)
        weights, loose = _weights(vertices, triangles, points, shared[0], len(template), pin, options)
    except ValueError as error:
        raise MeshError(f"{name}: {error}") from error
    # The axes are put in order; the pose that remains is the mesh's own.
    turn = max(canonical_frame.turns(), key=lambda turn: np.trace(turn @ rotation))
    notes = canonical_frame.axes_note(turn)
    try:
        millimetres, unit = canonical_frame.unit_of(size, name)
        notes += [f"read as {unit}"] if unit != "millimetres" else []
    except canonical_frame.FaceError:
        millimetres = 1 / size
        notes.append("in no usual unit: scaled to the size of a head")
    if len(points) < len(template):
        notes.append(f"{len(points)} of the motion's {len(template)} landmarks are known here")
    if loose:
        notes.append(f"{loose} vertices belong to no triangle: they stay where they are")
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
    """Vertices (..., T, N, 3) in mm of a face that moves through displacements from neutral (..., T, 68, 3).

    With `head` the motion turns the head, too: its rigid part, that of the landmarks which stay put in a head
    (`schemes.Scheme.stable`), moves all vertices as one; without, pinned rims would hold it back.
    """
    rest, marks = _at_rest(face), landmarks_of(face, curve, intensity=intensity)
    if not head:
        return _move(face.vertices, face.weights, marks - rest)
    own = np.isin(face.shared[1], schemes.by_count(len(face.landmarks)).stable)
    pose = align.procrustes(jnp.broadcast_to(rest, marks.shape)[..., own, :], marks[..., own, :])
    # Back into the head's own frame, where the neck stays; then all go with the head.
    undone = jnp.einsum("...ji,...lj->...li", pose.rotation, marks - pose.translation[..., None, :])
    moved = _move(face.vertices, face.weights, undone - rest)
    return align.apply(pose, moved)


def landmarks_of(face: Face, curve: np.ndarray | jax.Array, *, intensity: float = 1.0) -> jax.Array:
    """The shared landmarks (..., T, C, 3) in mm on the way. Raises `ValueError` for a curve of another scheme."""
    least = int(face.shared[0].max()) + 1
    if np.ndim(curve) < 2 or np.shape(curve)[-1] != 3 or np.shape(curve)[-2] < least:
        raise ValueError(f"curve: expected (..., T, L, 3) with L of {least} or more, got {np.shape(curve)}")
    check_intensity(intensity)
    return _at_rest(face) + intensity * face.size * jnp.asarray(curve)[..., face.shared[0], :] @ face.rotation.T


def check_intensity(intensity: float) -> None:
    """Raise `ValueError` for a scale of the motion out of 0..2."""
    if not 0 <= intensity <= 2:
        raise ValueError(f"intensity must lie in 0..2, got {intensity}")


def _at_rest(face: Face) -> jax.Array:
    return jnp.asarray(face.landmarks[face.shared[1]])


@jax.jit
def _move(vertices: jax.Array, weights: jax.Array, displacements: jax.Array) -> jax.Array:
    return vertices + rbf.warp(weights, displacements)


def _weights(vertices, triangles, points, names, count, pin, options) -> tuple[np.ndarray, int]:
    """Weights (N, C) of the points (C, 3), and how many vertices are in no triangle.

    Seams of textures are no rims, and ways along the mesh cross them: vertices at one place are one.
    """
    used, same, faces = graph.weld(vertices, triangles)
    lips = _lips(schemes.by_count(count).points, names)
    reach = rbf_weights.REACH if pin else np.inf
    found = rbf_weights.weights(vertices[used], faces, points, lips=lips, reach=reach, **options)
    weights = np.where(same[:, None] >= 0, found[same], 0).astype(np.float32)
    return weights, int(np.sum(same < 0))


def _lips(points: tuple[str, ...], which: np.ndarray) -> tuple[list[int], list[int]] | None:
    """Upper and lower lip among the landmarks `which` of a scheme, without the corners; None where one is unknown."""
    shown = [points[i] for i in which]
    found = tuple([i for i, name in enumerate(shown) if f"{place} lip" in name] for place in ("upper", "lower"))
    return found if all(found) else None
