"""Riemannian flow matching: the second generator of landmark motion, on the same sphere as the GAN.

After Chen & Lipman 2024 ("Flow Matching on General Geometries"). A motion is carried from a simple distribution to
that of the data along a velocity field on the manifold; the field is learnt by regression on the velocities of
geodesics, with no critic.

The manifold. The chart's point p and its R directions span a great sphere S^R within the SRVF sphere. A great sphere
is totally geodesic: geodesics, exp, log and transport of the large sphere are those of the small one, so a state is
R + 1 numbers and nothing is approximated but the chart's residual. Beside it go log-length and log-seconds,
standardised.

    state    (y, s): y (1, 1, R + 1), a unit vector, of which entry 0 lies along p; s (2,).
    time     t in [0, 1], from source to data. The source is the chart's Gaussian of the pair and the pose, wrapped on
             the sphere by exp_p: a field of zero already gives the right mean and spread.

One sample; the caller vmaps. `start`, `end` are label indices, `pose` is (D,), see `charts`.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from facejax.geometry import sphere
from facejax.models.motion import tangent_pca
from facejax.models.motion.tangent_pca import Motion, TangentPCA

Weights = dict[str, Any]
State = tuple[jax.Array, jax.Array]
FREQUENCIES = 16  # of the time, as cosines and sines
STEPS = 16  # of integration


class Config(NamedTuple):
    """Sizes, all static; the default field counts 1.5 M numbers."""

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
    """The chart that the field lives in, and the weights that are trained."""

    chart: TangentPCA
    weights: Weights


def init(key: jax.Array, chart: TangentPCA, *, config: Config = DEFAULT) -> FlowMatching:
    """A field that is zero everywhere."""
    sizes = (config.rank, config.steps, config.landmarks, 3), (config.labels, config.labels, config.rank), config.pose
    found = chart.basis.shape, chart.mean.shape, len(chart.pose_scale)
    if found != sizes:
        raise ValueError(f"the chart's basis, means and poses must be {sizes}; got {found}")
    stem_key, label_key, *keys = jax.random.split(key, 2 + 2 * config.blocks)
    inputs = 2 * (config.rank + 1) + tangent_pca.SCALARS + 2 * FREQUENCIES + 2 * config.embedding + config.pose
    context = 2 * FREQUENCIES + 2 * config.embedding + config.pose
    weights = {
        "labels": jax.random.normal(label_key, (2, config.labels, config.embedding)),
        "stem": _dense(stem_key, inputs, config.width),
        "blocks": [_dense(k, config.width, config.width) for k in keys[: config.blocks]],
        # The context enters every block again as a factor on its units: time changes what the field does.
        "gates": [_zeros(context, config.width) for _ in keys[config.blocks :]],
        "head": _zeros(config.width, config.rank + 1 + tangent_pca.SCALARS),
    }
    return FlowMatching(chart, weights)


@jax.jit
def velocity(params: FlowMatching, state: State, time: jax.Array, start, end, pose: jax.Array) -> State:
    """The field at a state and a time (): a tangent vector at y (1, 1, R + 1), and the rate of s (2,)."""
    chart, weights = jax.lax.stop_gradient(params.chart), params.weights
    y, s = state
    scale = state_std(chart, start, end)
    context = jnp.concatenate([_waves(time), weights["labels"][0, start], weights["labels"][1, end], pose])
    centre = to_state(chart, tangent_pca.conditional_mean(chart, start, end, pose))[0]
    offset = (y - centre)[0, 0] / scale
    # Near the mean in units of its spread, and as it is: the first saturates where a motion is far from its pair.
    hidden = jnp.concatenate([jnp.tanh(offset / 4) * 4, y[0, 0] * jnp.sqrt(len(scale)), s, context])
    hidden = jax.nn.silu(_linear(weights["stem"], hidden))
    for block, gate in zip(weights["blocks"], weights["gates"], strict=True):
        change = jax.nn.silu(_linear(block, hidden)) * (1 + _linear(gate, context))
        hidden = hidden + change / len(weights["blocks"])
    out = _linear(weights["head"], hidden)
    return sphere.project(y, (scale * out[: len(scale)])[None, None]), out[len(scale) :]


@jax.jit
def sample_source(chart: TangentPCA, key: jax.Array, start, end, pose: jax.Array) -> State:
    """Draw where the flow begins: the Gaussian of a pair and a pose, wrapped on the sphere."""
    noise = jax.random.normal(key, (tangent_pca.SCALARS + len(chart.basis),))
    return to_state(
        chart,
        tangent_pca.conditional_mean(chart, start, end, pose) + tangent_pca.conditional_std(chart, start, end) * noise,
    )


@jax.jit
def to_state(chart: TangentPCA, values: jax.Array) -> State:
    """Coordinates (2 + R,) -> the state: exp_p within the great sphere."""
    # The tangent vector's norm on the SRVF sphere is a mean over steps, its components' a sum.
    tangent = jnp.append(0.0, values[tangent_pca.SCALARS :]) / jnp.sqrt(len(chart.p))
    return sphere.exp(_pole(chart), tangent[None, None]), values[: tangent_pca.SCALARS]


@jax.jit
def from_state(chart: TangentPCA, state: State, start, end) -> Motion:
    """The motion of a state: a point on the SRVF sphere, log-length and log-seconds."""
    y, s = state
    y = (y / sphere.norm(y)[..., None, None, None])[0, 0]
    # p has norm 1 on the sphere to rounding only, and the basis is tangent to rounding only.
    q = y[0] * chart.p + jnp.sqrt(len(chart.p)) * jnp.tensordot(y[1:], chart.basis, 1)
    q = q / sphere.norm(q)[..., None, None, None]
    log_length, log_seconds = chart.scalar_mean[start, end] + chart.scalar_std * s
    return Motion(q, log_length, log_seconds)


@partial(jax.jit, static_argnames="steps")
def sample(params: FlowMatching, key: jax.Array, start, end, pose: jax.Array, *, steps: int = STEPS) -> Motion:
    """Draw a motion between two labels that starts at a pose (D,): `steps` midpoint steps along the field.

    Raises `ValueError` for fewer than one step.
    """
    if steps < 1:
        raise ValueError(f"steps of integration: expected 1 or more, got {steps}")
    state = sample_source(params.chart, key, start, end, pose)

    def advance(state: State, time: jax.Array) -> tuple[State, None]:
        y, s = state
        v, rate = velocity(params, state, time, start, end, pose)
        middle = sphere.exp(y, v / (2 * steps)), s + rate / (2 * steps)
        v, rate = velocity(params, middle, time + 1 / (2 * steps), start, end, pose)
        # The middle's velocity is tangent there; carried back, it is tangent at y.
        y = sphere.exp(y, sphere.transport(middle[0], y, v) / steps)
        return (y / sphere.norm(y)[..., None, None, None], s + rate / steps), None

    state, _ = jax.lax.scan(advance, state, jnp.arange(steps) / steps)
    return from_state(params.chart, state, start, end)


def _pole(chart: TangentPCA) -> jax.Array:
    return jnp.zeros((1, 1, len(chart.basis) + 1)).at[0, 0, 0].set(1.0)


@jax.jit
def state_std(chart: TangentPCA, start, end) -> jax.Array:
    """A length for each entry of y (R + 1,): the pair's deviations; their mean along p."""
    scale = chart.scale[start, end] / jnp.sqrt(len(chart.p))
    return jnp.append(jnp.sqrt(jnp.mean(scale**2)), scale)


def _waves(time: jax.Array) -> jax.Array:
    angle = jnp.pi * time * jnp.arange(FREQUENCIES)
    return jnp.concatenate([jnp.cos(angle), jnp.sin(angle)])


def _dense(key: jax.Array, inputs: int, outputs: int) -> Weights:
    return {"kernel": jax.nn.initializers.he_normal()(key, (inputs, outputs)), "bias": jnp.zeros(outputs)}


def _zeros(inputs: int, outputs: int) -> Weights:
    return {"kernel": jnp.zeros((inputs, outputs)), "bias": jnp.zeros(outputs)}


def _linear(layer: Weights, x: jax.Array) -> jax.Array:
    return x @ layer["kernel"] + layer["bias"]
