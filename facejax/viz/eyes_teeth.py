"""Eyes and teeth for a face without them: MakeHuman's, fitted to the face's landmarks.

For rendering only: no model is trained or measured on them. iBUG's 68 landmarks are required.
T frames, P vertices of a set of teeth, K of its triangles; millimetres, y up, z out of the face.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable, Sequence
from importlib import resources
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from facejax.geometry import align
from facejax.mesh import graph
from facejax.viz import scene

EYES = (range(42, 48), range(36, 42))  # landmarks of the left and right eye
MOUTH = (*range(31, 36), *range(48, 68))
JAW = range(4, 13)
LANDMARKS = 68  # number of points of the only supported scheme, iBUG
TEETH_SCALE, TEETH_SETBACK = 0.92, 2.0  # and mm: decoded lips would intersect teeth of full size
TEETH_COLOUR, TONGUE_COLOUR = (0.80, 0.77, 0.71), (0.58, 0.30, 0.29)
FRONT_DEPTH = 18.0  # mm from the foremost point: teeth that are drawn


class Props(NamedTuple):
    """The template's eyes and teeth, and its landmarks."""

    landmarks: np.ndarray  # (68, 3)
    eye_centre: np.ndarray  # (2, 3) left, right
    eye_radius: np.ndarray  # (2,)
    upper_teeth: np.ndarray  # (P, 3)
    upper_faces: np.ndarray  # (K, 3)
    lower_teeth: np.ndarray  # (P, 3)
    lower_faces: np.ndarray  # (K, 3)


@functools.cache
def template() -> Props:
    """Return the eyes and teeth of MakeHuman's average head."""
    with resources.files("facejax.assets").joinpath("eyes_teeth.npz").open("rb") as stream:
        arrays = np.load(stream, allow_pickle=False)
        return Props(**{name: arrays[name] for name in Props._fields})


def parts(template: Props, neutral: np.ndarray, landmarks: np.ndarray) -> tuple[scene.Part, ...]:
    """Return eyeballs and teeth of a face with neutral landmarks (68, 3) that moves through landmarks (T, 68, 3).

    Each eye is placed by its lids, the teeth by nose and mouth; the lower teeth follow the jaw. Another landmark scheme
    has no parts.
    """
    neutral, landmarks = np.asarray(neutral, np.float32), np.asarray(landmarks, np.float32)
    if neutral.shape != (LANDMARKS, 3) or len(template.landmarks) != LANDMARKS:
        return ()
    found = []
    # The eyes look along the face's own forward axis.
    gaze = np.asarray(_fit(template.landmarks, neutral, range(LANDMARKS), scaling=True).rotation)[:, 2]
    for side, lids in enumerate(EYES):
        fit = _fit(template.landmarks, neutral, lids, scaling=True)
        centre = np.asarray(align.apply(fit, template.eye_centre[side : side + 1]))[0]
        radius = float(fit.scale) * float(template.eye_radius[side])
        found.append(eyeball(centre, radius, gaze=gaze, iris_radius=min(5.9, 0.45 * radius)))
    fit = _fit(template.landmarks, neutral, MOUTH, scaling=True)
    upper, lower = (
        np.asarray(align.apply(fit, _scale_teeth(teeth))) for teeth in (template.upper_teeth, template.lower_teeth)
    )
    jaw = np.broadcast_to(neutral, landmarks.shape)
    moving = np.asarray(
        align.apply(_fit(jaw, landmarks, JAW, scaling=False), np.broadcast_to(lower, (len(landmarks), *lower.shape)))
    )
    for teeth, faces, placed in (
        (template.upper_teeth, template.upper_faces, upper),
        (template.lower_teeth, template.lower_faces, moving),
    ):
        used, shown = front_teeth(teeth, faces)
        found.append(scene.Part(placed[..., used, :], shown, TEETH_COLOUR, 0.6))
    return tuple(found)


def eyeball(
    centre: ArrayLike,
    radius: float,
    *,
    gaze: Sequence[float] | np.ndarray = (0.0, 0.0, 1.0),
    iris: ArrayLike = (0.30, 0.42, 0.46),
    iris_radius: float = 5.9,
    sectors: int = 32,
) -> scene.Part:
    """Build an eye: white, iris with a dark rim, pupil.

    Args:
      centre: (3,), or (T, 3) where the head moves; mm.
      radius: mm.
      gaze: direction of view.
      iris: sRGB in [0, 1].
      iris_radius: mm, at most 0.8 of the radius; the pupil is a third of it.
      sectors: vertices on each ring.

    Raises:
      ValueError: `iris_radius` is out of range.
    """
    if not 0 < iris_radius <= 0.8 * radius:
        raise ValueError(f"iris_radius must lie in (0, 0.8 * radius = {0.8 * radius:g}], got {iris_radius}")
    white, iris, pupil = (0.90, 0.88, 0.86), np.asarray(iris), (0.02, 0.02, 0.02)
    edge, hole = np.degrees(np.arcsin([iris_radius / radius, iris_radius / 3 / radius]))
    # Degrees from the gaze, and the colour there. Two coincident rings of different colours make a sharp edge.
    rings = [(0.5, pupil), (hole, pupil), (hole, iris * 0.8), ((hole + edge) / 2, iris)]
    rings += [(0.93 * edge, iris * 0.45), (edge, iris * 0.45), (edge, white)]
    rings += [(angle, white) for angle in np.linspace(edge, 179.5, 12)[1:]]
    polar = np.radians([angle for angle, _ in rings])[:, None]
    around = np.linspace(0, 2 * np.pi, sectors, endpoint=False)[None]
    z = np.asarray(gaze, np.float64) / np.linalg.norm(gaze)
    x = np.cross((0.0, 1.0, 0.0), z) if abs(z[1]) < 0.99 else np.array((1.0, 0.0, 0.0))
    x /= np.linalg.norm(x)
    frame = np.stack([x, np.cross(z, x), z])
    ball = np.stack(
        np.broadcast_arrays(np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar)), -1
    )
    a = (np.arange(len(rings) - 1)[:, None] * sectors + np.arange(sectors)).ravel()
    b = (np.arange(len(rings) - 1)[:, None] * sectors + (np.arange(sectors) + 1) % sectors).ravel()
    faces = np.concatenate([np.stack([a, a + sectors, b + sectors], -1), np.stack([a, b + sectors, b], -1)])
    vertices = np.asarray(centre)[..., None, :] + radius * ball.reshape(-1, 3) @ frame
    colour = np.repeat(np.array([colour for _, colour in rings]), sectors, axis=0)
    return scene.Part(vertices.astype(np.float32), faces.astype(np.int32), colour.astype(np.float32), 1.0)


def has_eye_holes(vertices: np.ndarray, faces: np.ndarray, landmarks: np.ndarray) -> bool:
    """Return whether a mesh is open at the eyes of its landmarks (68, 3), so that eyeballs are visible."""
    centres = [vertices[loop].mean(axis=0) for loop in graph.boundary_loops(faces)]
    for lids in EYES:
        eye = landmarks[list(lids)]
        centre = eye.mean(axis=0)
        width = np.linalg.norm(eye - centre, axis=1).max()
        if not any(np.linalg.norm(hole_centre - centre) < width for hole_centre in centres):
            return False
    return True


def front_teeth(teeth: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return vertex indices and triangles (K, 3) of the front teeth.

    There are no cheeks inside the mouth: molars would be visible through it.
    """
    shown = faces[(teeth[faces, 2] > teeth[:, 2].max() - FRONT_DEPTH).all(axis=1)]
    used, renumbered = np.unique(shown, return_inverse=True)
    return used, renumbered.reshape(shown.shape).astype(np.int32)


def _scale_teeth(teeth: np.ndarray) -> np.ndarray:
    """Scale and set back teeth (P, 3), so that they stay behind decoded lips."""
    centre = teeth.mean(axis=0)
    return (centre + TEETH_SCALE * (teeth - centre) - [0, 0, TEETH_SETBACK]).astype(np.float32)


def _fit(source: np.ndarray, target: np.ndarray, which: Iterable[int], *, scaling: bool) -> align.Similarity:
    index = np.array(list(which))
    return align.procrustes(source[..., index, :], target[..., index, :], scaling=scaling)
