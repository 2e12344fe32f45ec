"""Non-rigid registration of a template to a scan, and transfer of the template's motion to the scan's vertices.

Iterative closest points (ICP), in outline as in Amberg et al. 2007 and Li et al. 2017: landmarks align the template
rigidly, a morphable model of heads fits the shape, then single vertices move under a smoothness constraint. The scan
may have any topology, holes and noise.
V vertices of the scan, N of the template, L landmarks, k components; millimetres, y up, z forward.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu
from scipy.spatial.transform import Rotation

from facejax.geometry import host
from facejax.geometry.interpolation import smoothstep
from facejax.mesh import closest_point, graph
from facejax.mesh.normals import vertex_normals_host
from facejax.models import pca

MODEL_ITERATIONS = 10  # of matching, for the morphable model
EFFECTIVE_MATCHES = 400.0  # independent matches of 1 mm that all together count as: neighbours are correlated
STIFFNESS = (300.0, 100.0, 30.0, 10.0, 3.0, 1.0)  # weight of smoothness against a match, by iteration
MAX_DISTANCE = (25.0, 5.0)  # mm, of a match, in the first and the last iteration
TANGENTIAL_WEIGHT = 0.05  # of a match along the surface, against 1 along its normal
MIN_COSINE = 0.5  # between the normals of a match
REACH = 15.0  # mm from the template's surface at which the scan's displacements become zero


class HeadModel(NamedTuple):
    """PCA model of heads at rest."""

    mean: np.ndarray  # (N, 3)
    components: np.ndarray  # (k, N, 3), scaled by their standard deviations: coefficients are in standard deviations
    faces: np.ndarray  # (F, 3)
    landmark_index: np.ndarray  # (68,)


class Registration(NamedTuple):
    """A template registered to a scan."""

    vertices: np.ndarray  # (N, 3) float32, in the scan's frame
    rotation: np.ndarray  # (3, 3): x -> rotation @ x + translation maps the scan's frame to the template's
    translation: np.ndarray  # (3,)
    coefficients: np.ndarray  # (k,)
    matched: np.ndarray  # (N,) bool: whether the vertex has a match on the scan
    distance: np.ndarray  # (N,) mm to the scan, valid where matched


class Binding(NamedTuple):
    """Map from template vertices to the vertices of a scan."""

    faces: np.ndarray  # (V, 3) the template's vertices that each scan vertex is bound to
    weights: np.ndarray  # (V, 3), decaying to zero away from the template


def fit_head_model(
    people: np.ndarray, faces: np.ndarray, landmark_index: np.ndarray, *, components: int = 80
) -> HeadModel:
    """Fit the PCA model of heads at rest (M, N, 3), each aligned to the mean by its landmarks."""
    people = np.asarray(people, np.float64)
    mean = people.mean(axis=0)
    placed = np.stack([_onto(face, face[landmark_index], mean[landmark_index]) for face in people])
    mean = placed.mean(axis=0)
    flat = (placed - mean).reshape(len(people), -1)
    _, vectors = pca.from_covariance(flat @ flat.T / len(people))
    count = min(components, len(people) - 1)
    # Rows of unit norm are vectors.T @ flat / sqrt(M variance); times the standard deviation sqrt(variance).
    rows = vectors[:, :count].T @ flat / np.sqrt(len(people))
    return HeadModel(mean, rows.reshape(count, *mean.shape), np.asarray(faces), np.asarray(landmark_index))


def fit(
    model: HeadModel,
    vertices: np.ndarray,
    faces: np.ndarray,
    landmarks: np.ndarray,
    scheme_index: np.ndarray,
    *,
    landmark_noise: float = 1.0,
) -> Registration:
    """Register the template to a scan (V, 3) in millimetres, in any pose.

    Args:
      model: heads at rest.
      vertices, faces: of the scan.
      landmarks: (L, 3) on it, three or more that are not collinear.
      scheme_index: (L,) which of the template's 68 landmarks each is.
      landmark_noise: standard deviation of the landmarks in mm.

    Raises:
      ValueError: fewer than three landmarks, or collinear ones.
    """
    landmarks, scheme_index = np.asarray(landmarks, np.float64), np.asarray(scheme_index)
    if len(landmarks) < 3 or np.linalg.matrix_rank(landmarks - landmarks.mean(axis=0), tol=1.0) < 2:
        raise ValueError(f"landmarks: expected three or more that are not collinear, got {len(landmarks)}")
    at = model.landmark_index[scheme_index]
    rotation, translation = _rigid(landmarks, model.mean[at])
    placed, marks = np.asarray(vertices, np.float64) @ rotation.T + translation, landmarks @ rotation.T + translation
    scan = closest_point.surface(placed, _oriented(np.asarray(faces), placed, model.mean, model.faces))
    found, coefficients = _fit_model(model, scan, marks, at, landmark_noise)
    found, matched, distance = _refine(model, found, scan, marks, at, landmark_noise)
    return Registration(
        ((found - translation) @ rotation).astype(np.float32), rotation, translation, coefficients, matched, distance
    )


def bind(registered: np.ndarray, faces: np.ndarray, scan: np.ndarray, scan_faces: np.ndarray) -> Binding:
    """Bind scan vertices (V, 3) to the registered template (N, 3)."""
    scan_faces = _oriented(np.asarray(scan_faces), scan, registered, faces)
    normals = vertex_normals_host(np.asarray(scan, np.float64), scan_faces)
    hits = closest_point.closest_points(
        closest_point.surface(registered, faces), scan, normals=normals, normal_weight=REACH / 4
    )
    decay = 1 - smoothstep(hits.distance, 0, REACH)
    return Binding(np.asarray(faces)[hits.face], (hits.weights * decay[:, None]).astype(np.float32))


def transfer_displacements(binding: Binding, displacements: np.ndarray) -> np.ndarray:
    """Transfer displacements (..., N, 3) of the template to the scan's vertices (..., V, 3)."""
    return np.einsum("vk,...vkx->...vx", binding.weights, np.asarray(displacements)[..., binding.faces, :])


def _fit_model(model: HeadModel, scan: closest_point.Surface, marks: np.ndarray, at: np.ndarray, noise: float):
    """Fit the morphable model to the scan by Gauss-Newton; return its vertices (N, 3) and coefficients (k,)."""
    coefficients, rotation, translation = np.zeros(len(model.components)), np.eye(3), np.zeros(3)

    def face() -> np.ndarray:
        return (model.mean + np.tensordot(coefficients, model.components, axes=1)) @ rotation.T + translation

    for step in range(MODEL_ITERATIONS + 1):
        here = face()
        centre = here.mean(axis=0)
        basis = np.einsum("ij,knj->nik", rotation, model.components)
        lever = _jacobian(here, basis, centre)
        held = np.concatenate([np.full(6, 1e-3), np.ones(len(coefficients))])
        rows = [lever[at].reshape(3 * len(at), -1) / noise, np.diag(held)]
        right = [(marks - here[at]).ravel() / noise, -held * np.concatenate([np.zeros(6), coefficients])]
        if step:  # the first step uses landmarks only: nearest points are not yet correspondences
            far = MAX_DISTANCE[0] + (MAX_DISTANCE[1] - MAX_DISTANCE[0]) * (step - 1) / (MODEL_ITERATIONS - 1)
            match, normals, weight = _matches(here, model.faces, scan, far)
            share = np.sqrt(weight * EFFECTIVE_MATCHES / max(weight.sum(), 1e-12))
            rows.append(np.einsum("ni,nij->nj", normals, lever) * share[:, None])
            right.append(np.einsum("ni,ni->n", normals, match - here) * share)
        system = np.concatenate(rows)
        found = np.linalg.solve(system.T @ system, system.T @ np.concatenate(right))
        small = Rotation.from_rotvec(found[:3]).as_matrix()
        rotation, translation = small @ rotation, small @ (translation - centre) + centre + found[3:6]
        coefficients = coefficients + found[6:]
    return face(), coefficients


def _jacobian(points: np.ndarray, basis: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """Return the derivatives (P, 3, 6 + k) of points by rotation about a centre, translation, and coefficients."""
    x, y, z = (points - centre).T
    zero, one = np.zeros_like(x), np.ones_like(x)
    turn = np.stack([[zero, -z, y], [z, zero, -x], [-y, x, zero]]).transpose(2, 1, 0)
    shift = np.stack([[one, zero, zero], [zero, one, zero], [zero, zero, one]]).transpose(2, 0, 1)
    return np.concatenate([turn, shift, basis], axis=2)


def _refine(
    model: HeadModel, start: np.ndarray, scan: closest_point.Surface, marks: np.ndarray, at: np.ndarray, noise: float
):
    """Move single vertices onto the scan under smoothness; return vertices, matched (N,) and distance (N,)."""
    count, here = len(start), start.copy()
    pairs = graph.edges(model.faces)
    rows = np.arange(len(pairs))
    difference = sparse.csr_array(
        (np.tile([1.0, -1.0], len(pairs)), (np.repeat(rows, 2), pairs.ravel())), (len(pairs), count)
    )
    smooth = sparse.kron(difference.T @ difference, sparse.eye_array(3), format="csc")
    pull = np.zeros(count)
    pull[at] = 1 / noise**2
    for stiff, far in zip(STIFFNESS, np.linspace(*MAX_DISTANCE, len(STIFFNESS)), strict=True):
        match, normals, weight = _matches(here, model.faces, scan, far)
        # Point to plane, with a small point-to-point weight against sliding.
        block = weight[:, None, None] * (normals[:, :, None] * normals[:, None, :] + TANGENTIAL_WEIGHT * np.eye(3))
        right = np.einsum("nij,nj->ni", block, match - start)
        right[at] += pull[at, None] * (marks - start[at])
        data = sparse.bsr_array((block + pull[:, None, None] * np.eye(3), np.arange(count), np.arange(count + 1)))
        # A small ridge keeps vertices that are neither matched nor connected.
        system = data + stiff * smooth + 1e-4 * sparse.eye_array(3 * count, format="csc")
        here = start + splu(system.tocsc()).solve(right.ravel()).reshape(count, 3)
    hits = closest_point.closest_points(scan, here)
    _, _, weight = _matches(here, model.faces, scan, MAX_DISTANCE[1])
    return here, weight > 0, hits.distance


def _matches(here: np.ndarray, faces: np.ndarray, scan: closest_point.Surface, far: float):
    """Return the nearest scan point of each vertex (N, 3), its normal, and a weight (N,): 0 where nothing matches."""
    own = vertex_normals_host(here, faces)
    hits = closest_point.closest_points(scan, here, normals=own, normal_weight=far / 4)
    normals = closest_point.at(scan, hits, scan.normals)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    facing = np.einsum("ni,ni->n", normals, own)
    good = (hits.distance < far) & (facing > MIN_COSINE) & ~closest_point.on_boundary(scan, hits)
    t = np.clip(hits.distance / far, 0, 1)
    return hits.points, normals, np.where(good, (1 - t**2) ** 2, 0.0)


def _oriented(scan_faces: np.ndarray, vertices: np.ndarray, template: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return the scan's triangles (F, 3), flipped if they are oriented against the template's."""
    scan = closest_point.surface(vertices, scan_faces)
    hits = closest_point.closest_points(scan, template)
    close = hits.distance <= np.median(hits.distance)
    dots = np.einsum(
        "ni,ni->n",
        closest_point.at(scan, hits, scan.normals),
        vertex_normals_host(np.asarray(template, np.float64), faces),
    )
    return scan_faces[:, ::-1] if np.median(dots[close]) < 0 else scan_faces


def _rigid(source: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the rotation (3, 3) and translation (3,) that align source (K, 3) to target."""
    rotation, source_mean, target_mean = host.procrustes(source, target)
    return rotation, target_mean - rotation @ source_mean


def _onto(points: np.ndarray, source: np.ndarray, target: np.ndarray) -> np.ndarray:
    rotation, translation = _rigid(source, target)
    return points @ rotation.T + translation
