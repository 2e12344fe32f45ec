"""Training steps for `facejax.training.loop.run`: supervised, adversarial, and vectorised over models.

Each maker takes functions and returns a model-independent `step(state, batch, constants) -> (state, metrics)`.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.sharding import Mesh, PartitionSpec
from jax.typing import ArrayLike

from facejax import losses
from facejax.training.loop import Metrics, Step, TrainState, Tree

Loss = Callable[[Tree, jax.Array, Tree, Tree], tuple[ArrayLike, Metrics]]  # of params, key, batch and constants


class Players(NamedTuple):
    """Parameters, optimisers, or optimiser states of generator and critic."""

    generator: Any
    critic: Any


def supervised(loss: Loss, optimiser: optax.GradientTransformation) -> Step:
    """Return an optimiser step on `loss(params, key, batch, constants) -> (scalar, metrics)`."""

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
    """Return the initial state of `supervised`."""
    return TrainState(jnp.int32(0), params, optimiser.init(params), key)


def with_moving_average(step: Step, decay: float) -> Step:
    """Return a step that keeps the exponential moving average of the parameters in `extra`; initialise it to them."""

    def stepped(state: TrainState, batch: Tree, constants: Tree) -> tuple[TrainState, Metrics]:
        following, metrics = step(state, batch, constants)
        average = optax.incremental_update(following.params, state.extra, 1.0 - decay)
        return following._replace(extra=average), metrics

    return stepped


def vectorize_models(step: Step, names: Sequence[str], ids: Sequence[int] | np.ndarray) -> Step:
    """Return one step of E independent models: parameters, optimiser states and batches are stacked, (E, ...).

    `step` receives one model, with constants (own, shared) of which `own` is stacked too, and a key derived from the
    run's key and the model's id: a model gets the same numbers alone as in a stack. Metrics are means over the models,
    and the loss of each by name.

    The models are split among the process's devices. On a CPU several devices help too, since the small products of one
    network use one core: set `jax.config.update("jax_num_cpu_devices", cores)` first (six networks of three layers of
    128 on two cores: 39 ms instead of 59). On one CPU device the models are mapped one after another, because batched
    small products have no fast kernel (72 ms under `vmap`). On other devices it is a `vmap`.

    Raises:
      ValueError: names that are not unique or not one per id.
    """
    if len(names) != len(ids) or len(set(names)) < len(names):
        raise ValueError(f"names: expected {len(ids)} unique names, one per model, got {list(names)}")
    model_ids = jnp.asarray(ids)

    def one(common: Tree, parts: Tree) -> tuple[Tree, Metrics]:
        (number_of_steps, run_key, shared), (params, opt_state, extra, number, batch, own) = common, parts
        key = jax.random.fold_in(run_key, number)
        found, metrics = step(TrainState(number_of_steps, params, opt_state, key, extra), batch, (own, shared))
        return (found.params, found.opt_state, found.extra), metrics

    def several(common: Tree, stacked: Tree) -> tuple[Tree, Metrics]:
        each = partial(one, common)
        return jax.lax.platform_dependent(stacked, cpu=partial(jax.lax.map, each), default=jax.vmap(each))

    def stepped(state: TrainState, batch: Tree, constants: Tree) -> tuple[TrainState, Metrics]:
        own, shared = constants
        devices = jax.local_devices()  # every process does the same work on its own devices
        count = max(n for n in range(1, len(devices) + 1) if len(ids) % n == 0)
        mapped = several
        if count > 1:
            mesh, split = Mesh(np.array(devices[:count]), ("models",)), PartitionSpec("models")
            mapped = jax.shard_map(
                several, mesh=mesh, in_specs=(PartitionSpec(), split), out_specs=split, check_vma=False
            )
        stacked = (state.params, state.opt_state, state.extra, model_ids, batch, own)
        (params, opt_state, extra), metrics = mapped((state.step, state.key, shared), stacked)
        means = {name: jnp.mean(values) for name, values in metrics.items()}
        losses = {f"loss_{name}": metrics["loss"][i] for i, name in enumerate(names)} if len(names) > 1 else {}
        return TrainState(state.step + 1, params, opt_state, state.key, extra), means | losses

    return stepped


def init_vectorized_models(params: Tree, optimiser: optax.GradientTransformation, key: jax.Array) -> TrainState:
    """Return the initial state of vectorised `supervised` steps; leaves of `params` are stacked, (E, ...)."""
    return TrainState(jnp.int32(0), params, jax.vmap(optimiser.init)(params), key)


def adversarial(
    generate: Callable[[Tree, Tree, jax.Array, Tree], Tree],
    score: Callable[[Tree, Tree, Tree, Tree], jax.Array],
    optimisers: Players,
    *,
    critic_steps: int = 5,
    penalty: float = 10.0,
    terms: Callable[[Tree, Tree, Tree, Tree], Metrics] | None = None,
    decay: float = 0.999,
) -> Step:
    """Return a Wasserstein GAN step with gradient penalty: `critic_steps` critic updates, then one of the generator.

    `extra` of the state is the exponential moving average of the generator's weights, which is better than any single
    iterate because adversarial training does not converge.

    Args:
      generate: `generate(weights, constants, key, condition) -> sample`, of ONE sample.
      score: `score(weights, constants, sample, condition) -> scalar`, of ONE sample.
      critic_steps: a batch is (real samples, conditions) with a leading axis of critic_steps * B; each critic update
        uses B of them, the generator's the last B.
      penalty: weight of the gradient penalty.
      terms: `terms(constants, fake, real, condition)` returns a dict of weighted losses to add to the generator's.
      decay: of the moving average.
    """

    def step(state: TrainState, batch: Tree, constants: Tree) -> tuple[TrainState, Metrics]:
        generator, critic = state.params
        noise_key, chord_key, play_key = jax.random.split(jax.random.fold_in(state.key, state.step), 3)
        size = jax.tree.leaves(batch)[0].shape[0]
        if size % critic_steps:
            raise ValueError(f"a batch needs a multiple of critic_steps = {critic_steps} samples; got {size}")
        many = jax.vmap(generate, (None, None, 0, 0))

        # One call for the fakes of all critic updates, during which the generator is constant.
        fake = many(generator, constants, jax.random.split(noise_key, size), batch[1])
        rounds = jax.tree.map(lambda leaf: leaf.reshape(critic_steps, -1, *leaf.shape[1:]), (*batch, fake))

        def judge(carry: tuple[Tree, Tree], data: Tree) -> tuple[tuple[Tree, Tree], Metrics]:
            critic, opt_state = carry
            key, (real, condition, fake) = data

            def loss(critic: Tree) -> tuple[jax.Array, Metrics]:
                return losses.critic(
                    lambda sample, condition: score(critic, constants, sample, condition),
                    key, real, fake, condition, penalty=penalty,
                )  # fmt: skip

            slope, metrics = jax.grad(loss, has_aux=True)(critic)
            return _descend(optimisers.critic, slope, opt_state, critic), metrics

        keys = jax.random.split(chord_key, critic_steps)
        (critic, critic_state), judged = jax.lax.scan(judge, (critic, state.opt_state.critic), (keys, rounds))

        real, condition, _ = jax.tree.map(lambda leaf: leaf[-1], rounds)

        def play(generator: Tree) -> tuple[ArrayLike, Metrics]:
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
    """Return the initial state of `adversarial`."""
    opt_state = Players(*(optimiser.init(side) for optimiser, side in zip(optimisers, params, strict=True)))
    return TrainState(jnp.int32(0), params, opt_state, key, extra=params.generator)


def _descend(optimiser: optax.GradientTransformation, slope: Tree, opt_state: Tree, params: Tree) -> tuple[Tree, Tree]:
    updates, opt_state = optimiser.update(slope, opt_state, params)
    return optax.apply_updates(params, updates), opt_state
