"""Onset, apex and offset of a recorded expression: detected in the landmarks, or read from a table.

The four frames are those of `Phases`. `facejax.data.motions.halves` takes neutral -> peak from the onset to the start
of the apex, and peak -> neutral from the end of the apex to the offset. T frames, L landmarks.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from facejax.data.importers.base import RecordingInfo, SourceError
from facejax.data.importers.tables import Row

APEX_FRACTION, REST_FRACTION = 0.95, 0.05  # of the largest displacement: the apex lies above, rest below
MIN_MOTION_MM = 1e-3  # mean displacement below which a recording contains no motion
JUMP_FACTOR, MIN_JUMP_MM = 10.0, 2.0  # a step is a jump above this multiple of the usual one and this mean distance


class Phases(NamedTuple):
    """Frame numbers within a recording."""

    onset: int
    apex_start: int
    apex_end: int
    offset: int


def mean_displacement(curve: np.ndarray, rest: np.ndarray) -> np.ndarray:
    """Return the mean distance (T,) of landmarks (T, L, 3) from those at rest (L, 3)."""
    return np.linalg.norm(curve - rest, axis=-1).mean(axis=-1)


def detect(curve: np.ndarray, rest: np.ndarray) -> Phases:
    """Detect the phases of landmarks (T, L, 3) by their mean displacement from those at rest (L, 3).

    The apex spans from the first to the last frame above 95 % of the maximum. The onset is the last frame before it
    below 5 %, or the first frame; the offset is the first frame after it below 5 %, or the last frame.
    """
    moved = mean_displacement(curve, rest)
    apex = np.flatnonzero(moved >= APEX_FRACTION * moved.max())
    quiet = np.flatnonzero(moved < REST_FRACTION * moved.max())
    before, after = quiet[quiet < apex[0]], quiet[quiet > apex[-1]]
    onset = before[-1] if len(before) else 0
    offset = after[0] if len(after) else len(moved) - 1
    return Phases(int(onset), int(apex[0]), int(apex[-1]), int(offset))


def not_at_rest(curve: np.ndarray, rest: np.ndarray, phases: Phases) -> tuple[bool, bool]:
    """Return whether a recording does not begin, and whether it does not end, at rest."""
    moved = mean_displacement(curve, rest)
    limit = REST_FRACTION * moved.max()
    return bool(moved[phases.onset] >= limit), bool(moved[phases.offset] >= limit)


def count_returns(curve: np.ndarray, rest: np.ndarray) -> int:
    """Count the separate expressions in landmarks (T, L, 3) with those at rest (L, 3).

    An expression is an excursion above half of the largest displacement, separated from others by frames below 10 %.
    """
    moved = mean_displacement(curve, rest)
    far, near = moved > 0.5 * moved.max(), moved < 2 * REST_FRACTION * moved.max()
    state = np.where(far, 1, np.where(near, 0, -1))
    state = state[state >= 0]
    return int(state[0] == 1) + int(np.sum(np.diff(state) == 1))


def detect_jumps(curve: np.ndarray) -> list[int]:
    """Return the frames of landmarks (T, L, 3) that are reached by an unusually large step.

    Such a step exceeds ten times the 90th percentile of all steps, and two millimetres in the mean.
    """
    steps = np.linalg.norm(np.diff(curve, axis=0), axis=-1).mean(axis=-1)
    limit = max(MIN_JUMP_MM, JUMP_FACTOR * float(np.quantile(steps, 0.9))) if len(steps) else 0.0
    return [int(frame) + 1 for frame in np.flatnonzero(steps > limit)]


def phases_from_table(
    rows: Sequence[Row], recordings: Sequence[RecordingInfo], people: Sequence[str]
) -> dict[int, Phases]:
    """Return phases by recording number, from rows of subject, recording, onset, apex_start, apex_end and offset.

    Raises:
      SourceError: a recording is unknown, or frames are not ascending or out of range.
    """
    found = {}
    for number, row in match_rows(rows, recordings, people).items():
        phases = Phases(*(row.integer(name) for name in Phases._fields))
        last = recordings[number].num_frames - 1
        if not 0 <= phases.onset <= phases.apex_start <= phases.apex_end <= phases.offset <= last:
            raise SourceError(
                f"{row.location}: onset, apex_start, apex_end and offset must be ascending frame numbers in 0..{last}, "
                f"got {list(phases)}"
            )
        if phases.onset == phases.apex_start and phases.apex_end == phases.offset:
            raise SourceError(
                f"{row.location}: onset equals apex_start and apex_end equals offset, so that there is no motion to "
                "the apex or back"
            )
        found[number] = phases
    return found


def match_rows(rows: Sequence[Row], recordings: Sequence[RecordingInfo], people: Sequence[str]) -> dict[int, Row]:
    """Return each row by the number of the recording that its `subject` and `recording` name.

    Raises:
      SourceError: a recording is unknown, or named by two rows.
    """
    known = {(people[one.subject], one.name.rpartition("/")[2]): i for i, one in enumerate(recordings)}
    found: dict[int, Row] = {}
    for row in rows:
        subject, recording = row.values["subject"], row.values["recording"]
        if (subject, recording) not in known:
            raise SourceError(f"{row.location}: subject {subject!r} has no recording {recording!r}")
        if (twin := found.setdefault(known[subject, recording], row)) is not row:
            raise SourceError(
                f"{row.location}: duplicate row for recording {recording!r} of subject {subject!r}, "
                f"see {twin.location.rpartition(': ')[2]}"
            )
    return found
