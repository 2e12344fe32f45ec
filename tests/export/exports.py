"""Inputs of exported functions, and small expression networks, for tests."""

import jax
import jax.numpy as jnp
import numpy as np

from facejax.export import functions
from facejax.inference import composition, expressions, pipeline
from facejax.models import expression_lstm

FRAMES = (9, 6)


def inputs(models, *, batch=2, frames=FRAMES):
    """The arrays of a motion and its face by name, the prepared face, and the motion (batch, F, L, 3)."""
    labels = jnp.asarray([[0, 1, 2], [1, 0, 2], [2, 0, 1]], jnp.int32)[:batch, : len(frames) + 1]
    noise = pipeline.sample_noise(models, jax.random.key(3), labels)
    face = pipeline.prepare(models, models.face.vertices)
    drawn = len(models.motion.chart.p) + 1
    arrays = {"choice": noise.choice, "blur": noise.blur, "noise": noise.transitions, "labels": labels}
    arrays |= {"timeline": composition.timeline(frames, drawn=drawn)}
    arrays |= functions.face_arrays(face) | {"intensity": jnp.full(batch, 0.8)}
    motion = pipeline.motion_from_noise(models, noise, labels, face, frames=frames, intensity=0.8)
    return arrays, face, motion


def networks(*, start="neutral"):
    """Two untrained expression networks of four landmarks."""
    config = expression_lstm.Config(landmarks=4, hidden=8, layers=2, start=start)
    neutral = jnp.asarray(np.random.default_rng(1).normal(size=(4, 3)), jnp.float32)
    one = jnp.ones(())
    scale = expression_lstm.Scale(0.1 * one, neutral, one, 0.5 * one, None)
    both = [expression_lstm.init(key, scale, config=config) for key in jax.random.split(jax.random.key(0))]
    params = jax.tree.map(lambda *leaves: jnp.stack(leaves), *both)
    return expressions.Expressions(("joy", "anger"), params, config, 30.0, 20, {})
