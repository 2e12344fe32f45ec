"""Write an animation as one HTML file with a WebGL 2 viewer and the data inside; it needs no network.

Positions are rounded to 16 bits over the extent of the motion: for a head (250 mm) the step is 0.004 mm and the error
half of that. Differences between frames, with low and high bytes separated, deflate well, since most of a face does not
move. T frames, N vertices, F faces, L landmarks.
"""

import base64
import html
import json
import os
import string
import zlib
from collections.abc import Sequence
from importlib import resources
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from facejax.io import atomic
from facejax.viz import render, scene, shading

_ASPECT = (4, 5)


def write(
    path: str | os.PathLike[str],
    vertices: ArrayLike,
    faces: ArrayLike,
    *,
    fps: float = 30.0,
    captions: scene.Captions = (),
    title: str = "facejax",
    landmarks: ArrayLike | None = None,
    extras: Sequence[scene.PartLike] = (),
    colours: ArrayLike | None = None,
) -> None:
    """Write the page, atomically.

    Args:
      path: the `.html` file.
      vertices: (T, N, 3) mm, or (N, 3).
      faces: (F, 3).
      fps: frames per second.
      captions: ((first frame, text), ...); each is shown until the next.
      title: heading of the page; all texts are escaped.
      landmarks: (T, L, 3) positions or (L,) vertex indices, hidden until they are switched on.
      extras: further meshes, see `scene.Part`.
      colours: (N, 3) sRGB in [0, 1]; default: skin.

    Raises:
      ValueError: invalid arrays, see `scene.make`.
    """
    animation = scene.make(vertices, faces, fps=fps, captions=captions, landmarks=landmarks, extras=extras)
    folder = resources.files("facejax.viz")
    page = string.Template(folder.joinpath("viewer.html").read_text("utf-8"))
    # The script of the page is no module.
    drawing = folder.joinpath("web", "drawing.js").read_text("utf-8").partition("\nexport {")[0]
    text = page.substitute(_fields(animation, str(title), colours), drawing=drawing)
    with atomic.replace_file(path) as temporary:
        temporary.write_text(text, "utf-8")


def camera_and_light(vertices: np.ndarray) -> dict[str, Any]:
    """Return the camera that shows vertices (T, N, 3) from the front, and the light, as `drawing.js` reads them."""
    view = render.fit_camera(vertices, size=_ASPECT, margin=0.03)
    centre = (vertices.min((0, 1)) + vertices.max((0, 1))).astype(np.float64) / 2
    return {
        "target": centre.tolist(),
        "distance": float(view.eye[2] - centre[2]),
        "zoom": view.zoom,
        "aspect": _ASPECT[0] / _ASPECT[1],
        "light": [(np.array(direction) / np.linalg.norm(direction)).tolist() for direction, _ in shading.LIGHTS],
        "tint": [colour for _, colour in shading.LIGHTS],
        "sky": shading.SKY,
        "ground": shading.GROUND,
        "inside": shading.INSIDE,
    }


def _fields(animation: scene.Scene, title: str, colours: ArrayLike | None) -> dict[str, str]:
    count, face = animation.vertices.shape[:2]
    skin = np.asarray(scene.SKIN if colours is None else colours, np.float32)
    if skin.shape not in ((3,), (face, 3)):
        raise ValueError(f"colours must be ({face}, 3), got {skin.shape}")
    parts = [scene.Part(animation.vertices, animation.faces, skin, render.SKIN_GLOSS), *animation.extras]
    layers = [np.broadcast_to(part.vertices, (count, *part.vertices.shape[-2:])) for part in parts]
    surface = [np.column_stack([scene.colours(p), np.full(p.vertices.shape[-2], p.gloss)]) for p in parts]
    offsets = np.cumsum([0] + [layer.shape[1] for layer in layers])
    triangles = [part.faces + offset for part, offset in zip(parts, offsets, strict=False)]
    shown = np.concatenate([*triangles, render.close_largest_hole(animation.vertices[0], animation.faces)])
    marks = 0
    if animation.landmarks is not None:
        marks = animation.landmarks.shape[1]
        layers.append(animation.landmarks)
        surface.append(np.zeros((marks, 4)))
    points = np.concatenate(layers, 1)
    packed, origin, step = _quantise(points)
    meta = {
        "frames": count,
        "points": points.shape[1],
        "face": face,
        "faces": sum(len(part) for part in triangles),
        "landmarks": marks,
        "fps": animation.fps,
        "captions": animation.captions,
        "origin": origin.tolist(),
        "step": step,
        **camera_and_light(animation.vertices),
    }
    return {
        "title": html.escape(title),
        # In a script element only "<" could end the element or open a comment.
        "meta": json.dumps(meta).replace("<", "\\u003c"),
        "positions": packed,
        "triangles": _pack(shown.astype("<u4").tobytes()),
        "surface": _pack(np.round(np.clip(np.concatenate(surface), 0, 1) * 255).astype(np.uint8).tobytes()),
    }


def _quantise(points: np.ndarray) -> tuple[str, np.ndarray, float]:
    """Return packed positions (T, P, 3), origin and step: origin + step * integer, stored as frame differences."""
    low, high = points.min((0, 1)).astype(np.float64), points.max((0, 1)).astype(np.float64)
    origin, step = (low + high) / 2, max(float((high - low).max()), 1e-6) / 65534
    integers = np.round((points - origin) / step).astype("<i2")
    integers[1:] = np.diff(integers, axis=0)
    return (
        _pack(np.ascontiguousarray(integers.reshape(-1).view(np.uint8).reshape(-1, 2).T).tobytes()),
        origin,
        step,
    )


def _pack(data: bytes) -> str:
    return base64.b64encode(zlib.compress(data, 9)).decode()
