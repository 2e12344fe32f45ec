"""Still pictures of a face on any machine: no GL, no display, numpy only.

Smooth shading (interpolated normals), one perspective camera for a whole motion, several samples per pixel.
Back faces (the inside of a head, seen through its mouth) are dark. A head of 6,388 triangles takes about 45
ms at 256 x 320 pixels on one core.
"""

from typing import NamedTuple

import numpy as np

from facejax.viz import props, rasterizer, scene, shading
from facejax.viz.contact_sheet import caption, contact_sheet, save

__all__ = ["Camera", "caption", "contact_sheet", "fit_camera", "frames", "heat_colours", "image", "save"]

SKIN_GLOSS = 0.30
LANDMARK = (0.02, 0.55, 0.80)


class Camera(NamedTuple):
    """A perspective camera.

    turn: (3, 3) rows are the camera's right, up and backward axes.
    eye: (3,) position, mm.
    zoom: focal length divided by half of the picture's height.
    """

    turn: np.ndarray
    eye: np.ndarray
    zoom: float


def fit_camera(vertices, *, size=(256, 320), turn=0.0, tilt=0.0, field=20.0, margin=0.05) -> Camera:
    """A camera that holds every given vertex, in all frames, in the picture.

    Args:
      vertices: (..., 3) all that must be seen; mm.
      size: (width, height).
      turn: degrees to the subject's left (the viewer's right).
      tilt: degrees from above.
      field: vertical angle of view in degrees.
      margin: free part of the picture at each edge.
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
    # |x| zoom / (distance - z) <= reach for every point: the farthest demand decides.
    reach = np.array([size[0] / size[1], 1.0]) * (1 - 2 * margin)
    distance = (np.abs(view[:, :2] - middle[:2]) * zoom / reach + view[:, 2:]).max()
    return Camera(axes, axes.T @ np.array([middle[0], middle[1], distance]), float(zoom))


def frames(
    vertices,
    faces,
    *,
    size=(256, 320),
    camera=None,
    colours=None,
    landmarks=None,
    extras=(),
    background=(0.93, 0.94, 0.96),
    samples=2,
) -> np.ndarray:
    """Draws every frame from one fixed camera.

    Args:
      vertices: (T, N, 3) mm.
      faces: (F, 3).
      size: (width, height) in pixels.
      camera: a `Camera`; without one the whole motion is framed from the front.
      colours: (N, 3) or (T, N, 3) sRGB in [0, 1], for heat maps; skin without.
      landmarks: (T, L, 3) positions or (L,) vertex indices, drawn as dots where visible.
      extras: parts beside the face, see `scene.Part`.
      background: sRGB.
      samples: samples per pixel along each axis.

    Returns:
      (T, height, width, 3) uint8.
    """
    film = scene.make(vertices, faces, landmarks=landmarks, extras=extras)
    view = fit_camera(film.vertices, size=size) if camera is None else camera
    count, points = film.vertices.shape[:2]
    tint = np.asarray(scene.SKIN if colours is None else colours, np.float32)
    if tint.shape not in ((3,), (points, 3), (count, points, 3)):
        raise ValueError(f"colours must be ({points}, 3) or ({count}, {points}, 3), got {tint.shape}")
    tint = np.broadcast_to(shading.linear(tint), (count, points, 3))
    neighbours = shading.neighbours(film.faces, points)
    # The stopper is drawn but gives no normal: the rim of the neck keeps its own light.
    solid = np.concatenate([film.faces, props.close_largest_hole(film.vertices[0], film.faces)])
    backdrop = _backdrop(background, size, samples)
    pictures = np.empty((count, size[1], size[0], 3), np.uint8)
    for t, surface in enumerate(film.vertices):
        normals = scene.normals(surface, film.faces)
        cavity = shading.cavity(surface, normals, neighbours)
        layers = [_Layer(surface, normals, tint[t] * cavity[:, None], solid, SKIN_GLOSS)]
        layers += [_layer(part, t) for part in film.extras]
        dots = None if film.landmarks is None else film.landmarks[t]
        pictures[t] = _draw(layers, dots, view, backdrop.copy(), samples)
    return pictures


def image(vertices, faces, *, landmarks=None, **options) -> np.ndarray:
    """One picture, (height, width, 3) uint8, of vertices (N, 3); options as of `frames`."""
    return frames(np.asarray(vertices)[None], faces, landmarks=landmarks, **options)[0]


def heat_colours(values, *, low=0.0, high=None) -> np.ndarray:
    """Colours (..., 3) of values (...): pale, yellow, orange, dark red; high is the maximum if not given."""
    values = np.asarray(values, np.float64)
    high = float(values.max()) if high is None else high
    at = np.clip((values - low) / max(high - low, 1e-12), 0, 1)
    stops = np.array(
        [[0.90, 0.90, 0.92], [1.00, 0.86, 0.50], [0.96, 0.52, 0.23], [0.76, 0.13, 0.20], [0.35, 0.03, 0.16]]
    )
    grid = np.linspace(0, 1, len(stops))
    return np.stack([np.interp(at, grid, stops[:, c]) for c in range(3)], -1)


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


def _draw(layers: list[_Layer], dots, view: Camera, picture: np.ndarray, samples: int) -> np.ndarray:
    """Draws layers over a linear backdrop (height, width, 3) counted in samples; gives sRGB pixels."""
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
    value = sum(weight[i, :, None] * np.take(attribute, corner[i], axis=0) for i in range(3))
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
    return shading.encode(sum(grid) / len(grid))


def _project(points: np.ndarray, view: Camera, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Columns and rows in samples, (N, 2), and 1/depth, (N,), not positive behind the camera."""
    x, y, z = ((points - view.eye) @ view.turn.T).T
    nearness = np.where(z < -1e-3, -1 / np.minimum(z, -1e-3), 0)
    scale = view.zoom * height / 2 * nearness
    return np.stack([width / 2 - 0.5 + x * scale, height / 2 - 0.5 - y * scale], -1), nearness


def _stamp(picture: np.ndarray, depth: np.ndarray, dots: np.ndarray, view: Camera) -> None:
    """Draws a disc at every landmark that is not more than 3 mm behind the surface seen there."""
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
        patch += cover * (np.array(LANDMARK, np.float32) - patch)


def _backdrop(colour, size, samples: int) -> np.ndarray:
    """A soft vertical fall-off, (height, width, 3) linear float32, counted in samples."""
    height = size[1] * samples
    fall = np.linspace(1.03, 0.86, height, dtype=np.float32)[:, None, None]
    return np.broadcast_to(shading.linear(np.asarray(colour, np.float32)) * fall, (height, size[0] * samples, 3))
