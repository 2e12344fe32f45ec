"""Fit the GPMM and the residual decoder.

The GPMM is chosen and fitted first (`fit_gpmm`). The network is trained on the residuals of its cross-validated
predictions, which resemble those on new faces; the last fold of people (or labels) is held out to choose the gate. A
run resumes from its checkpoints; a finished one is read from `network.safetensors`.
"""

from __future__ import annotations

import dataclasses
import hashlib
import os
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.sharding import Mesh

from facejax.data.mesh_subset import MeshSubset
from facejax.io import weights
from facejax.mesh import strain
from facejax.mesh.hierarchy import Hierarchy
from facejax.models import layers
from facejax.models.decoders import gpmm, gpmm_residual, residual
from facejax.training import loop, metric_logger, sharding, steps
from facejax.training.recipes import fit_gpmm

GATES = (0.0, 0.25, 0.5, 0.75, 1.0)
MIN_RELATIVE_GAIN = 0.995  # a gate above 0 must lower the error by 0.5 %


class ResidualPlan(NamedTuple):
    """Training plan of the network."""

    steps: int = 2_500
    batch: int = 16
    rate: float = 2e-3  # decays to zero along a cosine
    weight_decay: float = 1e-4
    # In units of `Scale.unit`: below it the loss is quadratic. Wrinkles are sparse, and an absolute loss predicts none.
    soft: float = 0.1


def fit(
    train: MeshSubset,
    hierarchy: Hierarchy,
    folder: str | os.PathLike[str],
    *,
    plan: ResidualPlan = ResidualPlan(),
    by: str = "subjects",
    seed: int = 0,
    base: fit_gpmm.FittedGPMM | None = None,
    device_mesh: Mesh | None = None,
) -> gpmm_residual.GPMMResidual:
    """Train on meshes.

    Args:
      by: what will be new at test time, "subjects" or "labels".
      base: a fitted GPMM, if there is one.
      device_mesh: as in `loop.run`.
    """
    folder, data = Path(folder), train.data
    chosen = hashlib.sha256(train.indices.tobytes()).hexdigest()
    base = base or fit_gpmm.fit(train, by=by)
    claim = {"plan": plan._asdict(), "by": by, "seed": seed, "dataset": data.index["spec"], "meshes": chosen}
    metric_logger.claim_folder(folder, claim | {"base": dataclasses.asdict(base.params.prior)})
    tables = jax.device_put(strain.vertex_triangles(np.asarray(data.faces), len(base.params.face)))
    hierarchy = jax.device_put(hierarchy)
    done = folder / "network.safetensors"
    if done.exists():
        return gpmm_residual.GPMMResidual(
            base.params, _load(done, hierarchy, base.params, len(data.landmark_index)), hierarchy, tables
        )
    predictions = base.held_out(train)
    *_, (_, kept) = base.folds
    seen = np.setdiff1d(np.arange(train.count), kept)
    scale = _measure(
        train.where(np.isin(np.arange(train.count), seen)), predictions[seen], np.asarray(base.params.face)
    )
    init_key, run_key = jax.random.split(jax.random.key(seed))
    params = residual.init(init_key, hierarchy, scale)

    def loss(
        trained: layers.Weights, key: jax.Array, batch: loop.Tree, constants: loop.Tree
    ) -> tuple[jax.Array, loop.Metrics]:
        scale, hierarchy, tables, neutrals = constants
        marks, start, target, owner = batch
        found = residual.apply(
            residual.ResidualDecoder(scale, trained, jnp.ones(())), hierarchy, tables, marks, start, neutrals[owner]
        )
        squared = jnp.sum(jnp.square((found - target) / scale.unit), axis=-1)
        # Charbonnier loss: a distance, quadratic near zero.
        value = jnp.mean(jnp.sqrt(squared + plan.soft**2))
        return value, {"error_mm": scale.unit * jnp.mean(jnp.sqrt(squared))}

    optimiser = optax.adamw(optax.cosine_decay_schedule(plan.rate, plan.steps), weight_decay=plan.weight_decay)
    indices = loop.epoch_indices(seed, len(seen), plan.batch)

    def batches(first: int, count: int):
        rows = seen[indices(first, count).ravel()]
        found = (*train.read(rows), predictions[rows], train.owner[rows])
        marks, target, start, owner = (x.reshape(count, plan.batch, *x.shape[1:]) for x in found)
        return marks, start, target, owner

    state = loop.run(
        steps.supervised(loss, optimiser),
        steps.init_supervised(params.weights, optimiser, run_key),
        batches,
        folder,
        steps=plan.steps,
        constants=(scale, hierarchy, tables, jnp.asarray(data.neutral)),
        chunk=25,
        device_mesh=device_mesh,
    )
    network = residual.ResidualDecoder(scale, state.params, jnp.ones(()))
    fitted = gpmm_residual.GPMMResidual(base.params, network, hierarchy, tables)
    network = network._replace(gate=jnp.float32(_gate(fitted, train, predictions, kept)))
    # Saved with its gate: computing the held-out predictions for the choice takes a minute.
    if sharding.is_primary():
        weights.save(done, network._asdict())
    sharding.barrier("the network is written")
    return fitted.replace(network=network)


def _load(path: Path, hierarchy: Hierarchy, base: gpmm.GPMM, landmarks: int) -> residual.ResidualDecoder:
    blank = residual.Scale(jnp.asarray(base.face, jnp.float32), jnp.zeros((landmarks, 3)), jnp.ones(()), jnp.ones(()))
    like = jax.eval_shape(lambda key: residual.init(key, hierarchy, blank), jax.random.key(0))
    return residual.ResidualDecoder(**jax.tree.map(jnp.asarray, weights.load(path, like._asdict())[0]))


def _measure(train: MeshSubset, predictions: np.ndarray, face: np.ndarray) -> residual.Scale:
    sums, squares, left, count = np.zeros(()), 0.0, 0.0, 0
    for marks, vertices in train:
        left += np.sum(np.square(vertices - predictions[count : count + len(vertices)], dtype=np.float64))
        count += len(marks)
        sums, squares = sums + marks.sum(axis=0, dtype=np.float64), squares + np.sum(np.square(marks, dtype=np.float64))
    mean = sums / count
    deviation = np.sqrt(max(squares / (count * mean.size) - np.mean(mean**2), 1e-12))
    unit = max(np.sqrt(left / (count * face.size)), 1e-6)
    return residual.Scale(*(jnp.asarray(x, jnp.float32) for x in (face, mean, deviation, unit)))


def _gate(fitted: gpmm_residual.GPMMResidual, train: MeshSubset, predictions: np.ndarray, kept: np.ndarray) -> float:
    """Return the share of the network's output with the least error on held-out meshes."""
    errors, count = np.zeros(len(GATES)), 0
    for low in range(0, len(kept), 256):
        rows = kept[low : low + 256 : 2]
        marks, vertices = train.read(rows)
        base = predictions[rows]
        rest = np.asarray(train.data.neutral)[train.owner[rows]]
        whole = np.asarray(gpmm_residual.refine(fitted, marks, base, rest)) - base
        left = vertices - base
        errors += [np.linalg.norm(left - gate * whole, axis=-1).mean(axis=-1).sum() for gate in GATES]
        count += len(rows)
    best = int(np.argmin(errors))
    return GATES[best] if errors[best] < MIN_RELATIVE_GAIN * errors[0] else 0.0
