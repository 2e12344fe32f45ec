"""Checks of inference options that need no model, only numbers and names; importing this module does not import JAX."""

from __future__ import annotations

import difflib
from collections.abc import Sequence

MAX_INTENSITY = 2
MAX_SEQUENCES = 100_000_000  # of a corpus


def check_intensity(intensity: float) -> None:
    """Raise `ValueError` for a scale of the displacements outside 0..2."""
    if not 0 <= intensity <= MAX_INTENSITY:
        raise ValueError(f"intensity must lie in 0..{MAX_INTENSITY}, got {intensity}")


def check_count(count: int) -> None:
    """Raise `ValueError` for a number of sequences outside 1..`MAX_SEQUENCES`."""
    if not 1 <= count <= MAX_SEQUENCES:
        raise ValueError(f"count: expected 1 to {MAX_SEQUENCES:,} sequences, got {count}")


def check_labels(names: Sequence[str], known: Sequence[str]) -> None:
    """Raise `ValueError` for a name that is not in `known`, listing the closest known names."""
    _check_sequence(names)
    for name in names:
        if name not in known:
            raise ValueError(f"unknown label {name!r}: {suggestion(name, known)}")


def check_transitions(names: Sequence[str]) -> None:
    """Raise `ValueError` unless there are two or more labels and no label repeats the one before it."""
    _check_sequence(names)
    for before, after in zip(names[:-1], names[1:], strict=True):
        if before == after:
            raise ValueError(f"labels: {before!r} follows itself; a transition needs two different labels")
    if len(names) < 2:
        raise ValueError(f"labels: expected at least a start and an end, got {list(names)}")


def check_expression(name: str, known: Sequence[str]) -> None:
    """Raise `ValueError` for an expression that is not in `known`, listing the closest known names."""
    if name not in known:
        raise ValueError(f"no network for the expression {name!r}: {suggestion(name, known)}")


def suggestion(name: str, known: Sequence[str]) -> str:
    """Return the second half of an error message: the known names closest to `name`, or all of them."""
    close = difflib.get_close_matches(name, known, n=3, cutoff=0.4)
    return f"did you mean {', '.join(close)}?" if close else f"expected one of {', '.join(known)}"


def _check_sequence(names: Sequence[str]) -> None:
    if isinstance(names, str):
        raise ValueError(f"labels: expected a sequence of names, got the one name {names!r}")
