"""CoMA (Ranjan et al. 2018): `ROOT/FaceTalk_*_TA/EXPRESSION/EXPRESSION.000001.ply`, 12 people x 12 expressions.

In metres, FLAME's 5,023 vertices, at 60 frames a second; the download has no landmarks (FLAME's embedding has them).
"""

from __future__ import annotations

import os
from pathlib import Path

from facejax.data.importers import folder_scan
from facejax.data.importers.base import Source, SourceError

RATE = 60.0


def scan(root: str | os.PathLike, *, rate: float = RATE, rest: str = "first", gaps: bool = False) -> Source:
    """The recordings of the people. Raises `SourceError`: see `tree.scan`; or nobody is called FaceTalk_*."""
    found = folder_scan.scan(Path(root), layout="coma", rate=rate, rest=rest, step=1, gaps=gaps)
    if other := [who.name for who in found.people if not who.name.startswith("FaceTalk_")]:
        raise SourceError(
            f"{Path(root) / other[0]}: expected people called FaceTalk_*_TA; of your own meshes: `folder`"
        )
    return found
