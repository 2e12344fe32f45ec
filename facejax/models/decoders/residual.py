"""A spiral decoder for what the best linear answer leaves over.

    displacement = base + gate * unit * network(landmarks, base, neutral)

`base` is the displacement of every vertex that a linear map gives (`facejax.models.gpmm`, or ridge regression). At
the finest level the network sees, at each vertex, that displacement, the local strain that it makes, the neutral
position and normal, a few numbers of the vertex's own, and the signal that S2D-Dec's climb (Otberdout et al. 2023,
3.3) makes from the landmarks; two spiral convolutions mix them, and every vertex reads its three numbers out in its
own way. It starts at zero, so that training starts at the base. The gate is not trained: it is chosen on held-out
faces, and may be 0.

N vertices, L landmarks, B samples, C channels; millimetres.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from facejax.mesh import spiral_conv, strain
from facejax.mesh.hierarchy import Hierarchy
from facejax.models.decoders import s2d_dec

CHANNELS = (64, 32, 16, 16, 16)
MIXED, OWN = 16, 8
STRAIN, MOVED, PLACE = 0.1, 2.0, 10.0  # what counts as one: a tenth longer, 2 mm moved, 10 mm off the mean face
LOCAL = 15  # strain 6, displacement, normal and place 3 each
# Each vertex sees few gradients for its own readout; with Adam's equal steps the factor makes it learn faster.
READOUT = 10.0


class Scale(NamedTuple):
    """Measured on the training set, in mm; never trained."""

    face: jax.Array  # (N, 3) the mean neutral face
    landmark_mean: jax.Array  # (L, 3)
    landmark_std: jax.Array  # ()
    unit: jax.Array  # () root mean square of what the base leaves over, per coordinate


class ResidualDecoder(NamedTuple):
    """The constants, the weights that are trained, and how much of the network's answer to take."""

    scale: Scale
    weights: dict[str, Any]
    gate: jax.Array  # ()


def init(
    key: jax.Array, hierarchy: Hierarchy, scale: Scale, *, channels: Sequence[int] = CHANNELS, mixed: int = MIXED
) -> ResidualDecoder:
    """Weights that answer zero."""
    climb_key, own_key, *mix_keys = jax.random.split(key, 4)
    vertices, spiral = hierarchy.sizes[0], len(hierarchy.surface.source)
    climb = s2d_dec.init_weights(climb_key, hierarchy, inputs=scale.landmark_mean.size, channels=channels, outputs=None)
    he = jax.nn.initializers.he_normal(in_axis=(0, 1), out_axis=2)
    widths = (LOCAL + OWN + channels[-1], mixed, mixed)
    mix = [
        {"kernel": he(k, (spiral, inward, outward)), "bias": jnp.zeros(outward)}
        for k, inward, outward in zip(mix_keys, widths[:-1], widths[1:], strict=True)
    ]
    weights = {
        "climb": climb,
        "own": 0.1 * jax.random.normal(own_key, (vertices, OWN)),
        "mix": mix,
        "readout": jnp.zeros((vertices, mixed, 3)),
        "shared": jnp.zeros((mixed, 3)),
    }
    return ResidualDecoder(scale, weights, jnp.ones(()))


@jax.jit
def apply(
    params: ResidualDecoder,
    hierarchy: Hierarchy,
    tables: strain.VertexTriangles,
    displacements: jax.Array,
    base: jax.Array,
    neutral: jax.Array,
) -> jax.Array:
    """Vertex displacements (B, N, 3) from landmark displacements (B, L, 3), a base (B, N, 3) and neutral faces.

    Neutral faces are (N, 3), or (B, N, 3) one for each sample. Give batches of 16 or so: all are worked on at once.
    """
    scale, weights = jax.lax.stop_gradient(params.scale), params.weights
    _check(scale, displacements, base, neutral)
    rest = jnp.swapaxes(jnp.broadcast_to(neutral, base.shape), 0, 1)
    moved = jnp.swapaxes(base, 0, 1)
    stretch, normal = strain.strain(moved, rest, tables)
    place = (rest - scale.face[:, None]) / PLACE
    own = jnp.broadcast_to(weights["own"][:, None], (*moved.shape[:2], OWN))
    x = (displacements - scale.landmark_mean).reshape(len(base), -1) / scale.landmark_std
    climbed = s2d_dec.decode_levels(weights["climb"], hierarchy, x)
    x = jnp.concatenate([stretch / STRAIN, moved / MOVED, normal, place, own, climbed], axis=-1)
    first, second = weights["mix"]
    x = jax.nn.elu(spiral_conv.spiral_conv(x, first["kernel"], hierarchy.surface) + first["bias"])
    x = x + jax.nn.elu(spiral_conv.spiral_conv(x, second["kernel"], hierarchy.surface) + second["bias"])
    found = READOUT * jnp.einsum("nbc,nco->nbo", x, weights["readout"]) + x @ weights["shared"]
    return base + params.gate * scale.unit * jnp.swapaxes(found, 0, 1)


def _check(scale: Scale, displacements: jax.Array, base: jax.Array, neutral: jax.Array) -> None:
    marks, vertices = scale.landmark_mean.shape, scale.face.shape
    if displacements.ndim != 3 or displacements.shape[1:] != marks:
        raise ValueError(f"displacements: expected (B, {marks[0]}, 3), got {displacements.shape}")
    if base.shape != (len(displacements), *vertices) or neutral.shape not in (vertices, base.shape):
        raise ValueError(
            f"expected a base of (B, {vertices[0]}, 3) and neutral faces of that shape or ({vertices[0]}, 3), got "
            f"{base.shape} and {neutral.shape}"
        )
