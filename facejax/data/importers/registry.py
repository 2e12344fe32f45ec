"""Every dataset that can be prepared, by the name of its layout, and the tables that a user may put beside it."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Any

from facejax.data import dataset
from facejax.data.importers import (
    apex_detection,
    bu3dfe,
    bu4dfe,
    coma,
    d3dfacs,
    florence4d,
    folder,
    ingest,
    livelink_people,
    tables,
    vocaset,
)
from facejax.data.importers.base import Person, Source, SourceError

SEXES = ("female", "male")  # Florence 4D is split by them
SCANS: dict[str, Callable[..., Source]] = {
    "folder": folder.scan,
    "coma": coma.scan,
    "d3dfacs": d3dfacs.scan,
    "florence4d": florence4d.scan,
    "vocaset": vocaset.scan,
    "bu3dfe": bu3dfe.scan,
    "bu4dfe": bu4dfe.scan,
    "livelink": livelink_people.scan,
}


def prepare(
    layout: str,
    root: Path,
    out: Path,
    *,
    landmarks: Path | None = None,
    unit: str | None = None,
    labels: Path | None = None,
    people: Path | None = None,
    phases: Path | None = None,
    remove_head_motion: bool = False,
    max_meshes: int = ingest.MAX_MESHES,
    workers: int | None = None,
    progress: ingest.Progress | None = None,
    **options: Any,
) -> dataset.Dataset:
    """Read a user's recordings into a new store at `out`; called again after an interruption, it goes on.

    Args:
      layout: one of `SCANS`.
      root: the folder of the recordings.
      out: of the store; it must not be there yet.
      landmarks, unit, most, workers, progress: see `ingest.prepare`.
      labels, people, cuts: tables; see `with_labels`, `with_people` and `read_phases`.
      hold: take the head's rigid motion out.
      options: the layout's own; those that are None are left to it.

    Raises:
      SourceError: something is wrong with the recordings or the request; nothing is left then.
    """
    found = scan(layout, root, **options)
    if labels is not None:
        found = with_labels(found, labels)
    if people is not None:
        found = with_people(found, people)
    named = {} if phases is None else read_phases(found, phases)
    request = ingest.Request(landmarks, unit, max_meshes, remove_head_motion, named)
    return ingest.prepare(found, out, request, workers=workers, progress=progress)


def scan(layout: str, root: Path, **options: Any) -> Source:
    """The recordings of a layout; options that are None are left to it.

    Raises `SourceError` for an unknown layout, for an option that it has not, and for one that it needs.
    """
    if layout not in SCANS:
        raise SourceError(f"unknown layout {layout!r}, expected one of {', '.join(SCANS)}")
    given = {name: value for name, value in options.items() if value is not None and value is not False}
    known = inspect.signature(SCANS[layout]).parameters
    if foreign := [name for name in given if name not in known]:
        raise SourceError(f"{layout}: has no --{foreign[0]}")
    needed = [name for name, option in known.items() if option.default is option.empty and name != "root"]
    if lacking := [name for name in needed if name not in given]:
        raise SourceError(f"{layout}: needs --{lacking[0]}")
    return SCANS[layout](root, **given)


def with_labels(found: Source, path: Path) -> Source:
    """Other labels, from a table of subject, recording and label. Raises `SourceError`, naming the line."""
    rows = tables.read(path, ("subject", "recording", "label"), ())
    at = apex_detection.match_rows(rows, found.takes, [who.name for who in found.people])
    takes = list(found.takes)
    for number, row in at.items():
        if ">" in (label := row.values["label"].lower()):
            raise SourceError(f"{row.where}: a label cannot hold '>'")
        takes[number] = takes[number]._replace(label=label)
    return found._replace(takes=tuple(takes))


def with_people(found: Source, path: Path) -> Source:
    """What a table says of people: subject and any other columns, of which `split` says where each serves.

    Raises `SourceError`, naming the line: nobody is called so, or a split is unknown.
    """
    about = {who.name: dict(who.about) for who in found.people}
    for row in tables.read(path, ("subject",)):
        values = dict(row.values)
        if (name := values.pop("subject")) not in about:
            raise SourceError(f"{row.where}: nobody is called {name!r}")
        if values.get("split", dataset.SPLITS[0]) not in dataset.SPLITS:
            raise SourceError(f"{row.where}: split: expected {', '.join(dataset.SPLITS)}, got {values['split']!r}")
        if values.get("sex", SEXES[0]) not in SEXES:
            raise SourceError(f"{row.where}: sex: expected {' or '.join(SEXES)}, got {values['sex']!r}")
        about[name] |= {key: value for key, value in values.items() if key != "name"}
    return found._replace(people=tuple(Person(who.name, about[who.name]) for who in found.people))


def read_phases(found: Source, path: Path) -> dict[int, apex_detection.Phases]:
    """The cuts of recordings, by number, from a table of subject, recording and `cuts.Cuts`' fields."""
    rows = tables.read(path, ("subject", "recording", *apex_detection.Phases._fields), ())
    return apex_detection.phases_from_table(rows, found.takes, [who.name for who in found.people])
