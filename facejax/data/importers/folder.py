"""A user's own registered 4D meshes, read from folders (`facejax.data.tree` shows how they lie) into a store."""

from __future__ import annotations

import os
from pathlib import Path

from facejax.data import dataset
from facejax.data.importers import folder_scan, ingest
from facejax.data.importers.base import Source


def scan(root: str | os.PathLike, *, rate: float = 30.0, rest: str = "first", gaps: bool = False) -> Source:
    """Recordings of any names, their frames numbered in any even steps; see `tree.scan`."""
    return folder_scan.scan(Path(root), rate=rate, rest=rest, gaps=gaps)


def prepare(
    root: str | os.PathLike,
    out: str | os.PathLike,
    *,
    landmarks: str | os.PathLike,
    unit: str | None = None,
    rate: float = 30.0,
    max_meshes: int = ingest.MAX_MESHES,
    progress: ingest.Progress | None = None,
) -> dataset.Dataset:
    """`scan` and `ingest.prepare` in one: the meshes under `root` in a new store at `out`.

    Raises `SourceError`, and leaves nothing, where something is wrong with the meshes.
    """
    request = ingest.Request(Path(landmarks), unit, max_meshes)
    return ingest.prepare(scan(root, rate=float(rate)), out, request, progress=progress)
