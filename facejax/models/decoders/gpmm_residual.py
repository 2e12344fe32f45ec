"""GPMM estimate plus residual decoder: from the landmarks of one face to its mesh.

    face = gpmm_residual.prepare(params, neutral)  # once per face
    vertices = neutral + gpmm_residual.apply(params, face, landmark_displacements)

`pack` and `unpack` convert the parameters for files.

N vertices, L landmarks, B samples, k components; millimetres.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int

from facejax.mesh import strain
from facejax.mesh.hierarchy import Hierarchy
from facejax.models import layers
from facejax.models.decoders import gpmm, linear, residual

BATCH = 16


class GPMMResidual(struct.PyTreeNode):
    """The GPMM, the residual decoder, and the index tables of the mesh."""

    base: gpmm.GPMM
    network: residual.ResidualDecoder
    hierarchy: Hierarchy
    tables: strain.VertexTriangles


class PreparedFace(NamedTuple):
    """What the decoder needs of one neutral face."""

    neutral: Float[Array, "N 3"]
    statistics: gpmm.FaceStatistics
    map: linear.LinearMap  # without landmark noise


@jax.jit
def prepare(params: GPMMResidual, neutral: Float[Array | np.ndarray, "N 3"]) -> PreparedFace:
    """Prepare a neutral face.

    Raises:
      ValueError: a face of another shape.
    """
    known = gpmm.on_face(params.base, neutral)
    return PreparedFace(jnp.asarray(neutral, known.mean.dtype), known, gpmm.posterior_map(params.base, known))


def apply(
    params: GPMMResidual,
    face: PreparedFace,
    displacements: Float[Array | np.ndarray, "... L 3"],
    *,
    refined: bool = True,
    noise: ArrayLike | None = 0.0,
) -> Float[Array, "... N 3"]:
    """Return vertex displacements of a prepared face from its landmark displacements: the default decoder.

    Args:
      refined: add the residual decoder's output; without it the GPMM estimate alone, one matrix product.
      noise: landmark noise sigma (mm) per coordinate, such as a detector's; None estimates it from the frames
        (`gpmm.estimate_landmark_noise`). Unless it is the number 0, the GPMM estimate is returned without the residual
        decoder, which was trained on noise-free landmarks.

    Raises:
      ValueError: wrong shapes, negative noise, or `noise` for a model that stores only a linear map (see `pack`).
    """
    marks = jnp.asarray(displacements, face.neutral.dtype)
    exact = isinstance(noise, float | int) and noise == 0
    if noise is None:
        noise = gpmm.estimate_landmark_noise(params.base, face.statistics, marks.reshape(-1, *marks.shape[-2:]))
    face_map = face.map
    if not exact:
        face_map = gpmm.posterior_map(gpmm.with_landmark_noise(params.base, noise), face.statistics)
    base = linear.apply(face_map, marks)
    if not exact or not refined or base.size == 0:
        return base
    count = math.prod(base.shape[:-2])
    flat = base.reshape(count, *base.shape[-2:])
    moved = refine(params, marks.reshape(count, *marks.shape[-2:]), flat, face.neutral)
    return moved.reshape(base.shape)


@jax.jit
def refine(
    params: GPMMResidual,
    displacements: Float[Array | np.ndarray, "B L 3"],
    base: Float[Array | np.ndarray, "B N 3"],
    neutral: Float[Array | np.ndarray, "*B N 3"],
) -> Float[Array, "B N 3"]:
    """Add the residual decoder's output to the GPMM estimates `base`; `neutral` is one face, or one per sample.

    Equal pieces of at most 16 samples are refined one after another, so that temporary arrays stay small.
    """
    rows = [jnp.asarray(x) for x in (displacements, base)] + ([jnp.asarray(neutral)] if np.ndim(neutral) == 3 else [])

    def one(displacements: Array, base: Array, *rest: Array) -> Array:
        face = rest[0] if rest else neutral
        return residual.apply(params.network, params.hierarchy, params.tables, displacements, base, face)

    def run(rows: Sequence[Array]) -> Array:
        return layers.map_pieces(one, rows, BATCH)

    return jax.lax.cond(params.network.gate == 0, lambda rows: rows[1], run, rows)


def pack(params: GPMMResidual, *, components: int | None = None) -> dict[str, Any]:
    """Return a tree of arrays for a file.

    A carried model is stored as its leading `components` in half precision, an error of about 0.0005 mm. A plain one is
    stored as its linear map, which is the same for all faces: solving with rounded moments would amplify the rounding
    and cost 0.2 mm on exactly linear data, where the error of the model is 1e-6 mm.
    """
    base = params.base
    tree: dict[str, Any] = {name: np.asarray(getattr(base, name), np.float32) for name in ("face", "motion", "hold")}
    prior = np.array([base.prior.carried, base.prior.smooth, base.prior.noise], np.float64)
    tree |= {"landmark_index": np.asarray(base.landmark_index, np.int32), "prior": prior}
    if base.shared_map is None:
        leading = slice(components)
        tree["mean"] = np.asarray(base.mean, np.float32)
        tree["components"] = np.asarray(base.components[leading], np.float16).reshape(-1, base.face.size)
        tree["variance"] = np.asarray(base.variance[leading], np.float32)
    else:
        (factor,) = base.shared_map.factors
        tree |= {"map": factor, "mean": base.shared_map.vertex_mean, "landmark_mean": base.shared_map.landmark_mean}
    return {"base": tree, "network": params.network._asdict()}


def unpack(tree: dict[str, Any], hierarchy: Hierarchy, faces: Int[np.ndarray, "F 3"]) -> GPMMResidual:
    """Return the parameters that `pack` was given, on the triangles (F, 3).

    Raises:
      KeyError: a tree that `pack` did not write.
    """
    base = tree["base"]
    at, (carried, smooth, noise) = np.asarray(base["landmark_index"]), np.asarray(base["prior"]).tolist()
    face, motion, hold, mean = (np.asarray(base[name], np.float64) for name in ("face", "motion", "hold", "mean"))
    shared, components, variance = None, np.zeros((0, *face.shape)), np.zeros(0)
    if "components" in base:
        components = np.asarray(base["components"], np.float64).reshape(-1, *face.shape)
        variance = np.asarray(base["variance"], np.float64)
    else:
        shared = linear.affine(base["landmark_mean"], base["mean"], base["map"])
    model = gpmm.build(
        faces, at, face=face, motion=motion, hold=hold, mean=mean, components=components, variance=variance,
        prior=gpmm.Prior(bool(carried), smooth, noise), shared_map=shared,
    )  # fmt: skip
    # A record, as `pack` returns it, or a dict, as read from a file.
    scale, network = tree["network"]["scale"], tree["network"]
    scale = residual.Scale(**scale) if isinstance(scale, dict) else scale
    return GPMMResidual(
        jax.tree.map(
            lambda leaf: jnp.asarray(leaf, jnp.float32) if np.asarray(leaf).dtype.kind == "f" else leaf, model
        ),
        jax.tree.map(jnp.asarray, residual.ResidualDecoder(scale, network["weights"], network["gate"])),
        jax.device_put(hierarchy),
        jax.device_put(strain.vertex_triangles(np.asarray(faces), len(face))),
    )
