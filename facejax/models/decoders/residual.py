"""Residual decoder: a spiral network that corrects a linear estimate of the vertex displacements.

    displacement = base + gate * unit * network(landmarks, base, neutral)

`base` is the linear estimate (`facejax.models.decoders.gpmm`, or ridge regression). At the finest level the input of
the network at each vertex is that displacement, the local strain that it causes, the neutral position and normal, a
learned embedding of the vertex, and the signal that the levels of S2D-Dec (Otberdout et al. 2023, 3.3) decode from the
landmarks. Two spiral convolutions follow, then a linear readout per vertex. The readout is initialised to zero, so that
training starts at the base. The gate is not trained: it is chosen on held-out faces, and may be 0.

N vertices, L landmarks, B samples; millimetres.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from facejax.mesh import strain
from facejax.mesh.hierarchy import Hierarchy
from facejax.models import layers
from facejax.models.decoders import s2d_dec

CHANNELS = (64, 32, 16, 16, 16)
WIDTH, EMBEDDING = 16, 8  # channels of the two convolutions, and numbers learned per vertex
STRAIN, DISPLACEMENT_MM, POSITION_MM = 0.1, 2.0, 10.0  # units that the inputs are divided by
LOCAL = 15  # inputs per vertex: strain 6; displacement, normal and position 3 each
# A vertex's own readout receives few gradients; Adam's steps are of one size, so this factor raises its learning rate.
READOUT = 10.0


class Scale(NamedTuple):
    """Normalisation measured on the training set, in mm; constant during training."""

    face: Array  # (N, 3) the mean neutral face
    landmark_mean: Array  # (L, 3)
    landmark_std: Array  # ()
    unit: Array  # () root mean square of the base's residual, per coordinate


class ResidualDecoder(NamedTuple):
    """Parameters: the normalisation, the trained weights, and the share of the network's output that is added."""

    scale: Scale
    weights: dict[str, Any]
    gate: Array  # ()


def init(
    key: Array, hierarchy: Hierarchy, scale: Scale, *, channels: Sequence[int] = CHANNELS, width: int = WIDTH
) -> ResidualDecoder:
    """Return parameters whose network outputs zero.

    Args:
      channels: of the decoded levels, as in `s2d_dec.init`.
      width: channels of the two convolutions at the finest level.

    Raises:
      ValueError: `channels` does not match the number of levels.
    """
    levels_key, embedding_key, *conv_keys = jax.random.split(key, 4)
    vertices, spiral = hierarchy.sizes[0], len(hierarchy.surface.source)
    levels = s2d_dec.init_weights(
        levels_key, hierarchy, inputs=scale.landmark_mean.size, channels=channels, outputs=None
    )
    widths = (LOCAL + EMBEDDING + channels[-1], width, width)
    convs = [
        layers.init_spiral_conv(conv_key, spiral, width_in, width_out)
        for conv_key, width_in, width_out in zip(conv_keys, widths[:-1], widths[1:], strict=True)
    ]
    # The keys are names of leaves in model files.
    weights = {
        "climb": levels,
        "own": 0.1 * jax.random.normal(embedding_key, (vertices, EMBEDDING)),
        "mix": convs,
        "readout": jnp.zeros((vertices, width, 3)),
        "shared": jnp.zeros((width, 3)),
    }
    return ResidualDecoder(scale, weights, jnp.ones(()))


@jax.jit
def apply(
    params: ResidualDecoder,
    hierarchy: Hierarchy,
    tables: strain.VertexTriangles,
    # Looser than (B, L, 3), (B, N, 3) and (B, N, 3) or (N, 3), so that wrong sizes get the error of `_check`.
    displacements: Float[Array | np.ndarray, " ..."],
    base: Float[Array | np.ndarray, "B N 3"],
    neutral: Float[Array | np.ndarray, " ..."],
) -> Float[Array, "B N 3"]:
    """Return refined vertex displacements from landmark displacements and a linear estimate `base`.

    `neutral` is one face (N, 3), or one per sample (B, N, 3). Pass batches of about 16: all samples are held in memory
    at once.

    Raises:
      ValueError: wrong shapes.
    """
    scale, weights = jax.lax.stop_gradient(params.scale), params.weights
    _check(scale, displacements, base, neutral)
    rest = jnp.swapaxes(jnp.broadcast_to(neutral, base.shape), 0, 1)
    moved = jnp.swapaxes(jnp.asarray(base), 0, 1)
    stretch, normal = strain.strain(moved, rest, tables)
    position = (rest - scale.face[:, None]) / POSITION_MM
    embedding = jnp.broadcast_to(weights["own"][:, None], (*moved.shape[:2], EMBEDDING))
    x = (jnp.asarray(displacements) - scale.landmark_mean).reshape(
        base.shape[0], scale.landmark_mean.size
    ) / scale.landmark_std
    decoded = s2d_dec.decode_levels(weights["climb"], hierarchy, x)
    x = jnp.concatenate([stretch / STRAIN, moved / DISPLACEMENT_MM, normal, position, embedding, decoded], axis=-1)
    first, second = weights["mix"]
    x = jax.nn.elu(layers.spiral_conv(first, x, hierarchy.surface))
    x = x + jax.nn.elu(layers.spiral_conv(second, x, hierarchy.surface))
    residual = READOUT * jnp.einsum("nbc,nco->nbo", x, weights["readout"]) + x @ weights["shared"]
    return jnp.asarray(base) + params.gate * scale.unit * jnp.swapaxes(residual, 0, 1)


def _check(
    scale: Scale, displacements: Array | np.ndarray, base: Array | np.ndarray, neutral: Array | np.ndarray
) -> None:
    marks, vertices = scale.landmark_mean.shape, scale.face.shape
    if displacements.ndim != 3 or displacements.shape[1:] != marks:
        raise ValueError(f"displacements: expected (B, {marks[0]}, 3), got {displacements.shape}")
    if base.shape != (displacements.shape[0], *vertices) or neutral.shape not in (vertices, base.shape):
        raise ValueError(
            f"expected a base of (B, {vertices[0]}, 3) and neutral faces of that shape or ({vertices[0]}, 3), got "
            f"{base.shape} and {neutral.shape}"
        )
