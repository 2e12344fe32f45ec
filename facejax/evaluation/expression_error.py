"""Landmark errors of expression networks in millimetres, on faces that they were not trained on.

F frames, L landmarks.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from facejax.data import sequences
from facejax.models import expression_lstm


class MeanSequence(NamedTuple):
    """The mean over training recordings of one expression, frame by frame; unitless."""

    curve: np.ndarray  # (F, L, 3); shorter recordings are extended by their last frame
    steps: np.ndarray  # (F - 1, L, 3)


def mean_sequence(train: sequences.Sequences, frames: int) -> MeanSequence:
    """Return the mean of recordings over the first `frames` frames."""
    curve = sequences.extend(train, frames).curves[:, :frames].mean(axis=0)
    return MeanSequence(curve, np.diff(curve, axis=0))


def expression_scores(
    params: expression_lstm.ExpressionLSTM,
    held_out: sequences.Sequences,
    train: sequences.Sequences,
    *,
    start: str,
    prefix: int = 10,
) -> dict[str, float]:
    """Return errors of one expression's network on held-out faces, in mm, beside those of baselines without a network.

    `next_*`: error of the next frame, given all previous frames. `rest_*`: of the frames after the first `prefix`,
    given those. `whole_*`: of all frames, given the neutral face. Means over the frames of each sequence, then over
    sequences. `energy` (mean squared step) and `acceleration` (mean norm of second differences) of the motion generated
    from the neutral face, as ratios to those of the recordings in the same frames.
    """
    frames = held_out.curves.shape[1]
    mean = mean_sequence(train, frames)
    truth, scale, count = held_out.curves, held_out.scale, held_out.frames
    neutral = jnp.asarray(held_out.neutral) if start == "neutral" else None

    def error(curves: np.ndarray | jax.Array, first: int = 0) -> float:
        distance = np.linalg.norm(np.asarray(curves) - truth, axis=-1).mean(axis=-1) * scale[:, None]
        return float(np.mean([row[first:end].mean() for row, end in zip(distance, count, strict=True)]))

    steps = np.diff(truth, axis=1)
    known = np.concatenate([np.zeros_like(steps[:, :1]), steps[:, :-1]], axis=1)
    before = truth[:, :-1]

    def after(following: np.ndarray | jax.Array) -> np.ndarray:
        return np.concatenate([truth[:, :1], before + np.asarray(following)], axis=1)

    current, velocity = truth[:, prefix - 1 : prefix], steps[:, prefix - 2 : prefix - 1]
    ahead = np.arange(frames)[:, None, None] - (prefix - 1)
    free = np.broadcast_to(np.asarray(expression_lstm.generate(params, neutral, frames=frames)), truth.shape)
    continued = expression_lstm.generate(params, neutral, jnp.asarray(truth[:, :prefix]), frames=frames)

    def ratio_to_real(curves: np.ndarray, order: int) -> float:
        """Return mean squared steps (order 1) or mean norms of second differences (2), as ratios."""

        def strength(rows: np.ndarray) -> np.floating:
            # In NumPy: every sequence has its own length, for which a jitted function would compile again.
            changes = (
                np.linalg.norm(np.diff(row[:end] * mm, n=order, axis=0), axis=-1)
                for row, mm, end in zip(rows, scale, count, strict=True)
            )
            return np.mean([np.mean(change**2 if order == 1 else change) for change in changes])

        return float(strength(curves) / strength(truth))

    mean_curves = np.broadcast_to(mean.curve, truth.shape)
    return {
        "next_network": error(after(expression_lstm.predict(params, known, neutral)), 1),
        "next_velocity": error(after(known), 1),
        "next_mean": error(after(np.broadcast_to(mean.steps, steps.shape)), 1),
        "rest_network": error(continued, prefix),
        "rest_velocity": error(current + ahead * velocity, prefix),
        "rest_mean": error(mean_curves, prefix),
        "rest_mean_steps": error(mean.curve + current - mean.curve[prefix - 1], prefix),
        "whole_network": error(free),
        "whole_mean": error(mean_curves),
        "energy": ratio_to_real(free, 1),
        "energy_mean": ratio_to_real(mean_curves, 1),
        "acceleration": ratio_to_real(free, 2),
        "acceleration_mean": ratio_to_real(mean_curves, 2),
    }
