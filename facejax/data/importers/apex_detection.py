"""Where an expression begins, is at its height and ends: found by itself, or read from a file.

A recording is cut at four frames: onset, start and end of the apex, and offset. `motions.halves` takes neutral -> peak
from onset to the start of the apex, and peak -> neutral from its end to the offset. T frames, L landmarks.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from facejax.data.importers.base import RecordingInfo, SourceError
from facejax.data.importers.tables import Row

APEX_FRACTION, REST_FRACTION = 0.95, 0.05  # of the largest displacement: the apex lies above, rest below
MIN_MOTION_MM = 1e-3  # mm, landmarks in the mean: what moves less is no recording of an expression
JUMP_FACTOR, MIN_JUMP_MM = 10.0, 2.0  # a step of so many usual ones, and of so many mm in the mean, is odd


class Phases(NamedTuple):
    """Frame numbers within a recording."""

    onset: int
    apex_start: int
    apex_end: int
    offset: int


def mean_displacement(curve: np.ndarray, rest: np.ndarray) -> np.ndarray:
    """How far landmarks (T, L, 3) are from those at rest (L, 3) in the mean, (T,)."""
    return np.linalg.norm(curve - rest, axis=-1).mean(axis=-1)


def detect(curve: np.ndarray, rest: np.ndarray) -> Phases:
    """The cuts of landmarks (T, L, 3) about those at rest (L, 3).

    By their mean displacement: the apex goes from the first to the last frame above 95 % of its maximum; the onset is
    the last frame before it below 5 %, or the first of all; the offset the first one after it, or the last of all.
    """
    moved = mean_displacement(curve, rest)
    apex = np.flatnonzero(moved >= APEX_FRACTION * moved.max())
    quiet = np.flatnonzero(moved < REST_FRACTION * moved.max())
    before, after = quiet[quiet < apex[0]], quiet[quiet > apex[-1]]
    onset = before[-1] if len(before) else 0
    offset = after[0] if len(after) else len(moved) - 1
    return Phases(int(onset), int(apex[0]), int(apex[-1]), int(offset))


def not_at_rest(curve: np.ndarray, rest: np.ndarray, cuts: Phases) -> tuple[bool, bool]:
    """Whether a recording does not begin, and does not end, at rest."""
    moved = mean_displacement(curve, rest)
    return tuple(bool(moved[frame] >= REST_FRACTION * moved.max()) for frame in (cuts.onset, cuts.offset))


def count_returns(curve: np.ndarray, rest: np.ndarray) -> int:
    """How often landmarks (T, L, 3) go more than half of their farthest way from rest (L, 3), and come home between."""
    moved = mean_displacement(curve, rest)
    far, home = moved > 0.5 * moved.max(), moved < 2 * REST_FRACTION * moved.max()
    known = np.where(far, 1, np.where(home, 0, -1))
    known = known[known >= 0]
    return int(known[0] == 1) + int(np.sum(np.diff(known) == 1))


def detect_jumps(curve: np.ndarray) -> list[int]:
    """Frames that landmarks (T, L, 3) jump to: by ten times the usual step, and by two millimetres in the mean."""
    steps = np.linalg.norm(np.diff(curve, axis=0), axis=-1).mean(axis=-1)
    limit = max(MIN_JUMP_MM, JUMP_FACTOR * float(np.quantile(steps, 0.9))) if len(steps) else 0.0
    return [int(frame) + 1 for frame in np.flatnonzero(steps > limit)]


def phases_from_table(rows: Sequence[Row], takes: Sequence[RecordingInfo], people: Sequence[str]) -> dict[int, Phases]:
    """Cuts of takes, by their number, from rows of subject, recording, onset, apex_start, apex_end and offset.

    Raises `SourceError` for a recording that is not there, and for frames that do not rise or are not there.
    """
    found = {}
    for at, row in match_rows(rows, takes, people).items():
        cuts = Phases(*(row.whole(name) for name in Phases._fields))
        last = takes[at].count - 1
        if not 0 <= cuts.onset <= cuts.apex_start <= cuts.apex_end <= cuts.offset <= last:
            raise SourceError(f"{row.where}: expected frames that rise from 0 to {last} at most, got {list(cuts)}")
        if cuts.onset == cuts.apex_start and cuts.apex_end == cuts.offset:
            raise SourceError(f"{row.where}: neither a way to the apex nor back")
        found[at] = cuts
    return found


def match_rows(rows: Sequence[Row], takes: Sequence[RecordingInfo], people: Sequence[str]) -> dict[int, Row]:
    """Which take each row names by `subject` and `recording`.

    Raises `SourceError`: there is none, or two rows name one.
    """
    known = {(people[take.subject], take.name.rpartition("/")[2]): i for i, take in enumerate(takes)}
    found: dict[int, Row] = {}
    for row in rows:
        key = (row.values["subject"], row.values["recording"])
        if key not in known:
            raise SourceError(f"{row.where}: no recording {key[1]!r} of {key[0]!r}")
        if (twin := found.setdefault(known[key], row)) is not row:
            raise SourceError(
                f"{row.where}: {key[1]!r} of {key[0]!r} stands in {twin.where.rpartition(': ')[2]} already"
            )
    return found
