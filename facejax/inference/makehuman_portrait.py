"""A posed MakeHuman head with its own eyes, teeth and tongue, for pictures.

T frames, M vertices: skin first, then the props (`facejax.data.rig.pose`). Millimetres.
"""

from __future__ import annotations

import numpy as np

from facejax.data.synthetic import assets, contact
from facejax.viz import eyes_teeth, props, scene


def parts(posed: np.ndarray) -> tuple[scene.Part, ...]:
    """What stands beside the skin of heads (T, M, 3): eyeballs, front teeth, tongue."""
    loaded = assets.load()
    found = []
    for name, triangles in loaded.prop_faces.items():
        used, local = np.unique(triangles, return_inverse=True)
        local = local.reshape(-1, 3)
        if name.endswith("eye"):
            centres, radii = zip(*(contact.fit_sphere(frame[used].astype(np.float64)) for frame in posed), strict=True)
            centre, radius = np.array(centres) - [0, 0, 0.3], float(radii[0])
            found.append(props.eyeball(centre, radius - 0.5, iris_radius=0.4 * radius))
            continue
        if "teeth" in name:
            shown, local = eyes_teeth.front(loaded.base[used], local)
            used = used[shown]
        colour = props.TONGUE if "tongue" in name else props.TEETH
        found.append(scene.Part(posed[:, used], local, colour, 0.6))
    return tuple(found)
