"""Motion3DGAN, sized for a CPU: noise and two labels in, a landmark motion on the SRVF sphere out.

After Otberdout et al. 2023, 3.1, with an architecture of our own; theirs is
`facejax.models.motion_reference`. A residual network turns noise and label embeddings into coordinates of
the training set's tangent chart (`facejax.models.charts`). The linear output basis makes jitter impossible
that the data do not have, and 5,916 outputs cost no more to train than its R directions. The critic reads
the same coordinates.

Both networks are told the two labels and the pose that the motion starts from: a mouth that is drawn to the left
moves otherwise to an open mouth than one that is drawn to the right. Both handle one sample; the caller vmaps.
`start`, `end` are label indices, 0 ... K - 1; `pose` is (D,), see `charts`.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from facejax.geometry import sphere
from facejax.models.motion import tangent_pca
from facejax.models.motion.tangent_pca import Motion, TangentPCA

Weights = dict[str, Any]


class Config(NamedTuple):
    """Sizes, all static; the default generator and critic count 2.0 M numbers, chart included."""

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
    """One network: the chart it speaks in, and the weights that are trained."""

    chart: TangentPCA
    weights: Weights


class Network(NamedTuple):
    """Pure functions of one network; `inner` is `apply` in the chart's coordinates, which training runs."""

    init: Callable
    apply: Callable
    inner: Callable


def _init_generator(key: jax.Array, chart: TangentPCA, *, config: Config = DEFAULT) -> Motion3DGAN:
    """A generator that starts as a Gaussian: the right mean and spread of every pair."""
    _check_chart(chart, config)
    stem_key, label_key, blocks_key = jax.random.split(key, 3)
    weights = {
        "labels": jax.random.normal(label_key, (2, config.labels, config.embedding)),
        "stem": _dense(stem_key, config.noise + config.pose + 2 * config.embedding, config.width),
        "blocks": _blocks(blocks_key, config),
        "head": _zeros(config.width, config.rank + tangent_pca.SCALARS),
        # Each of the widest directions, and length and duration, get a noise of their own.
        "skip": jnp.eye(config.noise, config.rank + tangent_pca.SCALARS),
    }
    return Motion3DGAN(chart, weights)


@jax.jit
def _generate_coordinates(params: Motion3DGAN, noise: jax.Array, start, end, pose: jax.Array) -> jax.Array:
    """Coordinates (2 + R,) from noise (128,) ~ N(0, 1), two label indices and a pose (D,)."""
    chart, weights = jax.lax.stop_gradient(params.chart), params.weights
    _check_noise(noise, weights)
    hidden = jnp.concatenate([noise, weights["labels"][0, start], weights["labels"][1, end], pose])
    hidden = _residual_stack(weights, hidden, jax.nn.silu)
    deviation = noise @ weights["skip"] + _linear(weights["head"], hidden)
    return (
        tangent_pca.conditional_mean(chart, start, end, pose)
        + tangent_pca.conditional_std(chart, start, end) * deviation
    )


@jax.jit
def _generate(
    params: Motion3DGAN, noise: jax.Array, start, end, pose: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Tangent vector at p (T-1, L, 3), log-length and log-seconds () from noise (128,), two label indices, a pose."""
    values = _generate_coordinates(params, noise, start, end, pose)
    return tangent_pca.decode(jax.lax.stop_gradient(params.chart), values, start, end)


def _init_critic(key: jax.Array, chart: TangentPCA, *, config: Config = DEFAULT) -> Motion3DGAN:
    _check_chart(chart, config)
    stem_key, label_key, blocks_key, head_key = jax.random.split(key, 4)
    weights = {
        "labels": jax.random.normal(label_key, (2, config.labels, config.embedding)),
        "stem": _dense(stem_key, config.rank + tangent_pca.SCALARS + config.pose + 2 * config.embedding, config.width),
        "blocks": _blocks(blocks_key, config),
        "head": _dense(head_key, config.width, 1),
    }
    return Motion3DGAN(chart, weights)


@jax.jit
def _score(params: Motion3DGAN, values: jax.Array, start, end, pose: jax.Array) -> jax.Array:
    """How real a motion looks, from its coordinates (2 + R,); any real number, larger is more real."""
    chart, weights = jax.lax.stop_gradient(params.chart), params.weights
    # Centred, and brought to order one by a single factor: a factor per direction would blow up the gradient
    # along the narrow ones, which the penalty then fights.
    offset = values - tangent_pca.conditional_mean(chart, start, end, pose)
    factor = 1 / jnp.sqrt(jnp.mean(jnp.square(chart.scale[start, end])))
    offset = offset.at[tangent_pca.SCALARS :].multiply(factor)
    hidden = jnp.concatenate([offset, weights["labels"][0, start], weights["labels"][1, end], pose])
    return _linear(weights["head"], _residual_stack(weights, hidden, partial(jax.nn.leaky_relu, negative_slope=0.2)))[0]


@jax.jit
def _criticise(
    params: Motion3DGAN, tangent: jax.Array, log_length, log_seconds, start, end, pose: jax.Array
) -> jax.Array:
    """How real a tangent vector at p (T-1, L, 3) with a log-length and log-seconds () looks for labels and pose."""
    chart = jax.lax.stop_gradient(params.chart)
    values = tangent_pca.encode(chart, tangent, log_length, log_seconds, start, end)
    return _score(params, values, start, end, pose)


generator = Network(_init_generator, _generate, _generate_coordinates)
critic = Network(_init_critic, _criticise, _score)


@jax.jit
def sample(params: Motion3DGAN, key: jax.Array, start, end, pose: jax.Array) -> Motion:
    """Draw a motion between two labels that starts at a pose (D,)."""
    noise = jax.random.normal(key, params.weights["skip"].shape[:1])
    tangent, log_length, log_seconds = generator.apply(params, noise, start, end, pose)
    return Motion(sphere.exp(params.chart.p, tangent), log_length, log_seconds)


def _dense(key: jax.Array, inputs: int, outputs: int) -> Weights:
    kernel = jax.nn.initializers.he_normal()(key, (inputs, outputs))
    return {"kernel": kernel, "bias": jnp.zeros(outputs)}


def _zeros(inputs: int, outputs: int) -> Weights:
    return {"kernel": jnp.zeros((inputs, outputs)), "bias": jnp.zeros(outputs)}


def _linear(layer: Weights, x: jax.Array) -> jax.Array:
    return x @ layer["kernel"] + layer["bias"]


def _blocks(key: jax.Array, config: Config) -> list[Weights]:
    return [_dense(k, config.width, config.width) for k in jax.random.split(key, config.blocks)]


def _residual_stack(weights: Weights, x: jax.Array, activation) -> jax.Array:
    x = activation(_linear(weights["stem"], x))
    for block in weights["blocks"]:
        x = x + activation(_linear(block, x)) / len(weights["blocks"])
    return x


def _check_chart(chart: TangentPCA, config: Config) -> None:
    expected = (config.rank, config.steps, config.landmarks, 3)
    means = (config.labels, config.labels, config.rank)
    if chart.basis.shape != expected or chart.mean.shape != means or len(chart.pose_scale) != config.pose:
        raise ValueError(
            f"the chart's basis must be {expected} for {config.labels} labels and poses of {config.pose}; "
            f"got {chart.basis.shape}, means {chart.mean.shape} and poses of {len(chart.pose_scale)}"
        )


def _check_noise(noise: jax.Array, weights: Weights) -> None:
    if noise.shape != weights["skip"].shape[:1]:
        raise ValueError(f"noise must have shape {weights['skip'].shape[:1]}; got {noise.shape}")
