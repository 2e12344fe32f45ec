"""Fit the generators of motion to a dataset.

Three with one interface: Motion3DGAN sized for a CPU, its authors' architecture, and flow matching. All are trained on
the same motions; each run keeps metrics and checkpoints in a folder and resumes from them.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.sharding import Mesh

from facejax import losses
from facejax.data import motions, transitions
from facejax.geometry import sphere, srvf
from facejax.models import layers
from facejax.models.motion import flow_matching, motion3dgan, motion3dgan_reference, tangent_pca
from facejax.training import loop, metric_logger, steps

Config = TypeVar("Config", motion3dgan.Config, flow_matching.Config)
Pair = tuple[jax.Array, jax.Array]  # indices of the start and end labels
Condition = tuple[jax.Array, jax.Array, jax.Array]  # start, end and pose


class GanPlan(NamedTuple):
    """Training plan of Motion3DGAN; values of OT23 where it gives them."""

    steps: int = 8_000
    batch: int = 128
    critic_steps: int = 4
    rate: float = 5e-4  # decays along a cosine, to 5 %
    penalty: float = 10.0
    reconstruction: float = 0.0  # alpha_2 of OT23 (10 there): it reduces the variance within a label pair
    length: float = 0.0  # weight of |log-length error|, which goes with it
    geodesic: float = 0.0  # weight of the geodesic distance, which the authors' program adds (10 there)
    decay: float = 0.999  # of the generator's moving average


# The authors' architecture with OT23's loss weights and learning rate.
REFERENCE = GanPlan(steps=2_000, rate=1e-4, reconstruction=10.0, length=10.0)


class FlowPlan(NamedTuple):
    """Training plan of flow matching."""

    steps: int = 12_000
    batch: int = 256
    rate: float = 1e-3  # decays along a cosine, to zero
    weight_decay: float = 1e-4
    whitening: float = 0.5  # 0: errors on the sphere; 1: in units of each direction's standard deviation
    decay: float = 0.999  # of the moving average


def fit_gan(
    examples: transitions.Examples,
    chart: tangent_pca.TangentPCA,
    folder: str | os.PathLike[str],
    *,
    plan: GanPlan = GanPlan(),
    config: motion3dgan.Config = motion3dgan.Config(),
    seed: int = 0,
    average: bool = True,
    device_mesh: Mesh | None = None,
) -> motion3dgan.Motion3DGAN:
    """Train the generator against its critic; returns its moving average, or without `average` its last state.

    Sizes of `config` that follow from the chart are replaced. A stopped run in `folder` is resumed.

    Raises:
      ValueError: `folder` holds a run with another plan, config, seed or motions.
    """
    config = config_for_chart(config, chart)
    _claim(folder, "gan", plan, config, seed, examples.values)
    generator_key, critic_key, play_key = jax.random.split(jax.random.key(seed), 3)
    players = steps.Players(
        motion3dgan.generator.init(generator_key, chart, config=config).weights,
        motion3dgan.critic.init(critic_key, chart, config=config).weights,
    )
    optimisers = steps.Players(
        *(
            optax.adam(optax.cosine_decay_schedule(plan.rate, plan.steps * count, alpha=0.05), 0.5, 0.9)
            for count in (1, plan.critic_steps)
        )
    )
    step = steps.adversarial(
        lambda weights, chart, key, condition: motion3dgan.generator.apply_coordinates(
            motion3dgan.Motion3DGAN(chart, weights), jax.random.normal(key, (config.noise,)), *condition
        ),
        lambda weights, chart, values, condition: motion3dgan.critic.apply_coordinates(
            motion3dgan.Motion3DGAN(chart, weights), values, *condition
        ),
        optimisers,
        critic_steps=plan.critic_steps,
        penalty=plan.penalty,
        terms=_terms(plan) if plan.reconstruction or plan.length or plan.geodesic else None,
        decay=plan.decay,
    )
    state = steps.init_adversarial(players, optimisers, play_key)
    state = _run(step, state, examples, chart, folder, plan.steps, plan.batch * plan.critic_steps, seed, device_mesh)
    return motion3dgan.Motion3DGAN(chart, state.extra if average else state.params.generator)


def fit_flow(
    examples: transitions.Examples,
    chart: tangent_pca.TangentPCA,
    folder: str | os.PathLike[str],
    *,
    plan: FlowPlan = FlowPlan(),
    config: flow_matching.Config = flow_matching.Config(),
    seed: int = 0,
    device_mesh: Mesh | None = None,
) -> flow_matching.FlowMatching:
    """Train a velocity field; returns its moving average. Chart, config, folder and device_mesh as in `fit_gan`.

    Errors are in units of each direction's standard deviation (to the power `plan.whitening`), so the chart's rank must
    not exceed the directions along which motions of a pair vary: elsewhere the unit is zero.
    """
    config = config_for_chart(config, chart)
    _claim(folder, "flow", plan, config, seed, examples.values)
    init_key, run_key = jax.random.split(jax.random.key(seed))
    weights = flow_matching.init(init_key, chart, config=config).weights

    def loss(
        weights: layers.Weights, key: jax.Array, batch: tuple[jax.Array, Condition], chart: tangent_pca.TangentPCA
    ) -> tuple[jax.Array, loop.Metrics]:
        values, condition = batch
        source_key, time_key = jax.random.split(key)
        keys = jax.random.split(source_key, len(values))
        source = jax.vmap(flow_matching.sample_source, (None, 0, 0, 0, 0))(chart, keys, *condition)
        target = jax.vmap(flow_matching.to_state, (None, 0))(chart, values)
        unit = jax.vmap(flow_matching.state_std, (None, 0, 0))(chart, *condition[:2])
        # Normalised to the same mean for every power, so that the two scalars keep their weight.
        size = jnp.sqrt(jnp.mean(unit ** (2 - 2 * plan.whitening), axis=1, keepdims=True))
        unit = size * unit**plan.whitening
        params = flow_matching.FlowMatching(chart, weights)

        def field(state: flow_matching.State, time: jax.Array, condition: Condition) -> flow_matching.State:
            return flow_matching.velocity(params, state, time, *condition)

        return losses.flow_matching(field, time_key, source, target, condition, unit), {}

    optimiser = optax.adamw(optax.cosine_decay_schedule(plan.rate, plan.steps), weight_decay=plan.weight_decay)
    step = steps.with_moving_average(steps.supervised(loss, optimiser), plan.decay)
    state = steps.init_supervised(weights, optimiser, run_key)._replace(extra=weights)
    state = _run(step, state, examples, chart, folder, plan.steps, plan.batch, seed, device_mesh)
    return flow_matching.FlowMatching(chart, state.extra)


def fit_reference(
    known: motions.Motions,
    chart: tangent_pca.TangentPCA,
    folder: str | os.PathLike[str],
    *,
    plan: GanPlan = REFERENCE,
    config: motion3dgan_reference.Config = motion3dgan_reference.Config(),
    seed: int = 0,
    device_mesh: Mesh | None = None,
) -> motion3dgan_reference.Motion3DGANReference:
    """Train the authors' architecture on whole tangent vectors; returns the generator's moving average."""
    _, steps_, landmarks, _ = chart.basis.shape
    config = config._replace(steps=steps_, landmarks=landmarks, labels=len(chart.mean))
    q, log_length = srvf.encode(jnp.asarray(known.curves))
    pair = jnp.asarray(known.start), jnp.asarray(known.end)
    standard = (log_length - chart.scalar_mean[*pair, 0]) / chart.scalar_std[0]
    real = {"tangent": sphere.log(chart.p, q), "length": standard}
    _claim(folder, "reference", plan, config, seed, np.asarray(known.curves))
    generator_key, critic_key, play_key = jax.random.split(jax.random.key(seed), 3)
    players = steps.Players(
        motion3dgan_reference.generator.init(generator_key, chart, config=config).weights,
        motion3dgan_reference.critic.init(critic_key, chart, config=config).weights,
    )
    optimisers = steps.Players(optax.adam(plan.rate, 0.5, 0.9), optax.adam(plan.rate, 0.5, 0.9))

    def scalars(chart: tangent_pca.TangentPCA, pair: Pair) -> tuple[jax.Array, jax.Array]:
        return chart.scalar_mean[*pair, 0], chart.scalar_std[0]

    def generate(
        weights: layers.Weights, chart: tangent_pca.TangentPCA, key: jax.Array, pair: Pair
    ) -> dict[str, jax.Array]:
        params = motion3dgan_reference.Motion3DGANReference(chart, weights)
        tangent, log_length = motion3dgan_reference.generator.apply(
            params, jax.random.normal(key, (config.noise,)), *pair
        )
        # The critic sees log_p of exp_p: the same vector, except for angles beyond pi.
        tangent = sphere.log(chart.p, sphere.exp(chart.p, tangent))
        mean, deviation = scalars(chart, pair)
        return {"tangent": tangent, "length": (log_length - mean) / deviation}

    def score(
        weights: layers.Weights, chart: tangent_pca.TangentPCA, sample: dict[str, jax.Array], pair: Pair
    ) -> jax.Array:
        mean, deviation = scalars(chart, pair)
        params = motion3dgan_reference.Motion3DGANReference(chart, weights)
        return motion3dgan_reference.critic.apply(params, sample["tangent"], mean + deviation * sample["length"], *pair)

    def terms(
        chart: tangent_pca.TangentPCA, fake: dict[str, jax.Array], real: dict[str, jax.Array], pair: Pair
    ) -> loop.Metrics:
        length = chart.scalar_std[0] * losses.tangent_l1(fake["length"], real["length"])
        return {
            "reconstruction": plan.reconstruction * losses.tangent_l1(fake["tangent"], real["tangent"]),
            "length": plan.length * length,
        }

    step = steps.adversarial(
        generate, score, optimisers, critic_steps=plan.critic_steps, penalty=plan.penalty, terms=terms, decay=plan.decay
    )
    state = loop.run(
        loop.gather_batches(step),
        steps.init_adversarial(players, optimisers, play_key),
        loop.epoch_indices(seed, len(known.curves), plan.batch * plan.critic_steps),
        folder,
        steps=plan.steps,
        constants=((real, pair), chart),
        chunk=1,
        save_seconds=120.0,
        device_mesh=device_mesh,
    )
    return motion3dgan_reference.Motion3DGANReference(chart, state.extra)


def _run(
    step: loop.Step,
    state: loop.TrainState,
    examples: transitions.Examples,
    chart: tangent_pca.TangentPCA,
    folder: str | os.PathLike[str],
    count: int,
    batch: int,
    seed: int,
    device_mesh: Mesh | None,
) -> loop.TrainState:
    rows = transitions.balance_pairs(examples.start, examples.end, seed)
    order = loop.epoch_indices(seed, len(rows), batch)
    conditions = tuple(jnp.asarray(x) for x in (examples.start, examples.end, examples.pose))
    held = (jnp.asarray(examples.values), conditions), chart
    return loop.run(
        loop.gather_batches(step),
        state,
        lambda first, count: rows[order(first, count)],
        folder,
        steps=count,
        constants=held,
        device_mesh=device_mesh,
    )


def config_for_chart(config: Config, chart: tangent_pca.TangentPCA) -> Config:
    """Return a network's config with the sizes of the chart."""
    (rank, steps, landmarks, _), labels, pose = chart.basis.shape, len(chart.mean), len(chart.pose_scale)
    return config._replace(rank=rank, steps=steps, landmarks=landmarks, labels=labels, pose=pose)


def _claim(
    folder: str | os.PathLike[str],
    kind: str,
    plan: GanPlan | FlowPlan,
    config: motion3dgan.Config | motion3dgan_reference.Config | flow_matching.Config,
    seed: int,
    known: np.ndarray,
) -> None:
    if plan.steps < 1:
        raise ValueError(f"plan: expected 1 step or more, got {plan.steps}")
    digest = hashlib.sha256(np.ascontiguousarray(known).data).hexdigest()
    record = {"plan": plan._asdict(), "config": config._asdict(), "seed": seed, "motions": digest, "kind": kind}
    metric_logger.claim_folder(folder, record)


def _terms(
    plan: GanPlan,
) -> Callable[[tangent_pca.TangentPCA, jax.Array, jax.Array, Condition], loop.Metrics]:
    def terms(chart: tangent_pca.TangentPCA, fake: jax.Array, real: jax.Array, condition: Condition) -> loop.Metrics:
        # Equation 6 on tangent vectors, which are linear in the coordinates.
        difference = jnp.tensordot((fake - real)[:, tangent_pca.SCALARS :], chart.basis, 1)
        scalars = chart.scalar_std * jnp.mean(jnp.abs((fake - real)[:, : tangent_pca.SCALARS]), axis=0)
        return {
            "reconstruction": plan.reconstruction * jnp.mean(jnp.abs(difference)),
            "length": plan.length * jnp.sum(scalars),
            "geodesic": plan.geodesic * jnp.mean(_distances(chart, fake, real)),
        }

    return terms


def _distances(chart: tangent_pca.TangentPCA, fake: jax.Array, real: jax.Array) -> jax.Array:
    fake, real = (jax.vmap(flow_matching.to_state, (None, 0))(chart, values)[0] for values in (fake, real))
    return sphere.distance(fake, real)
