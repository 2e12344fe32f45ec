"""Shading of a face: lights, sRGB, and cavity darkening.

Lights and viewer are far away, so light is a function of the camera-space normal alone: it is tabulated once and read
for every sample. Concave regions are darkened by the mesh's curvature, which makes wrinkles visible.
N vertices, S samples.
"""

import functools

import numpy as np

# Studio lights in camera space: direction (x right, y up, z to the viewer) and linear colour.
# Ambient light comes from sky and ground.
LIGHTS = (
    ((-0.50, 0.55, 0.67), (0.92, 0.85, 0.76)),
    ((0.85, 0.10, 0.52), (0.20, 0.25, 0.32)),
    ((0.45, 0.60, -0.66), (0.50, 0.55, 0.65)),
)
SKY, GROUND = (0.30, 0.33, 0.38), (0.12, 0.09, 0.08)
INSIDE = (0.028, 0.010, 0.009)
_TABLE = 512


def shade(normal: np.ndarray, colour: np.ndarray, gloss: np.ndarray) -> np.ndarray:
    """Return linear light (S, 3) for camera-space normals (S, 3), linear colours (S, 3) and gloss (S,)."""
    length = np.sqrt(np.einsum("sa,sa->s", normal, normal))
    scale = (_TABLE / 2 - 1) / np.maximum(length, 1e-20)
    index = (normal[:, :2] * scale[:, None] + _TABLE / 2).astype(np.int32)
    light_at = np.take(_table(), index[:, 1] * _TABLE + index[:, 0], axis=0)
    light = light_at[:, :3] * colour
    light += (light_at[:, 3] * gloss)[:, None]
    return light


@functools.cache
def _table() -> np.ndarray:
    """Return diffuse r, g, b and highlight (512 * 512, 4) for the normal (x, y, sqrt(1 - x^2 - y^2)) on a grid."""
    axis = (np.arange(_TABLE) + 0.5 - _TABLE / 2) / (_TABLE / 2 - 1)
    x, y = np.meshgrid(axis, axis)
    z = np.sqrt(np.maximum(1 - x * x - y * y, 0))
    normal = np.stack([x, y, z], -1)
    up = (0.5 + 0.5 * y)[..., None]
    diffuse = up * np.array(SKY) + (1 - up) * np.array(GROUND)
    highlight = np.zeros(x.shape)
    for direction, colour in LIGHTS:
        direction = np.array(direction) / np.linalg.norm(direction)
        # Wrapped diffuse light, an approximation of subsurface scattering.
        facing = np.maximum((normal @ direction + 0.20) / 1.20, 0)
        diffuse = diffuse + facing[..., None] ** 1.2 * np.array(colour)
        half = direction + np.array([0, 0, 1])
        half /= np.linalg.norm(half)
        highlight += np.maximum(normal @ half, 0) ** 28 * np.mean(colour) * 0.35
    return np.concatenate([diffuse, highlight[..., None]], -1).reshape(-1, 4).astype(np.float32)


def neighbours(faces: np.ndarray, points: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return unique directed edges (from, to), and the number of neighbours of each vertex."""
    edge = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    both = np.concatenate([edge, edge[:, ::-1]]).astype(np.int64)
    start, end = np.divmod(np.unique(both[:, 0] * points + both[:, 1]), points)
    return start, end, np.maximum(np.bincount(start, minlength=points), 1)


def cavity(
    vertices: np.ndarray, normals: np.ndarray, neighbours: tuple[np.ndarray, np.ndarray, np.ndarray]
) -> np.ndarray:
    """Return brightness (N,), below 1 in concave and above 1 in convex regions: bounded curvature times edge length."""
    start, end, count = neighbours
    step = vertices[end] - vertices[start]
    reach = np.bincount(start, np.linalg.norm(step, axis=1), len(vertices)) / count
    mean = np.stack([np.bincount(start, step[:, c], len(vertices)) for c in range(3)], -1) / count[:, None]
    bend = np.einsum("na,na->n", mean, normals) / np.maximum(reach, 1e-9)
    return np.exp(-np.clip(1.6 * bend, -0.25, 0.9))


def linear(colour: np.ndarray) -> np.ndarray:
    """Convert sRGB to linear light."""
    return np.where(colour <= 0.04045, colour / 12.92, ((np.maximum(colour, 0) + 0.055) / 1.055) ** 2.4).astype(
        np.float32
    )


_GRID = np.linspace(0, 1, 4096)
_SRGB = np.round(
    255 * np.where(_GRID <= 0.0031308, 12.92 * _GRID, 1.055 * np.maximum(_GRID, 1e-9) ** (1 / 2.4) - 0.055)
).astype(np.uint8)


def encode(picture: np.ndarray) -> np.ndarray:
    """Convert linear light to sRGB bytes by a table: a power per pixel would cost more than rasterising the face."""
    return _SRGB[(np.clip(picture, 0, 1) * 4095 + 0.5).astype(np.int64)]
