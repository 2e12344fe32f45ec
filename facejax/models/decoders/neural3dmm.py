"""Neural3DMM as modified by Otberdout et al. 2023, 4.2: a spiral autoencoder conditioned on landmark displacements.

The neutral face is encoded to 16 numbers by spiral convolutions, each followed by downsampling to the next level of the
hierarchy (Bouritsas et al. 2019). They are concatenated with the landmark displacements, and S2D-Dec's levels decode
the *positions* of the expressive face. A baseline: it has to reconstruct the identity as well, and generalises poorly
to unseen people.

N vertices, L landmarks, B samples; millimetres.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from facejax.mesh import stencils
from facejax.mesh.hierarchy import Hierarchy
from facejax.mesh.stencils import Stencil
from facejax.models import layers
from facejax.models.decoders import s2d_dec

ENCODER = (16, 32, 64, 128)
LATENT = 16


class Scale(NamedTuple):
    """Normalisation measured on the training set, in mm; constant during training."""

    face: Array  # (N, 3) mean of the neutral faces
    face_std: Array  # () standard deviation of the neutral faces about it
    landmark_mean: Array  # (L, 3)
    landmark_std: Array  # ()


class Neural3DMM(NamedTuple):
    """Parameters of Neural3DMM: the normalisation and the trained weights."""

    scale: Scale
    weights: dict[str, Any]


def downsampling_spirals(hierarchy: Hierarchy) -> tuple[Stencil, ...]:
    """Return stencils that convolve and downsample, from fine to coarse: spirals at vertices kept by the next level."""
    found: list[Stencil] = []
    for level, spirals in enumerate(hierarchy.spirals):
        within = np.searchsorted(np.sort(hierarchy.kept[level]), hierarchy.kept[level + 1])
        within = np.argsort(hierarchy.kept[level])[within]
        own = np.arange(len(spirals))[:, None]
        found.append(stencils.build(spirals[within], own, np.ones_like(own, np.float32), len(spirals)))
    return tuple(found)


def init(
    key: Array,
    hierarchy: Hierarchy,
    scale: Scale,
    *,
    encoder: Sequence[int] = ENCODER,
    channels: Sequence[int] = s2d_dec.CHANNELS,
) -> Neural3DMM:
    """Return random parameters.

    Args:
      encoder: channels from fine to coarse.
      channels: of the decoder, as in `s2d_dec.init`.

    Raises:
      ValueError: `encoder` or `channels` does not match the number of levels.
    """
    if len(encoder) != len(hierarchy.climbs):
        raise ValueError(f"encoder: expected {len(hierarchy.climbs)} channels for this hierarchy, got {len(encoder)}")
    decode_key, latent_key, *conv_keys = jax.random.split(key, 2 + len(encoder))
    convs = [
        layers.init_spiral_conv(conv_key, len(stencil.source), width_in, width_out)
        for conv_key, stencil, width_in, width_out in zip(
            conv_keys, hierarchy.climbs, (3, *encoder[:-1]), encoder, strict=True
        )
    ]
    coarse = hierarchy.sizes[-1] * encoder[-1]
    latent = layers.init_dense(latent_key, coarse, LATENT, initializer=jax.nn.initializers.glorot_normal())
    decoder = s2d_dec.init_weights(
        decode_key, hierarchy, inputs=LATENT + scale.landmark_mean.size, channels=channels, outputs=3
    )
    return Neural3DMM(scale, {"encoder": convs, "latent": latent, "decoder": decoder})


@jax.jit
def apply(
    params: Neural3DMM,
    hierarchy: Hierarchy,
    down: tuple[Stencil, ...],
    # Looser than (B, L, 3) and (B, N, 3), so that wrong sizes get the error below.
    displacements: Float[Array | np.ndarray, " ..."],
    neutral: Float[Array | np.ndarray, " ..."],
) -> Float[Array, "B N 3"]:
    """Return vertex positions from landmark displacements (B, L, 3) and neutral faces (B, N, 3).

    `down` is `downsampling_spirals(hierarchy)`.

    Raises:
      ValueError: wrong shapes.
    """
    scale, weights = jax.lax.stop_gradient(params.scale), params.weights
    marks, face = scale.landmark_mean.shape, scale.face.shape
    if displacements.ndim != 3 or displacements.shape[1:] != marks or neutral.shape != (len(displacements), *face):
        raise ValueError(
            f"expected displacements (B, {marks[0]}, 3) and neutral faces (B, {face[0]}, 3), got "
            f"{displacements.shape} and {neutral.shape}"
        )
    latent = encode(params, down, neutral)
    standard = (displacements - scale.landmark_mean).reshape(len(displacements), -1) / scale.landmark_std
    decoded = s2d_dec.decode(weights["decoder"], hierarchy, jnp.concatenate([latent, standard], axis=-1))
    return scale.face + scale.face_std * decoded.transpose(1, 0, 2)


@jax.jit
def encode(
    params: Neural3DMM, down: tuple[Stencil, ...], neutral: Float[Array | np.ndarray, "B N 3"]
) -> Float[Array, "B latent"]:
    """Return the latent codes (B, 16) of neutral faces."""
    scale, weights = jax.lax.stop_gradient(params.scale), params.weights
    x = ((jnp.asarray(neutral) - scale.face) / scale.face_std).transpose(1, 0, 2)
    for conv, stencil in zip(weights["encoder"], down, strict=True):
        x = jax.nn.elu(layers.spiral_conv(conv, x, stencil))
    return layers.dense(weights["latent"], x.transpose(1, 0, 2).reshape(x.shape[1], -1))
