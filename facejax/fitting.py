"""Training composed: a dataset in, parameters out. The two networks are trained apart, as OT23 4.1 does.

Both functions keep their run in a folder (metrics, checkpoints) and go on from there when called again.
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

from facejax import journal, losses, steps, training
from facejax.data import motions, store
from facejax.data.meshes import Meshes
from facejax.geometry import sphere, srvf
from facejax.mesh.topology import Hierarchy
from facejax.models import charts, decoder, motion

PER_PAIR = 48  # interpolated transitions of each ordered pair: with 12 labels about the 6,740 of OT23


class MotionPlan(NamedTuple):
    """How Motion3DGAN is trained; OT23's figures where it gives them."""

    steps: int = 15_000
    batch: int = 128
    critic_steps: int = 4
    rate: float = 5e-4  # decays along a cosine, to 5 %
    penalty: float = 10.0
    reconstruction: float = 0.0  # alpha_2 of OT23 (10 there): it narrows the spread within a label pair
    length: float = 0.0  # weight of |log-length error|, which goes with it
    decay: float = 0.999  # of the generator's moving average


class DecoderPlan(NamedTuple):
    """How S2D-Dec is trained."""

    steps: int = 12_000
    batch: int = 16
    rate: float = 1e-3  # decays to zero along a cosine (OT23: x 0.99 per epoch, for 300 epochs)
    weight_decay: float = 5e-5
    beta1: float = 1.0
    beta2: float = 0.1
    reduction: str = "paper"
    weighting: str = "linear"


def transitions(data: store.Store, split: str, *, per_pair: int = PER_PAIR, reuse: int | None = 1) -> motions.Motions:
    """What Motion3DGAN learns: halves, and peak -> peak transitions between every two expressions."""
    halves = motions.halves(data, split)
    onsets = halves.take(halves.start == 0)
    between = motions.interpolated(onsets, len(data.labels), per_pair=per_pair, reuse=reuse)
    return motions.join(halves, between)


def fit_motion(
    examples: motions.Motions,
    folder: str | os.PathLike,
    *,
    labels: int,
    plan: MotionPlan = MotionPlan(),
    config: motion.Config = motion.Config(),
    seed: int = 0,
) -> motion.Params:
    """Train the generator against its critic; returns the moving average of the generator."""
    config = config._replace(labels=labels, steps=examples.curves.shape[1] - 1, landmarks=examples.curves.shape[2])
    chart, values = chart_of(examples, config)
    digest = hashlib.sha256(np.ascontiguousarray(examples.curves)).hexdigest()
    journal.claim(folder, {"plan": plan._asdict(), "config": config._asdict(), "seed": seed, "motions": digest})
    generator_key, critic_key, play_key = jax.random.split(jax.random.key(seed), 3)
    players = steps.Players(
        motion.generator.init(generator_key, chart, config=config).weights,
        motion.critic.init(critic_key, chart, config=config).weights,
    )
    optimisers = steps.Players(
        *(
            optax.adam(optax.cosine_decay_schedule(plan.rate, plan.steps * count, alpha=0.05), 0.5, 0.9)
            for count in (1, plan.critic_steps)
        )
    )
    step = steps.adversarial(
        lambda weights, chart, key, pair: motion.generator.inner(
            motion.Params(chart, weights), jax.random.normal(key, (config.noise,)), *pair
        ),
        lambda weights, chart, values, pair: motion.critic.inner(motion.Params(chart, weights), values, *pair),
        optimisers,
        critic_steps=plan.critic_steps,
        penalty=plan.penalty,
        terms=_reconstruction(plan) if plan.reconstruction or plan.length else None,
        decay=plan.decay,
    )
    indices = training.epoch_indices(seed, len(values), plan.batch * plan.critic_steps)
    held = ((values, (jnp.asarray(examples.start), jnp.asarray(examples.end))), chart)
    state = training.run(
        training.gathered(step),
        steps.start_adversarial(players, optimisers, play_key),
        indices,
        folder,
        steps=plan.steps,
        constants=held,
    )
    return motion.Params(chart, state.extra)


def chart_of(examples: motions.Motions, config: motion.Config) -> tuple[charts.Chart, jax.Array]:
    """The chart of a training set, and the motions' coordinates in it (K, R + 1)."""
    q, log_length = srvf.encode(jnp.asarray(examples.curves))
    p = sphere.karcher_mean(q)
    tangents = sphere.log(p, q)
    chart = charts.fit(
        np.asarray(p), np.asarray(tangents), np.asarray(log_length), examples.start, examples.end,
        labels=config.labels, rank=config.rank,
    )  # fmt: skip
    pairs = (jnp.asarray(examples.start), jnp.asarray(examples.end))
    return chart, jax.vmap(charts.coordinates, (None, 0, 0, 0, 0))(chart, tangents, log_length, *pairs)


def fit_decoder(
    meshes: Meshes,
    hierarchy: Hierarchy,
    folder: str | os.PathLike,
    *,
    plan: DecoderPlan = DecoderPlan(),
    seed: int = 0,
) -> decoder.Params:
    """Train S2D-Dec on meshes; they are read from disk batch by batch, never held whole."""
    data = meshes.data
    chosen = hashlib.sha256(meshes.at.tobytes()).hexdigest()
    journal.claim(folder, {"plan": plan._asdict(), "seed": seed, "dataset": data.index["spec"], "meshes": chosen})
    template = np.asarray(data.neutral[np.unique(meshes.owner)], np.float64).mean(axis=0)
    weights = losses.landmark_weights(
        jnp.asarray(template, jnp.float32), jnp.asarray(data.landmark_index), mode=plan.weighting,
        edge_length=_edge_length(template, data.faces),
    )  # fmt: skip
    init_key, run_key = jax.random.split(jax.random.key(seed))
    scale = decoder.measure(meshes)
    params = decoder.init(init_key, hierarchy, landmarks=len(data.landmark_index), scale=scale)

    def loss(trained, key, batch, constants):
        scale, hierarchy, weights = constants
        marks, target = batch
        predicted = decoder.apply(decoder.Params(scale, trained), hierarchy, marks)
        value = losses.s2d(predicted, target, weights, beta1=plan.beta1, beta2=plan.beta2, reduction=plan.reduction)
        # The distance is for the journal alone: its gradient at a vertex that is met exactly would be NaN.
        distance = jnp.linalg.norm(jax.lax.stop_gradient(predicted - target), axis=-1)
        return value, {"error_mm": jnp.mean(distance)}

    optimiser = optax.adamw(optax.cosine_decay_schedule(plan.rate, plan.steps), weight_decay=plan.weight_decay)
    state = training.run(
        steps.supervised(loss, optimiser),
        steps.start_supervised(params.weights, optimiser, run_key),
        mesh_batches(meshes, plan.batch, seed),
        folder,
        steps=plan.steps,
        constants=(scale, jax.device_put(hierarchy), weights),
        chunk=50,
    )
    return decoder.Params(scale, state.params)


def mesh_batches(meshes: Meshes, batch: int, seed: int) -> Callable[[int, int], tuple[np.ndarray, np.ndarray]]:
    """`batches(first, count)`: landmarks (count, B, L, 3) and vertices (count, B, N, 3), read as they are needed."""
    indices = training.epoch_indices(seed, meshes.count, batch)

    def batches(first: int, count: int) -> tuple[np.ndarray, np.ndarray]:
        found = meshes.read(indices(first, count).ravel())
        return tuple(x.reshape(count, batch, *x.shape[1:]) for x in found)

    return batches


def _reconstruction(plan: MotionPlan) -> Callable:
    def terms(chart, fake, real, pair):
        # Equation 6 on tangent vectors; the coordinates expand linearly, so their difference does.
        difference = jnp.tensordot(fake[:, 1:] - real[:, 1:], chart.basis, 1)
        length = chart.length_std * jnp.mean(jnp.abs(fake[:, 0] - real[:, 0]))
        return {
            "reconstruction": plan.reconstruction * jnp.mean(jnp.abs(difference)),
            "length": plan.length * length,
        }

    return terms


def _edge_length(vertices: np.ndarray, faces: np.ndarray) -> float:
    ends = vertices[np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])]
    return float(np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1).mean())
