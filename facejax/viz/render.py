"""Render pictures of a face in NumPy, without OpenGL or a display.

Smooth shading (interpolated normals), one perspective camera for a whole motion, several samples per pixel. Back faces
(the inside of a head, visible through its mouth) are dark. A head of 6,388 triangles takes about 45 ms at 256 x 320
pixels on one core. T frames, N vertices, F faces, L landmarks; millimetres.
"""

from collections.abc import Sequence
from typing import NamedTuple, TypedDict, Unpack

import numpy as np
from numpy.typing import ArrayLike

from facejax.mesh import graph
from facejax.viz import rasterizer, scene, shading
from facejax.viz.contact_sheet import caption, contact_sheet, save

__all__ = [
    "Camera",
    "caption",
    "close_largest_hole",
    "contact_sheet",
    "fit_camera",
    "frames",
    "heat_colours",
    "image",
    "save",
]

SKIN_GLOSS = 0.30
LANDMARK_COLOUR = (0.02, 0.55, 0.80)


class Camera(NamedTuple):
    """A perspective camera.

    turn: (3, 3) rows are the camera's right, up and backward axes.
    eye: (3,) position, mm.
    zoom: focal length divided by half of the picture's height.
    """

    turn: np.ndarray
    eye: np.ndarray
    zoom: float


class Options(TypedDict, total=False):
    """Options of `frames` that `image` takes as well."""

    size: tuple[int, int]
    camera: Camera | None
    colours: ArrayLike | None
    extras: Sequence[scene.PartLike]
    background: ArrayLike
    samples: int


def fit_camera(
    vertices: ArrayLike,
    *,
    size: tuple[int, int] = (256, 320),
    turn: float = 0.0,
    tilt: float = 0.0,
    field: float = 20.0,
    margin: float = 0.05,
) -> Camera:
    """Return a camera that has every given vertex, in all frames, in the picture.

    Args:
      vertices: (..., 3) that must be visible; mm.
      size: (width, height).
      turn: degrees to the subject's left (the viewer's right).
      tilt: degrees from above.
      field: vertical angle of view in degrees.
      margin: fraction of the picture that stays free at each edge.
    """
    points = np.asarray(vertices, np.float64).reshape(-1, 3)
    turn, tilt = np.radians(turn), np.radians(tilt)
    back = np.array([np.sin(turn) * np.cos(tilt), np.sin(tilt), np.cos(turn) * np.cos(tilt)])
    right = np.array([np.cos(turn), 0, -np.sin(turn)])
    axes = np.stack([right, np.cross(back, right), back])
    zoom = 1 / np.tan(np.radians(field) / 2)
    view = points @ axes.T
    low, high = view.min(0), view.max(0)
    middle = (low + high) / 2
    # |x| zoom / (distance - z) <= reach for every point; the largest required distance applies.
    reach = np.array([size[0] / size[1], 1.0]) * (1 - 2 * margin)
    distance = (np.abs(view[:, :2] - middle[:2]) * zoom / reach + view[:, 2:]).max()
    return Camera(axes, axes.T @ np.array([middle[0], middle[1], distance]), float(zoom))


def frames(
    vertices: ArrayLike,
    faces: ArrayLike,
    *,
    size: tuple[int, int] = (256, 320),
    camera: Camera | None = None,
    colours: ArrayLike | None = None,
    landmarks: ArrayLike | None = None,
    extras: Sequence[scene.PartLike] = (),
    background: ArrayLike = (0.93, 0.94, 0.96),
    samples: int = 2,
) -> np.ndarray:
    """Render every frame from one fixed camera.

    Args:
      vertices: (T, N, 3) mm.
      faces: (F, 3).
      size: (width, height) in pixels.
      camera: a `Camera`; default: one that fits the whole motion, from the front.
      colours: (N, 3) or (T, N, 3) sRGB in [0, 1], for heat maps; default: skin.
      landmarks: (T, L, 3) positions or (L,) vertex indices, drawn as dots where visible.
      extras: further meshes, see `scene.Part`.
      background: sRGB.
      samples: samples per pixel along each axis.

    Returns:
      (T, height, width, 3) uint8.

    Raises:
      ValueError: invalid arrays, see `scene.make`, or colours of a wrong shape.
    """
    animation = scene.make(vertices, faces, landmarks=landmarks, extras=extras)
    view = fit_camera(animation.vertices, size=size) if camera is None else camera
    count, points = animation.vertices.shape[:2]
    tint = np.asarray(scene.SKIN if colours is None else colours, np.float32)
    if tint.shape not in ((3,), (points, 3), (count, points, 3)):
        raise ValueError(f"colours must be ({points}, 3) or ({count}, {points}, 3), got {tint.shape}")
    tint = np.broadcast_to(shading.linear(tint), (count, points, 3))
    neighbours = shading.neighbours(animation.faces, points)
    # The closing triangles are drawn but do not change normals: the shading of the neck's rim stays as it is.
    solid = np.concatenate([animation.faces, close_largest_hole(animation.vertices[0], animation.faces)])
    backdrop = _backdrop(background, size, samples)
    pictures = np.empty((count, size[1], size[0], 3), np.uint8)
    for t, surface in enumerate(animation.vertices):
        normals = scene.normals(surface, animation.faces)
        cavity = shading.cavity(surface, normals, neighbours)
        layers = [_Layer(surface, normals, tint[t] * cavity[:, None], solid, SKIN_GLOSS)]
        layers += [_layer(part, t) for part in animation.extras]
        dots = None if animation.landmarks is None else animation.landmarks[t]
        pictures[t] = _draw(layers, dots, view, backdrop.copy(), samples)
    return pictures


def image(
    vertices: ArrayLike, faces: ArrayLike, *, landmarks: ArrayLike | None = None, **options: Unpack[Options]
) -> np.ndarray:
    """Render one picture (height, width, 3) uint8 of vertices (N, 3); options as of `frames`."""
    return frames(np.asarray(vertices)[None], faces, landmarks=landmarks, **options)[0]


def heat_colours(values: ArrayLike, *, low: float = 0.0, high: float | None = None) -> np.ndarray:
    """Map values (...) to colours (..., 3): pale, yellow, orange, dark red; `high` defaults to the maximum."""
    values = np.asarray(values, np.float64)
    high = float(values.max()) if high is None else high
    at = np.clip((values - low) / max(high - low, 1e-12), 0, 1)
    stops = np.array(
        [[0.90, 0.90, 0.92], [1.00, 0.86, 0.50], [0.96, 0.52, 0.23], [0.76, 0.13, 0.20], [0.35, 0.03, 0.16]]
    )
    grid = np.linspace(0, 1, len(stops))
    return np.stack([np.interp(at, grid, stops[:, c]) for c in range(3)], -1)


def close_largest_hole(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return triangles (K, 3) that close the largest of several holes, so that no light shows through a mouth.

    The largest hole of a head is its neck. A mesh (N, 3), (F, 3) with fewer than two holes, such as a mask, stays open:
    no triangles. No vertex is added.
    """
    loops = [loop[::-1].tolist() for loop in graph.boundary_loops(faces)]
    if len(loops) < 2:
        return np.zeros((0, 3), np.int32)
    length = [np.linalg.norm(np.diff(vertices[loop + loop[:1]], axis=0), axis=1).sum() for loop in loops]
    return _strip(loops[int(np.argmax(length))])


class _Layer(NamedTuple):
    """One mesh of one frame: vertices, unit normals and linear colours (N, 3), faces (F, 3)."""

    vertices: np.ndarray
    normals: np.ndarray
    colours: np.ndarray
    faces: np.ndarray
    gloss: float


def _layer(part: scene.Part, t: int) -> _Layer:
    vertices = part.vertices[t] if part.vertices.ndim == 3 else part.vertices
    colours = shading.linear(scene.colours(part))
    return _Layer(vertices, scene.normals(vertices, part.faces), colours, part.faces, part.gloss)


def _draw(layers: list[_Layer], dots: np.ndarray | None, view: Camera, picture: np.ndarray, samples: int) -> np.ndarray:
    """Draw layers over a linear backdrop (height, width, 3) counted in samples; return sRGB pixels."""
    height, width = picture.shape[:2]
    offsets = np.cumsum([0] + [len(layer.vertices) for layer in layers])
    points = np.concatenate([layer.vertices for layer in layers])
    faces = np.concatenate([layer.faces + offset for layer, offset in zip(layers, offsets, strict=False)])
    gloss = np.repeat([np.float32(layer.gloss) for layer in layers], [len(layer.faces) for layer in layers])
    normals = np.concatenate([layer.normals for layer in layers]) @ view.turn.T
    colours = np.concatenate([layer.colours for layer in layers])

    screen, nearness = _project(points, view, width, height)
    hits = rasterizer.rasterize(screen, nearness, faces, (width, height))
    corner = faces.T[:, hits.face]
    # Perspective: attributes over depth are affine on the screen, and so is 1/depth itself.
    weight = hits.inside * nearness.astype(np.float32)[corner]
    near = weight[0] + weight[1] + weight[2]
    weight /= near
    attribute = np.concatenate([normals, colours], 1).astype(np.float32)
    value = np.asarray(sum(weight[i, :, None] * np.take(attribute, corner[i], axis=0) for i in range(3)))
    light = shading.shade(value[:, :3], value[:, 3:], gloss[hits.face])
    edge = screen[faces]
    ab, ac = edge[:, 1] - edge[:, 0], edge[:, 2] - edge[:, 0]
    behind = (ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0]) > 0
    light[behind[hits.face]] = shading.INSIDE

    picture.reshape(-1, 3)[hits.sample] = light
    if dots is not None:
        depth = np.zeros(width * height, np.float32)
        depth[hits.sample] = near
        _stamp(picture, depth.reshape(height, width), dots, view)
    # Adding strided pictures is ten times as fast as a mean over two short axes.
    grid = [picture[i::samples, j::samples] for i in range(samples) for j in range(samples)]
    return shading.encode(np.asarray(sum(grid)) / len(grid))


def _project(points: np.ndarray, view: Camera, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Return columns and rows in samples (N, 2), and 1/depth (N,), not positive behind the camera."""
    x, y, z = ((points - view.eye) @ view.turn.T).T
    nearness = np.where(z < -1e-3, -1 / np.minimum(z, -1e-3), 0)
    scale = view.zoom * height / 2 * nearness
    return np.stack([width / 2 - 0.5 + x * scale, height / 2 - 0.5 - y * scale], -1), nearness


def _stamp(picture: np.ndarray, depth: np.ndarray, dots: np.ndarray, view: Camera) -> None:
    """Draw a disc at every landmark that is not more than 3 mm behind the visible surface."""
    height, width = depth.shape
    radius = max(2.0, height / 150)
    screen, nearness = _project(dots, view, width, height)
    for (x, y), near in zip(screen, nearness, strict=True):
        x0, y0, reach = round(x), round(y), int(radius) + 2
        if near <= 0 or not (reach <= x0 < width - reach and reach <= y0 < height - reach):
            continue
        if depth[y0, x0] > 0 and 1 / near - 1 / depth[y0, x0] > 3:
            continue
        rows, columns = np.ogrid[y0 - reach : y0 + reach + 1, x0 - reach : x0 + reach + 1]
        cover = np.clip(radius + 0.5 - np.hypot(columns - x, rows - y), 0, 1)[..., None]
        patch = picture[y0 - reach : y0 + reach + 1, x0 - reach : x0 + reach + 1]
        patch += cover * (np.array(LANDMARK_COLOUR, np.float32) - patch)


def _backdrop(colour: ArrayLike, size: tuple[int, int], samples: int) -> np.ndarray:
    """Return a vertical gradient (height, width, 3) linear float32, counted in samples."""
    height = size[1] * samples
    fall = np.linspace(1.03, 0.86, height, dtype=np.float32)[:, None, None]
    return np.broadcast_to(shading.linear(np.asarray(colour, np.float32)) * fall, (height, size[0] * samples, 3))


def _strip(loop: list[int]) -> np.ndarray:
    """Triangulate a closed loop as a strip, adding no vertex."""
    low, high, triangles = 0, len(loop) - 1, []
    while high - low > 1:
        triangles.append((loop[low], loop[low + 1], loop[high]))
        low += 1
        if high - low > 1:
            triangles.append((loop[low], loop[high - 1], loop[high]))
            high -= 1
    return np.array(triangles, np.int32).reshape(-1, 3)
