"""The LSTM against a loop in NumPy, and its own backward passes against JAX's."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from facejax.models import lstm

T, B, D, H = 7, 3, 5, 4


def array(seed, *shape):
    return jnp.asarray(np.random.default_rng(seed).normal(size=shape), jnp.float32)


def parameters(seed=0, layers=3):
    """Random everywhere, biases too."""
    weights = lstm.init(jax.random.key(seed), D, hidden=H, layers=layers)
    leaves, tree = jax.tree.flatten(weights)
    return jax.tree.unflatten(tree, [leaf + 0.3 * array(10 + i, *leaf.shape) for i, leaf in enumerate(leaves)])


def naive(weights, x, given=None):
    """One sequence after another, one step after another, in float64."""
    weights = jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), weights)
    x = np.asarray(x, np.float64)
    given = np.ones(x.shape[:2], bool) if given is None else np.asarray(given)
    out = np.zeros_like(x)
    for b in range(x.shape[1]):
        states = [(np.zeros(len(row["hidden"])),) * 2 for row in weights["layers"]]
        last = np.zeros(x.shape[2])
        for t in range(len(x)):
            signal = x[t, b] if given[t, b] else last
            for n, row in enumerate(weights["layers"]):
                hidden, cell = states[n]
                i, f, g, o = np.split(signal @ row["input"] + hidden @ row["hidden"] + row["bias"], 4)
                i, f, o = (1 / (1 + np.exp(-z)) for z in (i, f, o))
                cell = f * cell + i * np.tanh(g)
                signal = o * np.tanh(cell)
                states[n] = signal, cell
            out[t, b] = last = signal @ weights["dense"]["kernel"] + weights["dense"]["bias"]
    return out


@pytest.mark.parametrize("layers", [1, 3])
def test_forward_is_the_loop(layers):
    weights, x = parameters(layers=layers), array(1, T, B, D)
    np.testing.assert_allclose(lstm.forward(weights, x), naive(weights, x), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("seed", range(3))
def test_follow_is_the_loop(seed):
    weights, x = parameters(seed), array(2, T, B, D)
    given = np.random.default_rng(seed).random((T, B)) < 0.5
    np.testing.assert_allclose(
        lstm.forward_scheduled(weights, x, given), naive(weights, x, given), rtol=1e-4, atol=1e-5
    )


def test_follow_with_all_inputs_given_is_forward():
    weights, x = parameters(), array(3, T, B, D)
    np.testing.assert_allclose(
        lstm.forward_scheduled(weights, x, jnp.ones((T, B), bool)), lstm.forward(weights, x), atol=1e-5
    )


def test_step_by_step_is_forward():
    weights, x = parameters(), array(4, T, B, D)
    states, outputs = lstm.init_states(weights, B), []
    for row in x:
        states, out = lstm.step(weights, states, row)
        outputs.append(out)
    np.testing.assert_allclose(jnp.stack(outputs), lstm.forward(weights, x), atol=1e-5)


def loop(weights, x, given):
    """The same by `step`, which JAX differentiates by itself."""

    def advance(carry, inputs):
        states, last = carry
        x, given = inputs
        states, out = lstm.step(weights, states, jnp.where(given[:, None], x, last))
        return (states, out), out

    return jax.lax.scan(advance, (lstm.init_states(weights, x.shape[1]), jnp.zeros_like(x[0])), (x, given))[1]


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_gradients_are_those_of_the_automatic_way(share):
    weights, x = parameters(), array(5, T, B, D)
    given = jnp.asarray(np.random.default_rng(1).random((T, B)) < share)
    forms = [lstm.forward_scheduled, loop] + ([lambda w, x, _: lstm.forward(w, x)] if share == 1.0 else [])
    slopes = [jax.grad(lambda w, x, f=f: jnp.sum(jnp.sin(f(w, x, given))), argnums=(0, 1))(weights, x) for f in forms]
    for other in slopes[1:]:
        for a, b in zip(jax.tree.leaves(slopes[0]), jax.tree.leaves(other), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-5)


def test_gradients_are_finite_differences():
    with jax.enable_x64(True):
        weights = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float64), parameters(layers=2))
        x = jnp.asarray(array(6, 4, 2, D), jnp.float64)
        given = jnp.asarray([[True, True], [False, True], [True, False], [False, False]])
        check_grads(lstm.forward, (weights, x), order=1, modes=["rev"], atol=1e-6, rtol=1e-6)
        check_grads(
            lambda w, x: lstm.forward_scheduled(w, x, given), (weights, x), order=1, modes=["rev"], atol=1e-6, rtol=1e-6
        )


def test_what_comes_later_changes_nothing_before():
    weights, x = parameters(), array(7, T, B, D)
    changed = x.at[4].add(1.0)
    before, after = lstm.forward(weights, x), lstm.forward(weights, changed)
    np.testing.assert_array_equal(before[:4], after[:4])
    assert float(jnp.abs(before[4:] - after[4:]).min(axis=(1, 2)).max()) > 0


def test_sequences_do_not_see_one_another():
    weights, x = parameters(), array(8, T, B, D)
    together = lstm.forward(weights, x)
    for b in range(B):
        np.testing.assert_allclose(lstm.forward(weights, x[:, b : b + 1])[:, 0], together[:, b], atol=1e-6)


def test_a_new_network_hardly_moves_and_remembers():
    weights = lstm.init(jax.random.key(0), D, hidden=16)
    assert float(jnp.abs(lstm.forward(weights, array(9, T, B, D))).max()) < 0.3
    np.testing.assert_array_equal(weights["layers"][0]["bias"][16:32], 1.0)
    for row in weights["layers"]:
        for block in jnp.split(row["hidden"], 4, axis=1):
            np.testing.assert_allclose(block @ block.T, np.eye(16), atol=1e-5)


@pytest.mark.parametrize("sizes", [(0, 4, 3), (5, 0, 3), (5, 4, 0)])
def test_sizes_out_of_range(sizes):
    with pytest.raises(ValueError, match="1 or more"):
        lstm.init(jax.random.key(0), sizes[0], hidden=sizes[1], layers=sizes[2])
