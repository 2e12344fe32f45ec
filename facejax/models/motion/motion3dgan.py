"""Motion3DGAN, sized for a CPU: a conditional GAN from noise and two labels to a landmark motion on the SRVF sphere.

After Otberdout et al. 2023, 3.1, with another architecture; the authors' own is
`facejax.models.motion.motion3dgan_reference`. A residual network maps noise and label embeddings to coordinates of the
chart (`facejax.models.motion.tangent_pca`). The linear output basis excludes jitter that is absent from the data, and
training 5,916 outputs costs no more than training R coordinates. The critic reads the same coordinates.

Both networks are conditioned on the two labels and on the pose that the motion starts from: the motion to an open mouth
differs between a mouth drawn to the left and one drawn to the right. Functions take one sample; the caller vmaps.
`start` and `end` are label indices, 0 ... K - 1; `pose` is (D,), see `tangent_pca`.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from facejax.geometry import sphere
from facejax.models import layers
from facejax.models.layers import Weights
from facejax.models.motion import tangent_pca
from facejax.models.motion.tangent_pca import Motion, TangentPCA


class Config(NamedTuple):
    """Sizes, all static; the default generator and critic have 2.0 M parameters, chart included."""

    steps: int = 29  # T - 1
    landmarks: int = 68
    labels: int = 19
    noise: int = 128
    rank: int = 128
    pose: int = 32
    width: int = 384
    blocks: int = 3
    embedding: int = 32


DEFAULT = Config()


class Motion3DGAN(NamedTuple):
    """Parameters of one network, generator or critic: the chart and the trained weights."""

    chart: TangentPCA
    weights: Weights


class Network(NamedTuple):
    """Pure functions of one network; `apply_coordinates` is `apply` in the chart's coordinates, used in training."""

    init: Callable[..., Motion3DGAN]
    apply: Callable[..., Any]
    apply_coordinates: Callable[..., Array]


def _init_generator(key: Array, chart: TangentPCA, *, config: Config = DEFAULT) -> Motion3DGAN:
    """Return a generator whose initial output is Gaussian, with the mean and standard deviation of every label pair."""
    _check_chart(chart, config)
    stem_key, label_key, blocks_key = jax.random.split(key, 3)
    weights = {
        "labels": jax.random.normal(label_key, (2, config.labels, config.embedding)),
        "stem": layers.init_dense(stem_key, config.noise + config.pose + 2 * config.embedding, config.width),
        "blocks": _blocks(blocks_key, config),
        "head": layers.zero_dense(config.width, config.rank + tangent_pca.SCALARS),
        # Length, duration and each of the leading directions have a noise input of their own.
        "skip": jnp.eye(config.noise, config.rank + tangent_pca.SCALARS),
    }
    return Motion3DGAN(chart, weights)


@jax.jit
def _generate_coordinates(
    params: Motion3DGAN,
    noise: Float[Array | np.ndarray, " noise"],
    start: ArrayLike,
    end: ArrayLike,
    pose: Float[Array | np.ndarray, " D"],
) -> Float[Array, " coordinates"]:
    """Return coordinates (2 + R,) from noise (128,) ~ N(0, 1), two label indices and a pose (D,)."""
    chart, weights = jax.lax.stop_gradient(params.chart), params.weights
    _check_noise(noise, weights)
    hidden = jnp.concatenate([noise, weights["labels"][0, start], weights["labels"][1, end], pose])
    hidden = layers.residual_stack(weights, hidden, jax.nn.silu)
    deviation = noise @ weights["skip"] + layers.dense(weights["head"], hidden)
    return (
        tangent_pca.conditional_mean(chart, start, end, pose)
        + tangent_pca.conditional_std(chart, start, end) * deviation
    )


@jax.jit
def _generate(
    params: Motion3DGAN,
    noise: Float[Array | np.ndarray, " noise"],
    start: ArrayLike,
    end: ArrayLike,
    pose: Float[Array | np.ndarray, " D"],
) -> tuple[Float[Array, "steps L 3"], Float[Array, ""], Float[Array, ""]]:
    """Return a tangent vector at p (T-1, L, 3), log-length and log-seconds () from noise, two labels and a pose."""
    values = _generate_coordinates(params, noise, start, end, pose)
    return tangent_pca.decode(jax.lax.stop_gradient(params.chart), values, start, end)


def _init_critic(key: Array, chart: TangentPCA, *, config: Config = DEFAULT) -> Motion3DGAN:
    """Return a critic with random weights."""
    _check_chart(chart, config)
    stem_key, label_key, blocks_key, head_key = jax.random.split(key, 4)
    weights = {
        "labels": jax.random.normal(label_key, (2, config.labels, config.embedding)),
        "stem": layers.init_dense(
            stem_key, config.rank + tangent_pca.SCALARS + config.pose + 2 * config.embedding, config.width
        ),
        "blocks": _blocks(blocks_key, config),
        "head": layers.init_dense(head_key, config.width, 1),
    }
    return Motion3DGAN(chart, weights)


@jax.jit
def _score(
    params: Motion3DGAN,
    values: Float[Array | np.ndarray, " coordinates"],
    start: ArrayLike,
    end: ArrayLike,
    pose: Float[Array | np.ndarray, " D"],
) -> Float[Array, ""]:
    """Return the critic's score () of coordinates (2 + R,), any real number; larger is more real."""
    chart, weights = jax.lax.stop_gradient(params.chart), params.weights
    # Centred, and scaled to order one by a single factor: a factor per direction would amplify the gradient along
    # directions of small variance, which conflicts with the gradient penalty.
    offset = values - tangent_pca.conditional_mean(chart, start, end, pose)
    factor = 1 / jnp.sqrt(jnp.mean(jnp.square(chart.scale[start, end])))
    offset = offset.at[tangent_pca.SCALARS :].multiply(factor)
    hidden = jnp.concatenate([offset, weights["labels"][0, start], weights["labels"][1, end], pose])
    leaky_relu = partial(jax.nn.leaky_relu, negative_slope=0.2)
    return layers.dense(weights["head"], layers.residual_stack(weights, hidden, leaky_relu))[0]


@jax.jit
def _criticise(
    params: Motion3DGAN,
    tangent: Float[Array | np.ndarray, "steps L 3"],
    log_length: ArrayLike,
    log_seconds: ArrayLike,
    start: ArrayLike,
    end: ArrayLike,
    pose: Float[Array | np.ndarray, " D"],
) -> Float[Array, ""]:
    """Return the critic's score () of a tangent vector at p (T-1, L, 3), log-length and log-seconds ()."""
    chart = jax.lax.stop_gradient(params.chart)
    values = tangent_pca.encode(chart, tangent, log_length, log_seconds, start, end)
    return _score(params, values, start, end, pose)


generator = Network(_init_generator, _generate, _generate_coordinates)
critic = Network(_init_critic, _criticise, _score)


def noise_size(params: Motion3DGAN) -> int:
    """Return the number of standard normal numbers that `generate` takes."""
    return len(params.weights["skip"])


@jax.jit
def generate(
    params: Motion3DGAN,
    noise: Float[Array | np.ndarray, " noise"],
    start: ArrayLike,
    end: ArrayLike,
    pose: Float[Array | np.ndarray, " D"],
) -> Motion:
    """Return the motion of noise (128,) between two labels from a pose."""
    tangent, log_length, log_seconds = generator.apply(params, noise, start, end, pose)
    return Motion(sphere.exp(params.chart.p, tangent), log_length, log_seconds)


def _blocks(key: Array, config: Config) -> list[Weights]:
    return [layers.init_dense(k, config.width, config.width) for k in jax.random.split(key, config.blocks)]


def _check_chart(chart: TangentPCA, config: Config) -> None:
    expected = (config.rank, config.steps, config.landmarks, 3)
    means = (config.labels, config.labels, config.rank)
    if chart.basis.shape != expected or chart.mean.shape != means or len(chart.pose_scale) != config.pose:
        raise ValueError(
            f"the chart's basis must be {expected} for {config.labels} labels and poses of {config.pose}; "
            f"got {chart.basis.shape}, means {chart.mean.shape} and poses of {len(chart.pose_scale)}"
        )


def _check_noise(noise: Array | np.ndarray, weights: Weights) -> None:
    if noise.shape != weights["skip"].shape[:1]:
        raise ValueError(f"noise must have shape {weights['skip'].shape[:1]}; got {noise.shape}")
