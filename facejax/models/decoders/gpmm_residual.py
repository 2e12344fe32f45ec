"""GPMM estimate plus residual decoder: from the landmarks of one face to its mesh.

    vertices = neutral + gpmm_residual.apply(params, landmark_displacements, neutral)

The linear map of a face is computed once on the host (0.2 s) and cached for the last few faces. `pack` and `unpack`
convert the parameters for files.

N vertices, L landmarks, B samples, k components; millimetres.
"""

from __future__ import annotations

import functools
import hashlib
import math
from collections import OrderedDict
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int

from facejax.mesh import strain
from facejax.mesh.hierarchy import Hierarchy
from facejax.models.decoders import gpmm, linear, residual

BATCH = 16
CACHE_SIZE = 8  # faces whose linear map is kept
# Model and linear map of a face, by the model's identity, the face's digest and the noise; least recently used first.
_cache: OrderedDict[tuple[int, str, float], tuple[gpmm.GPMM, linear.LinearMap]] = OrderedDict()


class GPMMResidual(NamedTuple):
    """The GPMM, the residual decoder, and the index tables of the mesh."""

    base: gpmm.GPMM
    network: residual.ResidualDecoder
    hierarchy: Hierarchy
    tables: strain.VertexTriangles


def apply(
    params: GPMMResidual,
    displacements: Float[Array | np.ndarray, "... L 3"],
    neutral: Float[Array | np.ndarray, "N 3"],
    *,
    refined: bool = True,
    noise: float | None = 0.0,
) -> Float[Array, "... N 3"]:
    """Return vertex displacements of one face from its landmark displacements: the default decoder.

    Args:
      refined: add the residual decoder's output; without it the GPMM estimate alone, one matrix product.
      noise: landmark noise sigma (mm) per coordinate, such as a detector's; None estimates it from the frames
        (`gpmm.estimate_landmark_noise`). With noise the GPMM estimate is returned without the residual decoder, which
        was trained on noise-free landmarks.

    Raises:
      ValueError: wrong shapes, a traced `neutral` (it is preprocessed on the host), or `noise` for a model that stores
        only a linear map (see `pack`).
    """
    if isinstance(neutral, Tracer):
        raise ValueError("neutral: every face is prepared on the host and cannot be traced: pass it as a constant")
    neutral = np.asarray(neutral)
    if noise is None:
        marks = np.asarray(displacements)
        noise = gpmm.estimate_landmark_noise(params.base, neutral, marks.reshape(-1, *marks.shape[-2:]))
    base = linear.apply(cached_linear_map(params.base, neutral, noise), jnp.asarray(displacements))
    if noise or not refined:
        return base
    lead = base.shape[:-2]
    flat = base.reshape(math.prod(lead), *base.shape[-2:])
    marks = jnp.asarray(displacements, jnp.float32).reshape(len(flat), len(params.base.landmark_index), 3)
    rest = jnp.broadcast_to(jnp.asarray(neutral, jnp.float32), flat.shape)
    return jnp.asarray(refine(params, marks, flat, rest)).reshape(*lead, *base.shape[-2:])


def cached_linear_map(base: gpmm.GPMM, neutral: Float[np.ndarray, "N 3"], noise: float = 0.0) -> linear.LinearMap:
    """Return `gpmm.linear_map` of the model with landmark noise sigma (mm), cached for the last `CACHE_SIZE` faces."""
    key = id(base), hashlib.sha256(np.ascontiguousarray(neutral).tobytes()).hexdigest(), noise
    if key not in _cache:
        # The model is kept with its map, so that its id cannot be reused by another model.
        _cache[key] = base, gpmm.linear_map(gpmm.with_landmark_noise(base, noise), neutral)
        while len(_cache) > CACHE_SIZE:
            _cache.popitem(last=False)
    _cache.move_to_end(key)
    return _cache[key][1]


def refine(
    params: GPMMResidual,
    displacements: Float[Array | np.ndarray, "B L 3"],
    base: Float[Array | np.ndarray, "B N 3"],
    neutral: Float[Array | np.ndarray, "B N 3"],
) -> Float[Array | np.ndarray, "B N 3"]:
    """Add the residual decoder's output to the GPMM estimates `base` of landmark displacements of neutral faces."""
    if len(base) == 0 or float(params.network.gate) == 0:
        return base
    return _refine(params.network, params.hierarchy, params.tables, displacements, base, neutral)


@jax.jit
def _refine(
    network: residual.ResidualDecoder,
    hierarchy: Hierarchy,
    tables: strain.VertexTriangles,
    displacements: Array,
    base: Array,
    neutral: Array,
) -> Array:
    """Refine equal pieces of at most 16 samples, one after another, so that temporary arrays stay small."""
    count = len(base)
    pieces = -(-count // BATCH)
    size = -(-count // pieces)
    parts = [
        jnp.pad(x, ((0, pieces * size - count), (0, 0), (0, 0)), mode="edge").reshape(pieces, size, *x.shape[1:])
        for x in (displacements, base, neutral)
    ]
    out = jax.lax.map(lambda part: residual.apply(network, hierarchy, tables, *part), tuple(parts))
    return out.reshape(-1, *out.shape[2:])[:count]


def pack(params: GPMMResidual, *, components: int | None = None) -> dict[str, Any]:
    """Return a tree of arrays for a file.

    A carried model is stored as its leading `components` in half precision, an error of about 0.0005 mm. A plain one is
    stored as its linear map, which is the same for all faces: solving with rounded moments would amplify the rounding
    and cost 0.2 mm on exactly linear data, where the error of the model is 1e-6 mm.
    """
    base = params.base
    tree: dict[str, Any] = {name: np.asarray(getattr(base, name), np.float32) for name in ("face", "motion", "hold")}
    tree |= {"landmark_index": np.asarray(base.landmark_index, np.int32), "prior": np.array(base.prior, np.float64)}
    statistics = base.statistics
    if isinstance(statistics, linear.Basis):
        leading = slice(components)
        tree["mean"] = np.asarray(statistics.vertex_mean, np.float32)
        tree["components"] = np.asarray(statistics.components[leading], np.float16)
        tree["variance"] = np.asarray(statistics.variance[leading], np.float32)
    else:
        face_map = gpmm.linear_map(base, base.face)
        (tree["map"],) = face_map.factors
        tree |= {"mean": face_map.vertex_mean, "landmark_mean": face_map.landmark_mean}
    return {"base": tree, "network": params.network._asdict()}


def unpack(tree: dict[str, Any], hierarchy: Hierarchy, faces: Int[np.ndarray, "F 3"]) -> GPMMResidual:
    """Return the parameters that `pack` was given, on the triangles (F, 3).

    Raises:
      KeyError: a tree that `pack` did not write.
    """
    base = dict(tree["base"])
    at, prior = np.asarray(base["landmark_index"]), np.asarray(base["prior"])
    as_float64 = functools.partial(np.asarray, dtype=np.float64)
    if "components" in base:
        components = as_float64(base["components"])
        marks = components.reshape(len(components), -1, 3)[:, at].reshape(len(components), -1)
        mean = as_float64(base["mean"])
        variance = as_float64(base["variance"])
        statistics = linear.Basis(mean[at], mean, components, marks, variance, float(variance.sum()))
    else:
        statistics = linear.affine(base["landmark_mean"], base["mean"], base["map"])
    prior = gpmm.Prior(bool(prior[0]), float(prior[1]), float(prior[2]))
    face, motion, hold = (as_float64(base[name]) for name in ("face", "motion", "hold"))
    faces = np.asarray(faces)
    model = gpmm.GPMM(faces, at, face, motion, hold, statistics, prior)
    # A record, as `pack` returns it, or a dict, as read from a file.
    scale, network = tree["network"]["scale"], tree["network"]
    scale = residual.Scale(**scale) if isinstance(scale, dict) else scale
    return GPMMResidual(
        model,
        jax.tree.map(jnp.asarray, residual.ResidualDecoder(scale, network["weights"], network["gate"])),
        jax.device_put(hierarchy),
        jax.device_put(strain.vertex_triangles(faces, len(face))),
    )
