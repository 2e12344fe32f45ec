"""S2D-Dec against its plain form, its laws, and its gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from jax.test_util import check_grads

from facejax.mesh import hierarchy as mesh_hierarchy
from facejax.models.decoders import s2d_dec

BALL = trimesh.creation.icosphere(subdivisions=2)  # 162 vertices
VERTICES, FACES = np.asarray(BALL.vertices), np.asarray(BALL.faces)
HIERARCHY = mesh_hierarchy.build(VERTICES, FACES, factors=(3, 3), lengths=(7, 6), reference=0)
L, CHANNELS = 5, (12, 9, 4)


def array(seed, *shape):
    return jnp.asarray(np.random.default_rng(seed).normal(size=shape), jnp.float32)


def parameters(seed=0):
    """Random everywhere, so that no term of the network vanishes."""
    scale = s2d_dec.Scale(array(1, L, 3), jnp.float32(2), array(2, len(VERTICES), 3), jnp.float32(0.5))
    params = s2d_dec.init(jax.random.key(seed), HIERARCHY, landmarks=L, channels=CHANNELS, scale=scale)
    leaves, tree = jax.tree.flatten(params.weights)
    leaves = [leaf + 0.2 * array(10 + i, *leaf.shape) for i, leaf in enumerate(leaves)]
    return params._replace(weights=jax.tree.unflatten(tree, leaves))


def plain(params, hierarchy, displacements):
    """One sample (L, 3), the obvious way: upsample, gather whole spirals, multiply."""
    scale, weights = params
    x = (displacements - scale.landmark_mean).ravel() / scale.landmark_std
    x = (x @ weights["dense"]["kernel"] + weights["dense"]["bias"]).reshape(hierarchy.sizes[-1], -1)
    *climbs, last = weights["convs"]
    for level, conv in reversed(list(enumerate(reversed(climbs)))):
        x = jnp.einsum("vkc,vk->vc", x[hierarchy.corners[level]], hierarchy.weights[level])
        x = jax.nn.elu(plain_conv(x, hierarchy.spirals[level], conv))
    return scale.vertex_mean + scale.vertex_std * plain_conv(x, hierarchy.spirals[0], last)


def plain_conv(x, spirals, conv):
    x = jnp.concatenate([x, jnp.zeros_like(x[:1])])
    return jnp.einsum("vsc,sco->vo", x[spirals], conv["kernel"]) + conv["bias"]


@pytest.mark.parametrize("batch", [1, 7, 8, 13])
def test_equals_the_plain_form_with_its_gradient(batch):
    params, d = parameters(), array(3, batch, L, 3)
    every = jax.vmap(plain, (None, None, 0))
    np.testing.assert_allclose(s2d_dec.apply(params, HIERARCHY, d), every(params, HIERARCHY, d), rtol=1e-4, atol=1e-4)

    def slope(function):
        def loss(weights):
            return jnp.sum(jnp.sin(function(params._replace(weights=weights), HIERARCHY, d)))

        return jax.grad(loss)(params.weights)

    for a, b in zip(jax.tree.leaves(slope(s2d_dec.apply)), jax.tree.leaves(slope(every)), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-3, atol=2e-3)


@pytest.mark.parametrize("lead", [(), (1,), (3, 2)])
def test_eager_jit_and_vmap_agree(lead):
    params, d = parameters(), array(4, *lead, L, 3)
    found = s2d_dec.apply(params, HIERARCHY, d)
    assert found.shape == (*lead, len(VERTICES), 3)
    with jax.disable_jit():
        np.testing.assert_allclose(s2d_dec.apply(params, HIERARCHY, d), found, atol=1e-4)
    mapped = s2d_dec.apply
    for _ in lead:
        mapped = jax.vmap(mapped, (None, None, 0))
    np.testing.assert_allclose(mapped(params, HIERARCHY, d), found, atol=1e-4)


@pytest.mark.parametrize("chunk", [1, 2, 3, 5, 100])
def test_chunks_change_nothing(chunk):
    params, d = parameters(), array(5, 5, L, 3)
    whole = s2d_dec.apply(params, HIERARCHY, d, chunk=5)
    np.testing.assert_allclose(s2d_dec.apply(params, HIERARCHY, d, chunk=chunk), whole, atol=1e-4)


def test_an_empty_batch_stays_empty():
    assert s2d_dec.apply(parameters(), HIERARCHY, jnp.zeros((0, L, 3))).shape == (0, len(VERTICES), 3)


def test_gradients_forward_reverse_and_finite_differences_agree():
    with jax.enable_x64(True):
        params = jax.tree.map(lambda leaf: leaf.astype(float), parameters())
        check_grads(
            lambda weights, d: jnp.sum(jnp.sin(s2d_dec.apply(params._replace(weights=weights), HIERARCHY, d))),
            (params.weights, array(6, 2, L, 3).astype(float)), order=1, modes=("fwd", "rev"),
        )  # fmt: skip


def test_relabelled_vertices_give_relabelled_output():
    order = np.random.default_rng(1).permutation(len(VERTICES))
    rank = np.argsort(order)
    fields = HIERARCHY._asdict()
    padded = np.append(rank, len(rank))
    arrays = mesh_hierarchy.save(HIERARCHY) | {
        "spirals/0": padded[HIERARCHY.spirals[0][order]].astype(np.int32),
        "corners/0": fields["corners"][0][order],
        "weights/0": fields["weights"][0][order],
    }
    params, d = parameters(), array(7, 2, L, 3)
    moved = params._replace(scale=params.scale._replace(vertex_mean=params.scale.vertex_mean[order]))
    found = s2d_dec.apply(moved, mesh_hierarchy.load(arrays), d)
    np.testing.assert_allclose(found, s2d_dec.apply(params, HIERARCHY, d)[:, order], atol=1e-4)


def test_starts_near_the_mean_displacement():
    params = s2d_dec.init(jax.random.key(0), HIERARCHY, landmarks=L, channels=CHANNELS)
    found = s2d_dec.apply(params, HIERARCHY, array(8, 4, L, 3))
    assert 0 < float(jnp.abs(found).max()) < 0.1


def test_scale_is_never_trained():
    params, d = parameters(), array(9, 2, L, 3)
    slope = jax.grad(lambda p: jnp.sum(s2d_dec.apply(p, HIERARCHY, d)))(params)
    assert not any(leaf.any() for leaf in jax.tree.leaves(slope.scale))
    assert all(leaf.any() for leaf in jax.tree.leaves(slope.weights))


def test_measured_scale_standardises():
    rng = np.random.default_rng(0)
    landmarks, vertices = 3 * rng.normal(size=(50, L, 3)) + 7, 0.1 * rng.normal(size=(50, 11, 3)) - 2
    scale = s2d_dec.measure((landmarks[i : i + 8], vertices[i : i + 8]) for i in range(0, 50, 8))
    np.testing.assert_allclose(scale.landmark_mean, landmarks.mean(axis=0), rtol=1e-5)
    np.testing.assert_allclose(scale.landmark_std, (landmarks - landmarks.mean(axis=0)).std(), rtol=1e-5)
    np.testing.assert_allclose(scale.vertex_mean, vertices.mean(axis=0), rtol=1e-5)
    np.testing.assert_allclose(scale.vertex_std, (vertices - vertices.mean(axis=0)).std(), rtol=1e-4)
    with pytest.raises(ValueError, match="at least one batch"):
        s2d_dec.measure([])


def test_same_shapes_trace_once():
    params = parameters()
    s2d_dec.apply(params, HIERARCHY, array(1, 3, L, 3))
    before = s2d_dec.apply._cache_size()
    s2d_dec.apply(params, HIERARCHY, array(2, 3, L, 3))
    assert s2d_dec.apply._cache_size() == before


def test_expanding_is_climbing_and_one_convolution_more():
    weights = s2d_dec.init_weights(jax.random.key(1), HIERARCHY, inputs=6, channels=CHANNELS, outputs=7)
    x = array(3, 2, 6)
    climb = jax.jit(s2d_dec.decode_levels)
    climbed = climb(weights, HIERARCHY, x)
    assert climbed.shape == (len(VERTICES), 2, CHANNELS[-1])
    found = jax.jit(s2d_dec.decode)(weights, HIERARCHY, x)
    for i in range(2):
        expected = plain_conv(climbed[:, i], HIERARCHY.spirals[0], weights["convs"][-1])
        np.testing.assert_allclose(found[:, i], expected, rtol=1e-4, atol=1e-4)
    # Weights without outputs are those of the climb alone, drawn alike.
    bare = s2d_dec.init_weights(jax.random.key(1), HIERARCHY, inputs=6, channels=CHANNELS, outputs=None)
    assert len(bare["convs"]) == len(CHANNELS) - 1 == len(weights["convs"]) - 1
    np.testing.assert_allclose(climb(bare, HIERARCHY, x), climbed, atol=1e-5)


def test_a_decoder_starts_with_a_quiet_last_convolution():
    params = s2d_dec.init(jax.random.key(1), HIERARCHY, landmarks=L, channels=CHANNELS)
    drawn = s2d_dec.init_weights(jax.random.key(1), HIERARCHY, inputs=3 * L, channels=CHANNELS, outputs=3)
    drawn["convs"][-1]["kernel"] *= 0.01
    for a, b in zip(jax.tree.leaves(params.weights), jax.tree.leaves(drawn), strict=True):
        np.testing.assert_array_equal(a, b)


def test_wrong_sizes_are_named():
    with pytest.raises(ValueError, match=r"expected \(\.\.\., 5, 3\), got \(2, 4, 3\)"):
        s2d_dec.apply(parameters(), HIERARCHY, jnp.zeros((2, 4, 3)))
    with pytest.raises(ValueError, match="channels: expected 3"):
        s2d_dec.init(jax.random.key(0), HIERARCHY, channels=(8, 4))
    with pytest.raises(ValueError, match="channels: expected 3 for this hierarchy, got 4"):
        s2d_dec.init_weights(jax.random.key(0), HIERARCHY, inputs=6, channels=(8, 4, 4, 2), outputs=None)


def test_the_head_has_the_papers_layers(template):
    hierarchy = mesh_hierarchy.build(template.vertices, template.faces)
    shapes = jax.eval_shape(lambda key: s2d_dec.init(key, hierarchy), jax.random.key(0)).weights
    kernels = [conv["kernel"].shape for conv in shapes["convs"]]
    assert kernels == [(9, 128, 64), (9, 64, 32), (14, 32, 32), (15, 32, 16), (15, 16, 3)]
    assert shapes["dense"]["kernel"].shape == (204, hierarchy.sizes[-1] * 128)
