"""A Gaussian process morphable model that is carried to each face: the best linear answer to a face's landmarks.

Displacements of a face are a Gaussian process on its surface: a mean, and a covariance that is the sum of what training
faces showed and of a smooth prior (Luthi et al. 2018), which takes up what they never did: near points move alike, each
as far as it usually moves. The most probable displacement given the landmarks', with noise of variance `noise`, is one
affine map; it differs from face to face where the covariance was learnt on a mean face and is *carried* to the given
one by deformation transfer (`facejax.mesh.transfer`). Plain, and without the smooth prior, it is ridge regression.
Landmarks that are off, a detector's say, mislead it badly; it can be `with_landmark_noise` how far, or find out (`estimate_landmark_noise`).

    params = gpmm.fit(people, faces, landmark_index, prior=gpmm.Prior(carried=True, smooth=0.01, noise=1e-4))
    mine = gpmm.on_face(params, neutral)  # once per face, a fifth of a second
    displacements = linear.apply(mine, landmark_displacements)

On makehuman4d's level 3, validation people, training on 80: ridge regression errs by 0.0432 mm over the head, this by
0.0205. Its expressions are themselves made by deformation transfer there, which favours it; levels 0 and 1 are not.

N vertices, F triangles, L landmarks, k components, T frames of a person; millimetres, on the host, in float64.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from facejax.mesh import deformation_transfer
from facejax.models.decoders import linear

COMPONENTS = 400
SMOOTH_SCALES_MM = (10.0, 20.0, 40.0, 80.0)  # mm, of the smooth prior: wrinkles of a cheek, a cheek, a jaw, a head
NOISE_GRID_MM = np.append(0.0, np.geomspace(0.003, 5.0, 120))  # mm, of landmarks: a sixteenth from one to the next


class Person(NamedTuple):
    """One face and its frames: displacements from neutral."""

    neutral: np.ndarray  # (N, 3)
    landmarks: np.ndarray  # (T, L, 3)
    vertices: np.ndarray  # (T, N, 3)


class Prior(NamedTuple):
    """How strongly what is believed; found by cross-validation (`facejax.fit_gpmm`)."""

    carried: bool = True
    smooth: float = 0.003  # standard deviation of the smooth prior, over how far each vertex usually moves
    noise: float = 1e-4  # variance of a landmark's coordinate, mm^2


class GPMM(NamedTuple):
    """The mean face, and what displacements look like on it."""

    faces: np.ndarray  # (F, 3)
    landmark_index: np.ndarray  # (L,)
    face: np.ndarray  # (N, 3)
    motion: np.ndarray  # (N,) how far each vertex moves, root mean square in mm: the smooth prior's measure
    hold: np.ndarray  # (N,) the same, as the carrier between faces was given it
    # Carried: a basis on the mean face. Plain: moments as they are, or the map itself, the same for all faces.
    statistics: linear.Basis | linear.Moments | linear.LinearMap
    prior: Prior


def fit(
    people: Iterable[Person],
    faces: np.ndarray,
    landmark_index: np.ndarray,
    *,
    prior: Prior = Prior(),
    components: int = COMPONENTS,
    passes: int = 3,
) -> GPMM:
    """Learn from people (any iterable that can be gone through several times)."""
    face, motion = mean_face_and_motion(people)
    known = fit_statistics(
        [(p.landmarks, transfer_to(p, faces, face, motion) if prior.carried else p.vertices) for p in people],
        carried=prior.carried, components=components, passes=passes,
    )  # fmt: skip
    return GPMM(faces, landmark_index, face, motion, motion, known, prior)


def mean_face_and_motion(people: Iterable[Person]) -> tuple[np.ndarray, np.ndarray]:
    """The mean face (N, 3), and how far its vertices move (N,), root mean square over all frames in mm."""
    count, faces, frames, squares = 0, 0.0, 0, 0.0
    for person in people:
        count, faces = count + 1, faces + np.asarray(person.neutral, np.float64)
        frames += len(person.vertices)
        squares += np.sum(np.square(person.vertices, dtype=np.float64), axis=(0, 2))
    if not frames:
        raise ValueError("expected at least one person with a frame, got none")
    return faces / count, np.sqrt(squares / frames)


def fit_statistics(
    batches: linear.Batches, *, carried: bool, components: int = COMPONENTS, passes: int = 3
) -> linear.Basis | linear.Moments:
    """The statistics of displacements: a basis of what was carried to the mean face, or moments of what was not."""
    return (
        linear.pca.prepare(batches, components=components, passes=passes) if carried else linear.ridge.prepare(batches)
    )


def transfer_to(person: Person, faces: np.ndarray, face: np.ndarray, regulariser: np.ndarray) -> np.ndarray:
    """A person's displacements on another face, (T, N, 3) float32."""
    anchors = deformation_transfer.anchor_weights(regulariser)
    there = deformation_transfer.DeformationTransfer(person.neutral, face, faces, anchors)
    back = deformation_transfer.DeformationTransfer(face, person.neutral, faces, anchors)
    return deformation_transfer.invert(there, back, person.vertices).astype(np.float32)


def with_landmark_noise(params: GPMM, noise: float) -> GPMM:
    """The model that knows landmarks to be off by so many mm in every coordinate, as a detector's are.

    Raises `ValueError` for noise below 0, and for a model of which only the map was kept.
    """
    if not noise >= 0:
        raise ValueError(f"noise: expected 0 mm or more, got {noise}")
    if noise and isinstance(params.statistics, linear.LinearMap):
        raise ValueError("noise: this model was kept as one map, which was made for landmarks that are right")
    return params._replace(prior=params.prior._replace(noise=params.prior.noise + noise**2))


def estimate_landmark_noise(params: GPMM, neutral: np.ndarray, landmarks: np.ndarray) -> float:
    """How far landmark displacements (T, L, 3) of one face (N, 3) are off, by the model: mm in every coordinate.

    The noise under which they are most likely (type II maximum likelihood): what no face does is noise. One number for
    all frames, of `NOISE_GRID_MM`, 5 mm at most. Raises `ValueError` as `linear_map` and `with_landmark_noise` do, for no frames, and for
    landmarks that are not finite.
    """
    if len(landmarks) == 0 or not np.isfinite(landmarks).all():
        raise ValueError(f"landmarks: expected one or more frames of finite numbers, got {np.shape(landmarks)}")
    if isinstance(params.statistics, linear.LinearMap):
        raise ValueError("noise: this model was kept as one map, which cannot tell what faces do not do")
    known = covariances(params, neutral, vertex_index=np.zeros(0, int))
    here, _ = _posterior(known, params.prior)
    variance, directions = np.linalg.eigh(here)
    off = (np.asarray(landmarks) - known.landmark_mean).reshape(len(landmarks), -1)
    seen = np.mean(np.square(off @ directions), axis=0)
    whole = np.maximum(variance, params.prior.noise) + np.square(NOISE_GRID_MM)[:, None]
    likelihood = -np.sum(np.log(whole) + seen / whole, axis=1)
    return float(NOISE_GRID_MM[np.argmax(likelihood)])


def linear_map(params: GPMM, neutral: np.ndarray) -> linear.LinearMap:
    """The map of one face (N, 3): what `linear.apply` takes. Raises `ValueError` for a face of another shape."""
    if isinstance(params.statistics, linear.LinearMap):
        _check(params, neutral)
        return params.statistics
    here, there = _posterior(known := covariances(params, neutral), params.prior)
    return linear.affine(known.mean[params.landmark_index], known.mean, np.linalg.solve(here, there))


class Covariances(NamedTuple):
    """What is believed of V vertices of one face, before the prior's weights; 3 L and 3 V coordinates."""

    mean: np.ndarray  # (V, 3)
    landmark_mean: np.ndarray  # (L, 3)
    within: np.ndarray  # (3 L, 3 L) learnt, of the landmarks among themselves
    cross: np.ndarray  # (3 L, 3 V) learnt, of landmarks and vertices
    smooth_within: np.ndarray  # (3 L, 3 L) of the smooth prior at standard deviations of one motion
    smooth_cross: np.ndarray  # (3 L, 3 V)


def covariances(params: GPMM, neutral: np.ndarray, *, vertex_index: np.ndarray | None = None) -> Covariances:
    """Of one face (N, 3): all vertices, or `vertex_index` (V,). Raises `ValueError` for a face of another shape."""
    _check(params, neutral)
    at = params.landmark_index
    keep = np.arange(len(params.face)) if vertex_index is None else vertex_index
    mean, within, cross = _learnt(params, neutral, keep)
    smooth = _smooth(params)
    spread = [np.kron(smooth[:, some], np.eye(3)) for some in (at, keep)]
    return Covariances(mean[keep], mean[at], within, cross, *spread)


def predict(known: Covariances, prior: Prior, landmarks: np.ndarray) -> np.ndarray:
    """Displacements (T, V, 3) of landmarks' (T, L, 3): for a few frames cheaper than a map."""
    here, there = _posterior(known, prior)
    off = (landmarks - known.landmark_mean).reshape(len(landmarks), -1)
    return known.mean + (np.linalg.solve(here, off.T).T @ there).reshape(len(landmarks), -1, 3)


def _check(params: GPMM, neutral: np.ndarray) -> None:
    if np.shape(neutral) != params.face.shape:
        raise ValueError(f"neutral: expected vertices {params.face.shape}, got {np.shape(neutral)}")


def _posterior(known: Covariances, prior: Prior) -> tuple[np.ndarray, np.ndarray]:
    far = prior.smooth**2
    here = known.within + far * known.smooth_within + prior.noise * np.eye(len(known.within))
    return here, known.cross + far * known.smooth_cross


def _learnt(params: GPMM, neutral: np.ndarray, keep: np.ndarray):
    """On this face: the mean (N, 3), the landmarks' covariance among themselves, and with the kept vertices."""
    known, at = params.statistics, params.landmark_index
    if isinstance(known, linear.Moments):
        cross = known.cross.reshape(len(known.cross), -1, 3)[:, keep].reshape(len(known.cross), -1)
        return known.vertex_mean, known.covariance, cross
    anchors = deformation_transfer.anchor_weights(params.hold)
    carrier = deformation_transfer.DeformationTransfer(params.face, neutral, params.faces, anchors)
    shape = (len(known.components), *params.face.shape)
    moved = carrier(np.concatenate([known.vertex_mean[None], known.components.reshape(shape)]))
    mean, moved = moved[0], moved[1:]
    marks = moved[:, at].reshape(len(moved), -1)
    weighted = known.variance[:, None] * marks
    return mean, weighted.T @ marks, weighted.T @ moved[:, keep].reshape(len(moved), -1)


def _smooth(params: GPMM) -> np.ndarray:
    """The smooth prior's covariance of landmarks and vertices, (L, N), for a standard deviation of one motion."""
    at = params.landmark_index
    squared = np.sum((params.face[at, None] - params.face) ** 2, axis=-1)
    alike = sum(np.exp(-squared / (2 * scale**2)) for scale in SMOOTH_SCALES_MM) / len(SMOOTH_SCALES_MM)
    return alike * params.motion[at, None] * params.motion
