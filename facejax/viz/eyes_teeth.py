"""Eyes and teeth for a face that came without: the template's, fitted to its landmarks.

They are for the eye alone: nothing is learnt from them or measured on them. iBUG's 68 landmarks are assumed;
millimetres."""

from __future__ import annotations

import functools
from importlib import resources
from typing import NamedTuple

import numpy as np

from facejax.geometry import align
from facejax.mesh import graph
from facejax.viz import props, scene

EYES = (range(42, 48), range(36, 42))  # landmarks of the left and right eye
MOUTH = (*range(31, 36), *range(48, 68))
JAW = range(4, 13)
IBUG = 68
SHRINK, SET_BACK = 0.92, 2.0  # of the teeth; millimetres
FRONT = 18.0  # depth of the teeth that are shown, millimetres


class Props(NamedTuple):
    """The template's eyes and teeth, beside its landmarks."""

    landmarks: np.ndarray  # (68, 3)
    eye_centre: np.ndarray  # (2, 3) left, right
    eye_radius: np.ndarray  # (2,)
    upper_teeth: np.ndarray  # (P, 3)
    upper_faces: np.ndarray  # (K, 3)
    lower_teeth: np.ndarray  # (P, 3)
    lower_faces: np.ndarray  # (K, 3)


@functools.cache
def template() -> Props:
    """The eyes and teeth of MakeHuman's average head, millimetres."""
    with resources.files("facejax.assets").joinpath("eyes_teeth.npz").open("rb") as stream:
        arrays = np.load(stream, allow_pickle=False)
        return Props(**{name: arrays[name] for name in Props._fields})


def parts(template: Props, neutral: np.ndarray, landmarks: np.ndarray) -> tuple[scene.Part, ...]:
    """Eyeballs and teeth of a face with neutral landmarks (68, 3) that moves through landmarks (T, 68, 3).

    Each eye is placed by its own lids, the teeth by nose and mouth; the lower teeth go with the jaw. None for another
    landmark scheme.
    """
    neutral, landmarks = np.asarray(neutral, np.float32), np.asarray(landmarks, np.float32)
    if neutral.shape != (IBUG, 3) or len(template.landmarks) != IBUG:
        return ()
    found = []
    # A face may look anywhere; its eyes look with it.
    gaze = np.asarray(_fit(template.landmarks, neutral, range(IBUG), scaling=True).rotation)[:, 2]
    for side, lids in enumerate(EYES):
        fit = _fit(template.landmarks, neutral, lids, scaling=True)
        centre = np.asarray(align.apply(fit, template.eye_centre[side : side + 1]))[0]
        radius = float(fit.scale) * float(template.eye_radius[side])
        found.append(props.eyeball(centre, radius, gaze=gaze, iris_radius=min(5.9, 0.45 * radius)))
    fit = _fit(template.landmarks, neutral, MOUTH, scaling=True)
    upper, lower = (
        np.asarray(align.apply(fit, _behind_the_lips(teeth))) for teeth in (template.upper_teeth, template.lower_teeth)
    )
    jaw = np.broadcast_to(neutral, landmarks.shape)
    moving = np.asarray(
        align.apply(_fit(jaw, landmarks, JAW, scaling=False), np.broadcast_to(lower, (len(landmarks), *lower.shape)))
    )
    for teeth, faces, placed in (
        (template.upper_teeth, template.upper_faces, upper),
        (template.lower_teeth, template.lower_faces, moving),
    ):
        used, shown = front(teeth, faces)
        found.append(scene.Part(placed[..., used, :], shown, props.TEETH, 0.6))
    return tuple(found)


def has_eye_holes(vertices: np.ndarray, faces: np.ndarray, landmarks: np.ndarray) -> bool:
    """Whether a mesh is open where the eyes of its landmarks (68, 3) are, so that eyeballs belong behind it."""
    middles = [vertices[loop].mean(axis=0) for loop in graph.boundary_loops(faces)]
    for lids in EYES:
        eye = landmarks[list(lids)]
        centre = eye.mean(axis=0)
        width = np.linalg.norm(eye - centre, axis=1).max()
        if not any(np.linalg.norm(middle - centre) < width for middle in middles):
            return False
    return True


def front(teeth: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles of the front teeth: with no cheek inside, molars would shine through an open mouth."""
    shown = faces[(teeth[faces, 2] > teeth[:, 2].max() - FRONT).all(axis=1)]
    used, renumbered = np.unique(shown, return_inverse=True)
    return used, renumbered.reshape(shown.shape).astype(np.int32)


def _behind_the_lips(teeth: np.ndarray) -> np.ndarray:
    """A little narrower and further back: lips here are made by a decoder, which knows no teeth."""
    centre = teeth.mean(axis=0)
    return (centre + SHRINK * (teeth - centre) - [0, 0, SET_BACK]).astype(np.float32)


def _fit(source: np.ndarray, target: np.ndarray, which, *, scaling: bool) -> align.Similarity:
    index = np.array(list(which))
    return align.procrustes(source[..., index, :], target[..., index, :], scaling=scaling)
