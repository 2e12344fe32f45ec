"""Riemannian flow matching: a generator of landmark motion on the SRVF sphere.

After Chen & Lipman 2024 ("Flow Matching on General Geometries"). Samples of a simple distribution are transported to
the data distribution along a velocity field on the manifold; the field is trained by regression on the velocities of
geodesics, without a critic.

The manifold. The chart's point p and its R directions span a great sphere S^R within the SRVF sphere. A great sphere is
totally geodesic: geodesics, exp, log and parallel transport agree with those of the whole sphere, so a state is R + 1
numbers, and the only approximation is the chart's residual. Standardised log-length and log-seconds complete the state.

    state    (y, s): y (1, 1, R + 1), a unit vector, of which entry 0 is the component along p; s (2,).
    time     t in [0, 1], from source to data. The source is the chart's Gaussian given the label pair and the pose,
             wrapped onto the sphere by exp_p: a zero field already has the right mean and standard deviation.

Functions take one sample; the caller vmaps. `start` and `end` are label indices, `pose` is (D,), see
`facejax.models.motion.tangent_pca`.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from facejax.geometry import sphere
from facejax.geometry.precision import HIGHEST
from facejax.models import layers
from facejax.models.layers import Weights
from facejax.models.motion import tangent_pca
from facejax.models.motion.tangent_pca import Motion, TangentPCA

State = tuple[Array, Array]
FREQUENCIES = 16  # of the time embedding, cosines and sines
STEPS = 16  # of integration


class Config(NamedTuple):
    """Sizes, all static; the default field has 1.5 M parameters."""

    steps: int = 29  # T - 1
    landmarks: int = 68
    labels: int = 19
    rank: int = 128
    pose: int = 32
    width: int = 512
    blocks: int = 4
    embedding: int = 32


DEFAULT = Config()


class FlowMatching(NamedTuple):
    """Parameters: the chart and the trained weights of the velocity field."""

    chart: TangentPCA
    weights: Weights


def init(key: Array, chart: TangentPCA, *, config: Config = DEFAULT) -> FlowMatching:
    """Return random weights whose field is zero everywhere.

    Raises:
      ValueError: sizes of the chart that differ from those of `config`.
    """
    expected = (
        (config.rank, config.steps, config.landmarks, 3), (config.labels, config.labels, config.rank), config.pose,
    )  # fmt: skip
    sizes = chart.basis.shape, chart.mean.shape, len(chart.pose_scale)
    if sizes != expected:
        raise ValueError(f"the chart's basis, means and poses must be {expected}; got {sizes}")
    stem_key, label_key, *keys = jax.random.split(key, 2 + 2 * config.blocks)
    inputs = 2 * (config.rank + 1) + tangent_pca.SCALARS + 2 * FREQUENCIES + 2 * config.embedding + config.pose
    context = 2 * FREQUENCIES + 2 * config.embedding + config.pose
    weights = {
        "labels": jax.random.normal(label_key, (2, config.labels, config.embedding)),
        "stem": layers.init_dense(stem_key, inputs, config.width),
        "blocks": [layers.init_dense(k, config.width, config.width) for k in keys[: config.blocks]],
        # The context gates every block: it scales the block's units, so that the field can vary with time.
        "gates": [layers.zero_dense(context, config.width) for _ in keys[config.blocks :]],
        "head": layers.zero_dense(config.width, config.rank + 1 + tangent_pca.SCALARS),
    }
    return FlowMatching(chart, weights)


@jax.jit
def velocity(
    params: FlowMatching,
    state: State,
    time: ArrayLike,
    start: ArrayLike,
    end: ArrayLike,
    pose: Float[Array | np.ndarray, " D"],
) -> State:
    """Return the field at a state and a time: a tangent vector at y (1, 1, R + 1), and the derivative of s (2,)."""
    chart, weights = jax.lax.stop_gradient(params.chart), params.weights
    y, s = state
    scale = state_std(chart, start, end)
    context = jnp.concatenate(
        [_time_embedding(jnp.asarray(time, y.dtype)), weights["labels"][0, start], weights["labels"][1, end], pose]
    )
    centre = to_state(chart, tangent_pca.conditional_mean(chart, start, end, pose))[0]
    offset = (y - centre)[0, 0] / scale
    # Both the offset from the mean in standard deviations and y itself: the first saturates far from the mean.
    hidden = jnp.concatenate([jnp.tanh(offset / 4) * 4, y[0, 0] * jnp.sqrt(len(scale)), s, context])
    hidden = jax.nn.silu(layers.dense(weights["stem"], hidden))
    for block, gate in zip(weights["blocks"], weights["gates"], strict=True):
        change = jax.nn.silu(layers.dense(block, hidden)) * (1 + layers.dense(gate, context))
        hidden = hidden + change / len(weights["blocks"])
    out = layers.dense(weights["head"], hidden)
    return sphere.project(y, (scale * out[: len(scale)])[None, None]), out[len(scale) :]


@jax.jit
def sample_source(
    chart: TangentPCA, key: Array, start: ArrayLike, end: ArrayLike, pose: Float[Array | np.ndarray, " D"]
) -> State:
    """Draw a state at time 0 from the Gaussian of a label pair and a pose, wrapped onto the sphere."""
    noise = jax.random.normal(key, (tangent_pca.SCALARS + len(chart.basis),), chart.mean.dtype)
    return source(chart, noise, start, end, pose)


@jax.jit
def source(
    chart: TangentPCA,
    noise: Float[Array | np.ndarray, " coordinates"],
    start: ArrayLike,
    end: ArrayLike,
    pose: Float[Array | np.ndarray, " D"],
) -> State:
    """Return the state at time 0 that belongs to standard normal noise (2 + R,)."""
    return to_state(
        chart,
        tangent_pca.conditional_mean(chart, start, end, pose) + tangent_pca.conditional_std(chart, start, end) * noise,
    )


@jax.jit
def to_state(chart: TangentPCA, values: Float[Array | np.ndarray, " coordinates"]) -> State:
    """Return the state of coordinates (2 + R,): exp_p within the great sphere."""
    # Norms on the SRVF sphere are means over steps, norms of coordinates are sums.
    tangent = jnp.append(0.0, values[tangent_pca.SCALARS :]) / jnp.sqrt(len(chart.p))
    return sphere.exp(_reference_point(chart), tangent[None, None]), jnp.asarray(values)[: tangent_pca.SCALARS]


@jax.jit
def from_state(chart: TangentPCA, state: State, start: ArrayLike, end: ArrayLike) -> Motion:
    """Return the motion of a state: a point on the SRVF sphere, log-length and log-seconds."""
    y, s = state
    y = (y / sphere.norm(y)[..., None, None, None])[0, 0]
    # p is normalised, and the basis tangent to it, only up to rounding: normalise again.
    q = y[0] * chart.p + jnp.sqrt(len(chart.p)) * jnp.tensordot(y[1:], chart.basis, 1, precision=HIGHEST)
    q = q / sphere.norm(q)[..., None, None, None]
    log_length, log_seconds = chart.scalar_mean[start, end] + chart.scalar_std * s
    return Motion(q, log_length, log_seconds)


def noise_size(params: FlowMatching) -> int:
    """Return the number of standard normal numbers that `generate` takes."""
    return tangent_pca.SCALARS + len(params.chart.basis)


@partial(jax.jit, static_argnames="steps")
def generate(
    params: FlowMatching,
    noise: Float[Array | np.ndarray, " coordinates"],
    start: ArrayLike,
    end: ArrayLike,
    pose: Float[Array | np.ndarray, " D"],
    *,
    steps: int = STEPS,
) -> Motion:
    """Return the motion of noise (2 + R,) between two labels from a pose, by `steps` midpoint steps along the field.

    Raises:
      ValueError: fewer than one step.
    """
    if steps < 1:
        raise ValueError(f"steps of integration: expected 1 or more, got {steps}")
    state = source(params.chart, noise, start, end, pose)

    def advance(state: State, time: Array) -> tuple[State, None]:
        y, s = state
        v, rate = velocity(params, state, time, start, end, pose)
        middle = sphere.exp(y, v / (2 * steps)), s + rate / (2 * steps)
        v, rate = velocity(params, middle, time + 1 / (2 * steps), start, end, pose)
        # The velocity at the midpoint is tangent there; parallel transport makes it tangent at y.
        y = sphere.exp(y, sphere.transport(middle[0], y, v) / steps)
        return (y / sphere.norm(y)[..., None, None, None], s + rate / steps), None

    state, _ = jax.lax.scan(advance, state, jnp.arange(steps, dtype=state[1].dtype) / steps)
    return from_state(params.chart, state, start, end)


def _reference_point(chart: TangentPCA) -> Array:
    return jnp.zeros((1, 1, len(chart.basis) + 1), chart.basis.dtype).at[0, 0, 0].set(1.0)


@jax.jit
def state_std(chart: TangentPCA, start: ArrayLike, end: ArrayLike) -> Float[Array, " entries"]:
    """Return a standard deviation for each entry of y: those of the label pair; their root mean square along p."""
    scale = chart.scale[start, end] / jnp.sqrt(len(chart.p))
    return jnp.append(jnp.sqrt(jnp.mean(scale**2)), scale)


def _time_embedding(time: Array) -> Array:
    angle = jnp.pi * time * jnp.arange(FREQUENCIES, dtype=time.dtype)
    return jnp.concatenate([jnp.cos(angle), jnp.sin(angle)])
