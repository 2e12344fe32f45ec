"""Motion3DGAN, sized for a CPU: noise and two labels in, a landmark motion on the SRVF sphere out.

After Otberdout et al. 2023, 3.1, with an architecture of our own; theirs is
`facejax.models.motion_reference`. A residual network turns noise and label embeddings into coordinates of
the training set's tangent chart (`facejax.models.charts`). The linear output basis makes jitter impossible
that the data do not have, and 5,916 outputs cost no more to train than its R directions. The critic reads
the same coordinates.

Both networks handle one sample; the caller vmaps. `start`, `end` are label indices, 0 ... K - 1.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from facejax.geometry import sphere
from facejax.models import charts
from facejax.models.charts import Chart

Weights = dict[str, Any]


class Config(NamedTuple):
    """Sizes, all static; the default generator and critic count 1.9 M numbers, chart included."""

    steps: int = 29  # T - 1
    landmarks: int = 68
    labels: int = 19
    noise: int = 128
    rank: int = 128
    width: int = 384
    blocks: int = 3
    embedding: int = 32


DEFAULT = Config()


class Params(NamedTuple):
    """One network: the chart it speaks in, and the weights that are trained."""

    chart: Chart
    weights: Weights


class Network(NamedTuple):
    """Pure functions of one network; `inner` is `apply` in the chart's coordinates, which training runs."""

    init: Callable
    apply: Callable
    inner: Callable


def _init_generator(key: jax.Array, chart: Chart, *, config: Config = DEFAULT) -> Params:
    """A generator that starts as a Gaussian: the right mean and spread of every pair."""
    _check_chart(chart, config)
    stem_key, label_key, blocks_key = jax.random.split(key, 3)
    weights = {
        "labels": jax.random.normal(label_key, (2, config.labels, config.embedding)),
        "stem": _dense(stem_key, config.noise + 2 * config.embedding, config.width),
        "blocks": _blocks(blocks_key, config),
        "head": _zeros(config.width, config.rank + 1),
        # Each of the widest directions, and the length, gets a noise of its own.
        "skip": jnp.eye(config.noise, config.rank + 1),
    }
    return Params(chart, weights)


@jax.jit
def _generate_coordinates(params: Params, noise: jax.Array, start, end) -> jax.Array:
    """Coordinates (R + 1,) from noise (128,) ~ N(0, 1) and two label indices."""
    chart, weights = jax.lax.stop_gradient(params.chart), params.weights
    _check_noise(noise, weights)
    hidden = jnp.concatenate([noise, weights["labels"][0, start], weights["labels"][1, end]])
    hidden = _residual_stack(weights, hidden, jax.nn.silu)
    deviation = noise @ weights["skip"] + _linear(weights["head"], hidden)
    unit = jnp.append(1.0, chart.scale[start, end])
    centre = jnp.append(0.0, chart.mean[start, end])
    return centre + unit * deviation


@jax.jit
def _generate(params: Params, noise: jax.Array, start, end) -> tuple[jax.Array, jax.Array]:
    """Tangent vector at p (T-1, L, 3) and log-length () from noise (128,) and two label indices."""
    return charts.motion(
        jax.lax.stop_gradient(params.chart), _generate_coordinates(params, noise, start, end), start, end
    )


def _init_critic(key: jax.Array, chart: Chart, *, config: Config = DEFAULT) -> Params:
    _check_chart(chart, config)
    stem_key, label_key, blocks_key, head_key = jax.random.split(key, 4)
    weights = {
        "labels": jax.random.normal(label_key, (2, config.labels, config.embedding)),
        "stem": _dense(stem_key, config.rank + 1 + 2 * config.embedding, config.width),
        "blocks": _blocks(blocks_key, config),
        "head": _dense(head_key, config.width, 1),
    }
    return Params(chart, weights)


@jax.jit
def _score(params: Params, values: jax.Array, start, end) -> jax.Array:
    """How real a motion looks, from its coordinates (R + 1,); any real number, larger is more real."""
    chart, weights = jax.lax.stop_gradient(params.chart), params.weights
    # Centred per pair, and brought to order one by a single factor: a factor per direction would blow up the
    # gradient along the narrow ones, which the penalty then fights.
    offset = (values[1:] - chart.mean[start, end]) / jnp.sqrt(jnp.mean(jnp.square(chart.scale[start, end])))
    hidden = jnp.concatenate([values[:1], offset, weights["labels"][0, start], weights["labels"][1, end]])
    return _linear(weights["head"], _residual_stack(weights, hidden, partial(jax.nn.leaky_relu, negative_slope=0.2)))[0]


@jax.jit
def _criticise(params: Params, tangent: jax.Array, log_length: jax.Array, start, end) -> jax.Array:
    """How real a tangent vector at p (T-1, L, 3) with a log-length () looks for two label indices."""
    return _score(
        params,
        charts.coordinates(jax.lax.stop_gradient(params.chart), tangent, log_length, start, end),
        start,
        end,
    )


generator = Network(_init_generator, _generate, _generate_coordinates)
critic = Network(_init_critic, _criticise, _score)


@jax.jit
def sample(params: Params, key: jax.Array, start, end) -> tuple[jax.Array, jax.Array]:
    """Draw a motion: a point q on the sphere (T-1, L, 3), and its log-length ()."""
    noise = jax.random.normal(key, params.weights["skip"].shape[:1])
    tangent, log_length = generator.apply(params, noise, start, end)
    return sphere.exp(params.chart.p, tangent), log_length


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


def _check_chart(chart: Chart, config: Config) -> None:
    expected = (config.rank, config.steps, config.landmarks, 3)
    if chart.basis.shape != expected or chart.mean.shape != (config.labels, config.labels, config.rank):
        raise ValueError(
            f"the chart's basis must be {expected} for {config.labels} labels; "
            f"got {chart.basis.shape} and means {chart.mean.shape}"
        )


def _check_noise(noise: jax.Array, weights: Weights) -> None:
    if noise.shape != weights["skip"].shape[:1]:
        raise ValueError(f"noise must have shape {weights['skip'].shape[:1]}; got {noise.shape}")
