"""The expression network of Seo and Luo 2021: an LSTM that predicts how far each landmark moves in the next frame.

One network per expression, without a label input. Trained by next-step prediction on recorded sequences, it generates
new ones by feeding back its own output. A *step* is the displacement of the landmarks between two frames; a *curve* is
the cumulative sum of steps, the displacement from the first frame. Both are unitless (divided by the norm of the
neutral landmarks, see `facejax.data.motions`); arrays are (..., T, L, 3). Pass whole batches: a vmap of single
sequences is slower.

Generation starts in one of the paper's two ways: "zero", the first input is a zero vector (its Fig. 3), and everybody
gets the same curve; or "neutral", the first input is the neutral landmarks (its 4.2), and curves differ between people.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Real

from facejax.models import lstm, pca

STARTS = ("zero", "neutral")
# An expression ends when its amplitude is below this fraction of the peak and it is still for this many frames.
RETURN_FRACTION, QUIET_STEPS = 0.3, 5


class Config(NamedTuple):
    """Sizes, all static; the paper's, with 68 landmarks in place of its 83."""

    landmarks: int = 68
    hidden: int = 128
    layers: int = 3
    start: str = "zero"
    carry: float = 0.5  # share of the last step that is added to the output; 0 in the paper
    components: int | None = None  # principal components of the steps in place of coordinates


class Scale(NamedTuple):
    """Normalisation measured on the training set; constant during training."""

    step: Array  # () root mean square of a coordinate of the moving steps
    neutral_mean: Array  # (L, 3)
    neutral_std: Array  # ()
    carry: Array  # () of the last step, see `Config`
    basis: Array | None  # (3 L, C) orthonormal columns, or None: no PCA


class ExpressionLSTM(NamedTuple):
    """Parameters: the normalisation and the trained weights (`facejax.models.lstm`)."""

    scale: Scale
    weights: lstm.Weights


def init(key: Array, scale: Scale, *, config: Config = Config()) -> ExpressionLSTM:
    """Return random parameters whose predictions are close to zero motion.

    Raises:
      ValueError: `config.landmarks` does not match the scale.
    """
    expected = (config.landmarks, 3)
    if scale.neutral_mean.shape != expected:
        raise ValueError(f"scale: expected neutral_mean {expected}, got {scale.neutral_mean.shape}")
    size = 3 * config.landmarks if scale.basis is None else scale.basis.shape[1]
    return ExpressionLSTM(scale, lstm.init(key, size, hidden=config.hidden, layers=config.layers))


def measure(
    steps: Float[np.ndarray, "K f L 3"],
    mask: Bool[np.ndarray, "K f"],
    neutral: Float[np.ndarray, "K L 3"],
    *,
    config: Config = Config(),
) -> Scale:
    """Measure the normalisation of a training set of masked steps and neutral landmarks.

    Raises:
      ValueError: an unknown start, a number of components out of range, or PCA with the start "neutral", whose
        landmarks are not in the span of the steps' components.
    """
    if config.start not in STARTS:
        raise ValueError(f"start: expected one of {', '.join(STARTS)}, got {config.start!r}")
    moved = np.asarray(steps, np.float64)[mask].reshape(-1, 3 * config.landmarks)
    basis = None
    if config.components is not None:
        if not 1 <= config.components <= moved.shape[1]:
            raise ValueError(f"components: expected 1 to {moved.shape[1]}, got {config.components}")
        if config.start == "neutral":
            raise ValueError('components: PCA of the steps requires the start "zero", got "neutral"')
        # Not centred, so that zero motion stays the origin.
        basis = pca.from_covariance(moved.T @ moved)[1][:, : config.components]
    root_mean_square = max(np.sqrt(np.mean(moved**2)), 1e-12)
    about = neutral - neutral.mean(axis=0)
    neutral_std = max(np.sqrt(np.mean(about**2)), 1e-12)
    return Scale(
        jnp.asarray(root_mean_square, jnp.float32),
        jnp.asarray(neutral.mean(axis=0), jnp.float32),
        jnp.asarray(neutral_std, jnp.float32),
        jnp.asarray(config.carry, jnp.float32),
        None if basis is None else jnp.asarray(basis, jnp.float32),
    )


@jax.jit
def predict(
    params: ExpressionLSTM,
    steps: Float[Array | np.ndarray, "... T L 3"],
    neutral: Float[Array | np.ndarray, "... _ 3"] | None = None,  # not L: another number gets the error of `_check`
) -> Float[Array, "... T L 3"]:
    """Predict the step that follows each of the recorded steps (teacher forcing).

    The first of `steps` is the zero of a block (`facejax.data.sequences.block`). `neutral` replaces it; pass it to
    networks that were trained with the start "neutral", and to no others.

    Raises:
      ValueError: wrong shapes.
    """
    _check(params, steps, "steps")
    x, base = _encode(params, steps, neutral)
    return _decode(params, base + _time_major(partial(lstm.forward, params.weights), x))


@jax.jit
def predict_scheduled(
    params: ExpressionLSTM,
    steps: Float[Array | np.ndarray, "... T L 3"],
    given: Bool[Array | np.ndarray, "... T"],
    neutral: Float[Array | np.ndarray, "... _ 3"] | None = None,
) -> Float[Array, "... T L 3"]:
    """Predict as `predict`, but feed back the last prediction where `given` (..., T) is false (scheduled sampling).

    The first step is always given. Gradients flow through the predictions that are fed back.
    """
    _check(params, steps, "steps")
    x, base = _encode(params, steps, neutral)
    given = jnp.broadcast_to(given | (jnp.arange(x.shape[-2]) == 0), x.shape[:-1])
    carry = jax.lax.stop_gradient(params.scale.carry)

    def inside(x: Array, base: Array, given: Array) -> Array:
        return lstm.forward_scheduled(params.weights, x, given[..., 0], base, carry)

    return _decode(params, _time_major(inside, x, base, given[..., None]))


@partial(jax.jit, static_argnames="frames")
def generate(
    params: ExpressionLSTM,
    neutral: Float[Array | np.ndarray, "... L 3"] | None = None,
    prefix: Float[Array | np.ndarray, "... P L 3"] | None = None,
    *,
    frames: int,
    stop: float | Real[Array, ""] = 0.0,
) -> Float[Array, "... frames L 3"]:
    """Generate a curve that starts at 0, by feeding the network's output back.

    Args:
      neutral: as in `predict`.
      prefix: the beginning of a recorded curve, first frame included, which the curve repeats and continues.
      stop: if positive, hold the last pose from `expression_length(curve, fraction=stop)` on.

    Raises:
      ValueError: wrong shapes, or `frames` below 2 or shorter than the prefix.
    """
    shape = params.scale.neutral_mean.shape
    lead = neutral.shape[:-2] if neutral is not None else prefix.shape[:-3] if prefix is not None else ()
    known = 1 if prefix is None else prefix.shape[-3]
    if frames < 2 or known > frames or known < 1:
        raise ValueError(f"frames: expected 2 or more, and {known} for the prefix; got {frames}")
    curve = jnp.zeros((*lead, frames, *shape), params.scale.neutral_mean.dtype)
    if prefix is not None:
        _check(params, prefix, "prefix")
        curve = curve.at[..., :known, :, :].set(prefix)
    return continue_curve(params, curve, known, neutral, stop=stop)


@jax.jit
def continue_curve(
    params: ExpressionLSTM,
    curve: Float[Array | np.ndarray, "... T L 3"],
    known: int | Int[Array | np.ndarray, ""],
    neutral: Float[Array | np.ndarray, "... L 3"] | None = None,
    *,
    stop: float | Real[Array, ""] | None = None,
) -> Float[Array, "... T L 3"]:
    """Continue the first `known` frames (1 or more) of a curve to its length; its other frames are not read.

    `generate` for arrays: neither the length nor `known` is static. `neutral` and `stop` as there; None is 0.

    Raises:
      ValueError: wrong shapes.
    """
    _check(params, curve, "curve")
    frames = curve.shape[-3]
    time = jnp.arange(frames - 1)[:, None, None]
    given = jnp.where(time < known - 1, jnp.diff(jnp.asarray(curve), axis=-3), 0)
    # Entry t holds the step that led to frame t, as in a training block.
    steps = jnp.concatenate([jnp.zeros_like(jnp.asarray(curve)[..., :1, :, :]), given], axis=-3)[..., :-1, :, :]
    made = predict_scheduled(params, steps, jnp.arange(frames - 1) < known, neutral)
    made = jnp.where(time < known - 1, given, made)
    curve = jnp.cumsum(jnp.concatenate([jnp.zeros_like(jnp.asarray(curve)[..., :1, :, :]), made], axis=-3), axis=-3)
    if stop is None:
        return curve
    last = jnp.where(stop > 0, expression_length(curve, fraction=stop), frames) - 1
    place = jnp.minimum(jnp.arange(frames), last[..., None])
    return jnp.take_along_axis(curve, place[..., None, None], axis=-3)


@jax.jit
def expression_length(
    curve: Float[Array | np.ndarray, "... T L 3"], *, fraction: float | Real[Array, ""] = 0.01
) -> Int[Array, "*lead"]:
    """Return the number of frames that belong to the expression; T if it does not end.

    It ends at the first frame whose displacement is at most 0.3 of the largest one before it, and after which 5 steps
    have an energy (sum of squares) below `fraction` of the largest so far. Without the first condition, a held apex,
    which is quiet too, would end it.
    """
    energy = jnp.sum(jnp.diff(curve, axis=-3) ** 2, axis=(-2, -1))
    distance = jnp.sqrt(jnp.sum((curve - curve[..., :1, :, :]) ** 2, axis=(-2, -1)))
    returned = distance <= RETURN_FRACTION * jax.lax.cummax(distance, axis=distance.ndim - 1)
    top = jax.lax.cummax(energy, axis=energy.ndim - 1)
    loud = (energy > fraction * top) | (top == 0)
    # Count loud steps among the next QUIET_STEPS; steps past the end of the curve count as loud.
    ahead = jnp.concatenate([loud, jnp.ones((*loud.shape[:-1], QUIET_STEPS), bool)], axis=-1)
    busy = sum(ahead[..., i : i + loud.shape[-1]].astype(jnp.int32) for i in range(QUIET_STEPS))
    over = returned[..., :-1] & (busy == 0)
    return jnp.where(jnp.any(over, axis=-1), jnp.argmax(over, axis=-1) + 1, curve.shape[-3])


def _encode(
    params: ExpressionLSTM, steps: Array | np.ndarray, neutral: Array | np.ndarray | None
) -> tuple[Array, Array]:
    """Return the network's inputs (..., T, D), the first replaced by neutral landmarks, and the base of its outputs."""
    scale = jax.lax.stop_gradient(params.scale)
    x = jnp.asarray(steps / scale.step).reshape(*steps.shape[:-2], -1)
    if scale.basis is not None:
        x = x @ scale.basis
    base = scale.carry * x
    if neutral is not None:
        _check(params, neutral[..., None, :, :], "neutral")
        first = ((neutral - scale.neutral_mean) / scale.neutral_std).reshape(*neutral.shape[:-2], 1, -1)
        begins = jnp.arange(x.shape[-2])[:, None] == 0
        x, base = jnp.where(begins, first, x), jnp.where(begins, 0, base)
    return x, base


def _decode(params: ExpressionLSTM, y: Array) -> Array:
    scale = jax.lax.stop_gradient(params.scale)
    if scale.basis is not None:
        y = y @ scale.basis.T
    return scale.step * y.reshape(*y.shape[:-1], *scale.neutral_mean.shape)


def _time_major(function: Callable[..., Array], *arrays: Array) -> Array:
    """Call a function of time-major arrays (T, B, .) with arrays (..., T, .)."""
    lead = arrays[0].shape[:-2]
    flat = [jnp.swapaxes(x.reshape(-1, *x.shape[len(lead) :]), 0, 1) for x in arrays]
    out = jnp.swapaxes(function(*flat), 0, 1)
    return out.reshape(*lead, *out.shape[1:])


def _check(params: ExpressionLSTM, steps: Array | np.ndarray, name: str) -> None:
    expected = params.scale.neutral_mean.shape
    if steps.ndim < 3 or steps.shape[-2:] != expected:
        raise ValueError(f"{name}: expected (..., T, {expected[0]}, 3), got {steps.shape}")
