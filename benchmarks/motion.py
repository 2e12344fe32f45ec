"""Generators of motion in training beside PyTorch, and sampling from them.

    python -m benchmarks.motion [--json FILE] [--quick] [--whole]

* `gan_step_b128`, `flow_step_b256`: a training step as `facejax.fit_motion` hands it to the loop, with its plan and
  network (a round of the GAN: four steps of the critic, one of the generator). Ours is timed in one call of ten, as the
  loop has it, and alone as `single`. PyTorch starts from the same weights; first, three steps on the same draws must
  give the same metrics and weights. `memory_mb` is what our compiled program holds at once, `peer_memory_mb` what
  PyTorch's allocator gave out at one moment of a step; data, weights and the optimiser's moments included. Operations
  are those of the step's matrix products, gradients and the penalty's second ones among them, as JAX writes them down.
* `gan_reference_step_b8`: the authors' GAN at an eighth of its width, in batches of 8 samples, since a step of 128
  takes sixteen times as long and more. --whole: at full width as well.
* `gan_sample_64`, `flow_sample_64`: motions of one pair of labels.

Motions are made up; the sizes are a training's. Costs against size: batch 4 to 256 of the GAN's step. The peer is
eager, with a thread for every core and with one: under torch.compile the critic fails that check, and the flow gains a
twentieth at most. About two minutes, --quick one.
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

SCAN = 10  # steps in one call where they are scanned


@dataclasses.dataclass(frozen=True)
class Config(_measure.Options):
    """What to measure."""

    whole: bool = False
    """The authors' GAN at full width too."""
    gan: motion3dgan.Config = motion3dgan.DEFAULT
    flow: flow_matching.Config = flow_matching.DEFAULT
    gan_plan: fit_motion.GanPlan = dataclasses.field(default_factory=fit_motion.GanPlan)
    flow_plan: fit_motion.FlowPlan = dataclasses.field(default_factory=fit_motion.FlowPlan)
    reference_batch: int = 8
    """Samples in a step of the authors' GAN."""
    width_divisor: int = 8
    """Of the authors' GAN."""
    motions: int = 2048
    """To train on."""
    samples: int = 64
    """Drawn at once."""
    batches: tuple[int, ...] = (4, 16, 64, 256)
    """At which the cost of a step is measured."""
    threads: int | None = None
    """Of PyTorch, by default one for every core."""


class Run(NamedTuple):
    """A training as a fit hands it to `facejax.training.run`."""

    step: training_loop.Step
    state: training_loop.TrainState
    rows: np.ndarray  # (B,), the first batch
    held: Any  # (data, chart)


def run(config: Config) -> _measure.Found:
    """Rows of the tables."""
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
    """What a fit hands to the training loop, which is not entered: what is timed is what is trained."""
    with mock.patch.object(training_loop, "run") as loop, tempfile.TemporaryDirectory() as folder:
        fit(*args, folder, **options)
    step, state, batches, _ = loop.call_args.args
    return Run(step, state, batches(0, 1)[0], loop.call_args.kwargs["constants"])


def compiled(run: Run) -> tuple[Callable, float]:
    """The step as a program of (state, rows, held), and the megabytes that it holds at once."""
    program = jax.jit(run.step, donate_argnums=0).lower(*run[1:]).compile()
    size = program.memory_analysis()
    held = size.argument_size_in_bytes + size.output_size_in_bytes - size.alias_size_in_bytes + size.temp_size_in_bytes
    return program, held / 1e6


def _step(
    name: str, given: Run, plan: fit_motion.GanPlan | fit_motion.FlowPlan, with_torch: bool, repeats: int
) -> _measure.Row:
    """A training step beside PyTorch's."""
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
    """The step of the GAN as its authors built it, on few samples."""
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
    """Motions of one pair of labels."""
    keys, pose = jax.random.split(jax.random.key(0), config.samples), jnp.zeros(config.gan.pose)
    draw = jax.jit(jax.vmap(generators.sample, (None, 0, None, None, None)))
    sides = {"facejax": lambda: draw(params, keys, 1, 2, pose)}
    count = config.samples
    return _measure.row(f"{name}_sample_{count}", sides, repeats=repeats, items=count, unit="motions")


if __name__ == "__main__":
    _measure.main("motion", Config, run)
