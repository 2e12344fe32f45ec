"""Performances of expressions: unit weights over time for a label, a subject and a take.

A recipe (`facejax.data.synthetic.expression_recipes`) defines the units of an expression. The subject's style selects
a variant of it (one brow or both, left or right) and scales the units; a take adds variation between repetitions. A
performance consists of neutral, a minimum-jerk onset, an apex held with a small tremor, a minimum-jerk offset, and
neutral. Every unit has its own lag, speed and overshoot, so that landmarks move on curved paths. It is sampled at 60
frames per second, 60 to 140 frames, and stored at 30.

The random generator of a style is seeded with (seed, subject, label), that of a take also with the take's number.
T frames, U units.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np

from facejax.data.synthetic import expression_recipes, rig

RATE = 60  # frames per second, performed
STORED_RATE = 30  # frames per second, stored
GAIN_SPREAD, EXPRESSIVITY, INTENSITY = 0.18, (0.85, 1.15), (0.75, 1.1)
ASYMMETRY_SPREAD, TAKE_SPREAD = 0.08, 0.05


class Performance(NamedTuple):
    """One take at 30 frames per second, with the frame numbers of its phases."""

    weights: np.ndarray  # (T, U) float32
    head: np.ndarray  # (T, 3) float32: pitch, yaw, roll in radians, positive pitch leans back
    onset: int
    apex_start: int
    apex_end: int
    offset: int
    duration: float  # seconds


def apex_weights(label: str, subject: int, *, seed: int = 1) -> np.ndarray:
    """Return the unit weights (U,) of a subject's expression at the apex; zero for neutral.

    Raises:
      ValueError: the label is unknown.
    """
    names = rig.unit_names()
    weights = np.zeros(len(names))
    if label == expression_recipes.NEUTRAL:
        return weights
    if label not in expression_recipes.RECIPES:
        raise ValueError(f"unknown expression {label!r}; the expressions are {', '.join(expression_recipes.LABELS)}")
    recipe, person = expression_recipes.RECIPES[label], _person(subject, seed)
    rng = np.random.default_rng([seed, subject, 1 + expression_recipes.EXPRESSIONS.index(label)])
    chosen = [recipe.units]
    draw = rng.random()
    if recipe.variants:
        edges = np.cumsum([chance for chance, _ in recipe.variants])
        chosen.append(recipe.variants[min(int(np.searchsorted(edges, draw)), len(edges) - 1)][1])
    chosen += [units for chance, units in recipe.extras if rng.random() < chance]
    for units in chosen:
        for pattern, value in units.items():
            for side in ("Left", "Right") if "*" in pattern else ("",):
                weights[names.index(pattern.replace("*", side))] += value
    gains = np.exp(GAIN_SPREAD * np.clip(rng.standard_normal(len(names)), -2, 2))
    return weights * person * _same_on_both_sides(gains) * rng.uniform(*INTENSITY)


def perform(label: str, subject: int, *, take: int = 0, seed: int = 1) -> Performance:
    """Return a performance from neutral to the apex and back."""
    rng = np.random.default_rng([seed, subject, 1 + expression_recipes.EXPRESSIONS.index(label), 1 + take])
    apex = apex_weights(label, subject, seed=seed) * np.exp(TAKE_SPREAD * rng.standard_normal(len(rig.unit_names())))
    rest_before, rise = rng.integers(4, 10), rng.integers(18, 40)
    hold, fall, rest_after = rng.integers(12, 36), rng.integers(20, 46), rng.integers(4, 10)
    marks = np.cumsum([rest_before, rise, hold, fall])
    total = int(np.clip(marks[-1] + rest_after, 60, 140))
    time = np.arange(0, total, RATE // STORED_RATE, dtype=np.float64)
    up = _activation(time, marks[0], rise, len(apex), rng)
    down = _activation(time, marks[2], fall, len(apex), rng)
    share = up * (1 - down)
    weights = apex * share * (1 + _tremor(time, len(apex), rng))
    frames = [round(m * STORED_RATE / RATE) for m in marks]
    head = _lean(label, rng) * np.clip(share.mean(axis=1, keepdims=True), 0, None)
    return Performance(weights.astype(np.float32), head.astype(np.float32), *frames, duration=total / RATE)


def perform_direct(start: str, end: str, subject: int, *, take: int = 0, seed: int = 1, frames: int = 30) -> np.ndarray:
    """Return the unit weights (frames, U) of a direct transition, from apex to apex without passing neutral."""
    labels = [expression_recipes.LABELS.index(start), expression_recipes.LABELS.index(end)]
    rng = np.random.default_rng([seed, subject, 1000 + labels[0], 1000 + labels[1], take])
    first, second = apex_weights(start, subject, seed=seed), apex_weights(end, subject, seed=seed)
    length = float(rng.integers(24, 46))
    time = np.linspace(0, length, frames)
    # The first expression relaxes while the second one already begins, each with timing of its own.
    away = _activation(time, 0.0, 0.9 * length, len(first), rng)
    toward = _activation(time, 0.05 * length, 0.95 * length, len(first), rng)
    return (first * (1 - away) + second * toward).astype(np.float32)


def _person(subject: int, seed: int) -> np.ndarray:
    """Return a subject's gain per unit (U,) for all expressions, with one side stronger than the other."""
    rng = np.random.default_rng([seed, subject, 0])
    side = ASYMMETRY_SPREAD * rng.standard_normal()
    lean = np.array([side * _side(name) for name in rig.unit_names()])
    habit = np.exp(0.5 * GAIN_SPREAD * rng.standard_normal(len(lean)))
    return rng.uniform(*EXPRESSIVITY) * (1 + lean) * _same_on_both_sides(habit)


def _side(name: str) -> int:
    return 1 if "Left" in name or "-left-" in name else -1 if "Right" in name or "-right-" in name else 0


@functools.cache
def _partner() -> np.ndarray:
    """Return for each unit the one whose random value it shares: the left one of a pair, else itself."""
    names = rig.unit_names()
    return np.array([names.index(n.replace("Right", "Left").replace("-right-", "-left-")) for n in names])


def _same_on_both_sides(values: np.ndarray) -> np.ndarray:
    return values[_partner()]


def _activation(
    time: np.ndarray, begin: float, length: float | np.integer, units: int, rng: np.random.Generator
) -> np.ndarray:
    """Return a minimum-jerk rise from 0 to 1 per unit, (T, units), with individual lag, speed and overshoot.

    All units reach 1 by begin + length.
    """
    lag = _same_on_both_sides(rng.uniform(0.0, 0.3, units))
    speed = _same_on_both_sides(rng.uniform(0.75, 1.0, units))
    overshoot = _same_on_both_sides(np.clip(rng.normal(0.03, 0.03, units), 0, 0.1))
    x = (time[:, None] - begin - lag * length) / ((1 - lag) * speed * length)
    u = np.clip(x, 0, 1)
    bump = np.clip(1 - ((x - 1.1) / 0.5) ** 2, 0, None) ** 3
    return u**3 * (10 - 15 * u + 6 * u * u) + overshoot * bump


def _tremor(time: np.ndarray, units: int, rng: np.random.Generator) -> np.ndarray:
    """Return a relative tremor (T, units): two slow sines of about one per cent each, per unit."""
    seconds = time[:, None] / RATE
    total = np.zeros((len(time), units))
    for low, high in ((1.0, 2.5), (2.5, 5.0)):
        frequency, phase = rng.uniform(low, high, units), rng.uniform(0, 2 * np.pi, units)
        total = total + 0.008 * np.sin(2 * np.pi * frequency * seconds + phase)
    return total


def _lean(label: str, rng: np.random.Generator) -> np.ndarray:
    """Return pitch, yaw, roll at the apex: random sway, plus leaning back in surprise and bowing in sadness."""
    pitch = {"surprise": 0.12, "fear": 0.08, "sadness": -0.10, "anger": -0.05}.get(label, 0.0)
    return np.array([pitch * rng.uniform(0.5, 1.5), 0, 0]) + 0.02 * rng.standard_normal(3)
