"""Contact constraints: eyelids stay outside the eyeball, lips do not pass through one another or through the teeth.

No constraint moves the neutral face: where parts of it overlap, the overlap is the allowed minimum distance. All
functions take vertices (T, M, 3) in millimetres and return a new array.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np

from facejax.data.synthetic import assets, makehuman
from facejax.geometry.interpolation import smoothstep
from facejax.mesh import graph

LID_THICKNESS = 1.0
LID_REACH = 14.0  # geodesic distance from the lid's edge within which skin touches the eyeball
LIP_REACH = 9.0  # distance to which a correction at the lip's edge spreads into the lip
TEETH_REACH = 16.0
LIP_TO_TEETH = 1.0


class Contact(NamedTuple):
    """A subject's colliders."""

    eye_centre: np.ndarray  # (2, 3)
    eye_radius: tuple[np.ndarray, np.ndarray]  # (V,) each, minimum distance of a lid vertex from the centre
    lid_index: tuple[np.ndarray, np.ndarray]  # (V,) each, skin vertices of the lids
    lip_pairs: np.ndarray  # (K, 2) upper and lower vertices that meet when the mouth closes
    lip_gap: np.ndarray  # (K,) minimum gap
    lip_index: np.ndarray  # (V,) skin vertices that a lip correction moves
    lip_spread: np.ndarray  # (V, K) signed: + for the upper lip, - for the lower
    teeth_index: np.ndarray  # (V,)
    teeth_margin: np.ndarray  # (V,) minimum distance in front of the arch
    teeth_arch: np.ndarray  # (3,) front surface of the teeth: z = c0 + c1 x + c2 x^2


class Regions(NamedTuple):
    """Vertex sets of the shared topology, computed once on the template."""

    lids: tuple[np.ndarray, np.ndarray]
    lip_pairs: np.ndarray
    lip_index: np.ndarray
    lip_spread: np.ndarray
    teeth_index: np.ndarray


def build(subject: makehuman.Subject) -> Contact:
    """Measure a subject's colliders at rest."""
    loaded, regions = assets.load(), template_regions()
    neutral = subject.neutral.astype(np.float64)
    centres, radii = [], []
    for prop, lids in zip(("helper-l-eye", "helper-r-eye"), regions.lids, strict=True):
        centre, radius = fit_sphere(neutral[np.unique(loaded.prop_faces[prop])])
        rest = np.linalg.norm(neutral[lids] - centre, axis=1)
        centres.append(centre)
        radii.append(np.minimum(radius + LID_THICKNESS, rest))
    arch = _teeth_arch(neutral[np.unique(loaded.prop_faces["helper-upper-teeth"])])
    near = neutral[regions.teeth_index]
    gap = neutral[regions.lip_pairs[:, 0], 1] - neutral[regions.lip_pairs[:, 1], 1]
    return Contact(
        eye_centre=np.stack(centres).astype(np.float32),
        eye_radius=(radii[0].astype(np.float32), radii[1].astype(np.float32)),
        lid_index=regions.lids,
        lip_pairs=regions.lip_pairs,
        lip_gap=np.minimum(gap, 0.0).astype(np.float32),
        lip_index=regions.lip_index,
        lip_spread=regions.lip_spread,
        teeth_index=regions.teeth_index,
        teeth_margin=np.minimum(LIP_TO_TEETH, near[:, 2] - _arch_z(arch, near[:, 0])).astype(np.float32),
        teeth_arch=arch.astype(np.float32),
    )


def slide_lids(contact: Contact, vertices: np.ndarray) -> np.ndarray:
    """Push lid vertices radially out of the eyeball, so that a closing lid slides over it."""
    moved = vertices.copy()
    for centre, radius, lids in zip(contact.eye_centre, contact.eye_radius, contact.lid_index, strict=True):
        outward = moved[:, lids] - centre
        distance = np.linalg.norm(outward, axis=-1)
        moved[:, lids] = centre + outward * (np.maximum(distance, radius) / np.maximum(distance, 1e-6))[..., None]
    return moved


def clear_teeth(contact: Contact, vertices: np.ndarray) -> np.ndarray:
    """Keep the inside of the lips in front of the dental arch; applied before the jaw rotates."""
    moved = vertices.copy()
    near = moved[:, contact.teeth_index]
    least = _arch_z(contact.teeth_arch, near[..., 0]) + contact.teeth_margin
    moved[:, contact.teeth_index, 2] = np.maximum(near[..., 2], least)
    return moved


def separate_lips(contact: Contact, vertices: np.ndarray) -> np.ndarray:
    """Move both edges of overlapping lips back by half of the overlap, and the skin behind them smoothly."""
    upper, lower = contact.lip_pairs.T
    gap = vertices[:, upper, 1] - vertices[:, lower, 1]
    overlap = np.maximum(contact.lip_gap - gap, 0.0)
    moved = vertices.copy()
    moved[:, contact.lip_index, 1] += 0.5 * overlap @ contact.lip_spread.T
    return moved


@functools.cache
def template_regions() -> Regions:
    """Return the vertex sets that can be in contact, from the template."""
    shape = makehuman.template()
    loops = graph.boundary_loops(shape.faces)
    eyes = sorted((loop for loop in loops if len(loop) == 28), key=lambda loop: -shape.vertices[loop, 0].mean())
    (mouth,) = (loop for loop in loops if len(loop) == 38)
    left, right = (np.flatnonzero(graph.geodesic(shape.vertices, shape.faces, loop) < LID_REACH) for loop in eyes)
    pairs = _lip_pairs(shape.vertices, mouth)
    near = np.flatnonzero(graph.geodesic(shape.vertices, shape.faces, mouth) < LIP_REACH)
    to_upper = graph.geodesic(shape.vertices, shape.faces, pairs[:, 0])
    to_lower = graph.geodesic(shape.vertices, shape.faces, pairs[:, 1])
    sign = np.where(to_upper < to_lower, 1.0, -1.0)[near]
    edge = np.where(sign[:, None] > 0, pairs[:, 0], pairs[:, 1])
    distance = np.linalg.norm(shape.vertices[near][:, None] - shape.vertices[edge], axis=-1)
    kernel = np.exp(-0.5 * (distance / 2.5) ** 2)
    kernel /= np.maximum(kernel.sum(axis=1, keepdims=True), 1e-12)
    reach = graph.geodesic(shape.vertices, shape.faces, mouth)[near]
    fade = smoothstep(1 - reach / LIP_REACH)
    teeth = np.flatnonzero(graph.geodesic(shape.vertices, shape.faces, mouth) < TEETH_REACH)
    return Regions(
        (left, right), pairs, near, (sign * fade)[:, None].astype(np.float32) * kernel.astype(np.float32), teeth
    )


def fit_sphere(points: np.ndarray) -> tuple[np.ndarray, float]:
    """Fit a sphere to points (P, 3) in the least squares sense: centre (3,), radius."""
    design = np.concatenate([2 * points, np.ones((len(points), 1))], axis=1)
    solution = np.linalg.lstsq(design, (points**2).sum(axis=1), rcond=None)[0]
    return solution[:3], float(np.sqrt(solution[3] + solution[:3] @ solution[:3]))


def _lip_pairs(vertices: np.ndarray, mouth: np.ndarray) -> np.ndarray:
    """Pair each vertex of the upper edge with the vertex of the lower edge that lies straight below it, (K, 2)."""
    right, left = np.argmin(vertices[mouth, 0]), np.argmax(vertices[mouth, 0])
    ring = np.roll(mouth, -right)
    corner = (left - right) % len(mouth)
    upper, lower = ring[1:corner], ring[:corner:-1]
    if vertices[upper, 1].mean() < vertices[lower, 1].mean():
        upper, lower = lower, upper
    below = np.abs(vertices[upper, None, 0] - vertices[None, lower, 0]).argmin(axis=1)
    return np.stack([upper, lower[below]], axis=1)


def _teeth_arch(teeth: np.ndarray) -> np.ndarray:
    """Fit a parabola to the front of the teeth, the foremost vertex of each slice of x."""
    slices = np.round(teeth[:, 0] / 4.0)
    front = np.array([teeth[slices == s][np.argmax(teeth[slices == s, 2])] for s in np.unique(slices)])
    return np.polynomial.polynomial.polyfit(front[:, 0], front[:, 2], 2)


def _arch_z(arch: np.ndarray, x: np.ndarray) -> np.ndarray:
    return arch[0] + x * (arch[1] + x * arch[2])
