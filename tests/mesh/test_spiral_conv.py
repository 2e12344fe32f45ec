"""Spiral convolution, compared with gathering whole spirals and multiplying."""

import jax
import jax.export
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest
import trimesh
from jax.test_util import check_grads

from facejax.mesh import hierarchy, spiral_conv, stencils

BALL = trimesh.creation.icosphere(subdivisions=2)  # 162 vertices
HIERARCHY = hierarchy.build(np.asarray(BALL.vertices), np.asarray(BALL.faces), factors=(4,), lengths=(9,), reference=0)
PADDED = hierarchy.build(np.asarray(BALL.vertices), np.asarray(BALL.faces), factors=(4,), lengths=(170,), reference=0)


def array(seed, *shape):
    return jnp.asarray(np.random.default_rng(seed).normal(size=shape), jnp.float32)


def plain(x, kernel, hierarchy, *, lift):
    """Upsample x (M, B, C), append a zero row for the dummy vertex, gather whole spirals, multiply."""
    if lift:
        x = jnp.einsum("vkbc,vk->vbc", x[hierarchy.corners[0]], hierarchy.weights[0])
    x = jnp.concatenate([x, jnp.zeros_like(x[:1])])
    return jnp.einsum("vsbc,sco->vbo", x[hierarchy.spirals[0]], kernel)


def case(hierarchy, *, lift, batch, channels, out):
    stencil = hierarchy.climbs[0] if lift else hierarchy.surface
    x = array(1, hierarchy.sizes[1 if lift else 0], batch, channels)
    return x, array(2, hierarchy.spirals[0].shape[1], channels, out), stencil


# Both layouts: rows (many output channels, or few samples) and planes.
SIZES = [(1, 4, 3), (8, 4, 3), (9, 5, 8), (3, 2, 12)]


FORMS = [spiral_conv.spiral_conv, spiral_conv.spiral_conv_by_position, spiral_conv.spiral_conv_at_once]


@pytest.mark.parametrize("conv", FORMS, ids=["chosen", "by position", "at once"])
@pytest.mark.parametrize(("batch", "channels", "out"), SIZES)
@pytest.mark.parametrize("lift", [True, False])
@pytest.mark.parametrize("hierarchy", [HIERARCHY, PADDED], ids=["full", "padded"])
def test_convolution_and_its_gradients_equal_the_plain_form(hierarchy, lift, batch, channels, out, conv):
    x, kernel, stencil = case(hierarchy, lift=lift, batch=batch, channels=channels, out=out)
    expected, plain_vjp = jax.vjp(lambda x, k: plain(x, k, hierarchy, lift=lift), x, kernel)
    found, vjp = jax.vjp(lambda x, k: conv(x, k, stencil), x, kernel)
    np.testing.assert_allclose(found, expected, atol=2e-4, rtol=1e-4)
    cotangent = array(3, *found.shape)
    for a, b in zip(vjp(cotangent), plain_vjp(cotangent), strict=True):
        np.testing.assert_allclose(a, b, atol=2e-3, rtol=1e-4)


def test_convolution_against_a_loop():
    x, kernel, _ = case(HIERARCHY, lift=True, batch=2, channels=3, out=2)
    x, kernel = np.asarray(x, np.float64), np.asarray(kernel, np.float64)
    expected = np.zeros((HIERARCHY.sizes[0], 2, 2))
    for vertex, spiral in enumerate(HIERARCHY.spirals[0]):
        for position, read in enumerate(spiral):
            for corner, weight in zip(HIERARCHY.corners[0][read], HIERARCHY.weights[0][read], strict=True):
                expected[vertex] += weight * x[corner] @ kernel[position]
    found = spiral_conv.spiral_conv(jnp.asarray(x, jnp.float32), jnp.asarray(kernel, jnp.float32), HIERARCHY.climbs[0])
    np.testing.assert_allclose(found, expected, atol=1e-4)


@pytest.mark.parametrize("batch", [1, 8])
def test_gradients_forward_reverse_and_finite_differences_agree(batch):
    with jax.enable_x64(True):
        x, kernel, stencil = case(HIERARCHY, lift=True, batch=batch, channels=2, out=3)
        check_grads(
            lambda x, k: jnp.sum(jnp.sin(spiral_conv.spiral_conv(x, k, stencil))),
            (x.astype(float), kernel.astype(float)), order=2, modes=("fwd", "rev"), rtol=1e-4,
        )  # fmt: skip


def test_primitive_runs_outside_jit():
    with jax.disable_jit():
        x, kernel, stencil = case(HIERARCHY, lift=True, batch=2, channels=3, out=2)
        eager = spiral_conv.spiral_conv(x, kernel, stencil)
    np.testing.assert_allclose(eager, spiral_conv.spiral_conv(x, kernel, stencil), atol=1e-5)


def test_vmap_over_signals_and_kernels_equals_a_loop():
    x, kernel, stencil = case(HIERARCHY, lift=True, batch=2, channels=3, out=4)
    xs, kernels = jnp.stack([x, 2 * x, -x]), jnp.stack([kernel, kernel + 1, 3 * kernel])
    found = jax.vmap(spiral_conv.spiral_conv, (0, 0, None))(xs, kernels, stencil)
    for i in range(3):
        np.testing.assert_allclose(found[i], spiral_conv.spiral_conv(xs[i], kernels[i], stencil), atol=1e-4)
    slope = jax.vmap(jax.grad(lambda x: jnp.sum(spiral_conv.spiral_conv(x, kernel, stencil) ** 2)))(xs)
    np.testing.assert_allclose(slope[1], 2 * slope[0], rtol=1e-3, atol=1e-3)


def test_vmap_over_tables_is_refused():
    x, kernel, stencil = case(HIERARCHY, lift=True, batch=2, channels=3, out=4)
    many = jax.tree.map(lambda table: np.stack([table, table]), stencil)
    with pytest.raises(ValueError, match="one hierarchy"):
        jax.vmap(spiral_conv.spiral_conv, (None, None, 0))(x, kernel, many)


def test_wrong_shapes_are_named(monkeypatch):
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)  # what a caller gets: only tests check shapes
    x, kernel, stencil = case(HIERARCHY, lift=True, batch=2, channels=3, out=4)
    with pytest.raises(ValueError, match=r"expected \(M, B, 3\)"):
        spiral_conv.spiral_conv(x[..., :2], kernel, stencil)
    with pytest.raises(ValueError, match="stencil: has"):
        spiral_conv.spiral_conv(x, kernel[1:], stencil)
    with pytest.raises(ValueError, match="stencil: has"):
        spiral_conv.spiral_conv(x[1:], kernel, stencil)


def test_the_form_belongs_to_the_platform_that_is_compiled_for():
    x, kernel, stencil = case(
        HIERARCHY, lift=True, batch=200, channels=4, out=16
    )  # too large for all positions at once
    traced = jax.jit(spiral_conv.spiral_conv).trace(x, kernel, stencil)
    assert "stablehlo.while" in traced.lower(lowering_platforms=("cpu",)).as_text()
    assert "stablehlo.while" not in traced.lower(lowering_platforms=("cuda",)).as_text()


def test_maps_without_their_transpose_give_the_same():
    x, kernel, stencil = case(HIERARCHY, lift=True, batch=2, channels=3, out=4)
    found = spiral_conv.spiral_conv(x, kernel, stencils.without_transpose(stencil))
    np.testing.assert_array_equal(found, spiral_conv.spiral_conv(x, kernel, stencil))


def test_a_symbolic_batch_is_exported():
    _, kernel, stencil = case(HIERARCHY, lift=True, batch=1, channels=3, out=4)
    (batch,) = jax.export.symbolic_shape("batch")
    count = HIERARCHY.sizes[1]
    symbolic = jax.ShapeDtypeStruct((count, batch, 3), jnp.float32)
    exported = jax.export.export(jax.jit(spiral_conv.spiral_conv))(symbolic, kernel, stencil)
    for size in (1, 9):
        x = array(5, count, size, 3)
        np.testing.assert_allclose(
            exported.call(x, kernel, stencil), spiral_conv.spiral_conv(x, kernel, stencil), atol=1e-5
        )
