"""prepare, motion and vertices as pure functions: every transformation of JAX, in any order, on tiny models."""

import subprocess
import sys
import threading
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import PartitionSpec as P

from facejax.inference import composition, pipeline
from tests import tiny_models

ROOT = Path(__file__).parents[2]
FRAMES = 4
KEY = jax.random.key(7)


@pytest.fixture(scope="module", params=["gpmm", "s2d"])
def models(request):
    """Each decoder with one of the generators; the flow takes longer to compile."""
    return tiny_models.make(decoder=request.param, generator={"gpmm": "gan", "s2d": "flow"}[request.param])


@pytest.fixture(scope="module")
def gpmm_models():
    """For what does not depend on the decoder."""
    return tiny_models.make(generator="gan")


@pytest.fixture(scope="module")
def neutrals():
    rest = tiny_models.make().face.vertices
    return np.stack([rest @ (np.eye(3) + 0.1 * np.diag(row)) for row in np.eye(3)]).astype(np.float32)


def whole(models, key, labels, neutral, intensity=1.0):
    """From labels to the vertices of the last frames."""
    face = pipeline.prepare(models, neutral)
    moved = pipeline.motion(models, key, labels, face, frames=FRAMES, intensity=intensity)
    return pipeline.vertices(models, face, moved[-2:])


LABELS = np.array([0, 1, 2], np.int32)


def test_jit_first_and_eager_after_and_the_reverse(models, neutrals):
    jax.clear_caches()
    compiled = jax.jit(whole)(models, KEY, LABELS, neutrals[0])
    eager = whole(models, KEY, LABELS, neutrals[0])
    again = jax.jit(lambda *a: whole(*a))(models, KEY, LABELS, neutrals[0])
    np.testing.assert_allclose(compiled, eager, atol=5e-5)
    np.testing.assert_allclose(again, eager, atol=5e-5)
    # Models that are closed over are constants, and give the same.
    np.testing.assert_allclose(jax.jit(lambda face: whole(models, KEY, LABELS, face))(neutrals[0]), eager, atol=5e-5)


def test_vmap_over_keys_labels_and_faces_at_once(models, neutrals):
    keys = jax.random.split(KEY, 3)
    labels = np.array([[0, 1, 2], [2, 0, 1], [1, 2, 0]], np.int32)
    expected = [whole(models, *each) for each in zip(keys, labels, neutrals, strict=True)]
    found = jax.vmap(whole, (None, 0, 0, 0))(models, keys, labels, neutrals)
    np.testing.assert_allclose(found, expected, atol=5e-5)
    for axes, row in (((None, 0, None, None), 0), ((None, None, 0, None), 1), ((None, None, None, 0), 2)):
        arguments = [keys[0], labels[0], neutrals[0]]
        arguments[row] = (keys, labels, neutrals)[row]
        one = [keys[0], labels[0], neutrals[0]]
        one[row] = arguments[row][2]
        np.testing.assert_allclose(
            jax.vmap(whole, axes)(models, *arguments)[2], whole(models, *one), atol=5e-5, err_msg=str(axes)
        )


def test_leading_axes_of_labels_are_one_motion_each(gpmm_models, neutrals):
    face = pipeline.prepare(gpmm_models, neutrals[0])
    labels = np.array([[[0, 1], [0, 2]], [[1, 0], [2, 0]]], np.int32)
    found = pipeline.motion(gpmm_models, KEY, labels, face, frames=FRAMES)
    keys = jax.random.split(KEY, (2, 2))
    assert found.shape == (2, 2, FRAMES, 4, 3)
    for i in np.ndindex(2, 2):
        one = pipeline.motion(gpmm_models, keys[i], labels[i], face, frames=FRAMES)
        np.testing.assert_allclose(found[i], one, atol=1e-5)
    np.testing.assert_array_equal(pipeline.motion(gpmm_models, keys, labels, face, frames=FRAMES), found)


@pytest.mark.parametrize("what", ["neutral", "intensity", "landmarks", "noise"])
def test_derivatives_are_those_of_finite_differences(models, neutrals, what):
    with jax.enable_x64(True):
        exact = tiny_models.cast(models, jnp.float64)
        neutral = jnp.asarray(neutrals[0], jnp.float64)
        face = pipeline.prepare(exact, neutral)
        marks = pipeline.motion(exact, KEY, LABELS, face, frames=FRAMES)
        assert marks.dtype == jnp.float64
        gpmm = hasattr(exact.decoder, "base")
        value, at = {
            "neutral": (lambda x: whole(exact, KEY, LABELS, x), neutral),
            "intensity": (lambda x: whole(exact, KEY, LABELS, neutral, x), jnp.asarray(0.8)),
            "landmarks": (lambda x: pipeline.vertices(exact, face, x), marks),
            "noise": (lambda x: pipeline.vertices(exact, face, marks, noise=x if gpmm else 0.0), jnp.asarray(0.3)),
        }[what]
        total = jax.jit(lambda x: jnp.sum(jnp.sin(value(x) / 10)))
        slope = jax.grad(total)(at)
        step = np.random.default_rng(0).normal(size=np.shape(at))
        along = (total(at + 1e-5 * step) - total(at - 1e-5 * step)) / 2e-5
        assert value(at).dtype == jnp.float64
        np.testing.assert_allclose(np.sum(slope * step), along, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("generator", ["flow", "gan"])
def test_float32_models_stay_float32_where_float64_is_enabled(neutrals, generator):
    models = tiny_models.make(generator=generator)
    expected = whole(models, KEY, LABELS, neutrals[0])
    with jax.enable_x64(True):
        found = whole(models, KEY, LABELS, neutrals[0])
        assert found.dtype == jnp.float32
        np.testing.assert_allclose(found, expected, atol=1e-4)


def test_inside_scan(gpmm_models, neutrals):
    face = pipeline.prepare(gpmm_models, neutrals[0])
    keys = jax.random.split(KEY, 3)

    def advance(total, key):
        moved = pipeline.motion(gpmm_models, key, LABELS, face, frames=FRAMES)
        return total + pipeline.vertices(gpmm_models, face, moved[-1]), None

    found, _ = jax.lax.scan(advance, jnp.zeros_like(face.neutral), keys)
    each = [pipeline.motion(gpmm_models, key, LABELS, face, frames=FRAMES)[-1] for key in keys]
    np.testing.assert_allclose(found, sum(pipeline.vertices(gpmm_models, face, one) for one in each), atol=2e-4)


def sharded(models, neutral):
    """Compare motions and meshes computed on all devices with those of one."""
    devices = jax.devices()
    mesh = jax.make_mesh((len(devices),), ("data",), axis_types=(jax.sharding.AxisType.Auto,))
    keys = jax.random.split(KEY, 2 * len(devices))

    def part(models, keys):
        return jax.vmap(whole, (None, 0, None, None))(models, keys, LABELS, neutral)

    specs = {"in_specs": (P(), P("data")), "out_specs": P("data"), "check_vma": False}
    found = jax.jit(jax.shard_map(part, mesh=mesh, **specs))(models, keys)
    assert len(found.sharding.device_set) == len(devices)
    np.testing.assert_allclose(found, part(models, keys), atol=5e-5)
    return len(devices)


def test_under_shard_map_on_four_devices():
    script = (
        "import jax; jax.config.update('jax_num_cpu_devices', 4)\n"
        "from tests import tiny_models\n"
        "from tests.inference import test_pure_core\n"
        "models = tiny_models.make(generator='gan')\n"
        "print(test_pure_core.sharded(models, models.face.vertices), 'devices')"
    )
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["4", "devices"]


def test_eight_threads_get_the_same(gpmm_models, neutrals):
    keys = jax.random.split(KEY, 8)
    expected = [np.asarray(whole(gpmm_models, key, LABELS, neutrals[i % 3])) for i, key in enumerate(keys)]
    found = [None] * 8

    def work(i):
        found[i] = np.asarray(whole(gpmm_models, keys[i], LABELS, neutrals[i % 3]))

    threads = [threading.Thread(target=work, args=(i,)) for i in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(one, other)


def test_one_compilation_per_shape_and_models_of_other_sizes(neutrals):
    small = tiny_models.make(generator="gan")
    other = small.replace(about=small.about | {"seed": 1}, starts=jax.tree.map(lambda x: x * 0.5, small.starts))
    large = tiny_models.make(generator="gan", subdivisions=3)
    traced = []

    @jax.jit
    def counted(models, key, labels, neutral):
        traced.append(len(neutral))
        return whole(models, key, labels, neutral)

    first = counted(small, KEY, LABELS, neutrals[0])
    counted(other, KEY, LABELS[::-1], neutrals[1])
    assert len(traced) == 1
    assert counted(large, KEY, LABELS, large.face.vertices).shape == (2, 642, 3)
    np.testing.assert_array_equal(counted(small, KEY, LABELS, neutrals[0]), first)
    assert len(traced) == 2


def test_without_a_share_of_the_network_the_answer_is_the_linear_one(neutrals):
    models = tiny_models.make(generator="gan")
    network = models.decoder.network._replace(gate=jnp.zeros(()))
    closed = models.replace(decoder=models.decoder.replace(network=network))
    face = pipeline.prepare(closed, neutrals[0])
    marks = pipeline.motion(closed, KEY, LABELS, face, frames=FRAMES)
    found, linear = (pipeline.vertices(closed, face, marks, refined=refined) for refined in (True, False))
    np.testing.assert_array_equal(found, linear)


def test_wrong_arguments_are_named(models, neutrals):
    face = pipeline.prepare(models, neutrals[0])
    for labels, words in (
        (np.array([0, 3]), "number 2 is 3, expected one from 0 to 2"),
        (np.array([0, 0]), "repeats the previous one"),
        (["neutral", "smile"], "models.labels.encode"),
        (np.array([1]), "at least a start and an end"),
    ):
        with pytest.raises(ValueError, match=words):
            pipeline.motion(models, KEY, labels, face)
    with pytest.raises(ValueError, match="unknown label 'smirk': did you mean smile"):
        models.labels.encode(["neutral", "smirk"])
    with pytest.raises(ValueError, match=r"landmarks: expected \(..., 4, 3\), got \(7, 5, 3\)"):
        pipeline.vertices(models, face, np.zeros((7, 5, 3)))
    with pytest.raises(ValueError, match=r"intensity must lie in 0\.\.2, got 3"):
        pipeline.motion(models, KEY, LABELS, face, intensity=3.0)
    with pytest.raises(ValueError, match=r"neutral: expected vertices \(162, 3\)"):
        pipeline.prepare(models, neutrals[0][1:])


def test_motion_is_a_function_of_its_noise(gpmm_models, neutrals):
    face = pipeline.prepare(gpmm_models, neutrals[0])
    labels = np.array([[1, 0, 2], [0, 1, 0]])
    noise = pipeline.sample_noise(gpmm_models, KEY, labels)
    found = pipeline.motion_from_noise(gpmm_models, noise, labels, face, frames=FRAMES, intensity=0.5)
    expected = pipeline.motion(gpmm_models, KEY, labels, face, frames=FRAMES, intensity=0.5)
    np.testing.assert_allclose(found, expected, atol=1e-5)
    slope = jax.grad(lambda x: jnp.sum(pipeline.motion_from_noise(gpmm_models, x, labels, face, frames=FRAMES) ** 2))(
        noise
    )
    assert np.abs(slope.transitions).max() > 0 and np.isfinite(slope.transitions).all()
    with pytest.raises(ValueError, match="noise: expected arrays of shapes"):
        pipeline.motion_from_noise(gpmm_models, noise, labels[0], face)


def products(jaxpr):
    """The precision of every matrix product of a function, those of inner functions included."""
    for equation in jaxpr.eqns:
        if equation.primitive.name == "dot_general":
            yield equation.params["precision"]
        for inner in jax.tree.leaves(equation.params, is_leaf=lambda x: hasattr(x, "eqns") or hasattr(x, "jaxpr")):
            if hasattr(inner, "eqns") or hasattr(inner, "jaxpr"):
                yield from products(getattr(inner, "jaxpr", inner))


def test_products_of_positions_ask_for_all_bits():
    """A GPU's default would round them; a CPU's does not, so that only the program can tell."""
    models = tiny_models.make(generator="gan")
    neutral, marks = models.face.vertices, jnp.zeros((3, 4, 3))

    def linear(models, neutral, noise):
        return pipeline.vertices(models, pipeline.prepare(models, neutral), marks, refined=False, noise=noise)

    exact = (jax.lax.Precision.HIGHEST,) * 2
    found = list(products(jax.make_jaxpr(linear)(models, neutral, 0.5).jaxpr))
    assert len(found) >= 6 and set(found) == {exact}
    joined = list(products(jax.make_jaxpr(composition.join)(jnp.zeros((1, 1, 4, 5, 3)), jnp.zeros((6, 4))).jaxpr))
    assert joined == [exact]
    # The check sees products of other precision: those of the generator's layers.
    face = pipeline.prepare(models, neutral)
    drawn = products(jax.make_jaxpr(lambda models, key: pipeline.motion(models, key, LABELS, face))(models, KEY).jaxpr)
    assert set(drawn) == {exact, None}
