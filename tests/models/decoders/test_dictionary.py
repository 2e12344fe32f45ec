"""Codes against the elastic net's conditions, atoms against what they are to explain, and the map that they give."""

import jax.numpy as jnp
import numpy as np
import pytest

from facejax.models.decoders import dictionary, linear

L, N, ATOMS, FRAMES = 4, 20, 6, 120
PICKED = np.array([0, 9, 17, 12])
L1, L2 = 0.3, 0.1


def frames(count=FRAMES, seed=0, noise=0.0):
    """Displacements about a mean, of two atoms each out of ATOMS; landmarks are vertices."""
    atoms = np.random.default_rng(99).normal(size=(ATOMS, N, 3))
    mean = np.arange(3 * N).reshape(N, 3) / 50
    rng = np.random.default_rng(seed)
    used = np.argsort(rng.random((count, ATOMS)), axis=1) < 2
    vertices = mean + np.einsum("fr,rnx->fnx", used * rng.normal(size=(count, ATOMS)), atoms)
    vertices = vertices + noise * rng.normal(size=vertices.shape)
    return vertices[:, PICKED], vertices


def learn(pair, **options):
    options = {"landmark_index": PICKED, "atoms": ATOMS, "l1": L1, "l2": L2, **options}
    return dictionary.model.prepare([pair], **options)


def codes(learned, vertices, l1=L1, l2=L2, steps=2000):
    x = (vertices - learned.vertex_mean).reshape(len(vertices), -1)
    found = dictionary.sparse_code(
        jnp.asarray(learned.atoms, jnp.float32), jnp.asarray(x, jnp.float32), l1=l1, l2=l2, steps=steps
    )
    return x, np.asarray(found, np.float64)


@pytest.mark.parametrize(("l1", "l2"), [(0.05, 0.1), (1.0, 0.1), (1.0, 0.0), (3.0, 1.0)])
def test_codes_meet_the_conditions_of_the_elastic_net(l1, l2):
    rng = np.random.default_rng(0)
    atoms, x = rng.normal(size=(ATOMS, 30)), 3 * rng.normal(size=(40, 30))
    atoms /= np.linalg.norm(atoms, axis=1, keepdims=True)
    found = dictionary.sparse_code(
        jnp.asarray(atoms, jnp.float32), jnp.asarray(x, jnp.float32), l1=l1, l2=l2, steps=1000
    )
    a = np.asarray(found, np.float64)
    slope = (a @ atoms - x) @ atoms.T + l2 * a
    used = a != 0
    assert used.any() and (l1 < 1 or not used.all())
    np.testing.assert_allclose(slope[used], -l1 * np.sign(a[used]), atol=1e-3)
    assert np.abs(slope[~used]).max(initial=0) <= l1 + 1e-3


def test_the_usual_number_of_steps_is_enough():
    learned = learn(frames())
    _, short = codes(learned, frames(seed=1)[1], steps=200)
    _, long = codes(learned, frames(seed=1)[1], steps=2000)
    np.testing.assert_allclose(short, long, atol=2e-3)


def test_without_the_first_penalty_codes_are_ridge_and_a_large_one_leaves_none():
    learned, vertices = learn(frames()), frames(seed=1)[1]
    x, found = codes(learned, vertices, l1=0.0, l2=0.5)
    expected = np.linalg.solve(learned.atoms @ learned.atoms.T + 0.5 * np.eye(ATOMS), learned.atoms @ x.T).T
    np.testing.assert_allclose(found, expected, atol=1e-3)
    assert not codes(learned, vertices, l1=1e4)[1].any()


@pytest.mark.parametrize("atoms", [1, ATOMS, 150])
def test_atoms_are_in_the_unit_ball_and_read_at_the_landmarks(atoms):
    learned = learn(frames(noise=0.1), atoms=atoms)
    assert learned.atoms.shape == (atoms, 3 * N) and np.isfinite(learned.atoms).all()
    assert np.linalg.norm(learned.atoms, axis=1).max() <= 1 + 1e-5
    rows = learned.atoms.reshape(atoms, N, 3)[:, PICKED].reshape(atoms, -1)
    np.testing.assert_array_equal(learned.landmarks, rows)
    landmarks, vertices = frames(noise=0.1)
    np.testing.assert_allclose(learned.landmark_mean, landmarks.mean(axis=0), atol=1e-6)
    np.testing.assert_allclose(learned.vertex_mean, vertices.mean(axis=0), atol=1e-6)


def test_learning_lowers_what_it_minimises():
    pair = frames(noise=0.05)

    def objective(learned):
        x, a = codes(learned, pair[1])
        left = x - a @ learned.atoms
        return 0.5 * np.sum(left**2) + L1 * np.abs(a).sum() + L2 / 2 * np.sum(a**2)

    found = [objective(learn(pair, passes=passes)) for passes in (1, 4, 40)]
    # Atoms that are frames themselves, as learning starts with, beside those that made the frames.
    x = (pair[1] - pair[1].mean(axis=0)).reshape(FRAMES, -1)
    start = learn(pair)._replace(atoms=x[:ATOMS] / np.linalg.norm(x[:ATOMS], axis=1, keepdims=True))
    assert objective(start) > found[0] > found[1] > found[2]
    atoms = np.random.default_rng(99).normal(size=(ATOMS, 3 * N))
    made = start._replace(atoms=atoms / np.linalg.norm(atoms, axis=1, keepdims=True))
    assert found[2] < 1.2 * objective(made)


def test_atoms_settle_where_each_explains_best_what_codes_say():
    """At a fixed point of many passes over one batch, no atom gains by moving within the ball."""
    pair = frames(noise=0.05)
    learned = learn(pair, passes=300)
    x, a = codes(learned, pair[1])
    slope = a.T @ (a @ learned.atoms - x)
    size = np.linalg.norm(learned.atoms, axis=1)
    for atom, length, down in zip(learned.atoms, size, -slope, strict=True):
        pull = down - max(down @ atom, 0) * atom if length > 1 - 1e-3 else down  # what points out of the ball is lost
        assert np.linalg.norm(pull) < 0.02 * np.linalg.norm(a.T @ x, axis=1).max()


def test_landmarks_coefficients_minimise_the_stated_energy():
    pair, alpha = frames(noise=0.1), 0.4
    learned = learn(pair)
    params = dictionary.model.solve(learned, alpha=alpha)
    x = pair[0][3].ravel() - learned.landmark_mean.ravel()
    found = x @ np.asarray(params.factors[0], np.float64)

    def energy(coefficients):
        residual = x - coefficients @ learned.landmarks
        return residual @ residual + alpha * coefficients @ coefficients

    for step in 1e-2 * np.random.default_rng(0).normal(size=(50, ATOMS)):
        assert energy(found) < energy(found + step)
    expected = learned.vertex_mean.ravel() + found @ learned.atoms
    np.testing.assert_allclose(linear.apply(params, pair[0][3]).ravel(), expected, atol=1e-4)


def test_chosen_and_fitted_as_the_linear_models_are():
    train, held_out = frames(), frames(seed=5)
    alphas = [1e-6, 1e-2, 1e4]
    options = {"landmark_index": PICKED, "atoms": ATOMS, "l1": 0.05}
    best, errors = linear.choose(dictionary.model, [([train], [held_out])], alphas, **options)
    still = np.linalg.norm(held_out[1] - train[1].mean(axis=0), axis=-1).mean()
    assert best < 1e4 and errors[2] == pytest.approx(still, rel=1e-2)
    params = dictionary.model.fit([train], alpha=best, **options)
    found = np.linalg.norm(linear.apply(params, held_out[0]) - held_out[1], axis=-1).mean()
    assert found == pytest.approx(min(errors), rel=1e-5) and found < 0.2 * still


def test_the_seed_and_nothing_else_draws():
    pair = frames(noise=0.1)
    halves = [tuple(part[:70] for part in pair), tuple(part[70:] for part in pair)]
    first = learn(pair, seed=3)
    streamed = dictionary.model.prepare(halves, landmark_index=PICKED, atoms=ATOMS, l1=L1, l2=L2, seed=3)
    np.testing.assert_array_equal(streamed.atoms, first.atoms)
    assert np.abs(learn(pair, seed=4).atoms - first.atoms).max() > 1e-2


def test_wrong_input_is_named():
    for options in ({"atoms": 0}, {"passes": 0}, {"l1": -1.0}, {"l2": -1.0}):
        with pytest.raises(ValueError, match="atoms and passes of 1 or more and penalties of 0 or more"):
            learn(frames(), **options)
    with pytest.raises(ValueError, match="at least one batch"):
        dictionary.model.prepare([], landmark_index=PICKED)
    with pytest.raises(ValueError, match="alpha: expected 0 or more, got -1"):
        dictionary.model.fit([frames()], alpha=-1, landmark_index=PICKED, atoms=ATOMS)
