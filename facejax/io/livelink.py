"""Recordings of Live Link Face (Epic's app for the iPhone): real timing for the rig's ARKit units.

A recording is a CSV of one row per frame: timecode, number of values, 52 ARKit weights, and yaw, pitch and roll of
the head and of both eyes. Three things in it are not what they seem.

Time. A timecode is HH:MM:SS:FF.fff, FF.fff counted in frames of the timecode's own rate, which the file does not name
and which need not be the rate of the rows (30 rows a second in timecode of 60, for one). Rows are missing where the
phone was busy.

Rest. A face at rest has weights above zero: lids are lowered when the eyes look at the phone, the mouth hangs.

Sides. Left and right are the subject's (Apple, ARFaceAnchor.BlendShapeLocation), but the app's header names JawRight
before JawLeft and MouthRight before MouthLeft, while the values come as in Epic's EARFaceBlendShape, left first. The
mouth then goes to the wrong side, as users report (blender_livelinkface, pull request 1) and as a recording of 4,030
rows shows: where the header says left, the right eye narrows, the right cheek rises, and the right corner is stretched
(correlation -0.95). `read` exchanges both pairs where the header has them in this order.

Angles are in the file's own convention, in radians to all appearance: no documentation of unit or sign was found, and
eyes reach 0.6 in it. Eyes' yaw is negative to the subject's left, their pitch positive downward; the head's signs could
not be checked, so that nothing here turns it.

Shapes: T frames, 52 weights in the order of `BLENDSHAPES`, U units of the rig.
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from facejax.io import atomic

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
TIMECODE_RATES = (24, 25, 30, 60)  # frames per second that a timecode may count in
MAX_BYTES = 2**28 - 2**26  # bytes of a file
MAX_ROWS = 1_000_000  # rows: more than four hours at 60 per second
DAY, HALF_DAY = 86_400.0, 43_200.0
GAP_FACTOR = 1.5  # usual spacings of rows: what is longer is a gap
WEIGHT_RANGE = (-0.5, 2.0)  # ARKit's lie in 0..1, a little above now and then
_TIMECODE = re.compile(r"(\d{1,2}):(\d{1,2}):(\d{1,2})[:;](\d{1,3}(?:\.\d{1,9})?)")


class RecordingError(atomic.FileError):
    """A recording cannot be used; the message names the file, the line and the column."""


class Recording(NamedTuple):
    """Weights over time; `BLENDSHAPES` names the columns."""

    weights: np.ndarray  # (T, 52) float32
    head: np.ndarray  # (T, 3) float32: yaw, pitch, roll as in the file, radians
    times: np.ndarray  # (T,) float64 seconds since the first row, rising
    gaps: tuple[tuple[float, float], ...] = ()  # (time of the frame before, seconds until the next)
    notes: tuple[str, ...] = ()  # what was assumed and left out, one line each


def read(path: str | os.PathLike, *, base: int | None = None, trust_sides: bool = False) -> Recording:
    """Reads a recording. Rows without a face are left out, rows of equal time kept once, the rest put in order of time.

    Args:
      path: the CSV.
      base: frames per second that the timecode counts in; inferred if not given, and said in the notes.
      trust_sides: take JawLeft, JawRight, MouthLeft and MouthRight as the header names them.

    Raises:
      RecordingError: the file is missing, too large or no such recording; a column is missing; a row is garbled.
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
        raise RecordingError(f"{path}: is not a text in UTF-8") from None
    except ValueError as error:
        raise RecordingError(f"{path}: {error}") from error
    try:
        return _parse(lines, base, trust_sides)
    except ValueError as error:
        raise RecordingError(f"{path}: {error}") from error


def resample(recording: Recording, *, rate: float = 30.0, bridge: float = 0.25) -> Recording:
    """The same motion at equal intervals, linear between rows.

    Args:
      recording: any.
      rate: frames per second.
      bridge: seconds; a longer gap is not bridged: the face holds still at its last pose until the next row. `gaps` of
        the result are those, and a note counts them.

    Raises:
      ValueError: the rate is not positive, or gives more than `MAX_ROWS` frames.
    """
    times = recording.times
    if not (np.isfinite(rate) and rate > 0):
        raise ValueError(f"rate must be positive, got {rate}")
    if times[-1] * rate >= MAX_ROWS:
        raise ValueError(f"{times[-1]:.0f} seconds at {rate:g} per second are more than {MAX_ROWS} frames")
    new = np.arange(int(times[-1] * rate + 1e-6) + 1) / rate
    low = np.clip(np.searchsorted(times, new, side="right") - 1, 0, max(len(times) - 2, 0))
    high = np.minimum(low + 1, len(times) - 1)
    span = times[high] - times[low]
    share = np.clip((new - times[low]) / np.where(span > 0, span, 1), 0, 1)
    share = np.where((span > bridge) & (share < 1), 0, share)[:, None]
    mixed = (a[low] * (1 - share) + a[high] * share for a in (recording.weights, recording.head))
    weights, head = (a.astype(np.float32) for a in mixed)
    held = tuple(gap for gap in recording.gaps if gap[1] > bridge)
    notes = recording.notes + ((f"held still over {len(held)} gaps longer than {bridge:g} s",) if held else ())
    return Recording(weights, head, new, held, notes)


def rest_weights(recording: Recording, *, share: float = 0.1) -> np.ndarray:
    """The weights (52,) of the face at rest: the pose that the face comes back to.

    It is where the poses lie densest: the frame that has `share` of all frames nearest around it, and of these the
    median. Weights taken one by one mislead. Of a recording of 134 s, 11 % of all frames lie within 0.25 of the densest
    pose, from its beginning to its end; of the weights' modes 0.4 %, and of their tenth percentiles, a pose that the
    face never takes, none. It fails where an expression is held for longer than the face rests.
    """
    weights = recording.weights[:: -(-len(recording.weights) // 1000)].astype(np.float64)
    square = np.sum(weights**2, axis=1)
    distance = square[:, None] + square[None] - 2 * weights @ weights.T
    count = min(max(1, round(share * len(weights))), len(weights) - 1)
    centre = int(np.argmin(np.partition(distance, count, axis=1)[:, count]))
    return np.median(weights[np.argsort(distance[centre], kind="stable")[: count + 1]], axis=0).astype(np.float32)


def subtract_rest(recording: Recording, resting: np.ndarray | None = None) -> Recording:
    """Weights from rest, w -> max(0, (w - r) / (1 - r)): 0 at rest, 1 where they were 1, so that eyes still close.

    resting: (52,) weights in [0, 1); `rest_weights` of the recording if not given.
    """
    resting = np.asarray(rest_weights(recording) if resting is None else resting, np.float32)
    if resting.shape != (len(BLENDSHAPES),):
        raise ValueError(f"resting must be ({len(BLENDSHAPES)},), got {resting.shape}")
    # A weight that rests near 1 has no room left, and tells nothing.
    room = np.maximum(1 - np.clip(resting, 0, None), 0.1)
    weights = np.maximum(recording.weights - np.clip(resting, 0, None), 0) / room
    return recording._replace(weights=weights.astype(np.float32))


def unit_weights(recording: Recording, units: Sequence[str]) -> np.ndarray:
    """Weights (T, U) float32 of the U named units of a rig.

    Units that are no ARKit shape get 0, such as MakeHuman's own;
    shapes that are no unit are left out, such as the tongue's."""
    weights = np.zeros((len(recording.weights), len(units)), np.float32)
    for column, name in enumerate(BLENDSHAPES):
        if name in units:
            weights[:, units.index(name)] = recording.weights[:, column]
    return weights


def _lines(text: str) -> list[str]:
    if (count := text.count("\n") - 1) > MAX_ROWS:  # without the names of the columns
        raise ValueError(f"{count} rows; at most {MAX_ROWS}")
    return text.splitlines()


def _parse(lines: list[str], base: int | None, trust_sides: bool) -> Recording:
    header = [word.strip() for word in lines[0].split(",")] if lines else []
    names = [word[:1].lower() + word[1:] for word in header]
    missing = [name for name in ("timecode", *BLENDSHAPES, *HEAD_ANGLES) if name not in names]
    if missing:
        more = f" and {len(missing) - 3} more" if len(missing) > 3 else ""
        raise ValueError(f"line 1: lacks the columns {', '.join(missing[:3])}{more}; is it Live Link Face's CSV?")
    if len(lines) - 1 > MAX_ROWS:
        raise ValueError(f"{len(lines) - 1} rows; at most {MAX_ROWS}")
    at = [names.index(name) for name in (*BLENDSHAPES, *HEAD_ANGLES)]
    clocks, rows, numbers, faceless = [], [], [], 0
    for number, line in enumerate(lines[1:], 2):
        words = [word.strip() for word in line.split(",")]
        if not any(words):
            continue
        # Frames without a face carry no values in what the app sends; files are taken to be alike.
        if words[1:2] == ["0"] and not any(words[2:]):
            faceless += 1
            continue
        if len(words) != len(names):
            raise ValueError(f"line {number}: expected {len(names)} columns as in line 1, got {len(words)}")
        clocks.append(_clock(words[names.index("timecode")], number))
        rows.append(_row([words[i] for i in at], number))
        numbers.append(number)
    if not rows:
        raise ValueError("holds no row with a face")
    table, notes = np.stack(rows), []
    if not trust_sides:
        table, notes = _exchange(table, names)
    clock = np.array(clocks)
    if base is None:
        base = _base(clock)
        notes.append(f"timecode read as {base} frames per second")
    late = int(np.argmax(clock[:, 1]))
    if not clock[late, 1] < base:
        raise ValueError(f"line {numbers[late]}, column Timecode: frame {clock[late, 1]:g} of {base} per second")
    times = clock[:, 0] + clock[:, 1] / base
    # A step back of half a day and more is midnight (and forth, back across it); a smaller one is a row out of order.
    step = np.diff(times, prepend=times[0])
    times = times + DAY * np.cumsum(np.where(step < -HALF_DAY, 1, np.where(step > HALF_DAY, -1, 0)))
    times, first = np.unique(times, return_index=True)
    if faceless:
        notes.append(f"left out {faceless} rows without a face")
    if len(first) < len(rows):
        notes.append(f"left out {len(rows) - len(first)} rows of a time that was there before")
    times = times - times[0]
    weights, head = np.split(table[first], [len(BLENDSHAPES)], axis=1)
    return Recording(weights, head, times, _gaps(times), tuple(notes))


def _clock(text: str, line: int) -> tuple[float, float]:
    """Whole seconds since midnight, and frames."""
    match = _TIMECODE.fullmatch(text.strip())
    if not match:
        raise ValueError(f"line {line}, column Timecode: expected HH:MM:SS:FF.fff, got {text[:40]!r}")
    hours, minutes, seconds = (int(group) for group in match.groups()[:3])
    if hours > 23 or minutes > 59 or seconds > 59:
        raise ValueError(f"line {line}, column Timecode: no time of day: {text[:40]!r}")
    return 3600.0 * hours + 60 * minutes + seconds, float(match[4])


def _base(clock: np.ndarray) -> int:
    """Frames per second of the timecode, from seconds and frames (T, 2).

    Where one second gives way to the next, the step is as long as within a second: (base - frames before) + frames
    after. Without such a place the least base will do that all frames fit in, of 30 and 60.
    """
    possible = [base for base in TIMECODE_RATES if base > clock[:, 1].max()]
    second, frame = np.diff(clock, axis=0).T
    within = frame[(second == 0) & (frame > 0)]
    across = frame[second == 1]
    if not possible:
        return TIMECODE_RATES[-1]
    if not len(within) or not len(across):
        return next(base for base in possible if base >= 30)
    found = float(np.median(np.median(within) - across))
    return min(possible, key=lambda base: abs(base - found))


def _row(words: list[str], line: int) -> np.ndarray:
    """The weights, then the head's angles, of one row, (55,) float32, every number checked."""
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


def _exchange(table: np.ndarray, names: list[str]) -> tuple[np.ndarray, list[str]]:
    """The table (T, 55) with the sides put right that the header has the wrong way round, and notes about it."""
    order, notes = np.arange(table.shape[1]), []
    for part in ("jaw", "mouth"):
        if names.index(f"{part}Left") == names.index(f"{part}Right") + 1:
            left, right = BLENDSHAPES.index(f"{part}Left"), BLENDSHAPES.index(f"{part}Right")
            order[[left, right]] = right, left
            notes.append(f"exchanged {part}Left and {part}Right, which the app's header confuses")
    return table[:, order], notes


def _gaps(times: np.ndarray) -> tuple[tuple[float, float], ...]:
    step = np.diff(times)
    long = np.flatnonzero(step > GAP_FACTOR * np.median(step)) if len(step) else []
    return tuple((float(times[i]), float(step[i])) for i in long)
