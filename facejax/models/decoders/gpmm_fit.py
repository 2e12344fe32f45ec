"""Fit a Gaussian process morphable model (`facejax.models.decoders.gpmm`), on the host in float64.

    params = gpmm_fit.fit(people, faces, landmark_index, prior=gpmm.Prior(carried=True, smooth=0.01, noise=1e-4))

`covariances` and `predict` evaluate many priors on some vertices of a face; they form the covariances, and are the
oracle of `gpmm.linear_map`. N vertices, F triangles, L landmarks, k components, T frames of a person; millimetres.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Float, Int

from facejax.mesh import deformation_transfer
from facejax.models import pca
from facejax.models.decoders import gpmm, linear

COMPONENTS = 400


class Person(NamedTuple):
    """One neutral face and T frames of displacements from it."""

    neutral: np.ndarray  # (N, 3)
    landmarks: np.ndarray  # (T, L, 3)
    vertices: np.ndarray  # (T, N, 3)


def fit(
    people: Iterable[Person],
    faces: Int[np.ndarray, "F 3"],
    landmark_index: Int[np.ndarray, " L"],
    *,
    prior: gpmm.Prior = gpmm.Prior(),
    components: int = COMPONENTS,
    passes: int = 3,
) -> gpmm.GPMM:
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
    return assemble(statistics, prior, faces, landmark_index, face=face, motion=motion, hold=motion)


def assemble(
    statistics: linear.Basis | linear.Moments,
    prior: gpmm.Prior,
    faces: Int[np.ndarray, "F 3"],
    landmark_index: Int[np.ndarray, " L"],
    *,
    face: Float[np.ndarray, "N 3"],
    motion: Float[np.ndarray, " N"],
    hold: Float[np.ndarray, " N"],
) -> gpmm.GPMM:
    """Return the model of fitted statistics; the other arguments as in `gpmm.GPMM`."""
    if isinstance(statistics, linear.Basis):
        components, variance = statistics.components.reshape(-1, *face.shape), statistics.variance
    else:
        # Principal directions of the landmarks, each with the vertex displacements that go with it.
        variance, directions = pca.from_covariance(statistics.covariance)
        kept = variance > 1e-14 * max(variance[0], 1e-300)
        variance, directions = variance[kept], directions[:, kept]
        components = (directions.T @ statistics.cross / variance[:, None]).reshape(-1, *face.shape)
    params = gpmm.build(
        faces, landmark_index, face=face, motion=motion, hold=hold, mean=statistics.vertex_mean,
        components=components, variance=variance, prior=prior,
    )  # fmt: skip
    return with_prior(params, prior)


def with_prior(params: gpmm.GPMM, prior: gpmm.Prior) -> gpmm.GPMM:
    """Return the model under another prior, of the same `carried`."""
    params = params.replace(prior=prior, shared_map=None)
    if prior.carried:
        return params
    within, cross = _posterior(known := covariances(params, params.face), prior)
    return params.replace(shared_map=linear.affine(known.landmark_mean, known.mean, np.linalg.solve(within, cross)))


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


class Covariances(NamedTuple):
    """Covariances of V vertices and the landmarks of one face, before the prior's weights are applied."""

    mean: np.ndarray  # (V, 3)
    landmark_mean: np.ndarray  # (L, 3)
    within: np.ndarray  # (3 L, 3 L) learned, between landmarks
    cross: np.ndarray  # (3 L, 3 V) learned, between landmarks and vertices
    smooth_within: np.ndarray  # (3 L, 3 L) of the smooth prior with unit `smooth`
    smooth_cross: np.ndarray  # (3 L, 3 V)


def covariances(
    params: gpmm.GPMM, neutral: Float[Array | np.ndarray, "N 3"], *, vertex_index: Int[np.ndarray, " V"] | None = None
) -> Covariances:
    """Return the covariances of one face's landmarks with all vertices, or with those of `vertex_index`.

    Raises:
      ValueError: a face of another shape.
    """
    if np.shape(neutral) != np.shape(params.face):
        raise ValueError(f"neutral: expected vertices {np.shape(params.face)}, got {np.shape(neutral)}")
    face, at = np.asarray(params.face, np.float64), np.asarray(params.landmark_index)
    index = np.arange(len(face)) if vertex_index is None else vertex_index
    mean, components = np.asarray(params.mean, np.float64), np.asarray(params.components, np.float64)
    if params.prior.carried:
        anchors = deformation_transfer.anchor_weights(np.asarray(params.hold, np.float64))
        transfer = deformation_transfer.DeformationTransfer(
            face, np.asarray(neutral), np.asarray(params.faces), anchors
        )
        moved = transfer(np.concatenate([mean[None], components]))
        mean, components = moved[0], moved[1:]
    marks = components[:, at].reshape(len(components), -1)
    weighted = np.asarray(params.variance, np.float64)[:, None] * marks
    smooth = gpmm.smooth_kernel(face, at, np.asarray(params.motion, np.float64))
    smooth_within, smooth_cross = (np.kron(smooth[:, columns], np.eye(3)) for columns in (at, index))
    cross = weighted.T @ components[:, index].reshape(len(components), -1)
    return Covariances(mean[index], mean[at], weighted.T @ marks, cross, smooth_within, smooth_cross)


def predict(
    known: Covariances, prior: gpmm.Prior, landmarks: Float[Array | np.ndarray, "T L 3"]
) -> Float[np.ndarray, "T V 3"]:
    """Return the displacements (T, V, 3) given the landmarks'; for a few frames cheaper than `linear_map`."""
    within, cross = _posterior(known, prior)
    centred = np.asarray(landmarks - known.landmark_mean).reshape(len(landmarks), -1)
    return known.mean + (np.linalg.solve(within, centred.T).T @ cross).reshape(len(landmarks), -1, 3)


def _posterior(known: Covariances, prior: gpmm.Prior) -> tuple[np.ndarray, np.ndarray]:
    """Return the landmarks' covariance with noise, and that of landmarks and vertices, under a prior."""
    weight, noise = float(prior.smooth) ** 2, float(prior.noise)  # a loaded model's are arrays in float32
    within = known.within + weight * known.smooth_within + noise * np.eye(len(known.within))
    return within, known.cross + weight * known.smooth_cross
