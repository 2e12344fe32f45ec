"""Every training loop, on tiny data: `python tests/faults/loops.py LOOP FOLDER`.

Prints `begun` before the first step, and the SHA-256 of the result at the end. Checkpoints are frequent, and steps slow
enough for a kill between any two.
"""

import argparse
import hashlib
import sys
import time
from pathlib import Path

import jax
import numpy as np

STEPS, EVERY = 24, 4


def motions():
    from facejax.data import transitions
    from tests.data.test_motions import recorded

    known = transitions.transitions(recorded(subjects=6), "train", per_pair=6)
    chart = transitions.fit_chart(known, labels=4, rank=8, pose=4)
    return known, chart, transitions.encode_examples(chart, [known])


def gan(folder, mesh):
    from facejax.models.motion import motion3dgan
    from facejax.training.recipes import fit_motion

    _, chart, examples = motions()
    plan = fit_motion.GanPlan(steps=STEPS, batch=4, critic_steps=2)
    config = motion3dgan.Config(width=16, blocks=1, noise=4, embedding=4)
    return fit_motion.fit_gan(examples, chart, folder, plan=plan, config=config, device_mesh=mesh)


def flow(folder, mesh):
    from facejax.models.motion import flow_matching
    from facejax.training.recipes import fit_motion

    _, chart, examples = motions()
    plan = fit_motion.FlowPlan(steps=STEPS, batch=8)
    return fit_motion.fit_flow(
        examples,
        chart,
        folder,
        plan=plan,
        config=flow_matching.Config(width=16, blocks=1, embedding=4),
        device_mesh=mesh,
    )


def reference(folder, mesh):
    from facejax.models.motion import motion3dgan_reference
    from facejax.training.recipes import fit_motion

    known, chart, _ = motions()
    plan = fit_motion.REFERENCE._replace(steps=STEPS, batch=2, critic_steps=2)
    config = motion3dgan_reference.Config(width_divisor=16, noise=4)
    return fit_motion.fit_reference(known, chart, folder, plan=plan, config=config, device_mesh=mesh)


def balls():
    from facejax.data import mesh_subset
    from facejax.mesh import hierarchy as mesh_hierarchy
    from tests.balls import make_ball_dataset

    data = make_ball_dataset()
    template = data.neutral.mean(axis=0, dtype=np.float64)
    hierarchy = mesh_hierarchy.build(template, data.faces, factors=(2, 2, 2, 2), lengths=3)
    return data, mesh_subset.of_split(data, "train", size=20), hierarchy


def decoder(folder, mesh):
    from facejax.training.recipes import fit_s2d_dec

    _, train, hierarchy = balls()
    return fit_s2d_dec.fit(
        train, hierarchy, folder, plan=fit_s2d_dec.S2DDecPlan(steps=STEPS, batch=8), device_mesh=mesh
    )


def residual(folder, mesh):
    from facejax.training.recipes import fit_gpmm, fit_residual

    _, train, hierarchy = balls()
    base, plan = fit_gpmm.fit(train, components=20), fit_residual.ResidualPlan(steps=STEPS, batch=8)
    return fit_residual.fit(train, hierarchy, folder, plan=plan, base=base, device_mesh=mesh).network


def neural3dmm(folder, mesh):
    from facejax.training.recipes import fit_neural3dmm

    _, train, hierarchy = balls()
    plan = fit_neural3dmm.Neural3DMMPlan(steps=STEPS, batch=8)
    return fit_neural3dmm.fit(train, hierarchy, folder, plan=plan, device_mesh=mesh).params


def expressions(folder, mesh):
    from facejax.data import sequences
    from facejax.models import expression_lstm
    from facejax.training.recipes import fit_expression_lstm

    data, _, _ = balls()
    labels = {name: data.labels.index(name) for name in ("a", "b")}
    plan, config = fit_expression_lstm.ExpressionPlan(steps=STEPS, batch=2), expression_lstm.Config(hidden=8, layers=2)
    known = sequences.read(data, "train", tuple(labels))
    return fit_expression_lstm.fit(known, folder, labels=labels, plan=plan, config=config)


LOOPS = {loop.__name__: loop for loop in (gan, flow, reference, decoder, residual, neural3dmm, expressions)}


def plainly(rate: float):
    """Optimisers as one step down the gradient: what the parameters have changed by is the gradient."""
    import optax

    for name in ("adam", "adamw"):
        setattr(optax, name, lambda *args, **options: optax.sgd(rate))


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("loop", choices=LOOPS)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--pause", type=float, default=0.0, help="seconds before every chunk")
    parser.add_argument("--devices", type=int, default=1, help="of this process")
    parser.add_argument("--distributed", action="store_true", help="one of several processes")
    parser.add_argument("--plain", type=float, help="one step down the gradient, at this rate")
    parser.add_argument("--save", type=Path, help="an NPZ for the parameters")
    given = parser.parse_args()
    from facejax.cli import runtime
    from facejax.training import loop, sharding

    jax.config.update("jax_num_cpu_devices", given.devices)
    if given.distributed:
        runtime.join_distributed(patience=10)
    runtime.compile_cache()
    several = given.distributed or given.devices > 1
    if given.plain:
        plainly(given.plain)
    run = loop.run

    def frequent(step, state, batches, folder, **options):
        def slow(first, count):
            if first == 0 or given.pause:
                print("begun", flush=True)
            time.sleep(given.pause)
            return batches(first, count)

        often = {"chunk": EVERY // 2, "save_steps": EVERY} | ({"steps": 1} if given.plain else {})
        return run(step, state, slow, folder, **options | often)

    loop.run = frequent
    leaves = jax.tree.leaves(LOOPS[given.loop](given.folder, sharding.data_mesh() if several else None))
    found = hashlib.sha256()
    for leaf in leaves:
        found.update(np.ascontiguousarray(leaf).tobytes())
    if given.save:
        np.savez(given.save, *leaves)
    print(found.hexdigest(), flush=True)


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[2]))
    main()
