"""Eyes, teeth and tongue of posed MakeHuman heads, for rendering.

T frames, M vertices: skin first, then eyes, teeth and tongue (`data.synthetic.rig.pose`). Millimetres.
"""

from __future__ import annotations

import numpy as np

from facejax.data.synthetic import assets, contact
from facejax.viz import eyes_teeth, scene


def parts(posed: np.ndarray) -> tuple[scene.Part, ...]:
    """Return the parts beside the skin of heads (T, M, 3): eyeballs, front teeth, tongue."""
    loaded = assets.load()
    found = []
    for name, triangles in loaded.prop_faces.items():
        used, local = np.unique(triangles, return_inverse=True)
        local = local.reshape(-1, 3)
        if name.endswith("eye"):
            centres, radii = zip(*(contact.fit_sphere(frame[used].astype(np.float64)) for frame in posed), strict=True)
            centre, radius = np.array(centres) - [0, 0, 0.3], float(radii[0])
            found.append(eyes_teeth.eyeball(centre, radius - 0.5, iris_radius=0.4 * radius))
            continue
        if "teeth" in name:
            shown, local = eyes_teeth.front_teeth(loaded.base[used], local)
            used = used[shown]
        colour = eyes_teeth.TONGUE_COLOUR if "tongue" in name else eyes_teeth.TEETH_COLOUR
        found.append(scene.Part(posed[:, used], local, colour, 0.6))
    return tuple(found)
