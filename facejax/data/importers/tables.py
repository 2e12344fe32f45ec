"""CSV files that a user writes beside a dataset: labels, cuts, what is known of people.

The first row names the columns. Blank rows, and rows that begin with #, are passed over.
"""

from __future__ import annotations

import csv
import os
from collections.abc import Collection
from pathlib import Path
from typing import NamedTuple

from facejax.data.importers.base import SourceError

MAX_BYTES = 2**24  # bytes


class Row(NamedTuple):
    """A row, and where it stands."""

    where: str
    values: dict[str, str]

    def whole(self, name: str) -> int:
        """A column's whole number. Raises `SourceError`."""
        try:
            return int(self.values[name])
        except ValueError:
            raise SourceError(f"{self.where}: {name}: expected a whole number, got {self.values[name]!r}") from None


def read(path: str | os.PathLike, needed: Collection[str], allowed: Collection[str] | None = None) -> list[Row]:
    """The rows of a table. Raises `SourceError`, naming the line: a column is missing or unknown, a field is empty.

    `allowed`: further columns; None allows any.
    """
    path = Path(path)
    try:
        if path.stat().st_size > MAX_BYTES:
            raise SourceError(f"{path}: more than {MAX_BYTES} bytes")
        text = path.read_text("utf-8-sig")
    except OSError as error:
        raise SourceError(f"{path}: cannot be read: {error.strerror or error}") from error
    except UnicodeDecodeError:
        raise SourceError(f"{path}: is not UTF-8 text") from None
    lines = [line for line in enumerate(text.splitlines(), 1) if line[1].strip() and not line[1].startswith("#")]
    try:
        table = list(csv.reader((line for _, line in lines), strict=True))
    except csv.Error as error:
        raise SourceError(f"{path}: {error}") from error
    if len(table) < 2 or len(table) != len(lines):
        raise SourceError(f"{path}: expected a row of names and rows of values, got {len(table)} rows")
    names = [name.strip().lower() for name in table[0]]
    missing = [name for name in needed if name not in names]
    unknown = [] if allowed is None else [name for name in names if name not in {*needed, *allowed}]
    if missing or unknown or len(set(names)) < len(names):
        raise SourceError(f"{path}: line {lines[0][0]}: expected columns {', '.join(needed)}, got {', '.join(names)}")
    rows = []
    for (number, _), values in zip(lines[1:], table[1:], strict=True):
        where = f"{path}: line {number}"
        if len(values) != len(names):
            raise SourceError(f"{where}: {len(values)} fields, expected {len(names)}")
        row = Row(where, {name: value.strip() for name, value in zip(names, values, strict=True)})
        if empty := [name for name in needed if not row.values[name]]:
            raise SourceError(f"{where}: {empty[0]} is empty")
        rows.append(row)
    return rows
