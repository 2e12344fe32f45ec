"""A face that is in no topology: the template brought onto a scan, and its motion carried back to the scan's vertices.

Amberg et al. 2007 and Li et al. 2017 in outline: landmarks place the template, a morphable model of people takes the
face's shape as far as it goes, and single vertices the rest, held together by smoothness. The scan may have any
vertices, holes and noise. V vertices of the scan, N of the template, L landmarks; millimetres, y up, z forward.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu
from scipy.spatial.transform import Rotation

from facejax.mesh import closest_point, graph

MATCHES = 10  # rounds of matching for the morphable model
COUNTED = 400.0  # matches, at 1 mm each, that all together count as: neighbours say the same
STIFF = (300.0, 100.0, 30.0, 10.0, 3.0, 1.0)  # smoothness against a match, round by round
FAR = (25.0, 5.0)  # mm beyond which a match is none, in the first and the last round
SLIDE = 0.05  # the share of a match that holds along the surface
FACING = 0.5  # the least cosine between the normals of a match
REACH = 15.0  # mm from the template's surface to where the scan no longer moves with it


class HeadModel(NamedTuple):
    """The morphable model of people at rest."""

    mean: np.ndarray  # (N, 3)
    components: np.ndarray  # (k, N, 3), times their standard deviation: a coefficient is in standard deviations
    faces: np.ndarray  # (F, 3)
    landmark_index: np.ndarray  # (68,)


class Registration(NamedTuple):
    """The template on a scan."""

    vertices: np.ndarray  # (N, 3) float32, in the scan's place
    turn: np.ndarray  # (3, 3), and
    move: np.ndarray  # (3,): x -> turn @ x + move is the way from there to the template's frame
    coefficients: np.ndarray  # (k,)
    matched: np.ndarray  # (N,) bool: where the scan has something to match
    distance: np.ndarray  # (N,) mm to the scan, where matched


class Binding(NamedTuple):
    """How a scan hangs on the template."""

    faces: np.ndarray  # (V, 3) the template's vertices that each of the scan's hangs on
    weights: np.ndarray  # (V, 3), which fall to zero away from the template


def fit_head_model(
    people: np.ndarray, faces: np.ndarray, landmark_index: np.ndarray, *, components: int = 80
) -> HeadModel:
    """The model of people at rest (M, N, 3), each moved so that its landmarks lie on the mean's."""
    people = np.asarray(people, np.float64)
    mean = people.mean(axis=0)
    placed = np.stack([_onto(face, face[landmark_index], mean[landmark_index]) for face in people])
    mean = placed.mean(axis=0)
    flat = (placed - mean).reshape(len(people), -1)
    gram = flat @ flat.T / len(people)
    values, vectors = np.linalg.eigh(gram)
    order = np.argsort(values)[::-1][: min(components, len(people) - 1)]
    # Of unit length once divided by the root of M times the value; times the deviation, the root of the value.
    rows = vectors[:, order].T @ flat / np.sqrt(len(people))
    return HeadModel(mean, rows.reshape(len(order), *mean.shape), np.asarray(faces), np.asarray(landmark_index))


def fit(
    model: HeadModel,
    vertices: np.ndarray,
    faces: np.ndarray,
    landmarks: np.ndarray,
    which: np.ndarray,
    *,
    landmark_noise: float = 1.0,
) -> Registration:
    """Bring the template onto a scan (V, 3) in millimetres, that may stand and look anywhere.

    Args:
      model: people at rest.
      vertices, faces: of the scan.
      landmarks: (L, 3) on it, three or more that are on no line.
      which: (L,) which of the template's 68 each is.
      landmark_noise: mm, how far off the landmarks may be.

    Raises:
      ValueError: fewer than three landmarks, or on one line.
    """
    landmarks, which = np.asarray(landmarks, np.float64), np.asarray(which)
    if len(landmarks) < 3 or np.linalg.matrix_rank(landmarks - landmarks.mean(axis=0), tol=1.0) < 2:
        raise ValueError(f"landmarks: expected three or more that lie on no line, got {len(landmarks)}")
    at = model.landmark_index[which]
    turn, move = _rigid(landmarks, model.mean[at])
    placed, marks = np.asarray(vertices, np.float64) @ turn.T + move, landmarks @ turn.T + move
    scan = closest_point.surface(placed, _oriented(np.asarray(faces), placed, model.mean, model.faces))
    found, coefficients = _fit_model(model, scan, marks, at, landmark_noise)
    found, matched, distance = _refine(model, found, scan, marks, at, landmark_noise)
    return Registration(((found - move) @ turn).astype(np.float32), turn, move, coefficients, matched, distance)


def bind(registered: np.ndarray, faces: np.ndarray, scan: np.ndarray, scan_faces: np.ndarray) -> Binding:
    """Hang a scan's vertices (V, 3) on the registered template (N, 3)."""
    scan_faces = _oriented(np.asarray(scan_faces), scan, registered, faces)
    normals = closest_point.normals(scan, scan_faces)
    hits = closest_point.closest_points(closest_point.surface(registered, faces), scan, normals=normals, turn=REACH / 4)
    t = np.clip(hits.distance / REACH, 0, 1)
    hold = 1 - t * t * (3 - 2 * t)
    return Binding(np.asarray(faces)[hits.face], (hits.weights * hold[:, None]).astype(np.float32))


def transfer_displacements(on: Binding, displacements: np.ndarray) -> np.ndarray:
    """Displacements (..., N, 3) of the template as those (..., V, 3) of the scan."""
    return np.einsum("vk,...vkx->...vx", on.weights, np.asarray(displacements)[..., on.faces, :])


def _fit_model(model: HeadModel, scan: closest_point.Surface, marks: np.ndarray, at: np.ndarray, noise: float):
    """The morphable model's face nearest to the scan (N, 3), and its coefficients."""
    coefficients, turn, move = np.zeros(len(model.components)), np.eye(3), np.zeros(3)

    def face() -> np.ndarray:
        return (model.mean + np.tensordot(coefficients, model.components, axes=1)) @ turn.T + move

    for step in range(MATCHES + 1):
        here = face()
        centre = here.mean(axis=0)
        basis = np.einsum("ij,knj->nik", turn, model.components)
        lever = _jacobian(here, basis, centre)
        held = np.concatenate([np.full(6, 1e-3), np.ones(len(coefficients))])
        rows = [lever[at].reshape(3 * len(at), -1) / noise, np.diag(held)]
        right = [(marks - here[at]).ravel() / noise, -held * np.concatenate([np.zeros(6), coefficients])]
        if step:  # landmarks alone at first: what is near on the surface is not yet what belongs together
            far = FAR[0] + (FAR[1] - FAR[0]) * (step - 1) / (MATCHES - 1)
            match, normals, weight = _matches(here, model.faces, scan, far)
            share = np.sqrt(weight * COUNTED / max(weight.sum(), 1e-12))
            rows.append(np.einsum("ni,nij->nj", normals, lever) * share[:, None])
            right.append(np.einsum("ni,ni->n", normals, match - here) * share)
        system = np.concatenate(rows)
        found = np.linalg.solve(system.T @ system, system.T @ np.concatenate(right))
        small = Rotation.from_rotvec(found[:3]).as_matrix()
        turn, move = small @ turn, small @ (move - centre) + centre + found[3:6]
        coefficients = coefficients + found[6:]
    return face(), coefficients


def _jacobian(points: np.ndarray, basis: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """How points (P, 3) move with a turn about a centre, a shift, and the coefficients: (P, 3, 6 + k)."""
    x, y, z = (points - centre).T
    zero, one = np.zeros_like(x), np.ones_like(x)
    turn = np.stack([[zero, -z, y], [z, zero, -x], [-y, x, zero]]).transpose(2, 1, 0)
    shift = np.stack([[one, zero, zero], [zero, one, zero], [zero, zero, one]]).transpose(2, 0, 1)
    return np.concatenate([turn, shift, basis], axis=2)


def _refine(
    model: HeadModel, start: np.ndarray, scan: closest_point.Surface, marks: np.ndarray, at: np.ndarray, noise: float
):
    """Every vertex moved onto the scan, as smoothly as can be: vertices, which are matched, and how far they are."""
    count, here = len(start), start.copy()
    pairs = graph.edges(model.faces)
    rows = np.arange(len(pairs))
    difference = sparse.csr_matrix(
        (np.tile([1.0, -1.0], len(pairs)), (np.repeat(rows, 2), pairs.ravel())), (len(pairs), count)
    )
    smooth = sparse.kron(difference.T @ difference, sparse.eye(3), format="csc")
    pull = np.zeros(count)
    pull[at] = 1 / noise**2
    for stiff, far in zip(STIFF, np.linspace(*FAR, len(STIFF)), strict=True):
        match, normals, weight = _matches(here, model.faces, scan, far)
        # Onto the tangent plane, and a little onto the point itself, so that nothing slides away.
        block = weight[:, None, None] * (normals[:, :, None] * normals[:, None, :] + SLIDE * np.eye(3))
        right = np.einsum("nij,nj->ni", block, match - start)
        right[at] += pull[at, None] * (marks - start[at])
        data = sparse.block_diag(list(block + pull[:, None, None] * np.eye(3)), format="csc")
        # A little of staying put keeps what is neither matched nor connected.
        system = data + stiff * smooth + 1e-4 * sparse.eye(3 * count, format="csc")
        here = start + splu(system.tocsc()).solve(right.ravel()).reshape(count, 3)
    hits = closest_point.closest_points(scan, here)
    _, _, weight = _matches(here, model.faces, scan, FAR[1])
    return here, weight > 0, hits.distance


def _matches(here: np.ndarray, faces: np.ndarray, scan: closest_point.Surface, far: float):
    """For each vertex the scan's nearest point (N, 3), its normal there, and a weight: 0 where nothing matches."""
    own = closest_point.normals(here, faces)
    hits = closest_point.closest_points(scan, here, normals=own, turn=far / 4)
    normals = closest_point.at(scan, hits, scan.normals)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    facing = np.einsum("ni,ni->n", normals, own)
    good = (hits.distance < far) & (facing > FACING) & ~closest_point.on_edge(scan, hits)
    t = np.clip(hits.distance / far, 0, 1)
    return hits.points, normals, np.where(good, (1 - t**2) ** 2, 0.0)


def _oriented(scan_faces: np.ndarray, vertices: np.ndarray, template: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """The scan's triangles (F, 3), running round the way the template's do."""
    scan = closest_point.surface(vertices, scan_faces)
    hits = closest_point.closest_points(scan, template)
    close = hits.distance <= np.median(hits.distance)
    dots = np.einsum("ni,ni->n", closest_point.at(scan, hits, scan.normals), closest_point.normals(template, faces))
    return scan_faces[:, ::-1] if np.median(dots[close]) < 0 else scan_faces


def _rigid(source: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The rotation (3, 3) and shift (3,) that bring source (K, 3) nearest to target."""
    here, there = source.mean(axis=0), target.mean(axis=0)
    turn = Rotation.align_vectors(target - there, source - here)[0].as_matrix()
    return turn, there - turn @ here


def _onto(points: np.ndarray, source: np.ndarray, target: np.ndarray) -> np.ndarray:
    turn, move = _rigid(source, target)
    return points @ turn.T + move
