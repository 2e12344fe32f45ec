"""The morphable model against the covariance's eigenvectors, and what projections, directions and shares obey."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from facejax.models import morphable

N, RANK, M = 12, 4, 40


def planted(count=M, channels=3, seed=0, noise=0.0):
    """Values (count, N, channels) in a subspace of RANK dimensions about a mean."""
    rng = np.random.default_rng(99)
    modes, mean = rng.normal(size=(RANK, N, channels)), 50 + 20 * rng.normal(size=(N, channels))
    rng = np.random.default_rng(seed)
    weights = rng.normal(size=(count, RANK)) * np.arange(RANK, 0, -1)
    return mean + np.einsum("mr,rnc->mnc", weights, modes) + noise * rng.normal(size=(count, N, channels))


def array(seed, *shape):
    return jnp.asarray(np.random.default_rng(seed).normal(size=shape), jnp.float32)


@pytest.fixture(scope="module")
def params():
    return morphable.fit(planted(noise=0.3), components=5)


@pytest.fixture(scope="module")
def two():
    return morphable.fit_identity_expression(planted(6), planted(30, seed=1, noise=0.2) - 50, identity=3, expression=5)


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_components_are_the_eigenvectors_of_the_covariance(channels):
    examples = planted(channels=channels, noise=0.3)
    params = morphable.fit(examples, components=RANK)
    assert {leaf.dtype for leaf in params} == {jnp.dtype("float32")}
    flat = examples.reshape(M, -1)
    values, vectors = np.linalg.eigh(np.cov(flat.T, bias=True))
    np.testing.assert_allclose(params.mean, examples.mean(axis=0), rtol=1e-6)
    np.testing.assert_allclose(params.deviation, np.sqrt(values[::-1][:RANK]), rtol=1e-5)
    np.testing.assert_allclose(params.total_variance, values.sum(), rtol=1e-5)
    rows = np.asarray(params.components).reshape(RANK, -1)
    np.testing.assert_allclose(np.abs(np.sum(rows * vectors.T[::-1][:RANK], axis=1)), 1, atol=1e-5)


@pytest.mark.parametrize("count", [5, 200])
def test_components_are_orthonormal_and_the_widest_first(count):
    params = morphable.fit(planted(count, noise=0.3), components=4)
    rows = np.asarray(params.components).reshape(4, -1)
    np.testing.assert_allclose(rows @ rows.T, np.eye(4), atol=1e-6)
    assert np.all(np.diff(params.deviation) < 0)


def test_coefficients_of_the_examples_have_mean_zero_and_deviation_one(params):
    found = np.asarray(morphable.project(params, planted(noise=0.3)))
    np.testing.assert_allclose(found.mean(axis=0), 0, atol=1e-5)
    np.testing.assert_allclose(np.cov(found.T, bias=True), np.eye(5), atol=1e-4)


def test_a_planted_model_is_recovered_and_directions_without_variance_are_dropped():
    params = morphable.fit(planted(), components=20)
    assert params.components.shape == (RANK, N, 3) and params.deviation.shape == (RANK,)
    unseen = planted(seed=5)
    np.testing.assert_allclose(morphable.apply(params, morphable.project(params, unseen)), unseen, atol=1e-4)


def test_as_many_components_as_there_can_be_give_the_examples_back():
    examples = planted(6, noise=0.3)
    params = morphable.fit(examples, components=5)
    np.testing.assert_allclose(morphable.apply(params, morphable.project(params, examples)), examples, atol=1e-4)


def test_projection_is_orthogonal_and_idempotent(params):
    values = jnp.asarray(planted(7, seed=3, noise=2.0), jnp.float32)
    coefficients = morphable.project(params, values)
    nearest = morphable.apply(params, coefficients)
    np.testing.assert_allclose(morphable.project(params, nearest), coefficients, atol=1e-4)
    off = np.einsum("mnc,knc->mk", values - nearest, params.components)
    np.testing.assert_allclose(off, 0, atol=1e-4)
    assert float(jnp.linalg.norm(values - nearest)) > 1


def test_zero_is_the_mean_and_one_is_a_deviation_along_a_component(params):
    np.testing.assert_array_equal(morphable.apply(params, jnp.zeros(5)), params.mean)
    one = morphable.apply(params, jnp.eye(5)[2]) - params.mean
    np.testing.assert_allclose(one, params.deviation[2] * params.components[2], atol=1e-5)


def test_gradients_through_apply(params):
    weight, at = array(0, N, 3), array(1, 5)
    found = jax.grad(lambda c: jnp.sum(weight * morphable.apply(params, c)))(at)
    expected = params.deviation * jnp.einsum("nc,knc->k", weight, params.components)
    np.testing.assert_allclose(found, expected, rtol=1e-4)
    # The projection is where the squared distance is least.
    values = jnp.asarray(planted(1, seed=3, noise=1.0)[0], jnp.float32)
    slope = jax.grad(lambda c: jnp.sum((morphable.apply(params, c) - values) ** 2))
    np.testing.assert_allclose(slope(morphable.project(params, values)), 0, atol=2e-2)
    assert np.abs(slope(at)).max() > 10


CASES = {
    "apply": lambda params, two, lead: (morphable.apply, params, array(1, *lead, 5)),
    "project": lambda params, two, lead: (morphable.project, params, 50 + array(1, *lead, N, 3)),
    "face": lambda params, two, lead: (morphable.face, two, array(1, *lead, 3), array(2, *lead, RANK + 1)),
}


@pytest.mark.parametrize("lead", [(), (1,), (3, 2)], ids=str)
@pytest.mark.parametrize("case", CASES)
def test_eager_jit_and_vmap_agree(params, two, case, lead):
    function, *args = CASES[case](params, two, lead)
    found = function(*args)
    assert found.shape == (*lead, *((5,) if case == "project" else (N, 3)))
    with jax.disable_jit():
        np.testing.assert_allclose(function(*args), found, rtol=1e-5, atol=1e-5)
    mapped = function
    for _ in lead:
        mapped = jax.vmap(mapped, (None, *[0] * (len(args) - 1)))
    np.testing.assert_allclose(mapped(*args), found, rtol=1e-5, atol=1e-5)


def test_direction_is_the_sum_of_equation_1_and_the_covariance():
    examples, scores = planted(noise=0.3), 3 + np.random.default_rng(4).normal(size=M)
    found = morphable.direction(examples, scores)
    mean = examples.mean(axis=0)
    plain = sum(score * (example - mean) for score, example in zip(scores, examples, strict=True))
    np.testing.assert_allclose(found, plain, rtol=1e-4, atol=1e-4)
    covariance = [[np.cov(scores, examples[:, n, c], bias=True)[0, 1] for c in range(3)] for n in range(N)]
    np.testing.assert_allclose(found, M * np.array(covariance), rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(morphable.direction(examples, scores + 100), found, rtol=1e-4, atol=1e-4)


def test_unit_direction_is_the_slope_of_the_regression_on_the_scores():
    examples, scores = planted(noise=0.3), 3 + np.random.default_rng(4).normal(size=M)
    design = np.stack([np.ones(M), scores], axis=1)
    slope = np.linalg.lstsq(design, examples.reshape(M, -1), rcond=None)[0][1].reshape(N, 3)
    found = morphable.direction(examples, scores, unit=True)
    np.testing.assert_allclose(found, slope, rtol=1e-4, atol=1e-5)
    # Neither the unit of the scores nor how often the examples are given changes what one more of the score is.
    np.testing.assert_allclose(100 * morphable.direction(examples, 100 * scores, unit=True), found, atol=1e-5)
    twice = morphable.direction(np.tile(examples, (2, 1, 1)), np.tile(scores, 2), unit=True)
    np.testing.assert_allclose(twice, found, atol=1e-5)


@pytest.mark.parametrize(("count", "exact"), [(10, True), (200, False)])
def test_unit_direction_raises_the_regression_on_the_faces_by_r_squared(count, exact):
    examples, scores = planted(count, noise=0.3), 3 + np.random.default_rng(4).normal(size=count)
    centred, wanted = (examples - examples.mean(axis=0)).reshape(count, -1), scores - scores.mean()
    weights = np.linalg.lstsq(centred, wanted, rcond=None)[0]
    raised = np.sum(weights * np.asarray(morphable.direction(examples, scores, unit=True)).ravel())
    r_squared = 1 - np.sum((centred @ weights - wanted) ** 2) / np.sum(wanted**2)
    np.testing.assert_allclose(raised, r_squared, rtol=1e-4)
    assert (r_squared > 0.9999) == exact


def test_a_planted_attribute_is_found_from_its_scores():
    examples, scores, truth = planted(), np.random.default_rng(4).normal(size=M), np.asarray(array(7, N, 3))
    # Scores that go with nothing else in the examples.
    flat = examples.reshape(M, -1) - examples.reshape(M, -1).mean(axis=0)
    scores = scores - scores.mean()
    scores -= flat @ np.linalg.lstsq(flat, scores, rcond=None)[0]
    found = morphable.direction(examples + scores[:, None, None] * truth, 5 + scores, unit=True)
    np.testing.assert_allclose(found, truth, atol=1e-5)


def test_face_is_the_identity_and_the_expressions_displacement(two):
    identity, expression = array(1, 3), array(2, 7, 5)
    found = morphable.face(two, identity, expression)
    assert found.shape == (7, N, 3)
    expected = morphable.apply(two.identity, identity) + morphable.apply(two.expression, expression)
    np.testing.assert_allclose(found, expected, atol=1e-4)
    assert morphable.face(two, array(1, 4, 1, 3), expression).shape == (4, 7, N, 3)


def test_each_of_the_two_is_a_model_of_its_own(two):
    for found, expected in (
        (two.identity, morphable.fit(planted(6), components=3)),
        (two.expression, morphable.fit(planted(30, seed=1, noise=0.2) - 50, components=5)),
    ):
        jax.tree.map(np.testing.assert_array_equal, found, expected)


def test_people_and_expressions_in_the_models_are_given_back():
    neutral, displacements = planted(6), planted(9, seed=1) - planted(9, seed=2)
    two = morphable.fit_identity_expression(neutral, displacements, identity=5, expression=8)
    who = morphable.project(two.identity, neutral[2])
    made = morphable.face(two, who, morphable.project(two.expression, displacements))
    np.testing.assert_allclose(made, neutral[2] + displacements, atol=1e-4)
    still = morphable.face(two, who, morphable.project(two.expression, np.zeros((N, 3))))
    np.testing.assert_allclose(still, neutral[2], atol=1e-4)


def test_variance_kept_is_what_the_projection_keeps():
    examples = planted(noise=1.0)
    total = np.sum((examples - examples.mean(axis=0)) ** 2)
    kept = morphable.variance_kept(morphable.fit(examples, components=6))
    assert kept.shape == (6,) and kept.dtype == np.float64 and np.all(np.diff(kept) > 0)
    for k in (1, 3, 6):
        params = morphable.fit(examples, components=k)
        off = np.asarray(morphable.apply(params, morphable.project(params, examples)), np.float64) - examples
        np.testing.assert_allclose(kept[k - 1], 1 - np.sum(off**2) / total, atol=1e-5)


def test_components_for_is_the_least_number_that_keeps_the_share():
    params = morphable.fit(planted(noise=1.0), components=M - 1)
    kept = morphable.variance_kept(params)
    for share in (0.01, 0.5, 0.9, 0.99):
        k = morphable.components_for(params, share)
        assert kept[k - 1] >= share - 1e-6 and (k == 1 or kept[k - 2] < share)
    assert morphable.components_for(params, kept[2]) == 3
    # All components keep all of it, though in float32 some of these fall short of 1.
    whole = [morphable.fit(planted(seed=seed), components=20) for seed in range(8)]
    assert [morphable.components_for(params, 1) for params in whole] == [RANK] * 8
    assert min(morphable.variance_kept(params)[-1] for params in whole) < 1


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda x: morphable.fit(x[0], components=1), r"examples: expected \(M, N, C\).*, got \(12, 3\)"),
        (lambda x: morphable.fit(x[:1], components=1), r"examples: expected .* M of 2 or more, got \(1, 12, 3\)"),
        (lambda x: morphable.fit(x[:, :0], components=1), r"examples: expected .*, got \(40, 0, 3\)"),
        (lambda x: morphable.fit(x * np.nan, components=1), "examples: expected finite .* in example 0"),
        (lambda x: morphable.fit(x[[3] * 5], components=1), "examples: expected at least two that differ, got 5 alike"),
        (lambda x: morphable.fit(x, components=0), "components: expected 1 to 39 components of 40 examples, got 0"),
        (lambda x: morphable.fit(x, components=M), "components: expected 1 to 39 components of 40 examples, got 40"),
        (lambda x: morphable.direction(x, np.ones(3)), r"scores: expected \(40,\), got \(3,\)"),
        (lambda x: morphable.direction(x, np.full(M, np.inf)), "scores: expected finite numbers, got inf"),
        (lambda x: morphable.direction(x, np.full(M, 0.1), unit=True), "scores: expected at least two .* got 0.1 for"),
        (lambda x: morphable.direction(x[0], np.ones(N)), r"examples: expected \(M, N, C\)"),
        (
            lambda x: morphable.fit_identity_expression(x, x[:, 1:], identity=1, expression=1),
            r"got \(40, 12, 3\) and \(40, 11, 3\)",
        ),
        (
            lambda x: morphable.fit_identity_expression(x[..., :2], x[..., :2], identity=1, expression=1),
            r"expected \(P, N, 3\) and",
        ),
        (
            lambda x: morphable.fit_identity_expression(x[0], x, identity=1, expression=1),
            r"neutral: expected \(M, N, C\)",
        ),
        (
            lambda x: morphable.fit_identity_expression(x, 0 * x, identity=1, expression=1),
            "displacements: .* differ, got 40 alike",
        ),
        (
            lambda x: morphable.fit_identity_expression(x, x[:4], identity=5, expression=4),
            "expression: expected 1 to 3 .* got 4",
        ),
        (
            lambda x: morphable.fit_identity_expression(x[:4], x, identity=5, expression=4),
            "identity: expected 1 to 3 .* got 5",
        ),
    ],
)
def test_wrong_examples_are_named(call, message):
    with pytest.raises(ValueError, match=message):
        call(planted(noise=0.3))


def test_wrong_input_to_a_fitted_model_is_named(params, two):
    with pytest.raises(ValueError, match=r"coefficients: expected \(\.\.\., 5\), got \(3, 4\)"):
        morphable.apply(params, jnp.zeros((3, 4)))
    with pytest.raises(ValueError, match=r"coefficients: expected \(\.\.\., 5\), got \(\)"):
        morphable.apply(params, 1.0)
    with pytest.raises(ValueError, match=r"values: expected \(\.\.\., 12, 3\), got \(12, 2\)"):
        morphable.project(params, jnp.zeros((N, 2)))
    with pytest.raises(ValueError, match=r"identity: expected \(\.\.\., 3\), got \(5,\)"):
        morphable.face(two, jnp.zeros(5), jnp.zeros(5))
    with pytest.raises(ValueError, match=r"expression: expected \(\.\.\., 5\), got \(3,\)"):
        morphable.face(two, jnp.zeros(3), jnp.zeros(3))
    with pytest.raises(ValueError, match=r"leading axes that broadcast, got \(2, 3\) and \(7, 5\)"):
        morphable.face(two, jnp.zeros((2, 3)), jnp.zeros((7, 5)))
    for share in (0, 1.01, np.nan):
        with pytest.raises(ValueError, match="share: expected more than 0 and at most 1, got"):
            morphable.components_for(params, share)
    with pytest.raises(ValueError, match=r"share: expected at most 0\.\d+, which 5 components keep, got 0.9999"):
        morphable.components_for(params, 0.9999)
