"""Expressions performed: a label, a subject and a take give the weight of every unit over time.

A recipe says what an expression is; a style says how this subject does it (one brow or both, left or right,
stronger or weaker units); a take adds what differs from one try to the next. Time: neutral, a minimum-jerk onset,
an apex held with a small tremor, a minimum-jerk offset, neutral. Every unit has its own lag, speed and overshoot,
so that the path of the landmarks bends. Performed at 60 frames per second, 60 to 140 frames; handed out at 30.

Randomness: the generator of a style is seeded with (seed, subject, label), that of a take with the take's number too.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np

from facejax.data.synthetic import rig

NEUTRAL = "neutral"
COMA = (
    "bareteeth",
    "cheeks_in",
    "eyebrow",
    "high_smile",
    "lips_back",
    "lips_up",
    "mouth_down",
    "mouth_extreme",
    "mouth_middle",
    "mouth_open",
    "mouth_side",
    "mouth_up",
)
EMOTIONS = ("anger", "disgust", "fear", "happiness", "sadness", "surprise")
EXPRESSIONS = COMA + EMOTIONS
LABELS = (NEUTRAL, *EXPRESSIONS)

RATE = 60  # frames per second, performed
STORED_RATE = 30  # frames per second, stored
GAIN_SPREAD, EXPRESSIVITY, INTENSITY = 0.18, (0.85, 1.15), (0.75, 1.1)
ASYMMETRY_SPREAD, TAKE_SPREAD = 0.08, 0.05


class Recipe(NamedTuple):
    """Units at weight 1 of an expression. "*" in a unit's name stands for both sides."""

    units: dict[str, float]
    variants: tuple[tuple[float, dict[str, float]], ...] = ()  # (chance, units added): exactly one is chosen
    extras: tuple[tuple[float, dict[str, float]], ...] = ()  # (chance, units added): each on its own


RECIPES = {
    "bareteeth": Recipe(
        {"mouthUpperUp*": 0.85, "mouthLowerDown*": 0.9, "mouthStretch*": 0.6, "mouth-retraction": 0.5},
        extras=((0.5, {"noseSneer*": 0.5}), (0.4, {"eyeSquint*": 0.5})),
    ),
    "cheeks_in": Recipe(
        {"cheekPuff": -1.0, "mouthPucker": 0.55, "mouthPress*": 0.2},
        extras=((0.4, {"browInnerUp": 0.3}), (0.3, {"jawOpen": 0.06})),
    ),
    "eyebrow": Recipe(
        {"browInnerUp": 0.45, "eyeWide*": 0.35},
        variants=(
            (0.5, {"browOuterUp*": 1.0, "eyebrows-left-up": 0.8, "eyebrows-right-up": 0.8}),
            (0.25, {"browOuterUpLeft": 1.2, "eyebrows-left-up": 1.0, "browDownRight": 0.25}),
            (0.25, {"browOuterUpRight": 1.2, "eyebrows-right-up": 1.0, "browDownLeft": 0.25}),
        ),
    ),
    "high_smile": Recipe(
        {"mouthSmile*": 0.7, "mouth-corner-puller": 0.25, "cheekSquint*": 0.8, "mouthUpperUp*": 0.45},
        extras=((0.5, {"mouthLowerDown*": 0.4}), (0.4, {"eyeSquint*": 0.6}), (0.3, {"jawOpen": 0.12})),
    ),
    "lips_back": Recipe(
        {
            "mouthRollLower": 0.75,
            "mouthRollUpper": 0.45,
            "mouthDimple*": 0.6,
            "mouthPress*": 0.3,
            "mouthStretch*": 0.3,
        },
    ),
    "lips_up": Recipe(
        {"mouthUpperUp*": 0.9, "mouthShrugUpper": 0.9, "noseSneer*": 0.5, "mouth-elevation": 0.5},
        extras=((0.4, {"cheekSquint*": 0.5}),),
    ),
    "mouth_down": Recipe(
        {"mouthFrown*": 0.9, "mouth-depression": 0.7, "mouthLowerDown*": 0.35},
        extras=((0.4, {"neck-platysma": 0.5}), (0.4, {"mouthShrugLower": 0.35}), (0.3, {"browDown*": 0.3})),
    ),
    "mouth_extreme": Recipe(
        {
            "jawOpen": 0.7,
            "mouthStretch*": 0.8,
            "mouthLowerDown*": 0.5,
            "mouthUpperUp*": 0.5,
            "eyeSquint*": 0.5,
        },
        extras=((0.5, {"neck-platysma": 0.6}), (0.4, {"browOuterUp*": 0.5}), (0.3, {"noseSneer*": 0.5})),
    ),
    "mouth_middle": Recipe(
        {"mouthPucker": 0.9, "mouth-pursing": 0.45},
        extras=((0.4, {"mouthFunnel": 0.3}), (0.3, {"browDown*": 0.35})),
    ),
    "mouth_open": Recipe(
        {"jawOpen": 0.62, "mouthLowerDown*": 0.15},
        extras=((0.4, {"eyeWide*": 0.4}), (0.3, {"browInnerUp": 0.4}), (0.3, {"mouthFunnel": 0.3})),
    ),
    "mouth_side": Recipe(
        {"mouthPress*": 0.15},
        variants=(
            (0.5, {"mouthLeft": 1.0, "jawLeft": 0.6, "mouthDimpleLeft": 0.5}),
            (0.5, {"mouthRight": 1.0, "jawRight": 0.6, "mouthDimpleRight": 0.5}),
        ),
        extras=((0.3, {"eyeSquint*": 0.4}),),
    ),
    "mouth_up": Recipe(
        {"mouthShrugLower": 1.0, "mouthShrugUpper": 0.45, "mouthRollLower": 0.2, "jawForward": 0.25},
        extras=((0.4, {"mouthFrown*": 0.3}), (0.3, {"browInnerUp": 0.4})),
    ),
    "anger": Recipe(
        {"browDown*": 1.0, "eyebrows-left-down": 0.5, "eyebrows-right-down": 0.5, "eyeSquint*": 0.5},
        variants=(
            (0.6, {"mouthPress*": 0.7, "mouthRollLower": 0.3, "jawForward": 0.2}),
            (0.4, {"mouthUpperUp*": 0.5, "mouthLowerDown*": 0.6, "jawOpen": 0.08, "mouthStretch*": 0.2}),
        ),
        extras=((0.6, {"noseSneer*": 0.5}),),
    ),
    "disgust": Recipe(
        {"noseSneer*": 1.0, "nose-left-elevation": 0.6, "nose-right-elevation": 0.6, "mouthUpperUp*": 0.55},
        extras=((0.8, {"browDown*": 0.6}), (0.6, {"mouthShrugLower": 0.5}), (0.6, {"cheekSquint*": 0.6})),
    ),
    "fear": Recipe(
        {"browInnerUp": 0.9, "eyebrows-left-inner-up": 0.6, "eyebrows-right-inner-up": 0.6, "eyeWide*": 0.9},
        variants=(
            (0.6, {"mouthStretch*": 0.8, "jawOpen": 0.14, "mouthLowerDown*": 0.3}),
            (0.4, {"mouthStretch*": 0.7, "mouthPress*": 0.3}),
        ),
        extras=((0.5, {"neck-platysma": 0.5}), (0.4, {"browOuterUp*": 0.4})),
    ),
    "happiness": Recipe(
        {"mouthSmile*": 0.55, "mouth-corner-puller": 0.3, "cheekSquint*": 0.45},
        extras=((0.4, {"mouthDimple*": 0.4}), (0.4, {"eyeSquint*": 0.3}), (0.3, {"browOuterUp*": 0.3})),
    ),
    "sadness": Recipe(
        {
            "browInnerUp": 0.9,
            "eyebrows-left-inner-up": 0.8,
            "eyebrows-right-inner-up": 0.8,
            "mouthFrown*": 0.7,
        },
        extras=((0.6, {"mouthShrugLower": 0.5}), (0.5, {"eye-left-slit": 0.4, "eye-right-slit": 0.4})),
    ),
    "surprise": Recipe(
        {"browInnerUp": 0.8, "browOuterUp*": 0.9, "eyeWide*": 0.9, "jawOpen": 0.38},
        extras=((0.4, {"mouthFunnel": 0.35}), (0.4, {"eyebrows-left-up": 0.6, "eyebrows-right-up": 0.6})),
    ),
}


class Performance(NamedTuple):
    """One take: weights at 30 frames per second, and its marks as frame numbers of the same."""

    weights: np.ndarray  # (T, U) float32
    head: np.ndarray  # (T, 3) float32: pitch, yaw, roll in radians, positive pitch leans back
    onset: int
    apex_start: int
    apex_end: int
    offset: int
    duration: float  # seconds


def peak(label: str, subject: int, *, seed: int = 1) -> np.ndarray:
    """How a subject performs an expression: unit weights (U,) at the apex. Neutral is zero."""
    names = rig.unit_names()
    weights = np.zeros(len(names))
    if label == NEUTRAL:
        return weights
    if label not in RECIPES:
        raise ValueError(f"unknown expression {label!r}; the expressions are {', '.join(LABELS)}")
    recipe, person = RECIPES[label], _person(subject, seed)
    rng = np.random.default_rng([seed, subject, 1 + EXPRESSIONS.index(label)])
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
    """Neutral -> apex -> neutral."""
    rng = np.random.default_rng([seed, subject, 1 + EXPRESSIONS.index(label), 1 + take])
    apex = peak(label, subject, seed=seed) * np.exp(TAKE_SPREAD * rng.standard_normal(len(rig.unit_names())))
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


def direct(start: str, end: str, subject: int, *, take: int = 0, seed: int = 1, frames: int = 30) -> np.ndarray:
    """A transition performed directly, apex to apex, not through neutral: unit weights (frames, U)."""
    labels = [LABELS.index(start), LABELS.index(end)]
    rng = np.random.default_rng([seed, subject, 1000 + labels[0], 1000 + labels[1], take])
    first, second = peak(start, subject, seed=seed), peak(end, subject, seed=seed)
    length = float(rng.integers(24, 46))
    time = np.linspace(0, length, frames)
    # The muscles of the old expression let go while those of the new one already pull: two clocks.
    away = _activation(time, 0.0, 0.9 * length, len(first), rng)
    toward = _activation(time, 0.05 * length, 0.95 * length, len(first), rng)
    return (first * (1 - away) + second * toward).astype(np.float32)


def _person(subject: int, seed: int) -> np.ndarray:
    """A subject's gain per unit in every expression: expressivity, and one side stronger than the other."""
    rng = np.random.default_rng([seed, subject, 0])
    side = ASYMMETRY_SPREAD * rng.standard_normal()
    lean = np.array([side * _side(name) for name in rig.unit_names()])
    habit = np.exp(0.5 * GAIN_SPREAD * rng.standard_normal(len(lean)))
    return rng.uniform(*EXPRESSIVITY) * (1 + lean) * _same_on_both_sides(habit)


def _side(name: str) -> int:
    return 1 if "Left" in name or "-left-" in name else -1 if "Right" in name or "-right-" in name else 0


@functools.cache
def _partner() -> np.ndarray:
    """For each unit the one whose draw it shares: the left one of a pair, else itself."""
    names = rig.unit_names()
    return np.array([names.index(n.replace("Right", "Left").replace("-right-", "-left-")) for n in names])


def _same_on_both_sides(values: np.ndarray) -> np.ndarray:
    return values[_partner()]


def _activation(time, begin, length, units, rng) -> np.ndarray:
    """Minimum-jerk rise from 0 to 1 per unit, (T, units): own lag, speed and overshoot, all at 1 by begin + length."""
    lag = _same_on_both_sides(rng.uniform(0.0, 0.3, units))
    speed = _same_on_both_sides(rng.uniform(0.75, 1.0, units))
    overshoot = _same_on_both_sides(np.clip(rng.normal(0.03, 0.03, units), 0, 0.1))
    x = (time[:, None] - begin - lag * length) / ((1 - lag) * speed * length)
    u = np.clip(x, 0, 1)
    bump = np.clip(1 - ((x - 1.1) / 0.5) ** 2, 0, None) ** 3
    return u**3 * (10 - 15 * u + 6 * u * u) + overshoot * bump


def _tremor(time, units, rng) -> np.ndarray:
    """A held pose is never still: two slow sines of one per cent each, per unit."""
    seconds = time[:, None] / RATE
    total = 0.0
    for low, high in ((1.0, 2.5), (2.5, 5.0)):
        frequency, phase = rng.uniform(low, high, units), rng.uniform(0, 2 * np.pi, units)
        total = total + 0.008 * np.sin(2 * np.pi * frequency * seconds + phase)
    return total


def _lean(label: str, rng) -> np.ndarray:
    """Pitch, yaw, roll at the apex: everybody sways a little, surprise leans back, sadness bows."""
    pitch = {"surprise": 0.12, "fear": 0.08, "sadness": -0.10, "anger": -0.05}.get(label, 0.0)
    return np.array([pitch * rng.uniform(0.5, 1.5), 0, 0]) + 0.02 * rng.standard_normal(3)
