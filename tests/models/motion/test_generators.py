"""One call for every generator: the type of the parameters decides, and each answers as its own module does."""

import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest

from facejax.geometry import sphere
from facejax.models.motion import flow_matching, generators, motion3dgan, motion3dgan_reference
from tests.models.motion.test_flow_matching import CONFIG as FLOW
from tests.models.motion.test_flow_matching import moving
from tests.models.motion.test_motion3dgan import CONFIG as GAN
from tests.models.motion.test_motion3dgan import POSE, SHAPE, fitted, plain_weights, toy

REFERENCE = motion3dgan_reference.Config(steps=5, landmarks=4, labels=3, noise=6, width_divisor=32)
MODULES = {"gan": motion3dgan, "reference": motion3dgan_reference, "flow": flow_matching}
KEY = jax.random.key(1)


@pytest.fixture(scope="module")
def made():
    chart = fitted(toy(), labels=3, rank=GAN.rank)
    with plain_weights():
        return {
            "gan": motion3dgan.generator.init(jax.random.key(0), chart, config=GAN),
            "reference": motion3dgan_reference.generator.init(jax.random.key(0), chart, config=REFERENCE),
            "flow": moving(flow_matching.init(jax.random.key(0), chart, config=FLOW), 0.3),
        }


@pytest.mark.parametrize("name", MODULES)
def test_the_type_of_the_parameters_decides(made, name):
    params = made[name]
    steps = {"steps": 2} if name == "flow" else {}
    found = generators.sample(params, KEY, 1, 2, POSE, steps=2)
    noise = jax.random.normal(KEY, (generators.noise_size(params),))
    own = MODULES[name].generate(params, noise, 1, 2, POSE, **steps)
    for a, b in zip(found, own, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-5)
    assert found.q.shape == SHAPE and abs(float(sphere.norm(found.q)) - 1) < 1e-5
    assert found.log_length.shape == found.log_seconds.shape == ()
    assert generators.kind(params) == name and type(params) is generators.KINDS[name]
    other = generators.sample(params, KEY, 1, 2, 0 * POSE, steps=2)
    assert bool(np.any(other.q != found.q)) == generators.uses_start_pose(params) == (name != "reference")
    if name == "reference":
        np.testing.assert_array_equal(found.log_seconds, params.chart.scalar_mean[1, 2, 1])


def test_under_vmap_each_sample_is_the_one_of_its_key_labels_and_pose(made):
    keys, start, end = jax.random.split(KEY, 3), jnp.array([0, 1, 2]), jnp.array([1, 2, 0])
    poses = jnp.stack([0 * POSE, POSE, -POSE])
    many = jax.vmap(generators.sample, (None, 0, 0, 0, 0))(made["gan"], keys, start, end, poses)
    for i in range(3):
        one = generators.sample(made["gan"], keys[i], int(start[i]), int(end[i]), poses[i], steps=2)
        for a, b in zip(many, one, strict=True):
            np.testing.assert_allclose(a[i], b, atol=1e-5)


def test_steps_of_integration_are_the_flows(made):
    few, many = (generators.sample(made["flow"], KEY, 1, 2, POSE, **steps) for steps in ({"steps": 2}, {}))
    assert float(sphere.distance(few.q, many.q)) > 1e-4


def test_wrong_requests_are_named(made, monkeypatch):
    with pytest.raises(TypeError, match=r"parameters of a generator.*got dict"):
        generators.kind(made)
    with monkeypatch.context() as patch, pytest.raises(TypeError, match="got tuple"):
        patch.setattr(jaxtyping.config, "jaxtyping_disable", True)  # what a caller gets: only tests check types
        generators.sample((1, 2), KEY, 0, 1, POSE)
    for steps in (0, -1):
        with pytest.raises(ValueError, match=f"1 or more, got {steps}"):
            generators.sample(made["flow"], KEY, 1, 2, POSE, steps=steps)
