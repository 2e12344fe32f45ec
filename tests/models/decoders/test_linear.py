"""Ridge and PCA against direct solutions, streamed or whole; the laws of their limits."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from facejax.models.decoders import linear

L, N, RANK, FRAMES = 4, 30, 6, 80
PICKED = [0, 9, 17, 25]


def faces(frames=FRAMES, seed=0, noise=0.0):
    """Displacements in a subspace of RANK dimensions about a mean; landmarks are vertices."""
    modes, mean = np.random.default_rng(99).normal(size=(RANK, N, 3)), np.arange(3 * N).reshape(N, 3) / 50
    rng = np.random.default_rng(seed)
    weights = rng.normal(size=(frames, RANK)) * np.arange(RANK, 0, -1)
    vertices = mean + np.einsum("fr,rnx->fnx", weights, modes) + noise * rng.normal(size=(frames, N, 3))
    return vertices[:, PICKED], vertices


def split(pair, size=13):
    return [tuple(part[i : i + size] for part in pair) for i in range(0, len(pair[0]), size)]


def flat(pair):
    return [part.reshape(len(part), -1) for part in pair]


def distance(params, pair):
    return float(np.linalg.norm(np.asarray(linear.apply(params, jnp.asarray(pair[0]))) - pair[1], axis=-1).mean())


def test_ridge_against_stacked_least_squares():
    pair = faces(noise=0.3)
    params = linear.ridge.fit(split(pair), alpha=0.7)
    x, y = flat(pair)
    x, y = x - x.mean(axis=0), y - y.mean(axis=0)
    # Ridge is least squares with sqrt(F alpha) I appended to the data.
    stacked = np.concatenate([x, np.sqrt(len(x) * 0.7) * np.eye(x.shape[1])])
    expected = np.linalg.lstsq(stacked, np.concatenate([y, np.zeros((x.shape[1], y.shape[1]))]), rcond=None)[0]
    np.testing.assert_allclose(params.factors[0], expected, atol=1e-5)


def test_ridge_recovers_a_linear_face_exactly():
    params = linear.ridge.fit(split(faces()), alpha=0)
    assert distance(params, faces(seed=5)) < 1e-4


@pytest.mark.parametrize("model", [(linear.ridge, {}), (linear.pca, {"components": 4})], ids=["ridge", "pca"])
def test_streamed_equals_whole_and_a_large_penalty_gives_the_mean(model):
    model, options = model
    pair = faces(noise=0.1)
    whole = linear.apply(model.fit([pair], alpha=0.1, **options), pair[0])
    np.testing.assert_allclose(linear.apply(model.fit(split(pair), alpha=0.1, **options), pair[0]), whole, atol=1e-4)
    mean = linear.apply(model.fit([pair], alpha=1e12, **options), pair[0])
    np.testing.assert_allclose(mean, np.broadcast_to(pair[1].mean(axis=0), mean.shape), atol=1e-4)


def test_pca_against_the_singular_value_decomposition():
    pair = faces(noise=0.05)
    basis = linear.pca.prepare(split(pair), components=4)
    y = flat(pair)[1]
    _, singular, right = np.linalg.svd(y - y.mean(axis=0), full_matrices=False)
    np.testing.assert_allclose(basis.variance, singular[:4] ** 2 / FRAMES, rtol=1e-9)
    np.testing.assert_allclose(np.abs(np.sum(basis.components * right[:4], axis=1)), 1, atol=1e-9)
    np.testing.assert_allclose(basis.total_variance, np.sum(singular**2) / FRAMES, rtol=1e-9)
    rows = basis.components.reshape(4, N, 3)[:, PICKED].reshape(4, -1)
    np.testing.assert_allclose(basis.landmarks, rows, atol=1e-6)


def test_pca_coefficients_minimise_the_stated_energy():
    pair, alpha = faces(noise=0.2), 0.4
    basis = linear.pca.prepare([pair], components=4)
    params = linear.pca.solve(basis, alpha=alpha)
    x = pair[0][3].ravel() - basis.landmark_mean.ravel()
    found = x @ np.asarray(params.factors[0])

    def energy(coefficients):
        residual = x - coefficients @ basis.landmarks
        return residual @ residual + alpha * np.sum(coefficients**2 / basis.variance)

    for step in 1e-2 * np.random.default_rng(0).normal(size=(50, 4)):
        assert energy(found) < energy(found + step)


def test_pca_recovers_a_linear_face_and_drops_directions_without_motion():
    params = linear.pca.fit(split(faces()), alpha=1e-9, components=20)
    assert len(params.factors[1]) == RANK
    assert distance(params, faces(seed=5)) < 1e-3


@pytest.mark.parametrize("model", [(linear.ridge, {}), (linear.pca, {"components": 6})], ids=["ridge", "pca"])
def test_choose_returns_the_alpha_with_the_least_held_out_error(model):
    model, options = model
    train, held_out = faces(frames=20, noise=1.0), faces(seed=7, noise=1.0)
    alphas = [1e-6, 1.0, 1e6]
    best, errors = linear.choose(model, [(split(train), split(held_out))], alphas, **options)
    expected = [distance(model.fit([train], alpha=alpha, **options), held_out) for alpha in alphas]
    np.testing.assert_allclose(errors, expected, rtol=1e-5)
    assert best == alphas[int(np.argmin(expected))] and len(set(expected)) == 3


@pytest.mark.parametrize("lead", [(), (1,), (3, 2)])
def test_eager_jit_and_vmap_agree(lead):
    params = linear.pca.fit([faces()], alpha=0.1, components=3)
    x = jnp.asarray(np.random.default_rng(1).normal(size=(*lead, L, 3)), jnp.float32)
    found = linear.apply(params, x)
    assert found.shape == (*lead, N, 3)
    with jax.disable_jit():
        np.testing.assert_allclose(linear.apply(params, x), found, atol=1e-5)
    mapped = linear.apply
    for _ in lead:
        mapped = jax.vmap(mapped, (None, 0))
    np.testing.assert_allclose(mapped(params, x), found, atol=1e-5)


@pytest.mark.parametrize("inner", [(), (5,), (5, 2)], ids=["one", "two", "three"])
def test_affine_parameters_are_means_and_a_product_in_single_precision(inner):
    rng = np.random.default_rng(0)
    sizes = (3 * L, *inner, 3 * N)
    factors = [rng.normal(size=shape) for shape in zip(sizes[:-1], sizes[1:], strict=True)]
    means, x = (rng.normal(size=(L, 3)), rng.normal(size=(N, 3))), rng.normal(size=(7, L, 3))
    params = linear.affine(*means, *factors)
    assert {leaf.dtype.name for leaf in jax.tree.leaves(params)} == {"float32"} and len(params.factors) == len(factors)
    whole = factors[0] if len(factors) == 1 else np.linalg.multi_dot(factors)
    expected = means[1] + ((x - means[0]).reshape(7, -1) @ whole).reshape(7, N, 3)
    np.testing.assert_allclose(linear.apply(params, jnp.asarray(x, jnp.float32)), expected, rtol=1e-4, atol=1e-3)


def test_a_model_of_two_halves_fits_in_one_and_can_be_chosen():
    def prepare(batches, *, scale):
        return scale * sum(len(landmarks) for landmarks, _ in batches)

    def solve(prepared, *, alpha):
        linear.check_alpha(alpha)
        return linear.affine(np.zeros((L, 3)), np.full((N, 3), prepared + alpha), np.zeros((3 * L, 3 * N)))

    counting = linear.model(prepare, solve)
    assert (counting.prepare, counting.solve) == (prepare, solve)
    assert (counting.fit(split(faces()), alpha=0.5, scale=2).vertex_mean == 2 * FRAMES + 0.5).all()
    held_out = (np.zeros((3, L, 3)), np.full((3, N, 3), FRAMES + 7.0))
    alphas = [1.0, 5.0, 8.0, 90.0]
    best, errors = linear.choose(counting, [([faces()], [held_out])], alphas, scale=1)
    np.testing.assert_allclose(errors, np.sqrt(3) * np.abs(np.array(alphas) - 7), rtol=1e-5)
    assert best == 8.0


@pytest.mark.parametrize("alpha", [-1e-9, -1.0, np.nan])
def test_a_regularisation_below_zero_is_refused(alpha):
    for known in (linear.ridge, linear.pca):
        options = {"components": 2} if known is linear.pca else {}
        with pytest.raises(ValueError, match="alpha: expected 0 or more"):
            known.fit([faces()], alpha=alpha, **options)
    linear.check_alpha(0.0)


def test_wrong_input_is_named():
    landmarks, vertices = faces()
    with pytest.raises(ValueError, match="alpha: expected 0 or more, got -1"):
        linear.ridge.fit([(landmarks, vertices)], alpha=-1)
    with pytest.raises(ValueError, match="batches: expected"):
        linear.ridge.fit([(landmarks[:-1], vertices)], alpha=1)
    with pytest.raises(ValueError, match="at least one batch"):
        linear.ridge.fit([], alpha=1)
    with pytest.raises(ValueError, match="two frames"):
        linear.pca.fit(iter([(landmarks, vertices)]), alpha=1, components=2)
    with pytest.raises(ValueError, match="components"):
        linear.pca.fit([(landmarks, vertices)], alpha=1, components=0)
    with pytest.raises(ValueError, match="held-out frames"):
        linear.choose(linear.ridge, [([faces()], [])], [1.0])
    with pytest.raises(ValueError, match=r"expected \(\.\.\., 4, 3\)"):
        linear.apply(linear.ridge.fit([faces()], alpha=1), jnp.zeros((5, 3)))
