"""Motion3DGAN, sized for a CPU: noise and two labels in, a landmark motion on the SRVF sphere out.

After Otberdout et al. 2023, 3.1, with an architecture of our own; theirs is `facejax.models.motion_reference`.

Vocabulary
  chart        what the training motions fix once: the reference point p, R orthonormal tangent directions at p (their
               span holds the training motions up to a small residual), and the mean of each label pair.
  coordinates  (R + 1,) numbers for one motion: the standardised log-length, then the tangent vector's components along
               the chart's directions. The directions are orthonormal, so Euclidean distances and gradients are those of
               the tangent vectors themselves, and training can stay in coordinates from end to end.
  start, end   label indices, 0 ... K - 1.

Both networks handle one sample; the caller vmaps. A linear output basis makes jitter impossible that the data do not
have, and 5,916 outputs cost no more to train than R.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from facejax.geometry import sphere

Weights = dict[str, Any]


class Config(NamedTuple):
    """Sizes, all static; the generator and critic of the default together count 1.9 M numbers, chart included."""

    steps: int = 29  # T - 1
    landmarks: int = 68
    labels: int = 19
    noise: int = 128
    rank: int = 128
    width: int = 384
    blocks: int = 3
    embedding: int = 32


class Chart(NamedTuple):
    """Constants from the training set, never trained; K labels, R directions."""

    p: jax.Array  # (T-1, L, 3), a point on the sphere
    basis: jax.Array  # (R, T-1, L, 3), orthonormal in the Euclidean sense, orthogonal to p, widest spread first
    scale: jax.Array  # (R,), standard deviation along each direction within a label pair
    mean: jax.Array  # (K, K, R), mean components of each (start, end)
    length_mean: jax.Array  # (K, K), mean log-length of each (start, end)
    length_std: jax.Array  # (), standard deviation of the log-length within a label pair
    residual: jax.Array  # (), share of the training motions' squared norm outside the basis


class Params(NamedTuple):
    """One network: the chart it speaks in, and the weights that are trained."""

    chart: Chart
    weights: Weights


class Network(NamedTuple):
    """A pair of pure functions, and `score` or `coordinates`, the same network in the chart's coordinates."""

    init: Any
    apply: Any
    inner: Any


def fit_chart(
    p: np.ndarray,
    tangents: np.ndarray,
    log_length: np.ndarray,
    start: np.ndarray,
    end: np.ndarray,
    *,
    config: Config = Config(),
) -> Chart:
    """The chart of M training motions: p (T-1, L, 3), tangents log_p q (M, T-1, L, 3), the others (M,).

    The directions span the R principal ones of all tangent vectors, and are turned within that span so that the
    spread within label pairs is uncorrelated. Pairs without a motion get the sum of a start's and an end's effect.
    """
    shape = (config.steps, config.landmarks, 3)
    if p.shape != shape or tangents.shape[1:] != shape:
        raise ValueError(f"p must be {shape} and tangents (M, *{shape}); got {p.shape} and {tangents.shape}")
    if len(tangents) <= config.rank:
        raise ValueError(f"rank {config.rank} needs more than {config.rank} motions; got {len(tangents)}")
    flat = np.asarray(tangents, np.float32).reshape(len(tangents), -1)
    normal = np.ravel(p) / np.linalg.norm(p)
    span = _principal_directions(flat, config.rank)
    span = np.linalg.qr((span - np.outer(span @ normal, normal)).T)[0].T.astype(np.float32)
    components = (flat @ span.T).astype(np.float64)
    mean = _pair_means(components, start, end, config.labels)
    within = components - mean[start, end]
    variance, turn = np.linalg.eigh(within.T @ within / len(within))
    variance, turn = variance[::-1], turn[:, ::-1]
    scale = np.sqrt(np.maximum(variance, 1e-12 * variance[0]))
    length_mean = _pair_means(log_length[:, None], start, end, config.labels)[..., 0]
    length_std = np.std(log_length - length_mean[start, end])
    outside = 1.0 - np.sum(components**2) / np.sum(np.square(flat, dtype=np.float64))
    arrays = (p, (turn.T @ span).reshape(-1, *shape), scale, mean @ turn, length_mean, length_std, outside)
    return Chart(*(jnp.asarray(array, jnp.float32) for array in arrays))


@jax.jit
def to_coordinates(chart: Chart, tangent: jax.Array, log_length: jax.Array, start, end) -> jax.Array:
    """Coordinates (R + 1,) of a tangent vector at p (T-1, L, 3) and a log-length (); the part off the basis is lost."""
    standard = (log_length - chart.length_mean[start, end]) / chart.length_std
    return jnp.concatenate([standard[None], jnp.tensordot(chart.basis, tangent, 3)])


@jax.jit
def from_coordinates(chart: Chart, coordinates: jax.Array, start, end) -> tuple[jax.Array, jax.Array]:
    """The tangent vector at p (T-1, L, 3), exactly tangent, and the log-length () of coordinates (R + 1,)."""
    tangent = sphere.project(chart.p, jnp.tensordot(coordinates[1:], chart.basis, 1))
    return tangent, chart.length_mean[start, end] + chart.length_std * coordinates[0]


def _init_generator(key: jax.Array, chart: Chart, *, config: Config = Config()) -> Params:
    """A generator that starts as a Gaussian: the right mean per pair, the average spread within pairs."""
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
    chart, weights = params
    _check_noise(noise, weights)
    hidden = jnp.concatenate([noise, weights["labels"][0, start], weights["labels"][1, end]])
    hidden = _residual_stack(weights, hidden, jax.nn.silu)
    deviation = noise @ weights["skip"] + _linear(weights["head"], hidden)
    unit = jnp.concatenate([jnp.ones(1), chart.scale])
    centre = jnp.concatenate([jnp.zeros(1), chart.mean[start, end]])
    return centre + unit * deviation


@jax.jit
def _generate(params: Params, noise: jax.Array, start, end) -> tuple[jax.Array, jax.Array]:
    """Tangent vector at p (T-1, L, 3) and log-length () from noise (128,) and two label indices."""
    return from_coordinates(params.chart, _generate_coordinates(params, noise, start, end), start, end)


def _init_critic(key: jax.Array, chart: Chart, *, config: Config = Config()) -> Params:
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
def _score(params: Params, coordinates: jax.Array, start, end) -> jax.Array:
    """How real a motion looks, from its coordinates (R + 1,); any real number, larger is more real."""
    chart, weights = params
    # Centred per pair, and brought to order one by a single factor: a factor per direction would blow up the
    # gradient along the narrow ones, which the penalty then fights.
    offset = (coordinates[1:] - chart.mean[start, end]) / jnp.sqrt(jnp.mean(jnp.square(chart.scale)))
    hidden = jnp.concatenate(
        [coordinates[:1], offset, weights["labels"][0, start], weights["labels"][1, end]]
    )
    return _linear(weights["head"], _residual_stack(weights, hidden, partial(jax.nn.leaky_relu, negative_slope=0.2)))[0]


@jax.jit
def _criticise(params: Params, tangent: jax.Array, log_length: jax.Array, start, end) -> jax.Array:
    """How real a tangent vector at p (T-1, L, 3) with a log-length () looks for two label indices."""
    return _score(params, to_coordinates(params.chart, tangent, log_length, start, end), start, end)


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


def _principal_directions(flat: np.ndarray, rank: int) -> np.ndarray:
    """The `rank` leading right singular vectors (rank, D) of (M, D), by subspace iteration.

    The full decomposition of 20,000 x 5,916 takes minutes; this takes six thin products.
    """
    span = np.random.default_rng(0).standard_normal((flat.shape[1], min(rank + 32, *flat.shape)), np.float32)
    for _ in range(6):
        span = np.linalg.qr(flat.T @ (flat @ span))[0]
    values, turn = np.linalg.eigh(np.float64(flat @ span).T @ np.float64(flat @ span))
    return (span @ turn[:, np.argsort(-values)[:rank]]).T


def _pair_means(values: np.ndarray, start: np.ndarray, end: np.ndarray, labels: int) -> np.ndarray:
    """Mean of values (M, C) for each pair (K, K, C); absent pairs by least squares on start plus end effects."""
    pair = np.asarray(start) * labels + np.asarray(end)
    count = np.bincount(pair, minlength=labels**2)
    total = np.zeros((labels**2, values.shape[1]))
    np.add.at(total, pair, values)
    seen = np.flatnonzero(count)
    means = total / np.maximum(count, 1)[:, None]
    which = np.eye(labels)
    design = np.concatenate([np.repeat(which, labels, 0), np.tile(which, (labels, 1))], axis=1)
    additive = design @ np.linalg.lstsq(design[seen], means[seen], rcond=None)[0]
    return np.where(count[:, None] > 0, means, additive).reshape(labels, labels, -1)


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
