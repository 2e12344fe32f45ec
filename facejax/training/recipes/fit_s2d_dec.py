"""Fit S2D-Dec to meshes.

A run keeps metrics and checkpoints in a folder and resumes from them. The generator of motion is trained separately
(`fit_motion`), as in OT23 4.1.
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
from jax.sharding import Mesh

from facejax import losses
from facejax.data.mesh_subset import MeshSubset
from facejax.mesh.hierarchy import Hierarchy
from facejax.models import layers
from facejax.models.decoders import s2d_dec
from facejax.training import loop, metric_logger, steps


class S2DDecPlan(NamedTuple):
    """Training plan of S2D-Dec."""

    steps: int = 12_000
    batch: int = 16
    rate: float = 1e-3  # decays to zero along a cosine (OT23: x 0.99 per epoch, for 300 epochs)
    weight_decay: float = 5e-5
    beta1: float = 1.0
    beta2: float = 0.1
    reduction: str = "paper"
    weighting: str = "linear"


def fit(
    meshes: MeshSubset,
    hierarchy: Hierarchy,
    folder: str | os.PathLike[str],
    *,
    plan: S2DDecPlan = S2DDecPlan(),
    seed: int = 0,
    device_mesh: Mesh | None = None,
) -> s2d_dec.S2DDec:
    """Train S2D-Dec on meshes, which are read from disk batch by batch; `device_mesh` as in `loop.run`."""
    data = meshes.data
    chosen = hashlib.sha256(meshes.indices.tobytes()).hexdigest()
    metric_logger.claim_folder(
        folder, {"plan": plan._asdict(), "seed": seed, "dataset": data.index["spec"], "meshes": chosen}
    )
    weights = vertex_weights(meshes, plan.weighting)
    init_key, run_key = jax.random.split(jax.random.key(seed))
    scale = s2d_dec.measure(meshes)
    params = s2d_dec.init(init_key, hierarchy, landmarks=len(data.landmark_index), scale=scale)

    def loss(
        trained: layers.Weights, key: jax.Array, batch: loop.Tree, constants: loop.Tree
    ) -> tuple[jax.Array, loop.Metrics]:
        scale, hierarchy, weights = constants
        marks, target = batch
        predicted = s2d_dec.apply(s2d_dec.S2DDec(scale, trained), hierarchy, marks)
        value = losses.s2d(predicted, target, weights, beta1=plan.beta1, beta2=plan.beta2, reduction=plan.reduction)
        # The distance is logged only: its gradient at a vertex without error would be NaN.
        distance = jnp.linalg.norm(jax.lax.stop_gradient(predicted - target), axis=-1)
        return value, {"error_mm": jnp.mean(distance)}

    optimiser = optax.adamw(optax.cosine_decay_schedule(plan.rate, plan.steps), weight_decay=plan.weight_decay)
    state = loop.run(
        steps.supervised(loss, optimiser),
        steps.init_supervised(params.weights, optimiser, run_key),
        mesh_batches(meshes, plan.batch, seed),
        folder,
        steps=plan.steps,
        constants=(scale, jax.device_put(hierarchy), weights),
        chunk=50,
        device_mesh=device_mesh,
    )
    return s2d_dec.S2DDec(scale, state.params)


def vertex_weights(meshes: MeshSubset, weighting: str) -> jax.Array:
    """Return `losses.landmark_weights` (N,) on the mean neutral face of the meshes' subjects."""
    template = np.asarray(meshes.data.neutral[meshes.subjects], np.float64).mean(axis=0)
    return losses.landmark_weights(
        jnp.asarray(template, jnp.float32), jnp.asarray(meshes.data.landmark_index), mode=weighting,
        edge_length=_edge_length(template, meshes.data.faces),
    )  # fmt: skip


def mesh_batches(meshes: MeshSubset, batch: int, seed: int) -> Callable[[int, int], tuple[np.ndarray, np.ndarray]]:
    """Return `batches(first, count)`: landmarks (count, B, L, 3) and vertices (count, B, N, 3), read on demand."""
    indices = loop.epoch_indices(seed, meshes.count, batch)

    def batches(first: int, count: int) -> tuple[np.ndarray, np.ndarray]:
        marks, vertices = meshes.read(indices(first, count).ravel())
        return marks.reshape(count, batch, *marks.shape[1:]), vertices.reshape(count, batch, *vertices.shape[1:])

    return batches


def _edge_length(vertices: np.ndarray, faces: np.ndarray) -> float:
    ends = vertices[np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])]
    return float(np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1).mean())
