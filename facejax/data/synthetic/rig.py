"""Facial rigs: a subject's vertices as a function of expression unit weights, at four levels of realism.

Level 0   linear: neutral + weights @ units, the units averaged over ethnicities.
Level 1   the subject's own mixture of the ethnic variants; units saturate; the jaw rotates about its hinge.
Level 2   the units are adapted to the subject's shape by deformation transfer; eyelids slide on the eyeball, lips do
          not pass through one another or the teeth (`facejax.data.synthetic.contact`).
Level 3   skin wrinkles and bulges where it is compressed (`facejax.data.synthetic.skin`).

Every level is deterministic given the weights and the subject.

T frames, U units, N skin vertices, M = N + vertices of the props. Millimetres.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np

from facejax.data.synthetic import assets, contact, makehuman, skin
from facejax.mesh import deformation_transfer

LEVELS = (0, 1, 2, 3)
SATURATION = 0.35  # f(w) = (1 + k) w / (1 + k |w|): f(1) = 1, f(0.5) = 0.57
JAW_LANDMARKS = (0, 16)  # beside the ears; the hinge lies behind them
HINGE_OFFSET = np.array([0.0, -8.0, -8.0])
ANCHOR = 1e-7  # weight of the untransferred offsets in deformation transfer, relative to the gradient term


class Rig(NamedTuple):
    """The rig of one subject at one level of realism, for `pose`."""

    level: int
    neutral: np.ndarray  # (M, 3)
    units: np.ndarray  # (U, M, 3) offsets at weight 1; the row of jawOpen is the residual of its rotation
    hinge: np.ndarray  # (3,) point on the jaw's axis, which is parallel to x
    jaw_angle: np.ndarray  # (M,) radians at weight 1
    contact: contact.Contact | None  # levels 2 and 3
    skin: skin.Skin | None  # level 3


@functools.cache
def unit_names() -> tuple[str, ...]:
    """Return the names of the U units: ARKit's 51 that move skin, then MakeHuman's 34."""
    names = list(assets.load().targets)
    arkit = [n.split("/")[1] for n in names if n.startswith("arkit/") and n != "arkit/tongueOut"]
    human = [n.split("/")[2] for n in names if n.startswith("unit/caucasian/")]
    return (*arkit, *human)


def build(subject: makehuman.Subject, *, level: int = 3) -> Rig:
    """Build the rig of a subject. Raises `ValueError` for a level other than 0 to 3."""
    if level not in LEVELS:
        raise ValueError(f"realism level must be one of {LEVELS}, got {level}")
    loaded = assets.load()
    neutral = subject.neutral.astype(np.float64)
    units = _units(subject.ethnicity if level >= 1 else np.full(3, 1 / 3))
    if level >= 2:
        units = _transfer(units, neutral)
    jaw = unit_names().index("jawOpen")
    hinge = neutral[loaded.landmarks[list(JAW_LANDMARKS)]].mean(axis=0) + HINGE_OFFSET
    angle = np.zeros(len(neutral))
    if level >= 1:
        angle, residual = _split_jaw(neutral, units[jaw], hinge)
        units[jaw] = residual
    return Rig(
        level=level,
        neutral=subject.neutral,
        units=units.astype(np.float32),
        hinge=hinge.astype(np.float32),
        jaw_angle=angle.astype(np.float32),
        contact=contact.build(subject) if level >= 2 else None,
        skin=skin.build(subject) if level >= 3 else None,
    )


def pose(rig: Rig, weights: np.ndarray) -> np.ndarray:
    """Pose a rig by unit weights (T, U). Raises `ValueError` for another shape.

    Returns:
      Vertices (T, M, 3) float32, skin first, then the props.
    """
    weights = np.asarray(weights, np.float32)
    count, vertices, _ = rig.units.shape
    if weights.ndim != 2 or weights.shape[1] != count:
        raise ValueError(f"expected unit weights of shape (T, {count}), got {weights.shape}")
    active = saturate(weights) if rig.level >= 1 else weights
    moved = rig.neutral + (active @ rig.units.reshape(count, -1)).reshape(-1, vertices, 3)
    if rig.contact is not None:
        moved = contact.clear_teeth(rig.contact, moved)
    if rig.level >= 1:
        # The jaw's angle is proportional to the unsaturated weight, so that vertices move on arcs.
        moved = _rotate_jaw(rig, moved, weights[:, unit_names().index("jawOpen")])
    if rig.contact is not None:
        moved = contact.separate_lips(rig.contact, contact.slide_lids(rig.contact, moved))
    if rig.skin is not None:
        moved = skin.add_wrinkles(rig.skin, moved)
    return moved


def saturate(weights: np.ndarray) -> np.ndarray:
    """Model the saturation of muscle contraction: f(w) = (1 + k) w / (1 + k |w|)."""
    return (1 + SATURATION) * weights / (1 + SATURATION * np.abs(weights))


def _units(ethnicity: np.ndarray) -> np.ndarray:
    targets = assets.load().targets
    rows = []
    for name in unit_names():
        if f"arkit/{name}" in targets:
            rows.append(targets[f"arkit/{name}"].astype(np.float64))
        else:
            variants = (targets[f"unit/{e}/{name}"] for e in assets.ETHNICITIES)
            rows.append(sum(share * v.astype(np.float64) for share, v in zip(ethnicity, variants, strict=True)))
    return np.stack(rows)


def _split_jaw(neutral: np.ndarray, offset: np.ndarray, hinge: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Split the opening of the jaw into a rotation about x by an angle per vertex (M,) and a residual (M, 3).

    The residual is linear in the weight, and is added before the rotation.
    """
    before = neutral - hinge
    after = before + offset
    cross = before[:, 1] * after[:, 2] - before[:, 2] * after[:, 1]
    dot = before[:, 1] * after[:, 1] + before[:, 2] * after[:, 2]
    angle = np.where(np.linalg.norm(offset, axis=1) > 0, np.arctan2(cross, dot), 0.0)
    # Near the hinge the angle is ill-conditioned: fade it out within 25 mm.
    angle *= np.clip(np.linalg.norm(before[:, 1:], axis=1) / 25.0, 0, 1) ** 2
    return angle, _rotate_x(after, -angle) - before


def _rotate_x(points: np.ndarray, angle: np.ndarray) -> np.ndarray:
    cos, sin = np.cos(angle), np.sin(angle)
    x, y, z = points[..., 0], points[..., 1], points[..., 2]
    return np.stack([x, cos * y - sin * z, sin * y + cos * z], axis=-1)


def _rotate_jaw(rig: Rig, moved: np.ndarray, opening: np.ndarray) -> np.ndarray:
    """Rotate vertices, as moved by the other units, about the hinge."""
    return rig.hinge + _rotate_x(moved - rig.hinge, opening[:, None] * rig.jaw_angle)


def _transfer(units: np.ndarray, neutral: np.ndarray) -> np.ndarray:
    """Transfer the units' deformation gradients from the template to the subject (Sumner and Popovic 2004, linear).

    For each coordinate of each unit, the surface gradient on the template is projected to the subject's triangles and
    integrated by a Poisson solve. The scalp and neck, which no unit moves, are held fixed.
    """
    loaded = assets.load()
    n = loaded.skin
    still = np.abs(units[:, :n]).max(axis=(0, 2)) < 1e-6
    transfer = deformation_transfer.DeformationTransfer(
        makehuman.template().vertices, neutral[:n], loaded.faces, np.where(still, 1.0, ANCHOR)
    )
    transferred = units.copy()
    transferred[:, :n] = transfer(units[:, :n])
    return transferred
