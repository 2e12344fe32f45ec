"""A user's own registered 4D meshes in folders; `facejax.data.importers.folder_scan` documents the layout."""

from __future__ import annotations

import os
from pathlib import Path

from facejax.data import dataset
from facejax.data.importers import folder_scan, ingest
from facejax.data.importers.base import Source


def scan(root: str | os.PathLike[str], *, rate: float = 30.0, rest: str = "first", gaps: bool = False) -> Source:
    """List recordings of any names, with frame numbers in any regular steps; see `folder_scan.scan`."""
    return folder_scan.scan(Path(root), rate=rate, rest=rest, gaps=gaps)


def prepare(
    root: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    landmarks: str | os.PathLike[str],
    unit: str | None = None,
    rate: float = 30.0,
    max_meshes: int = ingest.MAX_MESHES,
    progress: ingest.Progress | None = None,
) -> dataset.Dataset:
    """Import the meshes under `root` into a new dataset at `out`: `scan`, then `ingest.prepare`.

    Raises:
      SourceError: the meshes cannot be used; nothing is left at `out`.
    """
    request = ingest.Request(Path(landmarks), unit, max_meshes)
    return ingest.prepare(scan(root, rate=float(rate)), out, request, progress=progress)
