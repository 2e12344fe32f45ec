"""D3DFACS as registered with FLAME: `ROOT/SUBJECT/ACTION_UNITS/ACTION_UNITS_FRAME.ply`, 10 people, 519 recordings.

Recordings are named after FACS action units, such as `1+2`; the label of a recording is its action units.
"""

from __future__ import annotations

import os
import re
from pathlib import Path

from facejax.data.importers import folder_scan
from facejax.data.importers.base import Source, SourceError

RATE = 60.0
_UNITS = re.compile(r"[0-9a-z]+(\+[0-9a-z]+)*", re.IGNORECASE)


def scan(root: str | os.PathLike[str], *, rate: float = RATE, rest: str = "first", gaps: bool = False) -> Source:
    """List the recordings.

    Raises:
      SourceError: as `folder_scan.scan`, or a frame is not named after its recording.
    """
    found = folder_scan.scan(Path(root), layout="d3dfacs", rate=rate, rest=rest, step=1, gaps=gaps)
    for recording in found.recordings:
        for path in recording.frame_paths:
            if path.stem.rpartition("_")[0] != recording.path.name:
                raise SourceError(f"{path}: expected a name of the form {recording.path.name}_FRAME")
    labelled = tuple(recording._replace(label=_label(recording.path.name)) for recording in found.recordings)
    return found._replace(recordings=labelled)


def _label(name: str) -> str:
    """Return the action units without the number of a repetition: "1+2_02" -> "1+2"."""
    units = re.sub(r"_\d+$", "", name).lower()
    return units if _UNITS.fullmatch(units) else re.sub(r"[^0-9a-z+]+", "_", units)
