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
    """Return stencils that convolve and downsample, from fine to coarse: spirals of the vertices kept by the next level."""
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
    INIT_BODY
def init(
    key: Array,
    hierarchy: Hierarchy,
    scale: Scale,
    *,
    encoder: Sequence[int] = ENCODER,
    channels: Sequence[int] = s2d_dec.CHANNELS,
) -> Neural3DMM:
    """Random weights. Raises `ValueError` where the numbers of levels do not fit."""
    if len(encoder) != len(hierarchy.climbs):
        raise ValueError(f"encoder: expected {len(hierarchy.climbs)} channels for this hierarchy, got {len(encoder)}")
    decode_key, latent_key, *keys = jax.random.split(key, 2 + len(encoder))
    he = jax.nn.initializers.he_normal(in_axis=(0, 1), out_axis=2)
    convs = [
        {"kernel": he(k, (len(climb.source), inward, outward)), "bias": jnp.zeros(outward)}
        for k, climb, inward, outward in zip(keys, hierarchy.climbs, (3, *encoder[:-1]), encoder, strict=True)
    ]
    coarse = hierarchy.sizes[-1] * encoder[-1]
    latent = {"kernel": jax.nn.initializers.glorot_normal()(latent_key, (coarse, LATENT)), "bias": jnp.zeros(LATENT)}
    decode = s2d_dec.init_weights(
        decode_key, hierarchy, inputs=LATENT + scale.landmark_mean.size, channels=channels, outputs=3
    )
    return Neural3DMM(scale, {"encoder": convs, "latent": latent, "decoder": decode})


@jax.jit
def apply(
    params: Neural3DMM, hierarchy: Hierarchy, down: tuple[Stencil, ...], displacements: Array, neutral: Array
) -> Array:
    """Positions (B, N, 3) of the vertices from landmark displacements (B, L, 3) and neutral faces (B, N, 3).

    `down` are `descents(hierarchy)`.
    """
    scale, weights = jax.lax.stop_gradient(params.scale), params.weights
    marks, face = scale.landmark_mean.shape, scale.face.shape
    if displacements.ndim != 3 or displacements.shape[1:] != marks or neutral.shape != (len(displacements), *face):
        raise ValueError(
            f"expected displacements (B, {marks[0]}, 3) and neutral faces (B, {face[0]}, 3), got "
            f"{displacements.shape} and {neutral.shape}"
        )
    latent = encode(params, down, neutral)
    moved = (displacements - scale.landmark_mean).reshape(len(displacements), -1) / scale.landmark_std
    found = s2d_dec.decode(weights["decoder"], hierarchy, jnp.concatenate([latent, moved], axis=-1))
    return scale.face + scale.face_std * found.transpose(1, 0, 2)


@jax.jit
def encode(params: Neural3DMM, down: tuple[Stencil, ...], neutral: Array) -> Array:
    """The latent code (B, 16) of neutral faces (B, N, 3)."""
    scale, weights = jax.lax.stop_gradient(params.scale), params.weights
    x = ((neutral - scale.face) / scale.face_std).transpose(1, 0, 2)
    for conv, stencil in zip(weights["encoder"], down, strict=True):
        x = jax.nn.elu(spiral_conv.spiral_conv(x, conv["kernel"], stencil) + conv["bias"])
    flat = x.transpose(1, 0, 2).reshape(x.shape[1], -1)
    return flat @ weights["latent"]["kernel"] + weights["latent"]["bias"]
