"""One HTML file to look at an animation: our own small WebGL 2 viewer with the data inside, no network.

Positions are rounded to 16 bits over the extent of the motion: for a head (250 mm) the step is 0.004 mm and
the error half of that. Differences from frame to frame, low and high bytes apart, deflate well, since most
of a face stands still.
"""

import base64
import html
import json
import os
import string
import zlib
from importlib import resources

import numpy as np

from facejax.io import atomic
from facejax.viz import props, render, scene, shading

_ASPECT = (4, 5)


def write(
    path: str | os.PathLike,
    vertices,
    faces,
    *,
    fps=30.0,
    captions=(),
    title="facejax",
    landmarks=None,
    extras=(),
    colours=None,
) -> None:
    """Writes the page, atomically.

    Args:
      path: the `.html` file.
      vertices: (T, N, 3) mm, or (N, 3).
      faces: (F, 3).
      fps: frames per second.
      captions: ((first frame, text), ...); each holds until the next.
      title: heading of the page; all texts are escaped.
      landmarks: (T, L, 3) positions or (L,) vertex indices, shown on demand.
      extras: parts beside the face, see `scene.Part`.
      colours: (N, 3) sRGB in [0, 1]; skin without.

    Raises:
      ValueError: the scene is out of order.
    """
    film = scene.make(vertices, faces, fps=fps, captions=captions, landmarks=landmarks, extras=extras)
    page = string.Template(resources.files("facejax.viz").joinpath("viewer.html").read_text("utf-8"))
    text = page.substitute(_fields(film, str(title), colours))
    with atomic.replace_file(path) as temporary:
        temporary.write_text(text, "utf-8")


def _fields(film: scene.Scene, title: str, colours) -> dict[str, str]:
    count, face = film.vertices.shape[:2]
    skin = np.asarray(scene.SKIN if colours is None else colours, np.float32)
    if skin.shape not in ((3,), (face, 3)):
        raise ValueError(f"colours must be ({face}, 3), got {skin.shape}")
    parts = [scene.Part(film.vertices, film.faces, skin, render.SKIN_GLOSS), *film.extras]
    layers = [np.broadcast_to(part.vertices, (count, *part.vertices.shape[-2:])) for part in parts]
    surface = [np.column_stack([scene.colours(p), np.full(p.vertices.shape[-2], p.gloss)]) for p in parts]
    offsets = np.cumsum([0] + [layer.shape[1] for layer in layers])
    triangles = [part.faces + offset for part, offset in zip(parts, offsets, strict=False)]
    shown = np.concatenate([*triangles, props.close_largest_hole(film.vertices[0], film.faces)])
    marks = 0
    if film.landmarks is not None:
        marks = film.landmarks.shape[1]
        layers.append(film.landmarks)
        surface.append(np.zeros((marks, 4)))
    points = np.concatenate(layers, 1)
    packed, origin, step = _quantise(points)
    view = render.fit_camera(film.vertices, size=_ASPECT, margin=0.03)
    centre = (film.vertices.min((0, 1)) + film.vertices.max((0, 1))).astype(np.float64) / 2
    meta = {
        "frames": count,
        "points": points.shape[1],
        "face": face,
        "faces": sum(len(part) for part in triangles),
        "landmarks": marks,
        "fps": film.fps,
        "captions": film.captions,
        "origin": origin.tolist(),
        "step": step,
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
    return {
        "title": html.escape(title),
        # Inside a script element only "<" could end it or open a comment.
        "meta": json.dumps(meta).replace("<", "\\u003c"),
        "positions": packed,
        "triangles": _pack(shown.astype("<u4").tobytes()),
        "surface": _pack(np.round(np.clip(np.concatenate(surface), 0, 1) * 255).astype(np.uint8).tobytes()),
    }


def _quantise(points: np.ndarray) -> tuple[str, np.ndarray, float]:
    """Packed (T, P, 3) positions: origin + step * integer, the integers being sums over the frames."""
    low, high = points.min((0, 1)).astype(np.float64), points.max((0, 1)).astype(np.float64)
    origin, step = (low + high) / 2, max(float((high - low).max()), 1e-6) / 65534
    whole = np.round((points - origin) / step).astype("<i2")
    whole[1:] = np.diff(whole, axis=0)
    return (
        _pack(np.ascontiguousarray(whole.reshape(-1).view(np.uint8).reshape(-1, 2).T).tobytes()),
        origin,
        step,
    )


def _pack(data: bytes) -> str:
    return base64.b64encode(zlib.compress(data, 9)).decode()
