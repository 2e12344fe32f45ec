"""Fit the modified Neural3DMM, a baseline, to meshes. A run keeps checkpoints in a folder and resumes from them."""

from __future__ import annotations

import hashlib
import os
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.sharding import Mesh

from facejax import losses
from facejax.data.mesh_subset import MeshSubset
from facejax.mesh.hierarchy import Hierarchy
from facejax.mesh.stencils import Stencil
from facejax.models import layers
from facejax.models.decoders import neural3dmm, s2d_dec
from facejax.training import loop, metric_logger, steps
from facejax.training.recipes import fit_s2d_dec

BATCH = 16


class Neural3DMMPlan(NamedTuple):
    """Training plan: loss L_pr alone (Otberdout et al. 2023, 4.2), otherwise as S2D-Dec."""

    steps: int = 3_000
    batch: int = BATCH
    rate: float = 1e-3  # decays to zero along a cosine
    weight_decay: float = 5e-5
    weighting: str = "linear"


class FittedNeural3DMM(NamedTuple):
    """The parameters and the index tables that `apply` needs."""

    params: neural3dmm.Neural3DMM
    hierarchy: Hierarchy
    down: tuple[Stencil, ...]


def fit(
    train: MeshSubset,
    hierarchy: Hierarchy,
    folder: str | os.PathLike[str],
    *,
    plan: Neural3DMMPlan = Neural3DMMPlan(),
    seed: int = 0,
    device_mesh: Mesh | None = None,
) -> FittedNeural3DMM:
    """Train on meshes; `device_mesh` as in `loop.run`."""
    data = train.data
    chosen = hashlib.sha256(train.indices.tobytes()).hexdigest()
    metric_logger.claim_folder(
        folder, {"plan": plan._asdict(), "seed": seed, "dataset": data.index["spec"], "meshes": chosen}
    )
    faces = np.asarray(data.neutral[train.subjects], np.float64)
    marks = s2d_dec.measure(train)
    scale = neural3dmm.Scale(
        jnp.asarray(faces.mean(axis=0), jnp.float32),
        jnp.float32(max((faces - faces.mean(axis=0)).std(), 1e-6)),
        marks.landmark_mean,
        marks.landmark_std,
    )
    weights = fit_s2d_dec.vertex_weights(train, plan.weighting)
    init_key, run_key = jax.random.split(jax.random.key(seed))
    params = neural3dmm.init(init_key, hierarchy, scale)
    down = jax.device_put(neural3dmm.downsampling_spirals(hierarchy))
    hierarchy = jax.device_put(hierarchy)

    def loss(
        trained: layers.Weights, key: jax.Array, batch: loop.Tree, constants: loop.Tree
    ) -> tuple[jax.Array, loop.Metrics]:
        scale, hierarchy, down, weights, neutrals = constants
        marks, target, owner = batch
        rest = neutrals[owner]
        found = neural3dmm.apply(neural3dmm.Neural3DMM(scale, trained), hierarchy, down, marks, rest) - rest
        distance = jnp.linalg.norm(jax.lax.stop_gradient(found - target), axis=-1)
        return losses.weighted_l1(found, target, weights), {"error_mm": jnp.mean(distance)}

    optimiser = optax.adamw(optax.cosine_decay_schedule(plan.rate, plan.steps), weight_decay=plan.weight_decay)
    indices = loop.epoch_indices(seed, train.count, plan.batch)

    def batches(first: int, count: int):
        rows = indices(first, count).ravel()
        found = (*train.read(rows), train.owner[rows])
        return tuple(x.reshape(count, plan.batch, *x.shape[1:]) for x in found)

    state = loop.run(
        steps.supervised(loss, optimiser),
        steps.init_supervised(params.weights, optimiser, run_key),
        batches,
        folder,
        steps=plan.steps,
        constants=(scale, hierarchy, down, weights, jnp.asarray(data.neutral)),
        chunk=50,
        device_mesh=device_mesh,
    )
    return FittedNeural3DMM(neural3dmm.Neural3DMM(scale, state.params), hierarchy, down)


def apply(fitted: FittedNeural3DMM, displacements: np.ndarray, neutral: np.ndarray) -> np.ndarray:
    """Return vertex displacements (T, N, 3) of one face (N, 3) from its landmark displacements (T, L, 3)."""
    found = [np.empty((0, *np.shape(neutral)), np.float32)]
    for low in range(0, len(displacements), BATCH):
        marks = np.asarray(displacements[low : low + BATCH], np.float32)
        rest = jnp.broadcast_to(jnp.asarray(neutral, jnp.float32), (len(marks), *np.shape(neutral)))
        found.append(np.asarray(neural3dmm.apply(fitted.params, fitted.hierarchy, fitted.down, marks, rest) - rest))
    return np.concatenate(found)
