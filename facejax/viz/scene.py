"""Scene records that every exporter takes: one animated face and further meshes.

T frames, N vertices, F faces, L landmarks, M vertices and K faces of a part. Millimetres, y up, z out of the face.
A colour is sRGB in [0, 1], one `(3,)` for a part or `(M, 3)` for its vertices.
"""

from collections.abc import Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from facejax.mesh.normals import vertex_normals_host

SKIN = (0.86, 0.70, 0.62)
GLOSS = 0.3
Captions: TypeAlias = Sequence[tuple[int, str]]  # (first frame, text)


class Part(NamedTuple):
    """A mesh besides the face, such as eyeballs or teeth.

    vertices: (M, 3), or (T, M, 3) where it moves.
    faces: (K, 3) int.
    colour: (3,) or (M, 3).
    gloss: 0 is matt, 1 is glossy.
    """

    vertices: np.ndarray
    faces: np.ndarray
    colour: np.ndarray | tuple[float, float, float]
    gloss: float = GLOSS


# A part, or a tuple of vertices, faces, colour and perhaps gloss.
PartLike: TypeAlias = tuple[ArrayLike, ArrayLike, ArrayLike, *tuple[float, ...]]


class Scene(NamedTuple):
    """One animation.

    vertices: (T, N, 3) float32.
    faces: (F, 3) int32.
    fps: frames per second.
    captions: ((first frame, text), ...), by rising frame; each is shown until the next.
    landmarks: (T, L, 3) float32, or None.
    extras: parts.
    """

    vertices: np.ndarray
    faces: np.ndarray
    fps: float = 30.0
    captions: tuple[tuple[int, str], ...] = ()
    landmarks: np.ndarray | None = None
    extras: tuple[Part, ...] = ()


def make(
    vertices: ArrayLike,
    faces: ArrayLike,
    *,
    fps: float = 30.0,
    captions: Captions = (),
    landmarks: ArrayLike | None = None,
    extras: Sequence[PartLike] = (),
) -> Scene:
    """Return a validated scene with all fields.

    Args:
      vertices: (T, N, 3), or (N, 3) for one frame; mm.
      faces: (F, 3) indices below N.
      landmarks: (T, L, 3) positions, (L, 3) for one frame, or (L,) vertex indices.
      extras: `Part` records, or tuples (vertices, faces, colour[, gloss]).

    Raises:
      ValueError: a wrong shape, index, caption or number; names it.
    """
    vertices = np.asarray(vertices, np.float32)
    vertices = vertices[None] if vertices.ndim == 2 else vertices
    faces = _faces(faces, "faces")
    if vertices.ndim != 3 or vertices.shape[-1] != 3 or 0 in vertices.shape:
        raise ValueError(f"vertices must be (T, N, 3) with T, N >= 1, got {vertices.shape}")
    _finite(vertices, "vertices")
    _in_range(faces, vertices.shape[1], "faces")
    if not (np.isfinite(fps) and fps > 0):
        raise ValueError(f"fps must be positive, got {fps}")
    return Scene(
        vertices,
        faces,
        float(fps),
        _captions(captions, len(vertices)),
        _landmarks(landmarks, vertices),
        tuple(_part(i, len(vertices), *part) for i, part in enumerate(extras)),
    )


def normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return unit vertex normals, area weighted, (..., N, 3) of (..., N, 3); (0, 0, 1) at a vertex without area."""
    found = vertex_normals_host(vertices, faces)
    return np.where(found.any(axis=-1, keepdims=True), found, np.array([0, 0, 1], found.dtype))


def colours(part: Part) -> np.ndarray:
    """Return the colour of each vertex of a part, (M, 3) float32 in [0, 1]."""
    return np.broadcast_to(np.asarray(part.colour, np.float32), (part.vertices.shape[-2], 3))


def _part(i: int, frames: int, vertices: ArrayLike, faces: ArrayLike, colour: ArrayLike, gloss: float = GLOSS) -> Part:
    where = f"extras[{i}]"
    vertices, faces = np.asarray(vertices, np.float32), _faces(faces, f"{where}.faces")
    if vertices.ndim not in (2, 3) or vertices.shape[-1] != 3 or 0 in vertices.shape:
        raise ValueError(f"{where}.vertices must be (M, 3) or (T, M, 3), got {vertices.shape}")
    if vertices.ndim == 3 and len(vertices) != frames:
        raise ValueError(f"{where}.vertices must have {frames} frames, got {len(vertices)}")
    _finite(vertices, f"{where}.vertices")
    _in_range(faces, vertices.shape[-2], f"{where}.faces")
    colour = np.asarray(colour, np.float32)
    if colour.shape not in ((3,), (vertices.shape[-2], 3)):
        raise ValueError(f"{where}.colour must be (3,) or ({vertices.shape[-2]}, 3), got {colour.shape}")
    return Part(vertices, faces, colour, float(gloss))


def _landmarks(landmarks: ArrayLike | None, vertices: np.ndarray) -> np.ndarray | None:
    if landmarks is None:
        return None
    landmarks = np.asarray(landmarks)
    if landmarks.ndim == 1 and np.issubdtype(landmarks.dtype, np.integer):
        _in_range(landmarks, vertices.shape[1], "landmarks")
        return vertices[:, landmarks]
    landmarks = landmarks[None] if landmarks.ndim == 2 else landmarks
    if landmarks.ndim != 3 or landmarks.shape[-1] != 3 or len(landmarks) != len(vertices):
        raise ValueError(f"landmarks must be ({len(vertices)}, L, 3) or (L,) vertex indices, got {landmarks.shape}")
    landmarks = landmarks.astype(np.float32)
    _finite(landmarks, "landmarks")
    return landmarks


def _captions(captions: Captions, frames: int) -> tuple[tuple[int, str], ...]:
    captions = tuple(sorted((int(frame), str(text)) for frame, text in captions))
    for frame, text in captions:
        if not 0 <= frame < frames:
            raise ValueError(f"caption {text!r} starts at frame {frame}, outside 0..{frames - 1}")
    return captions


def _faces(faces: ArrayLike, name: str) -> np.ndarray:
    faces = np.asarray(faces)
    if faces.ndim != 2 or faces.shape[-1] != 3 or not np.issubdtype(faces.dtype, np.integer):
        raise ValueError(f"{name} must be (F, 3) integers, got {faces.shape} {faces.dtype}")
    return faces


def _in_range(index: np.ndarray, size: int, name: str) -> None:
    if index.size and not (index.min() >= 0 and index.max() < size):
        raise ValueError(f"{name} must lie in 0..{size - 1}, got {index.min()}..{index.max()}")


def _finite(values: np.ndarray, name: str) -> None:
    bad = ~np.isfinite(values).all(-1)
    if bad.any():
        first = tuple(int(i) for i in np.argwhere(bad)[0])
        raise ValueError(f"{name}{list(first)} is not finite: {values[first]}")
