"""Motion3DGAN with the architecture of its authors' program: the SRVF as an image of 3L rows by T-1 columns.

The paper (Otberdout et al. 2023, 3.1) does not specify the layers; these are the layers of the authors' 2022 program,
with three changes: the last image has T-1 columns, the critic has no batch normalisation (which is unsound with a
gradient penalty), and both networks use the log-length. The generator has 77 M weights at 19 labels; `width_divisor`
makes all layers narrower.

The interface is that of `facejax.models.motion.motion3dgan`: one sample, `start` and `end` label indices. Images are
(rows, columns, channels); row 3 l + c is coordinate c of landmark l.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from facejax.geometry import sphere
from facejax.models import layers
from facejax.models.layers import Weights
from facejax.models.motion.tangent_pca import Motion, TangentPCA


class Config(NamedTuple):
    """Sizes, all static."""

    steps: int = 29  # T - 1
    landmarks: int = 68
    labels: int = 19
    noise: int = 128
    width_divisor: int = 1


DEFAULT = Config()


class Motion3DGANReference(NamedTuple):
    """Parameters of one network: the chart, of which p and the log-lengths are used, and the trained weights."""

    chart: TangentPCA
    weights: Weights


class Network(NamedTuple):
    """Pure functions of one network, generator or critic."""

    init: Callable[..., Motion3DGANReference]
    apply: Callable[..., Any]


def _init_generator(key: Array, chart: TangentPCA, *, config: Config = DEFAULT) -> Motion3DGANReference:
    stem_key, length_key, *conv_keys = jax.random.split(key, 6)
    condition = 2 * config.labels
    widths = [width // config.width_divisor for width in (1024, 512, 256, 128)] + [1]
    rows, columns = _sizes(3 * config.landmarks, config.steps)[0]
    # The labels enter twice: 128 + 2 x 36 = 200 inputs at the 18 labels of the original.
    weights = {
        "stem": layers.init_dense(stem_key, config.noise + 2 * condition, rows * columns * widths[0]),
        "convs": [
            _kernel(key, 3, inputs + condition, outputs)
            for key, inputs, outputs in zip(conv_keys, widths[:-1], widths[1:], strict=True)
        ],
        "length": layers.init_dense(length_key, widths[3], 1),
    }
    return Motion3DGANReference(chart, weights)


@jax.jit
def _generate(
    params: Motion3DGANReference, noise: Float[Array | np.ndarray, " noise"], start: ArrayLike, end: ArrayLike
) -> tuple[Float[Array, "steps L 3"], Float[Array, ""]]:
    """Return a tangent vector at p (T-1, L, 3) and log-length () from noise (128,) ~ N(0, 1) and two label indices."""
    chart, weights = jax.lax.stop_gradient(params.chart), params.weights
    steps, landmarks, _ = chart.p.shape
    condition = _one_hots(chart, start, end)
    sizes = _sizes(3 * landmarks, steps)
    stem = layers.dense(weights["stem"], jnp.concatenate([noise, condition, condition]))
    image = jax.nn.relu(stem).reshape(*sizes[0], -1)
    for kernel, size in zip(weights["convs"][:-1], sizes[1:], strict=True):
        image = jax.image.resize(_tile(image, condition), (*size, kernel.shape[2]), "nearest")
        image = jax.nn.relu(_convolve(image, kernel, stride=1))
    standard = layers.dense(weights["length"], jnp.mean(image, (0, 1)))[0]
    image = jnp.tanh(_convolve(_tile(image, condition), weights["convs"][-1], stride=1))
    tangent = sphere.project(chart.p, image[..., 0].T.reshape(steps, landmarks, 3))
    return tangent, chart.scalar_mean[start, end, 0] + chart.scalar_std[0] * standard


def _init_critic(key: Array, chart: TangentPCA, *, config: Config = DEFAULT) -> Motion3DGANReference:
    *conv_keys, hidden_key, head_key = jax.random.split(key, 5)
    condition = 2 * config.labels
    widths = [width // config.width_divisor for width in (64, 32, 16)]
    hidden = 1024 // config.width_divisor
    halved = [-(-size // 8) for size in (3 * config.landmarks, config.steps)]  # three strides of two, padded
    inputs = [1, *(width + condition for width in widths)]
    weights = {
        "convs": [_kernel(k, 5, i, o) for k, i, o in zip(conv_keys, inputs, widths, strict=False)],
        "hidden": layers.init_dense(hidden_key, halved[0] * halved[1] * inputs[-1] + 1, hidden),
        "head": layers.init_dense(head_key, hidden, 1),
    }
    return Motion3DGANReference(chart, weights)


@jax.jit
def _criticise(
    params: Motion3DGANReference,
    tangent: Float[Array | np.ndarray, "steps L 3"],
    log_length: ArrayLike,
    start: ArrayLike,
    end: ArrayLike,
) -> Float[Array, ""]:
    """Return the critic's score () of a tangent vector at p (T-1, L, 3) and a log-length (), for two label indices."""
    chart, weights = jax.lax.stop_gradient(params.chart), params.weights
    condition = _one_hots(chart, start, end)
    image = jnp.asarray(tangent).reshape(len(tangent), -1).T[..., None]
    for kernel in weights["convs"]:
        image = _tile(_leaky(_convolve(image, kernel, stride=2)), condition)
    standard = (log_length - chart.scalar_mean[start, end, 0]) / chart.scalar_std[0]
    hidden = _leaky(layers.dense(weights["hidden"], jnp.append(jnp.ravel(image), standard)))
    return layers.dense(weights["head"], hidden)[0]


generator = Network(_init_generator, _generate)
critic = Network(_init_critic, _criticise)


def noise_size(params: Motion3DGANReference) -> int:
    """Return the number of standard normal numbers that `generate` takes."""
    # The stem's inputs less twice the two one-hot labels.
    return params.weights["stem"]["kernel"].shape[0] - 4 * len(params.chart.scalar_mean)


@jax.jit
def generate(
    params: Motion3DGANReference,
    noise: Float[Array | np.ndarray, " noise"],
    start: ArrayLike,
    end: ArrayLike,
    pose: Float[Array | np.ndarray, " D"] | None = None,
) -> Motion:
    """Return the motion of noise (128,) between two labels. The pose is ignored, the duration the pair's mean."""
    del pose
    tangent, log_length = generator.apply(params, noise, start, end)
    return Motion(sphere.exp(params.chart.p, tangent), log_length, params.chart.scalar_mean[start, end, 1])


def _sizes(rows: int, columns: int) -> list[tuple[int, int]]:
    """Return image sizes from coarse to fine: 51 x 7, 102 x 14, 204 x 28, 204 x 29 for 68 landmarks and 29 steps."""
    low, short = -(-rows // 4), max(columns // 4, 1)
    return [(low, short), (2 * low, 2 * short), (rows, 4 * short), (rows, columns)]


def _one_hots(chart: TangentPCA, start: ArrayLike, end: ArrayLike) -> Array:
    labels = len(chart.scalar_mean)
    return jnp.concatenate([jax.nn.one_hot(label, labels, dtype=chart.p.dtype) for label in (start, end)])


def _tile(image: Array, condition: Array) -> Array:
    return jnp.concatenate([image, jnp.broadcast_to(condition, (*image.shape[:2], len(condition)))], axis=-1)


def _leaky(x: Array) -> Array:
    return jax.nn.leaky_relu(x, 0.2)


def _convolve(image: Array, kernel: Array, *, stride: int) -> Array:
    layout = ("NHWC", "HWIO", "NHWC")
    strides = (stride, stride)
    return jax.lax.conv_general_dilated(image[None], kernel, strides, "SAME", dimension_numbers=layout)[0]


def _kernel(key: Array, size: int, inputs: int, outputs: int) -> Array:
    return jax.nn.initializers.he_normal()(key, (size, size, inputs, outputs))
