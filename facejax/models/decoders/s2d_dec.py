"""S2D-Dec: from sparse landmark displacements to the displacement of every vertex.

After Otberdout et al. 2023, 3.3. A dense layer makes a signal on the coarsest level of a hierarchy; at
each level the signal is upsampled, convolved along spirals and passed through ELU; a last spiral
convolution gives three numbers per vertex. L landmarks, N vertices, millimetres. The output is a
displacement: the caller adds the neutral mesh.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from facejax.mesh import spiral_conv
from facejax.mesh.hierarchy import Hierarchy

Weights = dict[str, Any]
CHANNELS = (128, 64, 32, 32, 16)


class Scale(NamedTuple):
    """Normalisation measured on the training set, in mm; never trained."""

    landmark_mean: jax.Array  # (L, 3)
    landmark_std: jax.Array  # ()
    vertex_mean: jax.Array  # (N, 3)
    vertex_std: jax.Array  # ()


class S2DDec(NamedTuple):
    """The constants, and the weights that are trained."""

    scale: Scale
    weights: Weights


def init(
    key: jax.Array,
    hierarchy: Hierarchy,
    *,
    landmarks: int = 68,
    channels: Sequence[int] = CHANNELS,
    scale: Scale | None = None,
) -> S2DDec:
    """Random weights that start within a hundredth of the mean displacement.

    `channels` from the coarsest level's signal to the finest: one more than the hierarchy has
    upsamplings. Without `scale`, displacements are taken as they are. Raises `ValueError` where the
    numbers of levels do not fit.
    """
    weights = init_weights(key, hierarchy, inputs=3 * landmarks, channels=channels, outputs=3)
    weights["convs"][-1]["kernel"] *= 0.01
    if scale is None:
        scale = Scale(jnp.zeros((landmarks, 3)), jnp.ones(()), jnp.zeros((hierarchy.sizes[0], 3)), jnp.ones(()))
    return S2DDec(scale, weights)


def init_weights(
    key: jax.Array, hierarchy: Hierarchy, *, inputs: int, channels: Sequence[int], outputs: int | None
) -> Weights:
    """Random weights of `decode`, from `inputs` numbers to `outputs` per vertex; without outputs, of `decode_levels`.

    `channels` as in `init`. Raises `ValueError` where the numbers of levels do not fit.
    """
    climbs = hierarchy.climbs[::-1]
    if len(channels) != len(climbs) + 1:
        raise ValueError(f"channels: expected {len(climbs) + 1} for this hierarchy, got {len(channels)}")
    dense_key, *conv_keys = jax.random.split(key, len(channels) + 1)
    he = jax.nn.initializers.he_normal(in_axis=(0, 1), out_axis=2)
    convs = [
        {"kernel": he(k, (len(stencil.source), inward, outward)), "bias": jnp.zeros(outward)}
        for k, stencil, inward, outward in zip(
            conv_keys, (*climbs, hierarchy.surface), channels, (*channels[1:], outputs), strict=True
        )
        if outward is not None
    ]
    coarse = hierarchy.sizes[-1] * channels[0]
    glorot = jax.nn.initializers.glorot_normal()
    return {"dense": {"kernel": glorot(dense_key, (inputs, coarse)), "bias": jnp.zeros(coarse)}, "convs": convs}


def decode(weights: Weights, hierarchy: Hierarchy, x: jax.Array) -> jax.Array:
    """A batch of vectors (B, inputs) -> a signal on the finest level (N, B, outputs), the batch inside."""
    last = weights["convs"][-1]
    return (
        spiral_conv.spiral_conv(decode_levels(weights, hierarchy, x), last["kernel"], hierarchy.surface) + last["bias"]
    )


def decode_levels(weights: Weights, hierarchy: Hierarchy, x: jax.Array) -> jax.Array:
    """`decode` but for its last convolution: (B, inputs) -> (N, B, channels[-1])."""
    x = x @ weights["dense"]["kernel"] + weights["dense"]["bias"]
    climbs = hierarchy.climbs[::-1]
    convs = weights["convs"][: len(climbs)]
    # The batch inside, as `ops` wants it.
    x = x.reshape(len(x), hierarchy.sizes[-1], convs[0]["kernel"].shape[1]).transpose(1, 0, 2)
    for conv, stencil in zip(convs, climbs, strict=True):
        x = jax.nn.elu(spiral_conv.spiral_conv(x, conv["kernel"], stencil) + conv["bias"])
    return x


@partial(jax.jit, static_argnames="chunk")
def apply(params: S2DDec, hierarchy: Hierarchy, displacements: jax.Array, *, chunk: int | None = None) -> jax.Array:
    """Vertex displacements (..., N, 3) in mm from landmark displacements (..., L, 3) in mm.

    Give whole batches: leading axes are free, and a batch is much faster than a vmap of single samples.
    It is worked on `chunk` samples at a time, by default as suits the processor. Move the hierarchy to
    the device once (`jax.device_put`). Raises `ValueError` for a wrong number of landmarks.
    """
    expected = params.scale.landmark_mean.shape
    if displacements.shape[-2:] != expected:
        raise ValueError(f"displacements: expected (..., {expected[0]}, 3), got {displacements.shape}")
    lead = displacements.shape[:-2]
    flat = displacements.reshape(-1, 3 * expected[0])
    out = _in_chunks(partial(_decode, params, hierarchy), flat, chunk or _chunk(hierarchy))
    return out.reshape(*lead, *out.shape[1:])


def measure(batches: Iterable[tuple[np.ndarray, np.ndarray]]) -> Scale:
    """The scale of a training set that comes as batches of landmarks (B, L, 3) and vertices (B, N, 3), in mm.

    Means per point, one standard deviation over all coordinates about them. Sums are kept in float64.
    """
    count, sums, squares = 0, [0.0, 0.0], [0.0, 0.0]
    for pair in batches:
        count += len(pair[0])
        for i, values in enumerate(pair):
            sums[i] = sums[i] + np.sum(values, axis=0, dtype=np.float64)
            squares[i] += np.sum(np.square(values, dtype=np.float64))
    if count == 0:
        raise ValueError("expected at least one batch, got none")
    means = [total / count for total in sums]
    stds = [
        np.sqrt(max(square / (count * mean.size) - np.mean(mean**2), 1e-12))
        for square, mean in zip(squares, means, strict=True)
    ]
    leaves = (means[0], stds[0], means[1], stds[1])
    return Scale(*(jnp.asarray(leaf, jnp.float32) for leaf in leaves))


def _decode(params: S2DDec, hierarchy: Hierarchy, displacements: jax.Array) -> jax.Array:
    """A chunk (B, 3 L) -> (B, N, 3)."""
    scale, weights = jax.lax.stop_gradient(params.scale), params.weights
    x = (displacements - scale.landmark_mean.reshape(-1)) / scale.landmark_std
    x = decode(weights, hierarchy, x)
    return scale.vertex_mean + scale.vertex_std * x.transpose(1, 0, 2)


def _chunk(hierarchy: Hierarchy) -> int:
    """How many samples to work on at once.

    On a CPU, what is gathered from should stay in the cache, and temporary arrays of more than 32 MB are given back to
    the system by glibc's allocator after every call. Sixteen samples of 5,000 vertices were the fastest: 64 of them
    took 34 ms so, 42 by thirty-twos, 42 by fours.
    """
    return max(1, 82_000 // hierarchy.sizes[0]) if jax.default_backend() == "cpu" else 1024


def _in_chunks(function, x: jax.Array, chunk: int) -> jax.Array:
    """function(x) in equal pieces of at most `chunk` rows, one after another."""
    pieces = -(-len(x) // chunk)
    if pieces <= 1:
        return function(x)
    size = -(-len(x) // pieces)
    padded = jnp.pad(x, ((0, pieces * size - len(x)), (0, 0)))
    out = jax.lax.map(function, padded.reshape(pieces, size, -1))
    return out.reshape(-1, *out.shape[2:])[: len(x)]
