"""From the landmarks of one face to its mesh: the best linear answer, refined by a spiral decoder.

    vertices = neutral + expand.apply(params, landmark_displacements, neutral)

What the linear answer has to know of a face is worked out once, on the host, and remembered for the last few faces:
a fifth of a second each. `pack` and `unpack` are for files. N vertices, L landmarks, k components; millimetres.
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

from facejax.mesh import strain
from facejax.mesh.hierarchy import Hierarchy
from facejax.models.decoders import gpmm, linear, residual

BATCH = 16
CACHE_SIZE = 8  # remembered
# What was asked for last: the model and its map of a face, by the model's identity, the face's bytes and the noise.
_cache: OrderedDict[tuple[int, str, float], tuple[gpmm.GPMM, linear.LinearMap]] = OrderedDict()


class GPMMResidual(NamedTuple):
    """The linear answer, the network that refines it, and the tables that it works on."""

    base: gpmm.GPMM
    network: residual.ResidualDecoder
    hierarchy: Hierarchy
    tables: strain.VertexTriangles


def apply(
    params: GPMMResidual,
    displacements: jax.Array,
    neutral: np.ndarray,
    *,
    refined: bool = True,
    noise: float | None = 0.0,
) -> jax.Array:
    """Vertex displacements (..., N, 3) of one face (N, 3) from its landmarks' (..., L, 3).

    Without `refined` the linear answer alone, which is one product of matrices. `noise` tells by how many mm the
    landmarks are off in every coordinate, such as those of a detector; None finds it out from the frames given
    (`gpmm.estimate_landmark_noise`). The linear answer takes it into account, and goes unrefined, since the network has learnt from
    landmarks that are right.

    Raises `ValueError` for other shapes, for a face that is traced (each is prepared on the host), and for `noise`
    where the linear answer was kept as one map for all faces (`pack`).
    """
    if isinstance(neutral, jax.core.Tracer):
        raise ValueError(
            "neutral: every face is prepared on the host, so that it cannot be traced: leave it out of jit"
        )
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
    return refine(params, marks, flat, rest).reshape(*lead, *base.shape[-2:])


def cached_linear_map(base: gpmm.GPMM, neutral: np.ndarray, noise: float = 0.0) -> linear.LinearMap:
    """`gpmm.linear_map` of a model that is `gpmm.with_landmark_noise` of landmark noise in mm, remembered."""
    key = id(base), hashlib.sha256(np.ascontiguousarray(neutral).tobytes()).hexdigest(), noise
    if key not in _cache:
        # The model is kept with its answer: no other can then have its identity.
        _cache[key] = base, gpmm.linear_map(gpmm.with_landmark_noise(base, noise), neutral)
        while len(_cache) > CACHE_SIZE:
            _cache.popitem(last=False)
    _cache.move_to_end(key)
    return _cache[key][1]


def refine(params: GPMMResidual, displacements: jax.Array, base: jax.Array, neutral: jax.Array) -> jax.Array:
    """The base's answers (B, N, 3) to landmarks (B, L, 3) of faces (B, N, 3), refined."""
    if len(base) == 0 or float(params.network.gate) == 0:
        return base
    return _refine(params.network, params.hierarchy, params.tables, displacements, base, neutral)


@jax.jit
def _refine(network, hierarchy, tables, displacements, base, neutral):
    """In equal pieces of at most 16, one after another, so that temporary arrays stay small."""
    count = len(base)
    pieces = -(-count // BATCH)
    size = -(-count // pieces)
    parts = [
        jnp.pad(x, ((0, pieces * size - count), (0, 0), (0, 0)), mode="edge").reshape(pieces, size, *x.shape[1:])
        for x in (displacements, base, neutral)
    ]
    found = jax.lax.map(lambda part: residual.apply(network, hierarchy, tables, *part), tuple(parts))
    return found.reshape(-1, *found.shape[2:])[:count]


def pack(params: GPMMResidual, *, components: int | None = None) -> dict[str, Any]:
    """A tree of arrays for a file.

    Of a carried model the widest `components`, in half precision, an error of some 0.0005 mm. Of a plain one the map
    itself, which is the same for all faces: moments that were rounded would be solved for with the noise's weight, and
    cost 0.2 mm where a model of exactly linear data errs by 1e-6.
    """
    base = params.base
    tree = {name: np.asarray(getattr(base, name), np.float32) for name in ("face", "motion", "hold")}
    tree |= {"landmark_index": np.asarray(base.landmark_index, np.int32), "prior": np.array(base.prior, np.float64)}
    known = base.statistics
    if isinstance(known, linear.Basis):
        some = slice(components)
        tree["mean"] = np.asarray(known.vertex_mean, np.float32)
        tree["components"] = np.asarray(known.components[some], np.float16)
        tree["variance"] = np.asarray(known.variance[some], np.float32)
    else:
        found = gpmm.linear_map(base, base.face)
        (tree["map"],) = found.factors
        tree |= {"mean": found.vertex_mean, "landmark_mean": found.landmark_mean}
    return {"base": tree, "network": params.network._asdict()}


def unpack(tree: dict[str, Any], hierarchy: Hierarchy, faces: np.ndarray) -> GPMMResidual:
    """What `pack` was given, on the triangles (F, 3). Raises `KeyError` for a tree that is none of its own."""
    base = dict(tree["base"])
    at, prior = np.asarray(base["landmark_index"]), np.asarray(base["prior"])
    wide = functools.partial(np.asarray, dtype=np.float64)
    if "components" in base:
        components = wide(base["components"])
        marks = components.reshape(len(components), -1, 3)[:, at].reshape(len(components), -1)
        mean = wide(base["mean"])
        variance = wide(base["variance"])
        known = linear.Basis(mean[at], mean, components, marks, variance, float(variance.sum()))
    else:
        known = linear.affine(base["landmark_mean"], base["mean"], base["map"])
    prior = gpmm.Prior(bool(prior[0]), float(prior[1]), float(prior[2]))
    face, motion, hold = (wide(base[name]) for name in ("face", "motion", "hold"))
    faces = np.asarray(faces)
    found = gpmm.GPMM(faces, at, face, motion, hold, known, prior)
    # As `pack` leaves it, or all names, as a file does.
    scale, network = tree["network"]["scale"], tree["network"]
    scale = residual.Scale(**scale) if isinstance(scale, dict) else scale
    return GPMMResidual(
        found,
        jax.tree.map(jnp.asarray, residual.ResidualDecoder(scale, network["weights"], network["gate"])),
        jax.device_put(hierarchy),
        jax.device_put(strain.vertex_triangles(faces, len(face))),
    )
