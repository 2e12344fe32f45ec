"""Recipes of facial expressions: which units of the rig an expression activates, and how strongly.

The labels are the twelve expressions of CoMA and the six basic emotions. Units are named as in
`facejax.data.synthetic.rig.unit_names`.
"""

from __future__ import annotations

from typing import NamedTuple

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


class Recipe(NamedTuple):
    """Unit weights of an expression at full intensity. "*" in a unit's name stands for Left and Right."""

    units: dict[str, float]
    variants: tuple[tuple[float, dict[str, float]], ...] = ()  # (probability, units added): exactly one is chosen
    extras: tuple[tuple[float, dict[str, float]], ...] = ()  # (probability, units added): each independently


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
