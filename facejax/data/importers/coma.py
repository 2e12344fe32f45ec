"""CoMA (Ranjan et al. 2018): `ROOT/FaceTalk_*_TA/EXPRESSION/EXPRESSION.000001.ply`, 12 people x 12 expressions.

Meshes have FLAME's 5,023 vertices, in metres, at 60 frames per second. The download contains no landmarks; FLAME's
landmark embedding defines them.
"""

from __future__ import annotations

import os
from pathlib import Path

from facejax.data.importers import folder_scan
from facejax.data.importers.base import Source, SourceError

RATE = 60.0


def scan(root: str | os.PathLike[str], *, rate: float = RATE, rest: str = "first", gaps: bool = False) -> Source:
    """List the recordings.

    Raises:
      SourceError: as `folder_scan.scan`, or a subject's folder is not called FaceTalk_*.
    """
    found = folder_scan.scan(Path(root), layout="coma", rate=rate, rest=rest, step=1, gaps=gaps)
    if other := [person.name for person in found.people if not person.name.startswith("FaceTalk_")]:
        raise SourceError(
            f"{Path(root) / other[0]}: expected folders called FaceTalk_*_TA; use the folder importer for other meshes"
        )
    return found
