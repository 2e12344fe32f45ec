"""Reader of recordings of Live Link Face (Epic's app for the iPhone): ARKit blendshape weights over time.

A recording is a CSV file with one row per frame: timecode, number of values, 52 ARKit weights, and yaw, pitch and roll
of the head and of both eyes. Two properties need care.

Time. A timecode is HH:MM:SS:FF.fff, where FF.fff counts frames at the timecode's own rate. The file does not contain
this rate, which may differ from the rate of the rows (for example 30 rows per second in a timecode of 60). Rows are
missing where the phone dropped frames.

Sides. Left and right are the subject's (Apple, ARFaceAnchor.BlendShapeLocation), but the app's header names JawRight
before JawLeft and MouthRight before MouthLeft, while the values are in the order of Epic's EARFaceBlendShape, left
first. The mouth then moves to the wrong side, as users report (blender_livelinkface, pull request 1) and as a recording
of 4,030 rows shows: where the header says left, the right eye narrows, the right cheek rises, and the right corner is
stretched (correlation -0.95). `read` exchanges both pairs where the header has them in this order.

Angles are returned as in the file, apparently in radians: no documentation of unit or sign was found, and eyes reach
0.6. The eyes' yaw is negative to the subject's left, their pitch positive downward; the signs of the head's angles
could not be verified, so that they are not used here.

T frames, 52 weights in the order of `BLENDSHAPES`.
"""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

from facejax.io import errors

_SIDED = ("Left", "Right")
_EYE = ("Blink", "LookDown", "LookIn", "LookOut", "LookUp", "Squint", "Wide")
_MOUTH = ("Smile", "Frown", "Dimple", "Stretch")
BLENDSHAPES = (
    *(f"eye{move}{side}" for side in _SIDED for move in _EYE),
    *("jawForward", "jawLeft", "jawRight", "jawOpen"),
    *("mouthClose", "mouthFunnel", "mouthPucker", "mouthLeft", "mouthRight"),
    *(f"mouth{move}{side}" for move in _MOUTH for side in _SIDED),
    *("mouthRollLower", "mouthRollUpper", "mouthShrugLower", "mouthShrugUpper"),
    *(f"mouth{move}{side}" for move in ("Press", "LowerDown", "UpperUp") for side in _SIDED),
    *("browDownLeft", "browDownRight", "browInnerUp", "browOuterUpLeft", "browOuterUpRight", "cheekPuff"),
    *(f"{move}{side}" for move in ("cheekSquint", "noseSneer") for side in _SIDED),
    "tongueOut",
)
HEAD_ANGLES = ("headYaw", "headPitch", "headRoll")
TIMECODE_RATES = (24, 25, 30, 60)  # frames per second
MAX_BYTES = 2**28 - 2**26
MAX_ROWS = 1_000_000  # more than four hours at 60 per second
DAY, HALF_DAY = 86_400.0, 43_200.0  # seconds
GAP_FACTOR = 1.5  # a gap is longer than this multiple of the median spacing of rows
WEIGHT_RANGE = (-0.5, 2.0)  # accepted; ARKit's are in 0..1, occasionally slightly above
_TIMECODE = re.compile(r"(\d{1,2}):(\d{1,2}):(\d{1,2})[:;](\d{1,3}(?:\.\d{1,9})?)")


class RecordingError(errors.FileError):
    """A recording cannot be used; the message names the file, line and column."""


class Recording(NamedTuple):
    """ARKit weights over time; `BLENDSHAPES` names the columns."""

    weights: np.ndarray  # (T, 52) float32
    head: np.ndarray  # (T, 3) float32: yaw, pitch, roll as in the file, radians
    times: np.ndarray  # (T,) float64 seconds since the first row, ascending
    gaps: tuple[tuple[float, float], ...] = ()  # (time of the frame before the gap, its seconds)
    notes: tuple[str, ...] = ()  # assumptions and dropped rows, one line each


def read(path: str | os.PathLike[str], *, base: int | None = None, trust_sides: bool = False) -> Recording:
    """Read a recording. Rows without a face and duplicate times are dropped, the others sorted by time.

    Args:
      path: the CSV file.
      base: frames per second of the timecode; by default inferred and noted.
      trust_sides: use JawLeft, JawRight, MouthLeft and MouthRight as in the header, without exchanging them.

    Raises:
      RecordingError: the file is missing, too large or not such a recording; a column is missing; a row is invalid.
    """
    path = Path(path)
    try:
        size = path.stat().st_size
        if not path.is_file() or not 0 < size <= MAX_BYTES:
            raise RecordingError(f"{path}: {size} bytes; expected a file of 1 to {MAX_BYTES}")
        lines = _lines(path.read_text("utf-8-sig"))
    except FileNotFoundError:
        raise RecordingError(f"{path}: no such file") from None
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror or error}") from error
    except UnicodeDecodeError:
        raise RecordingError(f"{path}: not UTF-8 text") from None
    except ValueError as error:
        raise RecordingError(f"{path}: {error}") from error
    try:
        return _parse(lines, base, trust_sides)
    except ValueError as error:
        raise RecordingError(f"{path}: {error}") from error


def _lines(text: str) -> list[str]:
    if (count := text.count("\n") - 1) > MAX_ROWS:  # without the header
        raise ValueError(f"{count} rows; at most {MAX_ROWS} are read")
    return text.splitlines()


def _parse(lines: list[str], base: int | None, trust_sides: bool) -> Recording:
    header = [word.strip() for word in lines[0].split(",")] if lines else []
    names = [word[:1].lower() + word[1:] for word in header]
    missing = [name for name in ("timecode", *BLENDSHAPES, *HEAD_ANGLES) if name not in names]
    if missing:
        more = f" and {len(missing) - 3} more" if len(missing) > 3 else ""
        raise ValueError(f"line 1: missing columns {', '.join(missing[:3])}{more}; expected a CSV of Live Link Face")
    if len(lines) - 1 > MAX_ROWS:
        raise ValueError(f"{len(lines) - 1} rows; at most {MAX_ROWS} are read")
    at = [names.index(name) for name in (*BLENDSHAPES, *HEAD_ANGLES)]
    clocks, rows, numbers, faceless = [], [], [], 0
    for number, line in enumerate(lines[1:], 2):
        words = [word.strip() for word in line.split(",")]
        if not any(words):
            continue
        # Frames without a face have no values in the app's live stream; the same is assumed of files.
        if words[1:2] == ["0"] and not any(words[2:]):
            faceless += 1
            continue
        if len(words) != len(names):
            raise ValueError(f"line {number}: expected {len(names)} columns as in line 1, got {len(words)}")
        clocks.append(_clock(words[names.index("timecode")], number))
        rows.append(_row([words[i] for i in at], number))
        numbers.append(number)
    if not rows:
        raise ValueError("contains no row with a face")
    table, notes = np.stack(rows), []
    if not trust_sides:
        table, notes = _exchange_sides(table, names)
    clock = np.array(clocks)
    if base is None:
        base = _infer_rate(clock)
        notes.append(f"timecode read as {base} frames per second")
    late = int(np.argmax(clock[:, 1]))
    if not clock[late, 1] < base:
        raise ValueError(f"line {numbers[late]}, column Timecode: frame {clock[late, 1]:g}, expected below {base}")
    times = clock[:, 0] + clock[:, 1] / base
    # A step of half a day or more crosses midnight; a smaller step back is a row out of order.
    step = np.diff(times, prepend=times[0])
    times = times + DAY * np.cumsum(np.where(step < -HALF_DAY, 1, np.where(step > HALF_DAY, -1, 0)))
    times, first = np.unique(times, return_index=True)
    if faceless:
        notes.append(f"dropped {faceless} rows without a face")
    if len(first) < len(rows):
        notes.append(f"dropped {len(rows) - len(first)} rows with duplicate times")
    times = times - times[0]
    weights, head = np.split(table[first], [len(BLENDSHAPES)], axis=1)
    return Recording(weights, head, times, _gaps(times), tuple(notes))


def _clock(text: str, line: int) -> tuple[float, float]:
    """Return whole seconds since midnight, and frames."""
    match = _TIMECODE.fullmatch(text.strip())
    if not match:
        raise ValueError(f"line {line}, column Timecode: expected HH:MM:SS:FF.fff, got {text[:40]!r}")
    hours, minutes, seconds = (int(group) for group in match.groups()[:3])
    if hours > 23 or minutes > 59 or seconds > 59:
        raise ValueError(f"line {line}, column Timecode: invalid time of day {text[:40]!r}")
    return 3600.0 * hours + 60 * minutes + seconds, float(match[4])


def _infer_rate(clock: np.ndarray) -> int:
    """Infer the frames per second of the timecode from seconds and frames (T, 2).

    A step across a change of second is as long as one within a second: (rate - frames before) + frames after. Without
    such a step, the result is the smallest of 30 and 60 that exceeds all frame numbers.
    """
    possible = [rate for rate in TIMECODE_RATES if rate > clock[:, 1].max()]
    second, frame = np.diff(clock, axis=0).T
    within = frame[(second == 0) & (frame > 0)]
    across = frame[second == 1]
    if not possible:
        return TIMECODE_RATES[-1]
    if not len(within) or not len(across):
        return next(rate for rate in possible if rate >= 30)
    estimate = float(np.median(np.median(within) - across))
    return min(possible, key=lambda rate: abs(rate - estimate))


def _row(words: list[str], line: int) -> np.ndarray:
    """Parse the weights and the head's angles of one row, (55,) float32, and check their range."""
    values = np.empty(len(words), np.float32)
    for i, word in enumerate(words):
        low, high = WEIGHT_RANGE if i < len(BLENDSHAPES) else (-2 * np.pi, 2 * np.pi)
        try:
            value = float(word)
        except ValueError:
            value = np.nan
        if not low <= value <= high:
            name = (*BLENDSHAPES, *HEAD_ANGLES)[i]
            got = f"expected a number in {low:.3g}..{high:.3g}, got {word[:40]!r}"
            raise ValueError(f"line {line}, column {name[0].upper()}{name[1:]}: {got}")
        values[i] = value
    return values


def _exchange_sides(table: np.ndarray, names: list[str]) -> tuple[np.ndarray, list[str]]:
    """Exchange sides of the table (T, 55) that the header has in the wrong order, and return notes about it."""
    order, notes = np.arange(table.shape[1]), []
    for part in ("jaw", "mouth"):
        if names.index(f"{part}Left") == names.index(f"{part}Right") + 1:
            left, right = BLENDSHAPES.index(f"{part}Left"), BLENDSHAPES.index(f"{part}Right")
            order[[left, right]] = right, left
            notes.append(f"exchanged {part}Left and {part}Right, whose order in the app's header is wrong")
    return table[:, order], notes


def _gaps(times: np.ndarray) -> tuple[tuple[float, float], ...]:
    step = np.diff(times)
    long = np.flatnonzero(step > GAP_FACTOR * np.median(step)) if len(step) else []
    return tuple((float(times[i]), float(step[i])) for i in long)
