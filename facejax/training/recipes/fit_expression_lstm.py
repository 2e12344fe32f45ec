"""Fit the expression networks of Seo and Luo 2021 to recordings, one network per expression.

All networks are trained in one vectorised step, with the same result as each alone. A run keeps metrics and checkpoints
in a folder and resumes from them.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.typing import ArrayLike

from facejax import losses
from facejax.data import sequences
from facejax.models import expression_lstm, lstm
from facejax.training import loop, metric_logger, steps

FEEDS = ("truth", "coin", "switch")


class ExpressionPlan(NamedTuple):
    """Training options of the expression networks.

    `feed` selects the inputs in training. "truth": the recorded steps (teacher forcing, as in the paper). "coin": at
    each frame the network's own last output with a probability that grows to one (scheduled sampling, Bengio et al.
    2015). "switch": recorded steps up to some frame and own output from there on, as in generation; half of the time
    from the first frame, else from a frame in the first half of the block; for a share of sequences that grows to all.
    """

    steps: int = 3_000
    batch: int = 5
    rate: float = 1e-3  # of Adam
    final_rate: float = 0.0  # share of the rate at the end of a cosine decay; 1: constant
    feed: str = "switch"
    ramp: float = 0.5  # share of the run after which "coin" and "switch" apply fully
    noise: float = 0.0  # added to the inputs, in root mean squares of a step
    next_step: float = 0.3  # weights of the losses, see `facejax.losses`
    path: float = 1.0
    energy: float = 10.0  # of sequences generated from the first frame


# Learning rate, batch and loss as published; the number of steps stands in for the paper's number of epochs.
PAPER = ExpressionPlan(steps=10_000, final_rate=1.0, feed="truth", next_step=1.0, path=0.0, energy=0.0)


def fit(
    data: sequences.Sequences,
    folder: str | os.PathLike[str],
    *,
    labels: dict[str, int],
    plan: ExpressionPlan = ExpressionPlan(),
    config: expression_lstm.Config = expression_lstm.Config(),
    frames: int | None = None,
    masked: bool = True,
    seed: int = 0,
) -> expression_lstm.ExpressionLSTM:
    """Train one network per label; returns stacked parameters, (E, ...).

    Args:
      labels: name -> number in `data.label`.
      frames, masked: as in `sequences.block`; a network's result does not depend on the other networks for equal
        `frames`.

    Raises:
      ValueError: a label without recordings, or an unknown feed.
    """
    if plan.feed not in FEEDS:
        raise ValueError(f"feed: expected one of {', '.join(FEEDS)}, got {plan.feed!r}")
    config = config._replace(landmarks=data.curves.shape[2])
    rows = {name: np.flatnonzero(data.label == number) for name, number in labels.items()}
    for name, found in rows.items():
        if not len(found):
            raise ValueError(f"labels: there is no recording of {name!r} to train on")
    block = sequences.block(data, frames=frames, masked=masked)
    _claim(folder, data, block, labels, plan, config, seed)
    scales, weights, strengths = [], [], []
    for name, number in labels.items():
        mine = [field[rows[name]] for field in block]
        scale = expression_lstm.measure(mine[1], mine[2], mine[3], config=config)
        key = jax.random.fold_in(jax.random.key(seed), number)
        scales.append(scale)
        strengths.append(losses.step_energy(jnp.asarray(mine[1]) / scale.step, jnp.asarray(mine[2])))
        weights.append(expression_lstm.init(key, scale, config=config).weights)
    scale, weights = (jax.tree.map(lambda *leaves: jnp.stack(leaves), *parts) for parts in (scales, weights))
    rate = optax.cosine_decay_schedule(plan.rate, plan.steps, alpha=plan.final_rate)
    optimiser = optax.adam(rate)
    step = steps.vectorize_models(
        steps.supervised(_loss(plan, config), optimiser), tuple(labels), np.array(list(labels.values()), np.int32)
    )
    state = loop.run(
        step,
        steps.init_vectorized_models(weights, optimiser, jax.random.key(seed + 1)),
        _batches(rows, labels, plan.batch, seed),
        folder,
        steps=plan.steps,
        constants=((scale, jnp.stack(strengths)), jax.device_put(block)),
    )
    return expression_lstm.ExpressionLSTM(scale, state.params)


def network(params: expression_lstm.ExpressionLSTM, number: int) -> expression_lstm.ExpressionLSTM:
    """Return one of the stacked networks."""
    return jax.tree.map(lambda leaf: leaf[number], params)


def _batches(
    rows: dict[str, np.ndarray], labels: dict[str, int], batch: int, seed: int
) -> Callable[[int, int], tuple[np.ndarray, np.ndarray]]:
    """Return `batches(first, count)`: (steps done (count, E), rows of the block (count, E, B))."""
    orders = {name: loop.epoch_indices(1000 * seed + labels[name], len(rows[name]), batch) for name in labels}

    def batches(first: int, count: int) -> tuple[np.ndarray, np.ndarray]:
        chosen = np.stack([rows[name][orders[name](first, count)] for name in labels], axis=1)
        done = np.arange(first, first + count, dtype=np.float32)
        return np.repeat(done[:, None], len(labels), axis=1), chosen

    return batches


def _loss(plan: ExpressionPlan, config: expression_lstm.Config) -> steps.Loss:
    def loss(
        weights: lstm.Weights, key: jax.Array, batch: loop.Tree, constants: loop.Tree
    ) -> tuple[ArrayLike, loop.Metrics]:
        (done, which), ((scale, strength), block) = batch, constants
        inputs, target, mask, neutral = (field[which] for field in block)
        noise_key, feed_key = jax.random.split(key)
        if plan.noise:
            inputs = inputs + plan.noise * scale.step * jax.random.normal(noise_key, inputs.shape)
        params = expression_lstm.ExpressionLSTM(scale, weights)
        first = neutral if config.start == "neutral" else None
        if plan.feed == "truth":
            given = jnp.ones(mask.shape, bool)
            made = expression_lstm.predict(params, inputs, first)
        else:
            given = _given(feed_key, mask.shape, jnp.clip(done / (plan.ramp * plan.steps), 0, 1), plan.feed)
            made = expression_lstm.predict_scheduled(params, inputs, given, first)
        made, target = made / scale.step, target / scale.step
        # Only sequences generated from the first frame: after given steps the outcome is determined by them.
        alone = mask & ~jnp.any(given[:, 1:], axis=1, keepdims=True)
        terms = {
            "next_step": plan.next_step * losses.next_step(made, target, mask),
            "path": plan.path * losses.path_distance(made, target, mask),
            "energy": plan.energy * losses.energy_ratio(made, alone, strength),
        }
        return sum(terms.values()), terms

    return loss


def _given(key: jax.Array, shape: tuple[int, int], share: jax.Array, feed: str) -> jax.Array:
    """Return which inputs are recorded steps, (B, f) bool, with a `share` of own outputs."""
    if feed == "coin":
        return jax.random.uniform(key, shape) >= share
    own_key, frame_key, start_key = jax.random.split(key, 3)
    count, size = shape
    frame = jax.random.randint(frame_key, (count, 1), 1, max(size // 2, 2))
    frame = jnp.where(jax.random.bernoulli(start_key, 0.5, (count, 1)), 1, frame)
    frame = jnp.where(jax.random.uniform(own_key, (count, 1)) < share, frame, size)
    return jnp.arange(size) < frame


def _claim(
    folder: str | os.PathLike[str],
    data: sequences.Sequences,
    block: sequences.Block,
    labels: dict[str, int],
    plan: ExpressionPlan,
    config: expression_lstm.Config,
    seed: int,
) -> None:
    arrays = (block.targets, block.mask, block.neutral, data.label)
    digest = hashlib.sha256(b"".join(np.ascontiguousarray(a).tobytes() for a in arrays)).hexdigest()
    what = {"plan": plan._asdict(), "config": config._asdict(), "labels": labels, "seed": seed, "recordings": digest}
    metric_logger.claim_folder(folder, what)
