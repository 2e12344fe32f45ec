"""What a bare face lacks to look alive: eyeballs, and a closed neck.

Millimetres, y up, z out of the face.
"""

import numpy as np

from facejax.mesh import graph
from facejax.viz import scene

TEETH, TONGUE = (0.80, 0.77, 0.71), (0.58, 0.30, 0.29)


def eyeball(
    centre, radius: float, *, gaze=(0.0, 0.0, 1.0), iris=(0.30, 0.42, 0.46), iris_radius=5.9, sectors=32
) -> scene.Part:
    """An eye: white, iris with a dark rim, pupil.

    Args:
      centre: (3,), or (T, 3) where the head moves; mm.
      radius: mm.
      gaze: direction looked in.
      iris: sRGB in [0, 1].
      iris_radius: mm, at most 0.8 of the radius; the pupil is a third of it.
      sectors: vertices on each ring.
    """
    if not 0 < iris_radius <= 0.8 * radius:
        raise ValueError(f"iris_radius must lie in (0, 0.8 * radius = {0.8 * radius:g}], got {iris_radius}")
    white, iris, pupil = (0.90, 0.88, 0.86), np.asarray(iris), (0.02, 0.02, 0.02)
    edge, hole = np.degrees(np.arcsin([iris_radius / radius, iris_radius / 3 / radius]))
    # Degrees from the gaze, and the colour there. Where it jumps, two rings coincide: a sharp edge.
    rings = [(0.5, pupil), (hole, pupil), (hole, iris * 0.8), ((hole + edge) / 2, iris)]
    rings += [(0.93 * edge, iris * 0.45), (edge, iris * 0.45), (edge, white)]
    rings += [(angle, white) for angle in np.linspace(edge, 179.5, 12)[1:]]
    polar = np.radians([angle for angle, _ in rings])[:, None]
    around = np.linspace(0, 2 * np.pi, sectors, endpoint=False)[None]
    z = np.asarray(gaze, np.float64) / np.linalg.norm(gaze)
    x = np.cross((0.0, 1.0, 0.0), z) if abs(z[1]) < 0.99 else np.array((1.0, 0.0, 0.0))
    x /= np.linalg.norm(x)
    frame = np.stack([x, np.cross(z, x), z])
    ball = np.stack(
        np.broadcast_arrays(np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar)), -1
    )
    a = (np.arange(len(rings) - 1)[:, None] * sectors + np.arange(sectors)).ravel()
    b = (np.arange(len(rings) - 1)[:, None] * sectors + (np.arange(sectors) + 1) % sectors).ravel()
    faces = np.concatenate([np.stack([a, a + sectors, b + sectors], -1), np.stack([a, b + sectors, b], -1)])
    vertices = np.asarray(centre)[..., None, :] + radius * ball.reshape(-1, 3) @ frame
    colour = np.repeat([colour for _, colour in rings], sectors, axis=0)
    return scene.Part(vertices.astype(np.float32), faces.astype(np.int32), colour.astype(np.float32), 1.0)


def close_largest_hole(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Triangles (K, 3) that close the widest of several holes, so that no light shows through a mouth.

    The widest hole of a head is its neck. A mesh with fewer than two holes (a mask) is left open: no
    triangles. vertices: (N, 3). Vertices are those of the mesh; none is added.
    """
    loops = [loop[::-1].tolist() for loop in graph.boundary_loops(faces)]
    if len(loops) < 2:
        return np.zeros((0, 3), np.int32)
    length = [np.linalg.norm(np.diff(vertices[loop + loop[:1]], axis=0), axis=1).sum() for loop in loops]
    return _strip(loops[int(np.argmax(length))])


def _strip(loop: list[int]) -> np.ndarray:
    """Zips a closed loop shut from one end to the other, adding no vertex."""
    low, high, triangles = 0, len(loop) - 1, []
    while high - low > 1:
        triangles.append((loop[low], loop[low + 1], loop[high]))
        low += 1
        if high - low > 1:
            triangles.append((loop[low], loop[high - 1], loop[high]))
            high -= 1
    return np.array(triangles, np.int32).reshape(-1, 3)
