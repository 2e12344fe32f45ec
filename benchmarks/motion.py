"""Generators of motion in training beside PyTorch, sampling from them, and the making of their data.

    python -m benchmarks.motion [--out FILE] [--quick] [--whole]

* `GAN step`, `flow step`: a training step as `facejax.fit_motion` hands it to the loop, with its plan and network.
  `scanned` is the step within one call of ten, as the loop has it; `minutes` is what all steps of the plan take.
  PyTorch starts from the same weights; first, three steps on the same draws must give the same metrics and weights.
* `reference step`: the authors' GAN at an eighth of its width, in batches of 8 samples, since a step of 128 takes
  sixteen times as long and more: read `per_s`, samples a second. --whole: at full width as well.
* `64 motions`: of one pair of labels. `weights`: how many numbers a network trains.
* `1,280 transitions` between 1,440 onsets, at the "performed" pace: ours, the plain way, which decodes every point of
  the geodesics in full, and our way in NumPy; all must agree. `streamed`: many more (--quick: fewer), in a process of
  its own, whose peak of memory is `before_mb` when the data are there and `memory_mb` in the end.

Motions are made up; the sizes are a training's. Rows of a task are timed in turns, and `over_first` is the ratio of
medians to its first row. `memory_mb` of a step is what its compiled program holds at once, of PyTorch what its
allocator gave out at one moment of a step; data, weights and the optimiser's moments included.

The peer is eager: under torch.compile the critic fails that check, and the flow gains a twentieth at most. On a machine
that is busy with other work PyTorch's threads wait for one another: see its row of one thread. It comes with the extra
`bench`; without it its rows are left out. Under two minutes, --quick one; a busy machine takes twice that.
"""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from benchmarks import _measure, _transitions
from facejax import augment, fit_motion, motion_examples, steps, training
from facejax.data.motions import Motions
from facejax.models import charts, flow, generators, motion, motion_reference

try:
    import torch

    from benchmarks import _motion_torch, _torch_memory
except ImportError:
    torch = None

ROOT = Path(__file__).parents[1]
SCAN = 10  # steps in one call where they are scanned
REST = 0.02  # seconds between calls: OpenMP's threads spin on for a while when their work is done


@dataclasses.dataclass(frozen=True)
class Config:
    out: Path | None = None
    """Also write the rows here, as JSON."""
    quick: bool = False
    """Fewer repeats, fewer transitions."""
    whole: bool = False
    """The authors' GAN at full width too."""
    gan: motion.Config = motion.DEFAULT
    flow: flow.Config = flow.DEFAULT
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
    people: int = 80
    """Who perform all labels but neutral, each once."""
    compared: int = 1280
    """Transitions for the peers."""
    transitions: int = 300_000
    """In the pass; --quick takes a fifteenth."""
    threads: int = os.cpu_count() or 1
    """Of PyTorch; JAX takes the cores that the process may use."""


class Run(NamedTuple):
    """A training as a fit hands it to `facejax.training.run`."""

    step: training.Step
    state: training.TrainState
    rows: np.ndarray  # (B,), the first batch
    held: Any  # (data, chart)


def run(config: Config) -> list[dict]:
    """Rows of the table."""
    if torch is None:
        print('PyTorch is not here and its rows are left out: pip install ".[bench]" brings it.')
    else:
        torch.set_num_threads(config.threads)
    sizes = {name: getattr(config.gan, name) for name in ("labels", "steps", "landmarks")}
    known = _transitions.made_up(config.motions, **sizes)
    chart = motion_examples.chart_of(known, labels=config.gan.labels, rank=config.gan.rank, pose=config.gan.pose)
    examples = motion_examples.examples_of(chart, [known])
    gan = handed(fit_motion.fit_gan, examples, chart, plan=config.gan_plan, config=config.gan)
    field = handed(fit_motion.fit_flow, examples, chart, plan=config.flow_plan, config=config.flow)
    rows = _steps("GAN step", gan, config, config.gan_plan, "Gan")
    rows += _steps("flow step", field, config, config.flow_plan, "Flow")
    rows += _reference(known, chart, config)
    rows += _sampling(motion.Params(chart, gan.state.extra), flow.Params(chart, field.state.extra), config)
    rows += _compared(config, sizes) + [_pass(config, sizes, pace) for pace in augment.PACES]
    return rows + _sizes(chart, config, gan.state.params, field.state.params)


def handed(fit: Callable, *args, **options) -> Run:
    """What a fit hands to the training loop, which is not entered: what is timed is what is trained."""
    with mock.patch.object(training, "run") as loop, tempfile.TemporaryDirectory() as folder:
        fit(*args, folder, **options)
    step, state, batches, _ = loop.call_args.args
    return Run(step, state, batches(0, 1)[0], loop.call_args.kwargs["constants"])


def compiled(run: Run, *, scanned: int = 0) -> tuple[Callable, dict[str, float]]:
    """The step, or `scanned` of them on one batch, as a program of (state, rows, held); and what it costs."""

    def several(state, rows, held):
        return jax.lax.scan(lambda state, _: run.step(state, rows, held), state, length=scanned)

    begun = time.perf_counter()
    program = jax.jit(several if scanned else run.step, donate_argnums=0).lower(*run[1:]).compile()
    seconds, size = time.perf_counter() - begun, program.memory_analysis()
    held = size.argument_size_in_bytes + size.output_size_in_bytes - size.alias_size_in_bytes + size.temp_size_in_bytes
    return program, {"compile_s": seconds, "memory_mb": held / 1e6}


def _steps(
    task: str, run: Run, config: Config, plan: fit_motion.GanPlan | fit_motion.FlowPlan, peer: str
) -> list[dict]:
    """A training step beside PyTorch's."""
    (single, cost), (several, costs) = compiled(run), compiled(run, scanned=SCAN)
    functions = {"facejax": _onward(single, run), "facejax, scanned": _onward(several, run)}
    if torch is not None:
        make = getattr(_motion_torch, peer)
        _motion_torch.check(make(run.state, run.held, plan), single, run.state, run.rows, run.held)
        theirs, chosen = make(run.state, run.held, plan), torch.tensor(run.rows).long()
        functions["torch"] = lambda: theirs.step(chosen)
        if config.threads > 1:
            functions["torch, 1 thread"] = lambda: _alone(theirs.step, chosen)
    rows = _rows(task, functions, 5 if config.quick else 11)
    found = {"facejax": cost, "facejax, scanned": costs}
    if torch is not None:
        found["torch"] = {"memory_mb": _torch_memory.peak_mb(functions["torch"], theirs.held())}
    return [row | {"minutes": plan.steps * row["median_ms"] / 60e3} | found.get(row["side"], {}) for row in rows]


def _onward(program: Callable, run: Run) -> Callable:
    """A function that goes on from where it was with every call, and returns the metrics."""
    state = jax.tree.map(jnp.copy, run.state)  # what is donated is the copy

    def go() -> dict[str, jax.Array]:
        nonlocal state
        state, metrics = program(state, run.rows, run.held)
        return metrics

    return go


def _alone(function: Callable, argument: Any) -> Any:
    """A call with one thread: for small products, or on a busy machine, that can be the faster way."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        return function(argument)
    finally:
        torch.set_num_threads(before)


def _reference(known: Motions, chart: charts.Chart, config: Config) -> list[dict]:
    """The step of the GAN as its authors built it, on few samples."""
    plan, rows = fit_motion.REFERENCE._replace(batch=config.reference_batch), []
    for divisor in (config.width_divisor, 1)[: 1 + config.whole]:
        sizes = motion_reference.Config(width_divisor=divisor)
        found = handed(fit_motion.fit_reference, known, chart, plan=plan, config=sizes)
        program, cost = compiled(found)
        functions = {f"facejax, width / {divisor}": _onward(program, found)}
        rows += [row | cost for row in _rows("reference step", functions, 3, items=plan.batch)]
    return rows


def _sampling(gan: motion.Params, field: flow.Params, config: Config) -> list[dict]:
    """Motions of one pair of labels."""
    keys, pose = jax.random.split(jax.random.key(0), config.samples), jnp.zeros(config.gan.pose)
    draw = jax.jit(jax.vmap(generators.sample, (None, 0, None, None, None)))
    functions = {"GAN": lambda: draw(gan, keys, 1, 2, pose), "flow": lambda: draw(field, keys, 1, 2, pose)}
    return _rows(f"{config.samples} motions", functions, 5 if config.quick else 11, items=config.samples)


def _compared(config: Config, sizes: dict[str, int]) -> list[dict]:
    """Transitions in three ways."""
    functions = _transitions.forms(*_transitions.problem(config.compared, people=config.people, **sizes))
    return _rows(f"{config.compared:,} transitions", functions, 3 if config.quick else 9, items=config.compared)


def _pass(config: Config, sizes: dict[str, int], pace: str) -> dict:
    """One pass over many transitions in a process of its own."""
    count = config.transitions // 15 if config.quick else config.transitions
    found = _apart(sizes | {"people": config.people, "count": count, "pace": pace})
    return {"task": f"{count:,} transitions", "side": f"facejax, {pace}, streamed", **found}


def _apart(options: dict) -> dict[str, float]:
    command = [sys.executable, "-m", "benchmarks._transitions", json.dumps(options)]
    return json.loads(subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.PIPE).stdout)


def _sizes(chart: charts.Chart, config: Config, gan: steps.Players, field: flow.Weights) -> list[dict]:
    """How many numbers are trained."""
    networks = {"GAN, generator": gan.generator, "GAN, critic": gan.critic, "flow": field}
    for divisor in (config.width_divisor, 1):
        sizes = motion_reference.Config(*chart.p.shape[:2], len(chart.mean), width_divisor=divisor)
        for name, network in (("generator", motion_reference.generator), ("critic", motion_reference.critic)):
            made = jax.eval_shape(partial(network.init, config=sizes), jax.random.key(0), chart)
            networks[f"reference, width / {divisor}, {name}"] = made.weights
    count = {side: sum(leaf.size for leaf in jax.tree.leaves(tree)) for side, tree in networks.items()}
    return [{"task": "weights", "side": side, "weights": number} for side, number in count.items()]


def _rows(task: str, functions: dict[str, Callable], repeats: int, *, items: int = 1) -> list[dict]:
    """Times of functions in turns; a call makes so many items. Those that are scanned count as SCAN calls."""
    rested = {}
    for name, function in functions.items():
        rested |= {name: function, f"{name}, rest": lambda: time.sleep(REST)}
    found = _measure.interleaved(rested, repeats=repeats)
    rows = []
    for name in functions:
        calls = SCAN if name.endswith("scanned") else 1
        least, median = (1e3 * found[name][key] / calls for key in ("min_s", "median_s"))
        over = median / rows[0]["median_ms"] if rows else 1.0
        row = {"task": task, "side": name, "first_s": found[name]["first_s"], "min_ms": least, "median_ms": median}
        rows.append(row | {"over_first": over, "per_s": 1e3 * items / median})
    return rows


if __name__ == "__main__":
    options = tyro.cli(Config, prog="python -m benchmarks.motion", description=__doc__)
    _measure.report(run(options), options.out)
