"""Training steps for `facejax.training.run`: down a loss, or one round of the adversarial game.

Each maker takes functions and returns `step(state, batch, constants) -> (state, metrics)`; none knows a
model.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.sharding import Mesh, PartitionSpec

from facejax import losses
from facejax.training.loop import Metrics, Step, TrainState, Tree


class Players(NamedTuple):
    """The two sides of the adversarial game: parameters, optimisers, or optimiser states."""

    generator: Any
    critic: Any


def supervised(loss: Callable, optimiser: optax.GradientTransformation) -> Step:
    """A step down the gradient of `loss(params, key, batch, constants) -> (scalar, metrics)`."""

    def step(state: TrainState, batch: Tree, constants: Tree) -> tuple[TrainState, Metrics]:
        key = jax.random.fold_in(state.key, state.step)
        (value, metrics), slope = jax.value_and_grad(loss, has_aux=True)(state.params, key, batch, constants)
        params, opt_state = _descend(optimiser, slope, state.opt_state, state.params)
        return TrainState(state.step + 1, params, opt_state, state.key, state.extra), {
            "loss": value,
            **metrics,
        }

    return step


def init_supervised(params: Tree, optimiser: optax.GradientTransformation, key: jax.Array) -> TrainState:
    """The state that `supervised` starts from."""
    return TrainState(jnp.int32(0), params, optimiser.init(params), key)


def with_moving_average(step: Step, decay: float) -> Step:
    """`step`, and in `extra` the exponential moving average of the parameters; let it start as the parameters."""

    def stepped(state: TrainState, batch: Tree, constants: Tree) -> tuple[TrainState, Metrics]:
        following, metrics = step(state, batch, constants)
        average = optax.incremental_update(following.params, state.extra, 1.0 - decay)
        return following._replace(extra=average), metrics

    return stepped


def vectorize_models(step: Step, names: Sequence[str], ids: Sequence[int]) -> Step:
    """One step of E models that know nothing of each other: parameters, optimiser states, batches stacked, (E, ...).

    `step` sees one of them, with constants (own, shared) of which `own` comes stacked too, and a key made of the run's
    and its id: the same numbers alone as in company. Metrics are means over the models; the loss by name as well.

    Where the process has several devices, they share the models out among them. On a CPU that is worth it too, since
    the small products of one network keep one core busy: `jax.config.update("jax_num_cpu_devices", cores)` before
    anything else (six networks of three layers of 128 on two cores: 39 ms instead of 59). On one CPU device the models
    take turns: a batched small product runs through no fast kernel (72 ms under `vmap`). Elsewhere it is a `vmap`.
    """
    if len(names) != len(ids) or len(set(names)) < len(names):
        raise ValueError(f"names: expected one of its own for each of {len(ids)} models, got {list(names)}")
    ids = jnp.asarray(ids)

    def one(common, parts):
        (number_of_steps, run_key, shared), (params, opt_state, extra, number, batch, own) = common, parts
        key = jax.random.fold_in(run_key, number)
        found, metrics = step(TrainState(number_of_steps, params, opt_state, key, extra), batch, (own, shared))
        return (found.params, found.opt_state, found.extra), metrics

    def several(common, stacked):
        each = partial(one, common)
        return jax.lax.map(each, stacked) if jax.default_backend() == "cpu" else jax.vmap(each)(stacked)

    def stepped(state: TrainState, batch: Tree, constants: Tree) -> tuple[TrainState, Metrics]:
        own, shared = constants
        devices = jax.local_devices()  # other processes, where there are any, do the same
        count = max(n for n in range(1, len(devices) + 1) if len(ids) % n == 0)
        apart = several
        if count > 1:
            mesh, split = Mesh(np.array(devices[:count]), ("models",)), PartitionSpec("models")
            specs = {"in_specs": (PartitionSpec(), split), "out_specs": split}
            apart = jax.shard_map(several, mesh=mesh, check_vma=False, **specs)
        stacked = (state.params, state.opt_state, state.extra, ids, batch, own)
        (params, opt_state, extra), metrics = apart((state.step, state.key, shared), stacked)
        means = {name: jnp.mean(values) for name, values in metrics.items()}
        losses = {f"loss_{name}": metrics["loss"][i] for i, name in enumerate(names)} if len(names) > 1 else {}
        return TrainState(state.step + 1, params, opt_state, state.key, extra), means | losses

    return stepped


def init_vectorized_models(params: Tree, optimiser: optax.GradientTransformation, key: jax.Array) -> TrainState:
    """The state that `vectorize_models` of `supervised` steps starts from; every leaf of `params` is stacked, (E, ...)."""
    return TrainState(jnp.int32(0), params, jax.vmap(optimiser.init)(params), key)


def adversarial(
    generate: Callable,
    score: Callable,
    optimisers: Players,
    *,
    critic_steps: int = 5,
    penalty: float = 10.0,
    terms: Callable | None = None,
    decay: float = 0.999,
) -> Step:
    """A Wasserstein step with gradient penalty: `critic_steps` of the critic, then one of the generator.

    `generate(weights, constants, key, condition) -> sample` and `score(weights, constants, sample,
    condition) -> scalar` handle ONE sample. A batch is (real samples, conditions) with a leading axis of
    critic_steps * B; each critic step takes B of them, and the generator sees the last B. `terms(constants,
    fake, real, condition)` gives a dict of weighted batch losses to add to the generator's. `extra` of the
    state is the exponential moving average of the generator's weights: with a critic that never settles,
    the average is better than any single point.
    """

    def step(state: TrainState, batch: Tree, constants: Tree) -> tuple[TrainState, Metrics]:
        generator, critic = state.params
        noise_key, chord_key, play_key = jax.random.split(jax.random.fold_in(state.key, state.step), 3)
        size = jax.tree.leaves(batch)[0].shape[0]
        if size % critic_steps:
            raise ValueError(f"a batch needs a multiple of critic_steps = {critic_steps} samples; got {size}")
        many = jax.vmap(generate, (None, None, 0, 0))

        # One call for the fakes of all critic steps: the generator does not move meanwhile.
        fake = many(generator, constants, jax.random.split(noise_key, size), batch[1])
        rounds = jax.tree.map(lambda leaf: leaf.reshape(critic_steps, -1, *leaf.shape[1:]), (*batch, fake))

        def judge(carry, data):
            critic, opt_state = carry
            key, (real, condition, fake) = data

            def loss(critic):
                return losses.critic(
                    lambda sample, condition: score(critic, constants, sample, condition),
                    key, real, fake, condition, penalty=penalty,
                )  # fmt: skip

            slope, metrics = jax.grad(loss, has_aux=True)(critic)
            return _descend(optimisers.critic, slope, opt_state, critic), metrics

        keys = jax.random.split(chord_key, critic_steps)
        (critic, critic_state), judged = jax.lax.scan(judge, (critic, state.opt_state.critic), (keys, rounds))

        real, condition, _ = jax.tree.map(lambda leaf: leaf[-1], rounds)

        def play(generator):
            fake = many(generator, constants, jax.random.split(play_key, size // critic_steps), condition)
            adversarial = losses.generator(lambda *x: score(critic, constants, *x), fake, condition)
            added = terms(constants, fake, real, condition) if terms else {}
            return adversarial + sum(added.values()), {"adversarial": adversarial, **added}

        slope, played = jax.grad(play, has_aux=True)(generator)
        generator, generator_state = _descend(optimisers.generator, slope, state.opt_state.generator, generator)
        average = optax.incremental_update(generator, state.extra, 1.0 - decay)
        opt_state = Players(generator_state, critic_state)
        state = TrainState(state.step + 1, Players(generator, critic), opt_state, state.key, average)
        return state, {**jax.tree.map(jnp.mean, judged), **played}

    return step


def init_adversarial(params: Players, optimisers: Players, key: jax.Array) -> TrainState:
    """The state that `adversarial` starts from."""
    opt_state = Players(*(optimiser.init(side) for optimiser, side in zip(optimisers, params, strict=True)))
    return TrainState(jnp.int32(0), params, opt_state, key, extra=params.generator)


def _descend(optimiser, slope: Tree, opt_state: Tree, params: Tree) -> tuple[Tree, Tree]:
    updates, opt_state = optimiser.update(slope, opt_state, params)
    return optax.apply_updates(params, updates), opt_state
