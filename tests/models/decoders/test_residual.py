"""The decoder of residuals: it starts at the base, and its plain form, laws and gradients."""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from facejax.mesh import hierarchy, strain
from facejax.models.decoders import residual, s2d_dec

BALL = trimesh.creation.icosphere(subdivisions=2)  # 162 vertices
VERTICES, FACES, N = np.asarray(BALL.vertices), np.asarray(BALL.faces), len(BALL.vertices)
HIERARCHY = hierarchy.build(VERTICES, FACES, factors=(3, 3), lengths=(7, 6), reference=0)
TABLES = strain.vertex_triangles(FACES, N)
L, CHANNELS, MIXED = 5, (8, 6, 4), 5


def array(seed, *shape):
    return jnp.asarray(np.random.default_rng(seed).normal(size=shape), jnp.float32)


def scale():
    return residual.Scale(jnp.asarray(VERTICES, jnp.float32), array(2, L, 3), jnp.float32(0.5), jnp.float32(0.3))


@cache
def blank():
    init = partial(residual.init, hierarchy=HIERARCHY, scale=scale(), channels=CHANNELS, width=MIXED)
    return jax.jit(init)(jax.random.key(0))


def parameters():
    """Random everywhere, so that no term of the network vanishes."""
    leaves, tree = jax.tree.flatten(jax.device_get(blank().weights))
    leaves = [leaf + 0.1 * np.asarray(array(10 + i, *leaf.shape)) for i, leaf in enumerate(leaves)]
    return residual.ResidualDecoder(scale(), jax.tree.unflatten(tree, leaves), jnp.float32(0.7))


def samples(seed, batch):
    """Landmarks, base and neutral faces."""
    neutral = jnp.asarray(VERTICES, jnp.float32) + 0.05 * array(seed + 60, batch, N, 3)
    return array(seed, batch, L, 3), 0.2 * array(seed + 30, batch, N, 3), neutral


climb = jax.jit(s2d_dec.decode_levels)


def plain(params, displacements, base, neutral):
    """One sample, vertex by vertex."""
    scale, weights, gate = params
    stretch, normal = (part[:, 0] for part in strain.strain(base[:, None], neutral[:, None], TABLES))
    moved = (displacements - scale.landmark_mean).ravel() / scale.landmark_std
    climbed = climb(weights["climb"], HIERARCHY, moved[None])[:, 0]
    x = np.concatenate(
        [stretch / 0.1, base / 2, normal, (neutral - scale.face) / 10, weights["own"], climbed], axis=1
    )  # fmt: skip
    first, second = weights["mix"]

    def around(x, conv):
        out = [sum(x[at] @ conv["kernel"][i] for i, at in enumerate(spiral)) for spiral in HIERARCHY.spirals[0]]
        out = np.stack(out) + conv["bias"]
        return np.where(out > 0, out, np.expm1(out))

    x = around(x, first)
    x = x + around(x, second)
    own = np.einsum("nc,nco->no", x, weights["readout"])
    return base + gate * scale.unit * (residual.READOUT * own + x @ weights["shared"])


def test_answers_are_those_of_the_plain_form():
    params, (marks, base, neutral) = parameters(), samples(3, 2)
    found = residual.apply(params, HIERARCHY, TABLES, marks, base, neutral)
    assert float(jnp.abs(found - base).max()) > 0.5
    for i in range(2):
        expected = plain(jax.tree.map(np.asarray, params), *(np.asarray(x[i]) for x in (marks, base, neutral)))
        np.testing.assert_allclose(found[i], expected, rtol=1e-3, atol=1e-3)


def test_it_starts_at_the_base_and_a_closed_gate_stays_there():
    marks, base, neutral = samples(3, 2)
    np.testing.assert_array_equal(residual.apply(blank(), HIERARCHY, TABLES, marks, base, neutral), base)
    shut = parameters()._replace(gate=jnp.float32(0))
    np.testing.assert_array_equal(residual.apply(shut, HIERARCHY, TABLES, marks, base, neutral), base)


def test_the_gate_takes_its_share():
    params, (marks, base, neutral) = parameters(), samples(3, 2)
    whole, half = (
        residual.apply(params._replace(gate=jnp.float32(gate)), HIERARCHY, TABLES, marks, base, neutral) - base
        for gate in (1.0, 0.5)
    )
    np.testing.assert_allclose(half, whole / 2, atol=1e-5)


def test_one_face_serves_all_samples_and_they_do_not_mix():
    params, (marks, base, neutral) = parameters(), samples(3, 2)
    found = residual.apply(params, HIERARCHY, TABLES, marks, base, neutral)
    order = np.array([1, 0])
    turned = residual.apply(params, HIERARCHY, TABLES, marks[order], base[order], neutral[order])
    np.testing.assert_allclose(turned, found[order], atol=1e-4)
    one = residual.apply(params, HIERARCHY, TABLES, marks, base, neutral[1])
    np.testing.assert_allclose(one[1], found[1], atol=1e-4)
    repeated = jnp.broadcast_to(neutral[1], base.shape)
    np.testing.assert_allclose(one, residual.apply(params, HIERARCHY, TABLES, marks, base, repeated), atol=1e-4)


def test_relabelled_vertices_give_relabelled_output():
    order = np.random.default_rng(1).permutation(N)
    rank = np.argsort(order)
    arrays = hierarchy.save(HIERARCHY) | {
        "spirals/0": rank[HIERARCHY.spirals[0][order]].astype(np.int32),
        "corners/0": HIERARCHY.corners[0][order],
        "weights/0": HIERARCHY.weights[0][order],
    }
    params, (marks, base, neutral) = parameters(), samples(3, 2)
    found = residual.apply(params, HIERARCHY, TABLES, marks, base, neutral)
    weights = params.weights | {name: params.weights[name][order] for name in ("own", "readout")}
    moved = params._replace(scale=params.scale._replace(face=params.scale.face[order]), weights=weights)
    tables = strain.vertex_triangles(rank[FACES], N)
    relabelled = residual.apply(moved, hierarchy.load(arrays), tables, marks, base[:, order], neutral[:, order])
    np.testing.assert_allclose(relabelled, found[:, order], atol=1e-4)


@jax.jit
@partial(jax.value_and_grad, argnums=(0, 1, 2))
def waves(params, marks, base, neutral, hierarchy, tables):
    return jnp.sum(jnp.sin(residual.apply(params, hierarchy, tables, marks, base, neutral) / 5))


def test_gradients_are_finite_differences_and_scale_is_never_trained():
    with jax.enable_x64(True):
        point = jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), (parameters(), *samples(3, 1)))
        slopes = jax.device_get(waves(*point, HIERARCHY, TABLES)[1])
        assert not any(leaf.any() for leaf in jax.tree.leaves(slopes[0].scale))
        leaves, tree = jax.tree.flatten(point)
        trained = range(len(point[0].scale), len(leaves) - 1)
        for i in trained:
            step, slope = 1e-6 * np.random.default_rng(i).normal(size=leaves[i].shape), jax.tree.leaves(slopes)[i]
            ends = (
                jax.tree.unflatten(tree, [*leaves[:i], leaves[i] + way * step, *leaves[i + 1 :]]) for way in (1, -1)
            )
            found = waves(*next(ends), HIERARCHY, TABLES)[0] - waves(*next(ends), HIERARCHY, TABLES)[0]
            assert slope.any() and float(found) == pytest.approx(2 * np.vdot(slope, step), rel=1e-4)


def test_training_starts_at_once():
    """Zero readouts have slopes, though what lies behind them has none yet."""
    with jax.enable_x64(True):
        point = jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), (blank(), *samples(3, 1)))
        slope = waves(*point, HIERARCHY, TABLES)[1][0].weights
    assert slope["readout"].any() and slope["shared"].any()
    assert not any(leaf.any() for name in ("climb", "own", "mix") for leaf in jax.tree.leaves(slope[name]))


def test_wrong_sizes_are_named():
    params, (marks, base, neutral) = parameters(), samples(3, 2)
    with pytest.raises(ValueError, match=r"displacements: expected \(B, 5, 3\), got \(2, 4, 3\)"):
        residual.apply(params, HIERARCHY, TABLES, marks[:, 1:], base, neutral)
    with pytest.raises(ValueError, match=r"displacements: expected \(B, 5, 3\), got \(5, 3\)"):
        residual.apply(params, HIERARCHY, TABLES, marks[0], base, neutral)
    for wrong in ((base[:1], neutral), (base[:, 1:], neutral), (base, neutral[:1]), (base, neutral[:, 1:])):
        with pytest.raises(ValueError, match=r"a base of \(B, 162, 3\) and neutral faces of that shape or \(162, 3\)"):
            residual.apply(params, HIERARCHY, TABLES, marks, *wrong)
    with pytest.raises(ValueError, match="channels: expected 3 for this hierarchy, got 5"):
        residual.init(jax.random.key(0), HIERARCHY, scale())
