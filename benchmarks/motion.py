"""Training steps of the motion generators against PyTorch, and sampling from them.

    python -m benchmarks.motion [--json FILE] [--quick] [--whole]

* `gan_step_b128`, `flow_step_b256`: a training step as `facejax.training.recipes.fit_motion` passes it to the loop,
  with its plan and network (for the GAN, four steps of the critic and one of the generator). facejax's is timed as
  ten steps in one call, as in the loop, and alone as `single`. PyTorch starts from the same weights; first, three
  steps on the same random draws must give the same metrics and weights. `memory_mb` is the memory of facejax's
  compiled program, `peer_memory_mb` the peak of PyTorch's allocator during a step, both with data, weights and the
  optimiser's moments. Operations are those of the step's matrix products in its jaxpr, including gradients and second
  derivatives.
* `gan_reference_step_b8`: the authors' GAN at 1/8 of its width, in batches of 8 samples, since a step of 128 takes at
  least sixteen times as long. --whole: at full width as well.
* `gan_sample_64`, `flow_sample_64`: motions of one pair of labels.

Motions are synthetic, at the sizes of a training run. Cost against size: batches of 4 to 256 of the GAN's step. The
peer is eager, with one thread per core and with one thread: under torch.compile the critic fails the check, and the
flow gains 5 % at most. About two minutes, one with --quick.
"""

from __future__ import annotations

import dataclasses
import tempfile
from collections.abc import Callable
from typing import Any, NamedTuple
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import _measure, _sizes, _torch, _transitions, _work
from facejax.data import transitions
from facejax.data.motions import Motions
from facejax.models.motion import flow_matching, generators, motion3dgan, motion3dgan_reference, tangent_pca
from facejax.training import loop as training_loop
from facejax.training.recipes import fit_motion

SCAN = 10  # training steps in one call


@dataclasses.dataclass(frozen=True)
class Config(_measure.Options):
    """Options of the benchmark."""

    whole: bool = False
    """Also time the authors' GAN at full width."""
    gan: motion3dgan.Config = motion3dgan.DEFAULT
    flow: flow_matching.Config = flow_matching.DEFAULT
    gan_plan: fit_motion.GanPlan = dataclasses.field(default_factory=fit_motion.GanPlan)
    flow_plan: fit_motion.FlowPlan = dataclasses.field(default_factory=fit_motion.FlowPlan)
    reference_batch: int = 8
    """Batch size of the authors' GAN."""
    width_divisor: int = 8
    """Divisor of all widths of the authors' GAN."""
    motions: int = 2048
    """Number of motions to train on."""
    samples: int = 64
    """Number of samples drawn at once."""
    batches: tuple[int, ...] = (4, 16, 64, 256)
    """Batch sizes at which the cost of a step is measured."""
    threads: int | None = None
    """Number of PyTorch threads; by default one per core."""


class Run(NamedTuple):
    """A training run as a recipe passes it to `facejax.training.loop.run`."""

    step: training_loop.Step
    state: training_loop.TrainState
    rows: np.ndarray  # (B,), the first batch
    held: Any  # (data, chart)


def run(config: Config) -> _measure.Found:
    """Measure and return the rows."""
    with_torch, repeats = _torch.ready(config.threads), 5 if config.quick else 15
    known = _transitions.made_up(
        config.motions, labels=config.gan.labels, steps=config.gan.steps, landmarks=config.gan.landmarks
    )
    chart = transitions.fit_chart(known, labels=config.gan.labels, rank=config.gan.rank, pose=config.gan.pose)
    examples = transitions.encode_examples(chart, [known])
    gan = handed(fit_motion.fit_gan, examples, chart, plan=config.gan_plan, config=config.gan)
    field = handed(fit_motion.fit_flow, examples, chart, plan=config.flow_plan, config=config.flow)
    rows = [_step("gan_step", gan, config.gan_plan, with_torch, repeats)]
    rows.append(_step("flow_step", field, config.flow_plan, with_torch, repeats))
    rows += _reference(known, chart, config)
    pairs = {
        "gan": motion3dgan.Motion3DGAN(chart, gan.state.extra),
        "flow": flow_matching.FlowMatching(chart, field.state.extra),
    }
    rows += [_sampling(name, params, config, repeats) for name, params in pairs.items()]

    def sized(batch: int) -> Callable:
        plan = config.gan_plan._replace(batch=batch)
        given = handed(fit_motion.fit_gan, examples, chart, plan=plan, config=config.gan)
        return _work.onward(given.step, given.state, given.rows, given.held)

    return rows, [] if config.quick else _sizes.along("gan_step", "batch", config.batches, sized)


def handed(fit: Callable, *args, **options) -> Run:
    """Return what a recipe passes to the training loop, so that the timed step is the trained one."""
    with mock.patch.object(training_loop, "run") as loop, tempfile.TemporaryDirectory() as folder:
        fit(*args, folder, **options)
    step, state, batches, _ = loop.call_args.args
    return Run(step, state, batches(0, 1)[0], loop.call_args.kwargs["constants"])


def compiled(run: Run) -> tuple[Callable, float]:
    """Compile the step of (state, rows, held); return the program and its memory in megabytes."""
    program = jax.jit(run.step, donate_argnums=0).lower(*run[1:]).compile()
    size = program.memory_analysis()
    held = size.argument_size_in_bytes + size.output_size_in_bytes - size.alias_size_in_bytes + size.temp_size_in_bytes
    return program, held / 1e6


def _step(
    name: str, given: Run, plan: fit_motion.GanPlan | fit_motion.FlowPlan, with_torch: bool, repeats: int
) -> _measure.Row:
    """Time a training step against PyTorch's."""
    program, memory = compiled(given)
    sides = {
        "facejax": _work.onward(_work.scanned(given.step, SCAN), given.state, given.rows, given.held),
        "single": _work.onward(given.step, given.state, given.rows, given.held),
    }
    theirs, about = {}, {"memory_mb": memory, "gflop": _work.products(given.step, *given[1:])}
    if with_torch:
        from benchmarks import _motion_torch, _torch_memory

        make = {"gan_step": _motion_torch.Gan, "flow_step": _motion_torch.Flow}[name]
        _motion_torch.check(make(given.state, given.held, plan), program, given.state, given.rows, given.held)
        peer, rows = make(given.state, given.held, plan), _torch.tensor(given.rows)
        theirs = _torch.threaded("torch", lambda: peer.step(rows))
        if _torch.device() == "cpu":
            about["peer_memory_mb"] = _torch_memory.peak_mb(theirs["torch"], peer.held())
    return _measure.row(
        f"{name}_b{plan.batch}", sides | theirs, peers=list(theirs), repeats=repeats, calls={"facejax": SCAN}, items=1,
        unit="steps", **about,
    )  # fmt: skip


def _reference(known: Motions, chart: tangent_pca.TangentPCA, config: Config) -> list[_measure.Row]:
    """Time the training step of the authors' GAN on small batches."""
    plan, rows = fit_motion.REFERENCE._replace(batch=config.reference_batch), []
    for divisor in (config.width_divisor, 1)[: 1 + config.whole]:
        sizes = motion3dgan_reference.Config(width_divisor=divisor)
        given = handed(fit_motion.fit_reference, known, chart, plan=plan, config=sizes)
        _, memory = compiled(given)
        sides = {"facejax": _work.onward(given.step, given.state, given.rows, given.held)}
        name = f"gan_reference_step_b{plan.batch}" + ("" if divisor > 1 else "_whole")
        rows.append(_measure.row(name, sides, repeats=3, unit="steps", memory_mb=memory))
    return rows


def _sampling(name: str, params: Any, config: Config, repeats: int) -> _measure.Row:
    """Time the sampling of motions of one pair of labels."""
    keys, pose = jax.random.split(jax.random.key(0), config.samples), jnp.zeros(config.gan.pose)
    draw = jax.jit(jax.vmap(generators.sample, (None, 0, None, None, None)))
    sides = {"facejax": lambda: draw(params, keys, 1, 2, pose)}
    count = config.samples
    return _measure.row(f"{name}_sample_{count}", sides, repeats=repeats, items=count, unit="motions")


if __name__ == "__main__":
    _measure.main("motion", Config, run)
