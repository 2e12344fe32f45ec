"""The expression network: units, its two starts, a prefix that is kept, and when an expression is over."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from facejax.models import expression_lstm, lstm

L, K, F = 5, 6, 9


def array(seed, *shape):
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


def made(start="zero", components=None, seed=0):
    config = expression_lstm.Config(landmarks=L, hidden=8, layers=2, start=start, components=components)
    steps, neutral = 0.03 * array(1, K, F, L, 3), array(2, K, L, 3)
    scale = expression_lstm.measure(steps, np.ones((K, F), bool), neutral, config=config)
    params = expression_lstm.init(jax.random.key(seed), scale, config=config)
    leaves, tree = jax.tree.flatten(params.weights)
    weights = jax.tree.unflatten(tree, [leaf + 0.1 * array(20 + i, *leaf.shape) for i, leaf in enumerate(leaves)])
    return params._replace(weights=weights), steps, neutral


def test_the_scale_is_that_of_what_counts():
    steps, neutral = array(1, K, F, L, 3), array(2, K, L, 3)
    mask = np.arange(F) < np.arange(3, 3 + K)[:, None]
    found = expression_lstm.measure(steps, mask, neutral, config=expression_lstm.Config(landmarks=L))
    np.testing.assert_allclose(found.step, np.sqrt(np.mean(steps[mask] ** 2)), rtol=1e-5)
    np.testing.assert_allclose(found.neutral_mean, neutral.mean(axis=0), rtol=1e-5)
    assert found.basis is None


def test_predictions_do_not_depend_on_the_unit_of_the_data():
    """Steps ten times as large, scale measured on them: predictions ten times as large."""
    params, steps, _ = made()
    scaled = params._replace(scale=params.scale._replace(step=10 * params.scale.step))
    np.testing.assert_allclose(
        expression_lstm.predict(scaled, 10 * steps), 10 * expression_lstm.predict(params, steps), rtol=1e-4, atol=1e-6
    )


@pytest.mark.parametrize("lead", [(), (1,), (3, 2)], ids=str)
def test_eager_jit_and_vmap_agree(lead):
    params, _, _ = made("neutral")
    steps, neutral = jnp.asarray(array(3, *lead, F, L, 3)), jnp.asarray(array(4, *lead, L, 3))
    given = jnp.arange(F) % 3 == 0
    for function, extra in ((expression_lstm.predict, ()), (expression_lstm.predict_scheduled, (given,))):
        found = function(params, steps, *extra, neutral)
        assert found.shape == steps.shape
        with jax.disable_jit():
            np.testing.assert_allclose(function(params, steps, *extra, neutral), found, atol=1e-5)
        mapped = lambda s, n, f=function, e=extra: f(params, s, *e, n)  # noqa: E731
        for _ in lead:
            mapped = jax.vmap(mapped)
        np.testing.assert_allclose(mapped(steps, neutral), found, atol=1e-5)


def test_the_neutral_landmarks_take_the_place_of_the_first_input():
    params, steps, neutral = made("neutral")
    found = expression_lstm.predict(params, steps, neutral)
    np.testing.assert_allclose(
        expression_lstm.predict(params, steps + 1 * (np.arange(F) == 0)[:, None, None], neutral), found
    )
    assert np.abs(found - expression_lstm.predict(params, steps, neutral[::-1])).max() > 1e-6


def test_generate_feeds_itself():
    params, *_ = made()
    curve = expression_lstm.generate(params, frames=7)
    assert curve.shape == (7, L, 3) and not curve[0].any()
    known = np.zeros((1, L, 3), np.float32)
    for t in range(6):
        step = np.asarray(expression_lstm.predict(params, known))[-1]
        np.testing.assert_allclose(curve[t + 1] - curve[t], step, atol=1e-6)
        known = np.concatenate([known, step[None]])


def test_one_network_makes_one_curve_from_zero_and_many_from_neutral_faces():
    params, _, neutral = made("neutral")
    curves = expression_lstm.generate(params, neutral, frames=12)
    assert curves.shape == (K, 12, L, 3)
    assert np.abs(curves[0] - curves[1]).max() > 1e-5


def test_a_prefix_is_kept_and_gone_on_from():
    params, *_ = made()
    prefix = np.cumsum(0.03 * array(5, 3, 4, L, 3), axis=1)
    prefix -= prefix[:, :1]
    curve = np.asarray(expression_lstm.generate(params, None, prefix, frames=8))
    np.testing.assert_allclose(curve[:, :4], prefix, atol=1e-6)
    # What follows is the prediction from the true steps.
    steps = np.concatenate([np.zeros((3, 1, L, 3)), np.diff(prefix, axis=1)], axis=1).astype(np.float32)
    np.testing.assert_allclose(curve[:, 4] - curve[:, 3], expression_lstm.predict(params, steps)[:, -1], atol=1e-6)
    whole = np.asarray(expression_lstm.generate(params, None, prefix, frames=4))
    np.testing.assert_allclose(whole, prefix, atol=1e-6)


def test_components_span_the_prediction():
    params, steps, _ = made(components=4)
    assert params.weights["dense"]["kernel"].shape[1] == 4
    basis = np.asarray(params.scale.basis)
    np.testing.assert_allclose(basis.T @ basis, np.eye(4), atol=1e-5)
    flat = np.asarray(expression_lstm.predict(params, steps)).reshape(-1, 3 * L)
    np.testing.assert_allclose(flat @ basis @ basis.T, flat, atol=1e-6)
    # All components are a rotation of the numbers: the loss of the data is the same.
    every = made(components=3 * L)[0].scale
    x = np.asarray(expression_lstm._encode(expression_lstm.ExpressionLSTM(every, None), jnp.asarray(steps), None)[0])
    np.testing.assert_allclose(np.sum(x**2), np.sum((steps / every.step) ** 2), rtol=1e-4)


def bump(rise, hold, fall, rest, height=1.0):
    """A curve of one landmark that goes away, holds, comes back and rests."""
    x = np.concatenate(
        [np.linspace(0, height, rise + 1), np.full(hold, height), np.linspace(height, 0, fall + 1)[1:], np.zeros(rest)]
    )
    return jnp.asarray(np.stack([x, 0 * x, 0 * x], axis=-1)[:, None], jnp.float32)


def test_an_expression_is_over_when_it_is_home_and_quiet():
    assert int(expression_lstm.expression_length(bump(8, 6, 10, 12))) == 8 + 6 + 10 + 1
    # Held for ever, or still on the way: not over.
    assert int(expression_lstm.expression_length(bump(8, 30, 0, 0))) == 39
    assert int(expression_lstm.expression_length(bump(8, 6, 10, 3))) == 28
    # A second expression afterwards is cut off.
    twice = jnp.concatenate([bump(8, 6, 10, 12), bump(8, 6, 10, 12)])
    assert int(expression_lstm.expression_length(twice)) == 25
    both = jnp.stack([bump(8, 6, 10, 12), bump(12, 2, 10, 12)])
    np.testing.assert_array_equal(expression_lstm.expression_length(both), [25, 25])


def test_a_face_that_never_moves_is_not_over():
    assert int(expression_lstm.expression_length(jnp.zeros((20, L, 3)))) == 20


def test_stop_holds_the_face_still(monkeypatch):
    params, *_ = made()
    monkeypatch.setattr(expression_lstm, "predict_scheduled", lambda *a: jnp.diff(bump(8, 6, 10, 12), axis=0) + 1e-4)
    monkeypatch.setattr(expression_lstm, "_check", lambda *a: None)
    one = params._replace(scale=params.scale._replace(neutral_mean=jnp.zeros((1, 3))))
    with jax.disable_jit():
        free = expression_lstm.generate(one, frames=37)
        stopped = expression_lstm.generate(one, frames=37, stop=0.01)
    np.testing.assert_array_equal(stopped[:25], free[:25])
    np.testing.assert_array_equal(stopped[25:], np.repeat(stopped[24:25], 12, axis=0))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"start": "rest"}, "start: expected one of zero, neutral"),
        ({"components": 0}, "components: expected 1 to 15"),
        ({"components": 16}, "components: expected 1 to 15"),
        ({"components": 3, "start": "neutral"}, 'requires the start "zero", got "neutral"'),
    ],
)
def test_options_out_of_range(options, message):
    with pytest.raises(ValueError, match=message):
        made(**options)


def test_shapes_are_checked():
    params, steps, neutral = made()
    with pytest.raises(ValueError, match=r"steps: expected \(..., T, 5, 3\)"):
        expression_lstm.predict(params, steps[..., :4, :])
    with pytest.raises(ValueError, match="neutral: expected"):
        expression_lstm.predict(params, steps, neutral[:, :4])
    with pytest.raises(ValueError, match="prefix: expected"):
        expression_lstm.generate(params, None, steps[..., :4, :], frames=20)
    with pytest.raises(ValueError, match="frames: expected 2 or more, and 9 for the prefix; got 5"):
        expression_lstm.generate(params, None, steps, frames=5)
    with pytest.raises(ValueError, match="neutral_mean"):
        expression_lstm.init(jax.random.key(0), params.scale, config=expression_lstm.Config(landmarks=L + 1))


def test_the_constants_have_no_gradient():
    params, steps, neutral = made("neutral")
    slope = jax.grad(lambda p: jnp.sum(expression_lstm.predict(p, steps, neutral) ** 2))(params)
    inner = jax.tree.leaves(slope.scale)
    assert all(not np.asarray(leaf).any() for leaf in inner)
    assert all(np.abs(leaf).max() > 0 for leaf in jax.tree.leaves(slope.weights))
    assert lstm.init(jax.random.key(0), 3)["dense"]["bias"].shape == (3,)
