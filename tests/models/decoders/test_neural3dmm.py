"""The modified Neural3DMM against its plain form and its laws."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from facejax.mesh import hierarchy as mesh_hierarchy
from facejax.mesh import spiral_conv
from facejax.models.decoders import neural3dmm, s2d_dec

BALL = trimesh.creation.icosphere(subdivisions=2)  # 162 vertices
VERTICES, FACES, N = np.asarray(BALL.vertices), np.asarray(BALL.faces), len(BALL.vertices)
HIERARCHY = mesh_hierarchy.build(VERTICES, FACES, factors=(3, 3), lengths=(7, 6), reference=0)
PADDED = mesh_hierarchy.build(VERTICES, FACES, factors=(3, 3), lengths=(170, 60), reference=0)
DOWN = neural3dmm.downsampling_spirals(HIERARCHY)
L, ENCODER, CHANNELS = 5, (4, 6), (8, 6, 4)


def array(seed, *shape):
    return jnp.asarray(np.random.default_rng(seed).normal(size=shape), jnp.float32)


def scale():
    return neural3dmm.Scale(array(1, N, 3), jnp.float32(2), array(2, L, 3), jnp.float32(0.5))


def parameters():
    """Random everywhere, so that no term of the network vanishes."""

    def blank(key):
        return neural3dmm.init(key, HIERARCHY, scale(), encoder=ENCODER, channels=CHANNELS).weights

    leaves, tree = jax.tree.flatten(jax.eval_shape(blank, jax.random.key(0)))
    leaves = [array(10 + i, *leaf.shape) / np.sqrt(np.prod(leaf.shape[:-1]) + 1) for i, leaf in enumerate(leaves)]
    return neural3dmm.Neural3DMM(scale(), jax.tree.unflatten(tree, leaves))


def samples(seed, batch):
    return array(seed, batch, L, 3), array(1, N, 3) + array(seed + 50, batch, N, 3)


def descended(x, kernel, hierarchy, level):
    """x (N_i, B, C) to the vertices that the next level keeps: each with its whole spiral."""
    kept = hierarchy.kept[level].tolist()
    out = []
    for vertex in hierarchy.kept[level + 1]:
        spiral = hierarchy.spirals[level][kept.index(vertex)]
        # The dummy vertex reads zero.
        read = (x[at] if at < len(x) else np.zeros_like(x[0]) for at in spiral)
        out.append(sum(each @ kernel[position] for position, each in enumerate(read)))
    return np.stack(out)


@pytest.mark.parametrize("level", [0, 1])
@pytest.mark.parametrize("hierarchy", [HIERARCHY, PADDED], ids=["full", "padded"])
def test_descents_gather_whole_spirals_of_what_is_kept(hierarchy, level):
    down = neural3dmm.downsampling_spirals(hierarchy)
    assert len(down) == 2
    x = array(1, hierarchy.sizes[level], 2, 3)
    kernel = array(2, hierarchy.spirals[level].shape[1], 3, 4)
    found, back = jax.vjp(lambda x, kernel: spiral_conv.spiral_conv(x, kernel, down[level]), x, kernel)
    expected = descended(np.asarray(x, np.float64), np.asarray(kernel, np.float64), hierarchy, level)
    np.testing.assert_allclose(found, expected, atol=1e-4)
    # The table of the gradient is another one: of a linear map, along its own arguments, the value itself.
    cotangent = array(3, *found.shape)
    for slope, argument in zip(back(cotangent), (x, kernel), strict=True):
        assert float(jnp.vdot(slope, argument)) == pytest.approx(np.vdot(cotangent, expected), rel=1e-3)


def plain_code(params, neutral):
    """The latent code (16,) of one face (N, 3)."""
    params = jax.tree.map(np.asarray, params)
    x = np.asarray((neutral - params.scale.face) / params.scale.face_std, np.float64)[:, None]
    for level, conv in enumerate(params.weights["encoder"]):
        x = descended(x, conv["kernel"], HIERARCHY, level) + conv["bias"]
        x = np.where(x > 0, x, np.expm1(x))
    return x.ravel() @ params.weights["latent"]["kernel"] + params.weights["latent"]["bias"]


def test_positions_are_those_of_the_plain_form():
    params, (marks, neutral) = parameters(), samples(3, 2)
    found = neural3dmm.apply(params, HIERARCHY, DOWN, marks, neutral)
    codes = neural3dmm.encode(params, DOWN, neutral)
    assert codes.shape == (2, neural3dmm.LATENT)
    np.testing.assert_allclose(codes, [plain_code(params, face) for face in neutral], rtol=1e-3, atol=1e-3)
    moved = (marks - params.scale.landmark_mean).reshape(2, -1) / params.scale.landmark_std
    told = jnp.concatenate([codes, moved], axis=1)
    out = jax.jit(s2d_dec.decode)(params.weights["decoder"], HIERARCHY, told)
    expected = params.scale.face + params.scale.face_std * out.transpose(1, 0, 2)
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-3)


def test_samples_do_not_mix():
    params, (marks, neutral) = parameters(), samples(3, 2)
    found = neural3dmm.apply(params, HIERARCHY, DOWN, marks, neutral)
    order = np.array([1, 0])
    np.testing.assert_allclose(
        neural3dmm.apply(params, HIERARCHY, DOWN, marks[order], neutral[order]), found[order], atol=1e-4
    )


def test_the_face_and_the_landmarks_both_tell():
    params, (marks, neutral) = parameters(), samples(3, 2)
    found = neural3dmm.apply(params, HIERARCHY, DOWN, marks, neutral)
    for other in ((marks + 1, neutral), (marks, neutral + array(9, N, 3))):
        assert float(jnp.abs(neural3dmm.apply(params, HIERARCHY, DOWN, *other) - found).max()) > 0.1


@jax.jit
@partial(jax.value_and_grad, argnums=(0, 1, 2))
def waves(params, marks, neutral, hierarchy, down):
    return jnp.sum(jnp.sin(neural3dmm.apply(params, hierarchy, down, marks, neutral) / 5))


def test_gradients_are_finite_differences_and_scale_is_never_trained():
    with jax.enable_x64(True):
        point = jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), (parameters(), *samples(3, 1)))
        slopes = jax.device_get(waves(*point, HIERARCHY, DOWN)[1])
        assert not any(leaf.any() for leaf in jax.tree.leaves(slopes[0].scale))
        leaves, tree = jax.tree.flatten(point)
        trained = range(len(point[0].scale), len(leaves))
        for i in trained:
            step, slope = 1e-6 * np.random.default_rng(i).normal(size=leaves[i].shape), jax.tree.leaves(slopes)[i]
            ends = (
                jax.tree.unflatten(tree, [*leaves[:i], leaves[i] + way * step, *leaves[i + 1 :]]) for way in (1, -1)
            )
            found = waves(*next(ends), HIERARCHY, DOWN)[0] - waves(*next(ends), HIERARCHY, DOWN)[0]
            assert slope.any() and float(found) == pytest.approx(2 * np.vdot(slope, step), rel=1e-4)


def test_wrong_sizes_are_named():
    params, (marks, neutral) = parameters(), samples(3, 2)
    for message, options in {
        "encoder: expected 2 channels for this hierarchy, got 4": {},
        "channels: expected 3 for this hierarchy, got 2": {"encoder": ENCODER, "channels": (8, 4)},
    }.items():
        with pytest.raises(ValueError, match=message):
            jax.eval_shape(lambda key, o=options: neural3dmm.init(key, HIERARCHY, scale(), **o), jax.random.key(0))
    for wrong in ((marks[:, 1:], neutral), (marks[0], neutral[0]), (marks, neutral[:1]), (marks, neutral[0])):
        with pytest.raises(ValueError, match=r"displacements \(B, 5, 3\) and neutral faces \(B, 162, 3\), got"):
            neural3dmm.apply(params, HIERARCHY, DOWN, *wrong)


def test_the_head_is_told_in_16_numbers(template):
    hierarchy = mesh_hierarchy.build(template.vertices, template.faces)
    scale = neural3dmm.Scale(jnp.zeros((3260, 3)), jnp.ones(()), jnp.zeros((68, 3)), jnp.ones(()))
    shapes = jax.eval_shape(lambda key: neural3dmm.init(key, hierarchy, scale), jax.random.key(0)).weights
    kernels = [conv["kernel"].shape for conv in shapes["encoder"]]
    assert kernels == [(15, 3, 16), (14, 16, 32), (9, 32, 64), (9, 64, 128)]
    assert shapes["latent"]["kernel"].shape == (hierarchy.sizes[-1] * 128, 16)
    assert shapes["decoder"]["dense"]["kernel"].shape[0] == 16 + 204
