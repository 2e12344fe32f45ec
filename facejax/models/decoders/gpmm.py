"""Gaussian process morphable model (GPMM) transferred to each face: MAP vertex displacements given the landmarks.

Displacements of a face are modelled as a Gaussian process on its surface: a mean, and a covariance that is the sum of
the training statistics and of a smooth prior (Luthi et al. 2018). The smooth prior covers deformations that are absent
from the training set: nearby vertices move alike, each in proportion to its usual motion. The posterior mean given
landmark displacements with noise of variance `noise` is an affine map. It differs between faces if the model is
*carried*: the covariance is learned on the mean face and transferred to each face by deformation transfer
(`facejax.mesh.deformation_transfer`). Without transfer and without the smooth prior the model is ridge regression.
Noisy landmarks, such as a detector's, degrade the estimate strongly; set their noise with `with_landmark_noise`, or
estimate it with `estimate_landmark_noise`.

    params = gpmm_fit.fit(people, faces, landmark_index, prior=gpmm.Prior(carried=True, smooth=0.01, noise=1e-4))
    face_map = gpmm.linear_map(params, neutral)  # once per face
    displacements = linear.apply(face_map, landmark_displacements)

Covariances are never formed: they are held as a root S with S.T @ S the covariance. Its condition number is the square
root of the covariance's, so that float32 suffices (within 2e-4 mm of float64 on makehuman4d).

On makehuman4d's level 3, validation people, training on 80: the mean vertex error over the head is 0.0432 mm for ridge
regression and 0.0205 mm for this model. Expressions of that level are themselves made by deformation transfer, which
favours the model; those of levels 0 and 1 are not.

N vertices, L landmarks, k components; millimetres. Functions work in the dtype of the neutral face, and are pure: they
compile, vectorise over faces, and differentiate.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int

from facejax.geometry.precision import HIGHEST
from facejax.mesh import deformation_transfer
from facejax.models.decoders import linear
from facejax.models.records import Leaf, Number

SMOOTH_SCALES_MM = (10.0, 20.0, 40.0, 80.0)  # of the smooth prior: wrinkles, cheek, jaw, head
NOISE_GRID_MM = np.append(0.0, np.geomspace(0.003, 5.0, 120))  # steps of 6 %


class Prior(struct.PyTreeNode):
    """Hyperparameters; chosen by cross-validation (`facejax.training.recipes.fit_gpmm`)."""

    # Whether the learned covariance is transferred to each face.
    carried: bool = struct.field(pytree_node=False, default=True)
    smooth: Number = 0.003  # standard deviation of the smooth prior, in units of each vertex's `motion`
    noise: Number = 1e-4  # variance of a landmark coordinate, mm^2


class GPMM(struct.PyTreeNode):
    """The mean face and the statistics of displacements on it."""

    tables: deformation_transfer.TransferTables  # of the triangles
    landmark_index: Leaf  # (L,)
    face: Leaf  # (N, 3)
    motion: Leaf  # (N,) root mean square displacement of each vertex in mm, scales the smooth prior
    hold: Leaf  # (N,) `motion` as used by the deformation transfer's anchors
    mean: Leaf  # (N, 3) mean displacement
    components: Leaf  # (k, N, 3); the covariance is the sum of variance * component * component
    variance: Leaf  # (k,) mm^2
    smooth_root: Leaf  # (L, L), of the smooth prior with unit `smooth` between landmarks
    smooth_cross: Leaf  # (L, N); smooth_root.T @ smooth_cross is that of landmarks and vertices
    prior: Prior
    # The map without landmark noise where it is the same for all faces: a model that is not carried.
    shared_map: linear.LinearMap | None = None

    @property
    def faces(self) -> Leaf:
        """The triangles (F, 3)."""
        return self.tables.faces


class FaceStatistics(NamedTuple):
    """The model's statistics on one face."""

    mean: Float[Array, "N 3"]
    root: Float[Array, "k N 3"]  # components times their standard deviations


def build(
    faces: Int[np.ndarray, "F 3"],
    landmark_index: Int[np.ndarray, " L"],
    *,
    face: Float[np.ndarray, "N 3"],
    motion: Float[np.ndarray, " N"],
    hold: Float[np.ndarray, " N"],
    mean: Float[np.ndarray, "N 3"],
    components: Float[np.ndarray, "k N 3"],
    variance: Float[np.ndarray, " k"],
    prior: Prior,
    shared_map: linear.LinearMap | None = None,
) -> GPMM:
    """Return a model with the tables that depend only on its mean face; on the host. Fields as in `GPMM`."""
    kernel = smooth_kernel(face, landmark_index, motion)
    variances, directions = np.linalg.eigh(kernel[:, landmark_index])
    # Directions without variance cannot move; their inverse root would be noise.
    kept = variances > 1e-10 * max(variances[-1], 1e-300)
    root = np.sqrt(np.where(kept, variances, 0))
    cross = (directions.T @ kernel) * np.where(kept, 1 / np.where(kept, root, 1), 0)[:, None]
    tables = deformation_transfer.transfer_tables(faces, len(face))
    return GPMM(
        tables, landmark_index, face, motion, hold, mean, components, variance, root[:, None] * directions.T, cross,
        prior, shared_map,
    )  # fmt: skip


def smooth_kernel(
    face: Float[np.ndarray, "N 3"], landmark_index: Int[np.ndarray, " L"], motion: Float[np.ndarray, " N"]
) -> Float[np.ndarray, "L N"]:
    """Return the smooth prior's covariance of landmarks and vertices, for a standard deviation of `motion`."""
    squared = np.sum((face[landmark_index, None] - face) ** 2, axis=-1)
    kernel = np.mean([np.exp(-squared / (2 * scale**2)) for scale in SMOOTH_SCALES_MM], axis=0)
    return kernel * motion[landmark_index, None] * motion


def with_landmark_noise(params: GPMM, noise: ArrayLike) -> GPMM:
    """Return the model with landmark noise sigma (mm) per coordinate, added to the prior's noise.

    Raises:
      ValueError: negative noise, or a model that holds only the linear map.
    """
    if isinstance(noise, float | int):
        if not noise >= 0:
            raise ValueError(f"noise: expected 0 mm or more, got {noise}")
        if noise == 0:
            return params
    if not len(params.components):
        raise ValueError(
            "noise: this model file stores only a linear map fitted to noise-free landmarks; expected noise 0"
        )
    return params.replace(prior=params.prior.replace(noise=params.prior.noise + noise**2), shared_map=None)


@jax.jit
def on_face(params: GPMM, neutral: Float[Array | np.ndarray, "N 3"]) -> FaceStatistics:
    """Return the statistics on a face: transferred to it, if the model is carried.

    Raises:
      ValueError: a face of another shape.
    """
    if np.shape(neutral) != np.shape(params.face):
        raise ValueError(f"neutral: expected vertices {np.shape(params.face)}, got {np.shape(neutral)}")
    dtype = jnp.result_type(jnp.asarray(neutral), jnp.float32)
    mean, components, variance = (jnp.asarray(x, dtype) for x in (params.mean, params.components, params.variance))
    if params.prior.carried and len(components):
        anchors = deformation_transfer.anchor_weights(jnp.asarray(params.hold, dtype))
        fields = jnp.concatenate([mean[None], components])
        moved = deformation_transfer.transfer(params.face, jnp.asarray(neutral, dtype), params.tables, anchors, fields)
        mean, components = moved[0], moved[1:]
    return FaceStatistics(mean, components * jnp.sqrt(variance)[:, None, None])


@jax.jit
def posterior_map(params: GPMM, known: FaceStatistics) -> linear.LinearMap:
    """Return the affine map of a face from its statistics, for `linear.apply`.

    With the joint root (S, F) of landmarks and vertices and S = Q R, the map is (S.T S)^-1 S.T F = R^-1 Q.T F.
    """
    if params.shared_map is not None:
        return jax.tree.map(lambda leaf: jnp.asarray(leaf, known.mean.dtype), params.shared_map)
    dtype, at, smooth = known.mean.dtype, jnp.asarray(params.landmark_index), params.prior.smooth
    count, marks = len(known.root), len(at)
    orthonormal, triangle = jnp.linalg.qr(
        jnp.concatenate([_landmark_root(params, known), jnp.sqrt(params.prior.noise) * jnp.eye(3 * marks, dtype=dtype)])
    )
    learned = jnp.einsum("kj,knx->jnx", orthonormal[:count], known.root, precision=HIGHEST)
    rows = orthonormal[count : count + 3 * marks].reshape(marks, 3, 3 * marks)
    cross = smooth * jnp.asarray(params.smooth_cross, dtype)
    right = learned + jnp.einsum("rxj,rn->jnx", rows, cross, precision=HIGHEST)
    solved = jax.scipy.linalg.solve_triangular(triangle, right.reshape(3 * marks, -1))
    return linear.LinearMap(known.mean[at], known.mean, (solved,))


def linear_map(params: GPMM, neutral: Float[Array | np.ndarray, "N 3"]) -> linear.LinearMap:
    """Return the affine map of one face, for `linear.apply`.

    Raises:
      ValueError: a face of another shape.
    """
    return posterior_map(params, on_face(params, neutral))


@jax.jit
def estimate_landmark_noise(
    params: GPMM, known: FaceStatistics, landmarks: Float[Array | np.ndarray, "T L 3"]
) -> Float[Array, ""]:
    """Estimate the noise of one face's landmark displacements: sigma in mm per coordinate.

    The value of `NOISE_GRID_MM` (at most 5 mm) that maximises the marginal likelihood of all frames (type II maximum
    likelihood). Frames that are not finite give an arbitrary value.

    Raises:
      ValueError: no frames, or a model that holds only the linear map.
    """
    if len(landmarks) == 0:
        raise ValueError(f"landmarks: expected one or more frames, got {np.shape(landmarks)}")
    if not len(params.components):
        raise ValueError(
            "noise: this model file stores only a linear map, without the statistics to estimate landmark noise from"
        )
    root = _landmark_root(params, known)
    _, deviation, directions = jnp.linalg.svd(root, full_matrices=False)
    centred = (jnp.asarray(landmarks) - known.mean[jnp.asarray(params.landmark_index)]).reshape(len(landmarks), -1)
    observed = jnp.mean(jnp.square(jnp.matmul(centred, directions.T, precision=HIGHEST)), axis=0)
    grid = jnp.asarray(NOISE_GRID_MM, root.dtype)
    expected = deviation**2 + params.prior.noise + jnp.square(grid)[:, None]
    likelihood = -jnp.sum(jnp.log(expected) + observed / expected, axis=1)
    return grid[jnp.argmax(likelihood)]


def _landmark_root(params: GPMM, known: FaceStatistics) -> Float[Array, "rows coordinates"]:
    """Return the root (k + 3 L, 3 L) of the landmarks' covariance without noise."""
    learned = known.root[:, jnp.asarray(params.landmark_index)].reshape(len(known.root), -1)
    smooth = params.prior.smooth * jnp.asarray(params.smooth_root, known.mean.dtype)
    return jnp.concatenate([learned, jnp.kron(smooth, jnp.eye(3, dtype=smooth.dtype))])
