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


def scan(root: str | os.PathLike[str], *, rate: float = RATE, rest: str = "first", gaps: bool = False) -> Source:
    """List the recordings. Raises `SourceError` as `folder_scan.scan`.

    The paper holds out 30 women and 10 men; a table of people provides the column `sex`.
    """
    found = folder_scan.scan(Path(root), layout="florence4d", rate=rate, rest=rest, step=1, gaps=gaps)
    phases = (0, APEX, APEX, FRAMES - 1)
    recordings = [one._replace(phases=phases) if one.num_frames == FRAMES else one for one in found.recordings]
    odd = [one.name for one in recordings if one.phases is None]
    notes = (f"{len(odd)} recordings do not have {FRAMES} frames, their apex was detected: {', '.join(odd[:3])}",)
    return found._replace(recordings=tuple(recordings), notes=found.notes + (notes if odd else ()))
