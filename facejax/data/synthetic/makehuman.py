"""Synthetic people: MakeHuman heads, sampled by seed.

A subject has a mixture of ethnicities, a gender, a continuous adult age, a body weight and a few hundred detail
sliders. Subject `i` of seed `s` is always the same: all its numbers come from a generator seeded with (s, i).

Coordinates: millimetres, y up, z forward, the origin at the centroid of the subject's neutral skin.
"""

from __future__ import annotations

import functools
import re
from importlib import resources
from typing import NamedTuple

import numpy as np

from facejax.data.synthetic import assets

SLIDER_SPREAD = 0.22  # standard deviation of a slider whose range is -1..1
ASYMMETRY_SPREAD = 0.12  # standard deviation of each side from the shared value
OPPOSITES = (
    ("decr", "incr"),
    ("down", "up"),
    ("in", "out"),
    ("backward", "forward"),
    ("concave", "convex"),
    ("compress", "uncompress"),
)
# Caricatures, such as pointed ears or a square skull: at full weight they do not occur in scanned people.
CARICATURE = re.compile(
    r"ear-shape|head-(square|triangular|invertedtriangular|diamond|rectangular)|nubian|chin-triangle"
)
# These translate the whole face, which has no effect once the head is centred.
PLACEMENT = re.compile(r"head-trans|neck-trans|neck-height|measure-neck")


class Template(NamedTuple):
    """The topology that all subjects share, with the geometry of the average young adult."""

    vertices: np.ndarray  # (N, 3) float32
    faces: np.ndarray  # (F, 3) int32
    landmarks: np.ndarray  # (68,) int32
    face_mask: np.ndarray  # (N,) bool: within 25 mm geodesic distance of a landmark on the template


class Subject(NamedTuple):
    """One person at rest."""

    name: str
    neutral: np.ndarray  # (M, 3) float32: skin first, then the props (eyes, teeth, tongue)
    ethnicity: np.ndarray  # (3,) mixture over `assets.ETHNICITIES`, sums to 1
    gender: float  # 0 female .. 1 male
    age: float  # years, 18 to 80

    @property
    def vertices(self) -> np.ndarray:
        """The skin, (N, 3)."""
        return self.neutral[: assets.load().skin]


def template() -> Template:
    """Return the average young adult: equal ethnicities and genders, no sliders."""
    loaded = assets.load()
    packed = np.frombuffer(resources.files("facejax.assets").joinpath("face_mask.bin").read_bytes(), np.uint8)
    mask = np.unpackbits(packed)[: loaded.skin].astype(bool)
    return Template(average().vertices, loaded.faces, loaded.landmarks, mask)


def average() -> Subject:
    """Return the template as a subject, with eyes and teeth."""
    return Subject("average", _compose(np.full(3, 1 / 3), 0.5, 25.0, 0.0, {}), np.full(3, 1 / 3), 0.5, 25.0)


def subject(index: int, *, seed: int = 1) -> Subject:
    """Return subject `index` (0 or more) of the population of `seed`. Raises `ValueError` for a negative index."""
    if index < 0:
        raise ValueError(f"subject index must be 0 or more, got {index}")
    rng = np.random.default_rng([seed, index])
    ethnicity = rng.dirichlet(np.full(3, 0.6))
    gender = float(np.clip(rng.beta(0.35, 0.35), 0, 1))
    age = float(rng.uniform(18, 80) if rng.random() < 0.5 else rng.uniform(18, 45))
    weight = float(np.clip(rng.normal(0, 0.4), -1, 1))
    neutral = _compose(ethnicity, gender, age, weight, _draw_sliders(rng))
    return Subject(f"S{index:03d}", neutral, ethnicity, gender, age)


@functools.cache
def _sliders() -> tuple[tuple[str, str | None], ...]:
    """Return (positive target, negative target or None) of each slider, in a fixed order."""
    found = {}
    names = [n for n in assets.load().targets if n.split("/")[0] in assets.SLIDER_FOLDERS]
    for name in sorted(names):
        if PLACEMENT.search(name):
            continue
        for low, high in (*OPPOSITES, ("l", "r")) if name.startswith("asym/") else OPPOSITES:
            if name.endswith(f"-{high}") and f"{name.removesuffix(high)}{low}" in names:
                found[name] = f"{name.removesuffix(high)}{low}"
    paired = set(found) | set(found.values())
    found |= {name: None for name in names if name not in paired and not PLACEMENT.search(name)}
    return tuple(sorted(found.items()))


def _draw_sliders(rng: np.random.Generator) -> dict[str, float]:
    """Sample weights in 0..1 by target name. Left and right share most of a slider's value."""
    shared, weights = {}, {}
    for positive, negative in _sliders():
        folder, name = positive.split("/")
        unsided = name[2:] if name[:2] in ("l-", "r-") else name
        own = _truncated_normal(rng)
        if unsided != name:
            value = shared.setdefault((folder, unsided), own) + ASYMMETRY_SPREAD * _truncated_normal(rng)
        else:
            value = own
        spread = SLIDER_SPREAD * (0.35 if CARICATURE.search(name) or folder == "asym" else 1.0)
        value = float(np.clip(spread * value, -1, 1))
        if value > 0:
            weights[positive] = value
        elif negative is not None:
            weights[negative] = -value
    return weights


def _truncated_normal(rng: np.random.Generator, limit: float = 2.0) -> float:
    # Clipped, not rejected: every value takes exactly one draw.
    return float(np.clip(rng.standard_normal(), -limit, limit))


def _compose(ethnicity: np.ndarray, gender: float, age: float, weight: float, sliders: dict[str, float]) -> np.ndarray:
    """Return the base mesh plus weighted targets, centred, (M, 3) float32."""
    loaded = assets.load()
    old = np.clip((age - 25.0) / 65.0, 0.0, 1.0)  # MakeHuman's "young" is 25 and its "old" 90
    heavy, light = max(weight, 0.0), max(-weight, 0.0)
    total = loaded.base.astype(np.float64)
    for g, gender_share in zip(assets.GENDERS, (1 - gender, gender), strict=True):
        for a, age_share in zip(assets.AGES, (1 - old, old), strict=True):
            share = gender_share * age_share
            for e, ethnic_share in zip(assets.ETHNICITIES, ethnicity, strict=True):
                total += share * ethnic_share * loaded.targets[f"macro/{e}-{g}-{a}"]
            for w, weight_share in zip(assets.WEIGHTS, (light, 1 - heavy - light, heavy), strict=True):
                total += share * weight_share * loaded.targets[f"macro/universal-{g}-{a}-averagemuscle-{w}"]
    for name, value in sliders.items():
        total += value * loaded.targets[name]
    total -= total[: loaded.skin].mean(axis=0)
    return total.astype(np.float32)


def template_props() -> tuple[np.ndarray, ...]:
    """Return the template's eyes and teeth.

    Returns:
      Centres (2, 3) and radii (2,) of the left and right eyeball, then vertices and triangles of the upper and of the
      lower teeth.
    """
    loaded = assets.load()
    whole = average().neutral
    eyes = [whole[np.unique(loaded.prop_faces[name])] for name in ("helper-l-eye", "helper-r-eye")]
    # Slightly smaller and further back than the prop, whose cornea would intersect the lids.
    centres = np.stack([(eye.min(axis=0) + eye.max(axis=0)) / 2 - [0, 0, 0.8] for eye in eyes])
    radii = np.array([np.ptp(eye[:, 0]) / 2 - 0.5 for eye in eyes])
    found = [centres.astype(np.float32), radii.astype(np.float32)]
    for name in ("helper-upper-teeth", "helper-lower-teeth"):
        used, triangles = np.unique(loaded.prop_faces[name], return_inverse=True)
        found += [whole[used], triangles.reshape(-1, 3).astype(np.int32)]
    return tuple(found)
