"""D3DFACS as registered with FLAME: `ROOT/SUBJECT/ACTION_UNITS/ACTION_UNITS_FRAME.ply`, 10 people, 519 recordings.

Names are FACS action units such as `1+2`; a recording's label is its action units.
"""

from __future__ import annotations

import os
import re
from pathlib import Path

from facejax.data.importers import folder_scan
from facejax.data.importers.base import Source, SourceError

RATE = 60.0
_UNITS = re.compile(r"[0-9a-z]+(\+[0-9a-z]+)*", re.IGNORECASE)


def scan(root: str | os.PathLike, *, rate: float = RATE, rest: str = "first", gaps: bool = False) -> Source:
    """The recordings of the people. Raises `SourceError`: see `tree.scan`; or frames are of another recording."""
    found = folder_scan.scan(Path(root), layout="d3dfacs", rate=rate, rest=rest, step=1, gaps=gaps)
    for take in found.takes:
        for frame in take.frames:
            if frame.stem.rpartition("_")[0] != take.path.name:
                raise SourceError(f"{frame}: expected {take.path.name}_FRAME")
    return found._replace(takes=tuple(take._replace(label=_label(take.path.name)) for take in found.takes))


def _label(name: str) -> str:
    """The action units, without the number of a repetition: "1+2_02" and "1+2" are alike."""
    units = re.sub(r"_\d+$", "", name).lower()
    return units if _UNITS.fullmatch(units) else re.sub(r"[^0-9a-z+]+", "_", units)
