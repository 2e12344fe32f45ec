"""The catalogue of exported functions: the same numbers as the pipeline, from named arrays."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from facejax.export import functions
from facejax.inference import composition, pipeline
from tests import tiny_models

BATCH = 2
FRAMES = (9, 6)


def inputs(models):
    """The arrays of every input of a motion and its face, by name."""
    labels = jnp.asarray([[0, 1, 2], [1, 0, 2]], jnp.int32)
    noise = pipeline.sample_noise(models, jax.random.key(3), labels)
    face = pipeline.prepare(models, models.face.vertices)
    drawn = len(models.motion.chart.p) + 1
    arrays = {"choice": noise.choice, "blur": noise.blur, "noise": noise.transitions, "labels": labels}
    arrays |= {"timeline": jnp.asarray(composition.timeline(FRAMES, drawn=drawn))}
    arrays |= functions.face_arrays(face) | {"intensity": jnp.full(BATCH, 0.8)}
    motion = pipeline.motion_from_noise(models, noise, labels, face, frames=FRAMES, intensity=0.8)
    return arrays, face, motion


def call(function, arrays):
    found = function.call(function.params, *(arrays[name] for name in function.inputs))
    return dict(zip(function.outputs, found, strict=True))


@pytest.mark.parametrize("generator", ["flow", "gan"])
@pytest.mark.parametrize("decoder", ["gpmm", "s2d"])
def test_functions_give_what_the_pipeline_gives(generator, decoder):
    models = tiny_models.make(generator=generator, decoder=decoder)
    arrays, face, motion = inputs(models)
    found = functions.catalogue(
        models, [name for name in functions.NAMES[:5] if (decoder, name) != ("s2d", "decoder_linear")]
    )
    expected = {
        "motion": motion,
        "decoder": pipeline.vertices(models, face, motion[:, 3]),
        "decoder_linear": pipeline.vertices(models, face, motion[:, 3], refined=False),
        "chain": pipeline.vertices(models, face, motion),
    }
    for name in found.keys() - {"prepare"}:
        (output,) = call(found[name], arrays | {"landmarks": motion[:, 3]}).values()
        np.testing.assert_allclose(output, expected[name], atol=2e-5)
    prepared = call(found["prepare"], {"neutral": models.face.vertices})
    assert list(prepared) == list(functions.face_arrays(face))
    for name, array in functions.face_arrays(face).items():
        np.testing.assert_allclose(prepared[name], array, rtol=1e-4, atol=1e-4)
