"""Checks of inference options that need no model, only numbers and names; importing this module does not import JAX."""

from __future__ import annotations

from collections.abc import Sequence

from facejax.models.labels import suggestion

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


def check_expression(name: str, known: Sequence[str]) -> None:
    """Raise `ValueError` for an expression that is not in `known`, listing the closest known names."""
    if name not in known:
        raise ValueError(f"no network for the expression {name!r}: {suggestion(name, known)}")
