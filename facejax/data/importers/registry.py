"""All importers by the name of their layout, and tables that override labels, people and phases."""

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
    """Import recordings into a new dataset at `out`; called again after an interruption, it resumes.

    Args:
      layout: one of `SCANS`.
      root: the folder of the recordings.
      out: the folder of the dataset; it must not exist.
      landmarks, unit, max_meshes, workers, progress: see `ingest.prepare`.
      labels, people, phases: tables; see `with_labels`, `with_people` and `read_phases`.
      remove_head_motion: remove the rigid motion of the head.
      options: of the layout; those that are None keep their defaults.

    Raises:
      SourceError: the recordings or the request cannot be used; nothing is left at `out`.
    """
    source = scan(layout, root, **options)
    if labels is not None:
        source = with_labels(source, labels)
    if people is not None:
        source = with_people(source, people)
    known = {} if phases is None else read_phases(source, phases)
    request = ingest.Request(landmarks, unit, max_meshes, remove_head_motion, known)
    return ingest.prepare(source, out, request, workers=workers, progress=progress)


def scan(layout: str, root: Path, **options: Any) -> Source:
    """List the recordings of a layout; options that are None keep their defaults.

    Raises:
      SourceError: the layout is unknown, does not support an option, or requires one that is not given.
    """
    if layout not in SCANS:
        raise SourceError(f"unknown layout {layout!r}, expected one of {', '.join(SCANS)}")
    given = {name: value for name, value in options.items() if value is not None and value is not False}
    known = inspect.signature(SCANS[layout]).parameters
    if unsupported := [name for name in given if name not in known]:
        raise SourceError(f"--{unsupported[0]} is not supported by the {layout} importer")
    required = [name for name, option in known.items() if option.default is option.empty and name != "root"]
    if missing := [name for name in required if name not in given]:
        raise SourceError(f"--{missing[0]} is required by the {layout} importer")
    return SCANS[layout](root, **given)


def with_labels(source: Source, path: Path) -> Source:
    """Replace labels by those of a table of subject, recording and label. Raises `SourceError`, naming the line."""
    rows = tables.read(path, ("subject", "recording", "label"), ())
    recordings = list(source.recordings)
    matched = apex_detection.match_rows(rows, source.recordings, [person.name for person in source.people])
    for number, row in matched.items():
        if ">" in (label := row.values["label"].lower()):
            raise SourceError(f"{row.location}: a label must not contain '>'")
        recordings[number] = recordings[number]._replace(label=label)
    return source._replace(recordings=tuple(recordings))


def with_people(source: Source, path: Path) -> Source:
    """Add attributes of people from a table of subject and any other columns; `split` assigns people to splits.

    Raises:
      SourceError: naming the line; a subject is unknown, or `split` or `sex` has an unknown value.
    """
    attributes = {person.name: dict(person.attributes) for person in source.people}
    for row in tables.read(path, ("subject",)):
        values = dict(row.values)
        if (name := values.pop("subject")) not in attributes:
            raise SourceError(f"{row.location}: unknown subject {name!r}")
        if values.get("split", dataset.SPLITS[0]) not in dataset.SPLITS:
            raise SourceError(f"{row.location}: split: expected {', '.join(dataset.SPLITS)}, got {values['split']!r}")
        if values.get("sex", SEXES[0]) not in SEXES:
            raise SourceError(f"{row.location}: sex: expected {' or '.join(SEXES)}, got {values['sex']!r}")
        attributes[name] |= {key: value for key, value in values.items() if key != "name"}
    return source._replace(people=tuple(Person(person.name, attributes[person.name]) for person in source.people))


def read_phases(source: Source, path: Path) -> dict[int, apex_detection.Phases]:
    """Return phases by recording number, from a table of subject, recording and the fields of `Phases`."""
    rows = tables.read(path, ("subject", "recording", *apex_detection.Phases._fields), ())
    return apex_detection.phases_from_table(rows, source.recordings, [person.name for person in source.people])
