"""Names of the expressions that a model knows, and checks of names; importing this module does not import JAX."""

from __future__ import annotations

import difflib
from collections.abc import Sequence

import numpy as np


class Labels(tuple[str, ...]):
    """Names of labels, neutral first."""

    __slots__ = ()

    def encode(self, names: Sequence[str]) -> np.ndarray:
        """Return the indices (K,) int32 of names. Raises `ValueError` for an unknown name, with the closest ones."""
        check_labels(names, self)
        return np.array([self.index(name) for name in names], np.int32)


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


def suggestion(name: str, known: Sequence[str]) -> str:
    """Return the second half of an error message: the known names closest to `name`, or all of them."""
    close = difflib.get_close_matches(name, known, n=3, cutoff=0.4)
    return f"did you mean {', '.join(close)}?" if close else f"expected one of {', '.join(known)}"


def _check_sequence(names: Sequence[str]) -> None:
    if isinstance(names, str):
        raise ValueError(f"labels: expected a sequence of names, got the one name {names!r}")
