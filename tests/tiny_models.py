"""Small models for tests of the pipeline: 162 vertices, four landmarks, three labels; untrained, nothing is zero."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import trimesh

from facejax.mesh import hierarchy as mesh_hierarchy
from facejax.mesh import strain
from facejax.models import bundle
from facejax.models.decoders import gpmm, gpmm_fit, gpmm_residual, residual, s2d_dec
from facejax.models.motion import flow_matching, motion3dgan, start_poses
from tests.models.motion.test_flow_matching import CONFIG as FLOW
from tests.models.motion.test_motion3dgan import CONFIG, fitted, plain_weights, toy

LABELS = bundle.Labels(("neutral", "smile", "frown"))
CHANNELS = (8, 4, 4)  # of two levels: tests compile many functions


@functools.cache
def make(*, generator: str = "flow", decoder: str = "gpmm", subdivisions: int = 2) -> bundle.Models:
    """Return models; `generator` is "flow" or "gan", `decoder` "gpmm" or "s2d"."""
    ball = trimesh.creation.icosphere(subdivisions=subdivisions)
    rest, faces = 50.0 * np.asarray(ball.vertices), np.asarray(ball.faces, np.int32)
    marks = np.array([0, 9, 17, 30], np.int32)
    rng = np.random.default_rng(0)
    modes = np.sin(rest @ rng.normal(size=(3, 15)) / 40).reshape(len(rest), 5, 3).transpose(1, 0, 2)
    chart = fitted(toy(), labels=3, rank=CONFIG.rank)
    with plain_weights():
        if generator == "gan":
            motion = motion3dgan.generator.init(jax.random.key(0), chart, config=CONFIG)
        else:
            motion = flow_matching.init(jax.random.key(0), chart, config=FLOW)
    hierarchy = jax.device_put(mesh_hierarchy.build(rest, faces, factors=(3, 3), lengths=3))
    if decoder == "gpmm":
        moved = np.einsum("tk,knx->tnx", rng.normal(size=(30, 5)), modes)
        person = gpmm_fit.Person(rest, moved[:, marks], moved)
        base = gpmm_fit.fit([person], faces, marks, prior=gpmm.Prior(True, 0.1, 1e-3), components=5)
        ones = jnp.ones(())
        scale = residual.Scale(jnp.asarray(rest, jnp.float32), jnp.zeros((4, 3)), ones, 0.1 * ones)
        network = residual.init(jax.random.key(1), hierarchy, scale, channels=CHANNELS, width=4)
        shared = 0.1 * jax.random.normal(jax.random.key(2), network.weights["shared"].shape)
        network = network._replace(weights=network.weights | {"shared": shared})
        tables = jax.device_put(strain.vertex_triangles(faces, len(rest)))
        decoded = gpmm_residual.GPMMResidual(in_float32(base), network, hierarchy, tables)
    else:
        decoded = s2d_dec.init(jax.random.key(1), hierarchy, landmarks=4, channels=CHANNELS)
    return bundle.Models(
        labels=LABELS,
        face=bundle.Face(rest.astype(np.float32), faces, marks, np.zeros(0, np.int32), np.ones(len(rest), bool)),
        motion=motion,
        starts=start_poses.fit(rng.normal(size=(40, CONFIG.pose)), np.repeat([1, 2], 20), classes=3),
        hierarchy=hierarchy,
        decoder=decoded,
    )


def in_float32(tree):
    return cast(tree, jnp.float32)


def cast(tree, dtype):
    """Return the tree with its floating leaves in a dtype."""
    return jax.tree.map(
        lambda x: jnp.asarray(x, dtype) if jnp.issubdtype(jnp.result_type(x), jnp.floating) else x, tree
    )
