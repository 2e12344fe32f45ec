"""S2D-Dec: a spiral decoder from sparse landmark displacements to dense vertex displacements.

After Otberdout et al. 2023, 3.3. A dense layer computes a signal on the coarsest level of a mesh hierarchy; at each
level the signal is upsampled, convolved along spirals and passed through ELU; a last spiral convolution outputs three
numbers per vertex. The output is a displacement: the caller adds the neutral mesh.

L landmarks, N vertices, B samples; millimetres.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import export
from jaxtyping import Array, Float

from facejax.mesh.hierarchy import Hierarchy
from facejax.models import layers
from facejax.models.layers import Weights

CHANNELS = (128, 64, 32, 32, 16)
CHUNK = 1024  # samples to decode at once, on other platforms than a CPU


class Scale(NamedTuple):
    """Normalisation measured on the training set, in mm; constant during training."""

    landmark_mean: Array  # (L, 3)
    landmark_std: Array  # ()
    vertex_mean: Array  # (N, 3)
    vertex_std: Array  # ()


class S2DDec(NamedTuple):
    """Parameters of S2D-Dec: the normalisation and the trained weights."""

    scale: Scale
    weights: Weights


def init(
    key: Array,
    hierarchy: Hierarchy,
    *,
    landmarks: int = 68,
    channels: Sequence[int] = CHANNELS,
    scale: Scale | None = None,
) -> S2DDec:
    """Return random parameters whose initial output is close to the mean displacement.

    Args:
      channels: from the coarsest level's signal to the finest, one more than the hierarchy has upsamplings.
      scale: normalisation; without it displacements are used as they are.

    Raises:
      ValueError: `channels` does not match the number of levels.
    """
    weights = init_weights(key, hierarchy, inputs=3 * landmarks, channels=channels, outputs=3)
    weights["convs"][-1]["kernel"] *= 0.01
    if scale is None:
        scale = Scale(jnp.zeros((landmarks, 3)), jnp.ones(()), jnp.zeros((hierarchy.sizes[0], 3)), jnp.ones(()))
    return S2DDec(scale, weights)


def init_weights(
    key: Array, hierarchy: Hierarchy, *, inputs: int, channels: Sequence[int], outputs: int | None
) -> Weights:
    """Return random weights of `decode`, from `inputs` numbers to `outputs` per vertex.

    Without `outputs` the last convolution is left out: weights of `decode_levels`. `channels` and errors as in `init`.
    """
    upsamplings = hierarchy.climbs[::-1]
    if len(channels) != len(upsamplings) + 1:
        raise ValueError(f"channels: expected {len(upsamplings) + 1} for this hierarchy, got {len(channels)}")
    dense_key, *conv_keys = jax.random.split(key, len(channels) + 1)
    convs = [
        layers.init_spiral_conv(conv_key, len(stencil.source), width_in, width_out)
        for conv_key, stencil, width_in, width_out in zip(
            conv_keys, (*upsamplings, hierarchy.surface), channels, (*channels[1:], outputs), strict=True
        )
        if width_out is not None
    ]
    glorot = jax.nn.initializers.glorot_normal()
    dense = layers.init_dense(dense_key, inputs, hierarchy.sizes[-1] * channels[0], initializer=glorot)
    return {"dense": dense, "convs": convs}


def decode(weights: Weights, hierarchy: Hierarchy, x: Float[Array, "B inputs"]) -> Float[Array, "N B outputs"]:
    """Decode a batch of vectors to a signal on the finest level."""
    return layers.spiral_conv(weights["convs"][-1], decode_levels(weights, hierarchy, x), hierarchy.surface)


def decode_levels(weights: Weights, hierarchy: Hierarchy, x: Float[Array, "B inputs"]) -> Float[Array, "N B C"]:
    """Decode a batch of vectors up to the finest level, without the last convolution; C is `channels[-1]`."""
    upsamplings = hierarchy.climbs[::-1]
    convs = weights["convs"][: len(upsamplings)]
    # The batch axis comes second, as `spiral_conv` expects.
    x = layers.dense(weights["dense"], x)
    x = x.reshape(x.shape[0], hierarchy.sizes[-1], convs[0]["kernel"].shape[1]).transpose(1, 0, 2)
    for conv, stencil in zip(convs, upsamplings, strict=True):
        x = jax.nn.elu(layers.spiral_conv(conv, x, stencil))
    return x


@partial(jax.jit, static_argnames="chunk")
def apply(
    params: S2DDec,
    hierarchy: Hierarchy,
    displacements: Float[Array | np.ndarray, "... L 3"],
    *,
    chunk: int | None = None,
) -> Float[Array, "... N 3"]:
    """Return vertex displacements in mm from landmark displacements in mm.

    Pass whole batches: a batch is much faster than a vmap over single samples. `chunk` samples are decoded at a time,
    by default a number that suits the platform. Move the hierarchy to the device once (`jax.device_put`).

    Raises:
      ValueError: wrong number of landmarks.
    """
    expected = params.scale.landmark_mean.shape
    if displacements.shape[-2:] != expected:
        raise ValueError(f"displacements: expected (..., {expected[0]}, 3), got {displacements.shape}")
    lead = displacements.shape[:-2]
    flat = jnp.asarray(displacements).reshape(-1, 3 * expected[0])

    def in_chunks(chunk: int) -> Callable[[Array], Array]:
        return lambda flat: layers.map_pieces(partial(_decode, params, hierarchy), [flat], chunk)

    few = _cpu_chunk(hierarchy)
    if chunk is not None:
        out = in_chunks(chunk)(flat)
    elif not export.is_symbolic_dim(flat.shape[0]) and flat.shape[0] <= few:
        out = _decode(params, hierarchy, flat)
    else:
        out = jax.lax.platform_dependent(flat, cpu=in_chunks(few), default=in_chunks(CHUNK))
    return out.reshape(*lead, *out.shape[1:])


def measure(batches: Iterable[tuple[np.ndarray, np.ndarray]]) -> Scale:
    """Measure the normalisation of a training set given as batches of landmarks (B, L, 3) and vertices (B, N, 3) in mm.

    Returns a mean per point and one standard deviation over all coordinates. Sums are accumulated in float64.

    Raises:
      ValueError: no batch.
    """
    count = 0
    sums: list[np.ndarray] = [np.zeros(()), np.zeros(())]
    squares = [0.0, 0.0]
    for pair in batches:
        count += len(pair[0])
        for i, values in enumerate(pair):
            sums[i] = sums[i] + np.sum(values, axis=0, dtype=np.float64)
            squares[i] += float(np.sum(np.square(values, dtype=np.float64)))
    if count == 0:
        raise ValueError("expected at least one batch, got none")
    means = [total / count for total in sums]
    stds = [
        np.sqrt(max(square / (count * mean.size) - np.mean(mean**2), 1e-12))
        for square, mean in zip(squares, means, strict=True)
    ]
    leaves = (means[0], stds[0], means[1], stds[1])
    return Scale(*(jnp.asarray(leaf, jnp.float32) for leaf in leaves))


def _decode(params: S2DDec, hierarchy: Hierarchy, displacements: Array) -> Array:
    """Decode a chunk (B, 3 L) to (B, N, 3)."""
    scale, weights = jax.lax.stop_gradient(params.scale), params.weights
    x = (displacements - scale.landmark_mean.reshape(-1)) / scale.landmark_std
    x = decode(weights, hierarchy, x)
    return scale.vertex_mean + scale.vertex_std * x.transpose(1, 0, 2)


def _cpu_chunk(hierarchy: Hierarchy) -> int:
    """Return the number of samples to decode at once on a CPU.

    The signals that are gathered from should stay in the cache, and glibc's allocator returns temporary arrays of more
    than 32 MB to the system after every call. Chunks of 16 samples were the fastest at 5,000 vertices: 64 samples took
    34 ms, against 42 ms in chunks of 32 or of 4.
    """
    return max(1, 82_000 // hierarchy.sizes[0])
