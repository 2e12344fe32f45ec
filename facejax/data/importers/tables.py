"""CSV tables that a user writes beside a dataset: labels, phases, attributes of people.

The first row names the columns. Blank rows, and rows that begin with #, are skipped.
"""

from __future__ import annotations

import csv
import os
from collections.abc import Collection
from pathlib import Path
from typing import NamedTuple

from facejax.data.importers.base import SourceError

MAX_BYTES = 2**24


class Row(NamedTuple):
    """A row of a table, and its file and line for messages."""

    location: str
    values: dict[str, str]

    def integer(self, name: str) -> int:
        """Return the value of a column as an integer. Raises `SourceError`."""
        try:
            return int(self.values[name])
        except ValueError:
            raise SourceError(f"{self.location}: {name}: expected an integer, got {self.values[name]!r}") from None


def read(path: str | os.PathLike[str], required: Collection[str], optional: Collection[str] | None = None) -> list[Row]:
    """Read the rows of a table.

    Args:
      path: a CSV file.
      required: columns that must exist and be filled.
      optional: further columns that may exist; None allows any.

    Raises:
      SourceError: the file cannot be read, a column is missing or unknown, or a field is empty; names the line.
    """
    path = Path(path)
    try:
        if path.stat().st_size > MAX_BYTES:
            raise SourceError(f"{path}: more than {MAX_BYTES} bytes")
        text = path.read_text("utf-8-sig")
    except OSError as error:
        raise SourceError(f"{path}: cannot be read: {error.strerror or error}") from error
    except UnicodeDecodeError:
        raise SourceError(f"{path}: not UTF-8 text") from None
    lines = [line for line in enumerate(text.splitlines(), 1) if line[1].strip() and not line[1].startswith("#")]
    try:
        table = list(csv.reader((line for _, line in lines), strict=True))
    except csv.Error as error:
        raise SourceError(f"{path}: {error}") from error
    if len(table) < 2 or len(table) != len(lines):
        raise SourceError(
            f"{path}: expected a row of column names and one or more rows of values, got {len(table)} rows"
        )
    names = [name.strip().lower() for name in table[0]]
    missing = [name for name in required if name not in names]
    unknown = [] if optional is None else [name for name in names if name not in {*required, *optional}]
    if missing or unknown or len(set(names)) < len(names):
        raise SourceError(f"{path}: line {lines[0][0]}: expected columns {', '.join(required)}, got {', '.join(names)}")
    rows = []
    for (number, _), values in zip(lines[1:], table[1:], strict=True):
        location = f"{path}: line {number}"
        if len(values) != len(names):
            raise SourceError(f"{location}: {len(values)} fields, expected {len(names)}")
        row = Row(location, {name: value.strip() for name, value in zip(names, values, strict=True)})
        if empty := [name for name in required if not row.values[name]]:
            raise SourceError(f"{location}: column {empty[0]} is empty")
        rows.append(row)
    return rows
