"""The expression network of Seo and Luo 2021: an LSTM that says how far each landmark moves in the next frame.

One network per expression; it knows no label. Trained on what comes next in real sequences, it makes new ones by
reading its own output. A *step* is the displacement of the landmarks from one frame to the next, a *curve* the sum
of steps: the displacement from the first frame. Both are unitless (divided by the norm of the neutral landmarks, see
`facejax.data.motions`), arrays are (..., T, L, 3). Batches are taken whole: a vmap of single sequences is slower.

The start is the paper's two ways: "zero", the first input is a zero vector (its Fig. 3) and the outcome is one curve
for everybody; or "neutral", the first input is the neutral landmarks (its 4.2), and everybody moves in a way of their
own.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from facejax.models import lstm

STARTS = ("zero", "neutral")
RETURN_FRACTION, QUIET_STEPS = 0.3, 5  # an expression is over when it has come back so far, and been quiet for so many frames


class Config(NamedTuple):
    """Sizes, all static; the paper's, with its 83 landmarks replaced by ours."""

    landmarks: int = 68
    hidden: int = 128
    layers: int = 3
    start: str = "zero"
    carry: float = 0.5  # times the last step is added to the network's output; 0 in the paper
    components: int | None = None  # principal components of the steps in place of coordinates


class Scale(NamedTuple):
    """Normalisation measured on the training set; never trained."""

    step: jax.Array  # () root mean square of a coordinate of the moving steps
    neutral_mean: jax.Array  # (L, 3)
    neutral_std: jax.Array  # ()
    carry: jax.Array  # () of the last step, see `Config`
    basis: jax.Array | None  # (3 L, C) orthonormal columns, or None: no PCA


class ExpressionLSTM(NamedTuple):
    """The constants, and the weights that are trained (`facejax.models.lstm`)."""

    scale: Scale
    weights: lstm.Weights


def init(key: jax.Array, scale: Scale, *, config: Config = Config()) -> ExpressionLSTM:
    """Random weights whose predictions nearly stand still. Raises `ValueError` for sizes that do not fit the scale."""
    expected = (config.landmarks, 3)
    if scale.neutral_mean.shape != expected:
        raise ValueError(f"scale: expected neutral_mean {expected}, got {scale.neutral_mean.shape}")
    size = 3 * config.landmarks if scale.basis is None else scale.basis.shape[1]
    return ExpressionLSTM(scale, lstm.init(key, size, hidden=config.hidden, layers=config.layers))


def measure(steps: np.ndarray, mask: np.ndarray, neutral: np.ndarray, *, config: Config = Config()) -> Scale:
    """The scale of a training set: steps (K, f, L, 3) with mask (K, f), neutral landmarks (K, L, 3).

    Raises `ValueError` for an unknown start, a component count out of range, or PCA with the start "neutral", whose
    landmarks the components of steps do not span.
    """
    if config.start not in STARTS:
        raise ValueError(f"start: expected one of {', '.join(STARTS)}, got {config.start!r}")
    moved = np.asarray(steps, np.float64)[mask].reshape(-1, 3 * config.landmarks)
    basis = None
    if config.components is not None:
        if not 1 <= config.components <= moved.shape[1]:
            raise ValueError(f"components: expected 1 to {moved.shape[1]}, got {config.components}")
        if config.start == "neutral":
            raise ValueError('components: PCA of the steps needs the start "zero"; neutral landmarks are no steps')
        # Not centred: a face that stands still is the origin, and stays it.
        basis = np.linalg.eigh(moved.T @ moved)[1][:, ::-1][:, : config.components]
    root_mean_square = max(np.sqrt(np.mean(moved**2)), 1e-12)
    about = neutral - neutral.mean(axis=0)
    leaves = (root_mean_square, neutral.mean(axis=0), max(np.sqrt(np.mean(about**2)), 1e-12), config.carry)
    scale = [jnp.asarray(leaf, jnp.float32) for leaf in leaves]
    return Scale(*scale, None if basis is None else jnp.asarray(basis, jnp.float32))


@jax.jit
def predict(params: ExpressionLSTM, steps: jax.Array, neutral: jax.Array | None = None) -> jax.Array:
    """The step that follows each of the true steps (..., T, L, 3), as (..., T, L, 3): teacher forcing.

    The first of `steps` is the zero of a block (`facejax.data.sequences.block`). `neutral` (..., L, 3) takes its
    place; give it to networks that were trained to start from it, and to no others.
    """
    _check(params, steps, "steps")
    x, base = _encode(params, steps, neutral)
    return _decode(params, base + _side_by_side(partial(lstm.forward, params.weights), x))


@jax.jit
def predict_scheduled(
    params: ExpressionLSTM, steps: jax.Array, given: jax.Array, neutral: jax.Array | None = None
) -> jax.Array:
    """As `predict`, but where `given` (..., T) is false the network reads its own last prediction.

    The first step is always given. Gradients run through what was fed back.
    """
    _check(params, steps, "steps")
    x, base = _encode(params, steps, neutral)
    given = jnp.broadcast_to(jnp.asarray(given).at[..., 0].set(True), x.shape[:-1])
    carry = jax.lax.stop_gradient(params.scale.carry)

    def inside(x, base, given):
        return lstm.forward_scheduled(params.weights, x, given[..., 0], base, carry)

    return _decode(params, _side_by_side(inside, x, base, given[..., None]))


@partial(jax.jit, static_argnames="frames")
def generate(
    params: ExpressionLSTM,
    neutral: jax.Array | None = None,
    prefix: jax.Array | None = None,
    *,
    frames: int,
    stop: float = 0.0,
) -> jax.Array:
    """A curve (..., frames, L, 3) that starts at 0, made by the network that reads its own output.

    `neutral` (..., L, 3) as in `predict`. `prefix` (..., P, L, 3) is the beginning of a true curve, its first frame
    included: it is read, kept, and gone on from. With `stop` the face stands still from where `expression_length` finds the
    expression to be over; 0 never stops.
    """
    shape = params.scale.neutral_mean.shape
    lead = neutral.shape[:-2] if neutral is not None else prefix.shape[:-3] if prefix is not None else ()
    known = 1 if prefix is None else prefix.shape[-3]
    if frames < 2 or known > frames or known < 1:
        raise ValueError(f"frames: expected 2 or more, and {known} for the prefix; got {frames}")
    steps = jnp.zeros((*lead, frames - 1, *shape))
    if prefix is not None:
        _check(params, prefix, "prefix")
        # Entry t holds the step that led to frame t, as in a training block.
        steps = steps.at[..., 1:known, :, :].set(jnp.diff(prefix, axis=-3)[..., : frames - 2, :, :])
    made = predict_scheduled(params, steps, jnp.arange(frames - 1) < known, neutral)
    if prefix is not None:
        made = made.at[..., : known - 1, :, :].set(jnp.diff(prefix, axis=-3))
    curve = jnp.cumsum(jnp.concatenate([jnp.zeros((*lead, 1, *shape)), made], axis=-3), axis=-3)
    last = jnp.where(stop > 0, expression_length(curve, fraction=stop), frames) - 1
    place = jnp.minimum(jnp.arange(frames), last[..., None])
    return jnp.take_along_axis(curve, place[..., None, None], axis=-3)


@jax.jit
def expression_length(curve: jax.Array, *, fraction: float = 0.01) -> jax.Array:
    """How many frames (...) of curves (..., T, L, 3) belong to the expression; T where it is not over.

    It is over at the first frame that is nearer to the start than 0.3 of the farthest one before it, and from which
    on 5 steps have an energy (sum of squares) below `fraction` of the greatest so far. Without the way home a held
    apex, as quiet, would end it.
    """
    energy = jnp.sum(jnp.diff(curve, axis=-3) ** 2, axis=(-2, -1))
    away = jnp.sqrt(jnp.sum((curve - curve[..., :1, :, :]) ** 2, axis=(-2, -1)))
    home = away <= RETURN_FRACTION * jax.lax.cummax(away, axis=away.ndim - 1)
    top = jax.lax.cummax(energy, axis=energy.ndim - 1)
    loud = (energy > fraction * top) | (top == 0)
    # Loud frames within the next QUIET steps; past the end of the curve nothing is known, so nothing ends there.
    ahead = jnp.concatenate([loud, jnp.ones((*loud.shape[:-1], QUIET_STEPS), bool)], axis=-1)
    busy = sum(ahead[..., i : i + loud.shape[-1]].astype(jnp.int32) for i in range(QUIET_STEPS))
    over = home[..., :-1] & (busy == 0)
    return jnp.where(jnp.any(over, axis=-1), jnp.argmax(over, axis=-1) + 1, curve.shape[-3])


def _encode(params: ExpressionLSTM, steps: jax.Array, neutral: jax.Array | None) -> tuple[jax.Array, jax.Array]:
    """Steps (..., T, L, 3) as the network's numbers (..., T, D), the neutral landmarks in place of the first; and what
    its outputs are added to, the steps or nothing."""
    scale = jax.lax.stop_gradient(params.scale)
    x = (steps / scale.step).reshape(*steps.shape[:-2], -1)
    if scale.basis is not None:
        x = x @ scale.basis
    base = scale.carry * x
    if neutral is not None:
        _check(params, neutral[..., None, :, :], "neutral")
        first = ((neutral - scale.neutral_mean) / scale.neutral_std).reshape(*neutral.shape[:-2], -1)
        x, base = x.at[..., 0, :].set(first), base.at[..., 0, :].set(0)
    return x, base


def _decode(params: ExpressionLSTM, y: jax.Array) -> jax.Array:
    scale = jax.lax.stop_gradient(params.scale)
    if scale.basis is not None:
        y = y @ scale.basis.T
    return scale.step * y.reshape(*y.shape[:-1], *scale.neutral_mean.shape)


def _side_by_side(function, *arrays: jax.Array) -> jax.Array:
    """Call a function of (T, B, .) arrays with (..., T, .) ones."""
    lead = arrays[0].shape[:-2]
    flat = [jnp.swapaxes(x.reshape(-1, *x.shape[len(lead) :]), 0, 1) for x in arrays]
    out = jnp.swapaxes(function(*flat), 0, 1)
    return out.reshape(*lead, *out.shape[1:])


def _check(params: ExpressionLSTM, steps: jax.Array, name: str) -> None:
    expected = params.scale.neutral_mean.shape
    if steps.ndim < 3 or steps.shape[-2:] != expected:
        raise ValueError(f"{name}: expected (..., T, {expected[0]}, 3), got {steps.shape}")
