"""Florence 4D (Principi et al. 2023): `ROOT/IDENTITY/EXPRESSION/EXPRESSION_FRAME.ply`, binary PLY in double precision.

Recordings of 60 frames go from neutral to the apex at frame 30 and back.
"""

from __future__ import annotations

import os
from pathlib import Path

from facejax.data.importers import folder_scan
from facejax.data.importers.base import Source

RATE = 30.0
FRAMES, APEX = 60, 30


def scan(root: str | os.PathLike, *, rate: float = RATE, rest: str = "first", gaps: bool = False) -> Source:
    """The recordings of the people. Raises `SourceError`: see `tree.scan`.

    The paper leaves out 30 women and 10 men: a table of people says who is which (`sex`).
    """
    found = folder_scan.scan(Path(root), layout="florence4d", rate=rate, rest=rest, step=1, gaps=gaps)
    takes = [take._replace(cuts=(0, APEX, APEX, FRAMES - 1)) if take.count == FRAMES else take for take in found.takes]
    odd = [take.name for take in takes if take.cuts is None]
    said = [f"{len(odd)} recordings have not {FRAMES} frames, their apex was looked for: {', '.join(odd[:3])}"]
    return found._replace(takes=tuple(takes), notes=(*found.notes, *said * bool(odd)))
