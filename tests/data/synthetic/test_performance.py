"""Recipes, styles and time."""

import numpy as np
import pytest

from facejax.data.synthetic import expression_recipes, performance, rig


def test_recipes_name_existing_units_and_all_labels():
    assert set(expression_recipes.RECIPES) == set(expression_recipes.EXPRESSIONS)
    assert len(expression_recipes.LABELS) == 19 and expression_recipes.LABELS[0] == "neutral"
    names = set(rig.unit_names())
    for recipe in expression_recipes.RECIPES.values():
        for units in [recipe.units, *(u for _, u in recipe.variants), *(u for _, u in recipe.extras)]:
            for pattern in units:
                sides = ("Left", "Right") if "*" in pattern else ("",)
                assert {pattern.replace("*", side) for side in sides} <= names
        if recipe.variants:
            assert sum(chance for chance, _ in recipe.variants) == pytest.approx(1)


@pytest.mark.parametrize("label", expression_recipes.EXPRESSIONS)
def test_a_performance_rests_rises_holds_and_falls(label):
    take = performance.perform(label, 3)
    assert 60 <= take.duration * performance.RATE <= 140
    assert 0 < take.onset < take.apex_start < take.apex_end < take.offset < len(take.weights)
    np.testing.assert_array_equal(take.weights[0], 0)
    size = np.linalg.norm(take.weights, axis=1)
    held = size[take.apex_start : take.apex_end]
    assert held.min() > 0.85 * size.max()
    assert size[-1] < 0.12 * size.max()


def test_units_have_their_own_clocks():
    take = performance.perform("high_smile", 0)
    moving = np.abs(take.weights).max(axis=0) > 0.05
    share = np.abs(take.weights[:, moving]) / np.abs(take.weights[:, moving]).max(axis=0)
    middle = (take.onset + take.apex_start) // 2
    assert np.ptp(share[middle]) > 0.1


def test_styles_differ_between_subjects_but_not_between_calls():
    brows = np.stack([performance.apex_weights("eyebrow", i) for i in range(40)])
    names = rig.unit_names()
    left, right = brows[:, names.index("browOuterUpLeft")], brows[:, names.index("browOuterUpRight")]
    both, only_left, only_right = (
        ((left > 0.3) & (right > 0.3)).sum(),
        (right < 0.3).sum(),
        (left < 0.3).sum(),
    )
    assert min(both, only_left, only_right) >= 4
    np.testing.assert_array_equal(performance.apex_weights("eyebrow", 7), brows[7])


def test_takes_differ_a_little():
    one, other = (performance.perform("anger", 2, take=take).weights.max(axis=0) for take in (0, 1))
    assert 0 < np.abs(one - other).max() < 0.5


def test_direct_goes_from_peak_to_peak():
    path = performance.perform_direct("anger", "surprise", 4)
    np.testing.assert_allclose(path[0], performance.apex_weights("anger", 4), atol=1e-6)
    np.testing.assert_allclose(path[-1], performance.apex_weights("surprise", 4), atol=0.15)
    # Not through neutral: the two overlap.
    assert np.linalg.norm(path, axis=1).min() > 0.3 * np.linalg.norm(path[0])


def test_unknown_expression_lists_the_known():
    with pytest.raises(ValueError, match=r"unknown expression 'grin'.*high_smile"):
        performance.apex_weights("grin", 0)
