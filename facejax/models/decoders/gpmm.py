"""Gaussian process morphable model (GPMM) transferred to each face: MAP vertex displacements given the landmarks.

Displacements of a face are modelled as a Gaussian process on its surface: a mean, and a covariance that is the sum of
the training statistics and of a smooth prior (Luthi et al. 2018). The smooth prior covers deformations that are absent
from the training set: nearby vertices move alike, each in proportion to its usual motion. The posterior mean given
landmark displacements with noise of variance `noise` is an affine map. It differs between faces if the model is
*carried*: the covariance is learned on the mean face and transferred to each face by deformation transfer
(`facejax.mesh.deformation_transfer`). Without transfer and without the smooth prior the model is ridge regression.
Noisy landmarks, such as a detector's, degrade the estimate strongly; set their noise with `with_landmark_noise`, or
estimate it with `estimate_landmark_noise`.

    params = gpmm.fit(people, faces, landmark_index, prior=gpmm.Prior(carried=True, smooth=0.01, noise=1e-4))
    face_map = gpmm.linear_map(params, neutral)  # once per face, 0.2 s
    displacements = linear.apply(face_map, landmark_displacements)

On makehuman4d's level 3, validation people, training on 80: the mean vertex error over the head is 0.0432 mm for ridge
regression and 0.0205 mm for this model. Expressions of that level are themselves made by deformation transfer, which
favours the model; those of levels 0 and 1 are not.

N vertices, F triangles, L landmarks, k components, T frames of a person; millimetres, on the host, in float64.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Float, Int

from facejax.mesh import deformation_transfer
from facejax.models.decoders import linear

COMPONENTS = 400
SMOOTH_SCALES_MM = (10.0, 20.0, 40.0, 80.0)  # of the smooth prior: wrinkles, cheek, jaw, head
NOISE_GRID_MM = np.append(0.0, np.geomspace(0.003, 5.0, 120))  # steps of 6 %


class Person(NamedTuple):
    """One neutral face and T frames of displacements from it."""

    neutral: np.ndarray  # (N, 3)
    landmarks: np.ndarray  # (T, L, 3)
    vertices: np.ndarray  # (T, N, 3)


class Prior(NamedTuple):
    """Hyperparameters; chosen by cross-validation (`facejax.training.recipes.fit_gpmm`)."""

    carried: bool = True  # whether the learned covariance is transferred to each face
    smooth: float = 0.003  # standard deviation of the smooth prior, in units of each vertex's `motion`
    noise: float = 1e-4  # variance of a landmark coordinate, mm^2


class GPMM(NamedTuple):
    """The mean face and the statistics of displacements on it."""

    faces: np.ndarray  # (F, 3)
    landmark_index: np.ndarray  # (L,)
    face: np.ndarray  # (N, 3)
    motion: np.ndarray  # (N,) root mean square displacement of each vertex in mm, which scales the smooth prior
    hold: np.ndarray  # (N,) `motion` as used by the deformation transfer's anchors
    # Carried: a basis on the mean face. Otherwise moments, or the map itself (from a file), the same for all faces.
    statistics: linear.Basis | linear.Moments | linear.LinearMap
    prior: Prior


def fit(
    people: Iterable[Person],
    faces: Int[np.ndarray, "F 3"],
    landmark_index: Int[np.ndarray, " L"],
    *,
    prior: Prior = Prior(),
    components: int = COMPONENTS,
    passes: int = 3,
) -> GPMM:
    """Fit the model to people, any iterable that can be iterated several times.

    Args:
      faces: (F, 3) triangles.
      landmark_index: (L,) vertices.
      components: of the basis, if `prior.carried`.
      passes: of the subspace iteration.

    Raises:
      ValueError: no person with a frame.
    """
    face, motion = mean_face_and_motion(people)
    statistics = fit_statistics(
        [(p.landmarks, transfer_to(p, faces, face, motion) if prior.carried else p.vertices) for p in people],
        carried=prior.carried, components=components, passes=passes,
    )  # fmt: skip
    return GPMM(faces, landmark_index, face, motion, motion, statistics, prior)


def mean_face_and_motion(people: Iterable[Person]) -> tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, " N"]]:
    """Return the mean face (N, 3), and the root mean square displacement of its vertices over all frames (N,), in mm.

    Raises:
      ValueError: no person with a frame.
    """
    count, faces, frames, squares = 0, np.zeros(()), 0, np.zeros(())
    for person in people:
        count, faces = count + 1, faces + np.asarray(person.neutral, np.float64)
        frames += len(person.vertices)
        squares = squares + np.sum(np.square(person.vertices, dtype=np.float64), axis=(0, 2))
    if not frames:
        raise ValueError("expected at least one person with a frame, got none")
    return faces / count, np.sqrt(squares / frames)


def fit_statistics(
    batches: linear.Batches, *, carried: bool, components: int = COMPONENTS, passes: int = 3
) -> linear.Basis | linear.Moments:
    """Fit the statistics of displacements: a PCA basis if they were transferred to the mean face, else moments."""
    return (
        linear.pca.prepare(batches, components=components, passes=passes) if carried else linear.ridge.prepare(batches)
    )


def transfer_to(
    person: Person,
    faces: Int[np.ndarray, "F 3"],
    face: Float[np.ndarray, "N 3"],
    motion: Float[np.ndarray, " N"],
) -> Float[np.ndarray, "T N 3"]:
    """Transfer a person's displacements to another face, in float32; `motion` as in `GPMM`."""
    anchors = deformation_transfer.anchor_weights(motion)
    there = deformation_transfer.DeformationTransfer(person.neutral, face, faces, anchors)
    back = deformation_transfer.DeformationTransfer(face, person.neutral, faces, anchors)
    return deformation_transfer.invert(there, back, person.vertices).astype(np.float32)


def with_landmark_noise(params: GPMM, noise: float) -> GPMM:
    """Return the model with landmark noise sigma (mm) per coordinate, added to the prior's noise.

    Raises:
      ValueError: negative noise, or a model that holds only the linear map.
    """
    if not noise >= 0:
        raise ValueError(f"noise: expected 0 mm or more, got {noise}")
    if noise and isinstance(params.statistics, linear.LinearMap):
        raise ValueError(
            "noise: this model file stores only a linear map fitted to noise-free landmarks; expected noise 0"
        )
    return params._replace(prior=params.prior._replace(noise=params.prior.noise + noise**2))


def estimate_landmark_noise(
    params: GPMM, neutral: Float[Array | np.ndarray, "N 3"], landmarks: Float[Array | np.ndarray, "T L 3"]
) -> float:
    """Estimate the noise of one face's landmark displacements: sigma in mm per coordinate.

    The value of `NOISE_GRID_MM` (at most 5 mm) that maximises the marginal likelihood of all frames (type II maximum
    likelihood).

    Raises:
      ValueError: no frames, values that are not finite, or errors of `linear_map` and `with_landmark_noise`.
    """
    if len(landmarks) == 0 or not np.isfinite(landmarks).all():
        raise ValueError(f"landmarks: expected one or more frames of finite numbers, got {np.shape(landmarks)}")
    if isinstance(params.statistics, linear.LinearMap):
        raise ValueError(
            "noise: this model file stores only a linear map, without the statistics to estimate landmark noise from"
        )
    known = covariances(params, neutral, vertex_index=np.zeros(0, int))
    variance, directions = np.linalg.eigh(_posterior(known, params.prior)[0])
    centred = (np.asarray(landmarks) - known.landmark_mean).reshape(len(landmarks), -1)
    observed = np.mean(np.square(centred @ directions), axis=0)
    expected = np.maximum(variance, params.prior.noise) + np.square(NOISE_GRID_MM)[:, None]
    likelihood = -np.sum(np.log(expected) + observed / expected, axis=1)
    return float(NOISE_GRID_MM[np.argmax(likelihood)])


def linear_map(params: GPMM, neutral: Float[Array | np.ndarray, "N 3"]) -> linear.LinearMap:
    """Return the affine map of one face, for `linear.apply`.

    Raises:
      ValueError: a face of another shape.
    """
    if isinstance(params.statistics, linear.LinearMap):
        _check(params, neutral)
        return params.statistics
    within, cross = _posterior(known := covariances(params, neutral), params.prior)
    return linear.affine(known.mean[params.landmark_index], known.mean, np.linalg.solve(within, cross))


class Covariances(NamedTuple):
    """Covariances of V vertices and the landmarks of one face, before the prior's weights are applied."""

    mean: np.ndarray  # (V, 3)
    landmark_mean: np.ndarray  # (L, 3)
    within: np.ndarray  # (3 L, 3 L) learned, between landmarks
    cross: np.ndarray  # (3 L, 3 V) learned, between landmarks and vertices
    smooth_within: np.ndarray  # (3 L, 3 L) of the smooth prior with unit `smooth`
    smooth_cross: np.ndarray  # (3 L, 3 V)


def covariances(
    params: GPMM, neutral: Float[Array | np.ndarray, "N 3"], *, vertex_index: Int[np.ndarray, " V"] | None = None
) -> Covariances:
    """Return the covariances of one face's landmarks with all vertices, or with those of `vertex_index`.

    Raises:
      ValueError: a face of another shape.
    """
    _check(params, neutral)
    at = params.landmark_index
    index = np.arange(len(params.face)) if vertex_index is None else vertex_index
    mean, within, cross = _learned(params, neutral, index)
    smooth = _smooth(params)
    smooth_within, smooth_cross = (np.kron(smooth[:, columns], np.eye(3)) for columns in (at, index))
    return Covariances(mean[index], mean[at], within, cross, smooth_within, smooth_cross)


def predict(
    known: Covariances, prior: Prior, landmarks: Float[Array | np.ndarray, "T L 3"]
) -> Float[np.ndarray, "T V 3"]:
    """Return the displacements (T, V, 3) given the landmarks'; for a few frames cheaper than `linear_map`."""
    within, cross = _posterior(known, prior)
    centred = np.asarray(landmarks - known.landmark_mean).reshape(len(landmarks), -1)
    return known.mean + (np.linalg.solve(within, centred.T).T @ cross).reshape(len(landmarks), -1, 3)


def _check(params: GPMM, neutral: Array | np.ndarray) -> None:
    if np.shape(neutral) != params.face.shape:
        raise ValueError(f"neutral: expected vertices {params.face.shape}, got {np.shape(neutral)}")


def _posterior(known: Covariances, prior: Prior) -> tuple[np.ndarray, np.ndarray]:
    """Return the landmarks' covariance with noise, and that of landmarks and vertices, under a prior."""
    weight = prior.smooth**2
    within = known.within + weight * known.smooth_within + prior.noise * np.eye(len(known.within))
    return within, known.cross + weight * known.smooth_cross


def _learned(
    params: GPMM, neutral: Array | np.ndarray, vertex_index: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return, on this face, the mean (N, 3), the covariance between landmarks, and that with the chosen vertices."""
    statistics, at = params.statistics, params.landmark_index
    if isinstance(statistics, linear.Moments):
        cross = statistics.cross.reshape(len(statistics.cross), -1, 3)[:, vertex_index]
        return statistics.vertex_mean, statistics.covariance, cross.reshape(len(cross), -1)
    if isinstance(statistics, linear.LinearMap):
        raise ValueError("this model file stores only a linear map, without covariances")
    anchors = deformation_transfer.anchor_weights(params.hold)
    transfer = deformation_transfer.DeformationTransfer(params.face, np.asarray(neutral), params.faces, anchors)
    components = statistics.components.reshape(-1, *params.face.shape)
    moved = transfer(np.concatenate([statistics.vertex_mean[None], components]))
    mean, moved = moved[0], moved[1:]
    marks = moved[:, at].reshape(len(moved), -1)
    weighted = statistics.variance[:, None] * marks
    return mean, weighted.T @ marks, weighted.T @ moved[:, vertex_index].reshape(len(moved), -1)


def _smooth(params: GPMM) -> np.ndarray:
    """Return the smooth prior's covariance of landmarks and vertices, (L, N), for a standard deviation of `motion`."""
    at = params.landmark_index
    squared = np.sum((params.face[at, None] - params.face) ** 2, axis=-1)
    kernel = np.zeros_like(squared)
    for scale in SMOOTH_SCALES_MM:
        kernel = kernel + np.exp(-squared / (2 * scale**2))
    return kernel / len(SMOOTH_SCALES_MM) * params.motion[at, None] * params.motion
