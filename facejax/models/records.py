"""Fields of records, which are pytrees: flax's `struct.PyTreeNode` with static fields."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import jax
    import numpy as np

    Leaf = jax.Array | np.ndarray
    HostLeaf = np.ndarray  # of tables that stay on the host until a compiled function takes them
    Number = jax.Array | np.ndarray | float
else:
    # JAX puts tracers, shapes, axes and placeholders into records: nothing may be checked where they are created.
    Leaf = HostLeaf = Number = Any


class Provenance(Mapping[str, Any]):
    """Provenance of weights: command, commit, dataset, errors.

    All provenances are equal, so that models that differ in nothing else share their compiled functions.
    """

    def __init__(self, fields: Mapping[str, Any] = {}):
        self._fields = dict(fields)

    def __getitem__(self, name: str) -> Any:
        return self._fields[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._fields)

    def __len__(self) -> int:
        return len(self._fields)

    def __or__(self, other: Mapping[str, Any]) -> Provenance:
        return Provenance({**self, **other})

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Provenance)

    def __hash__(self) -> int:
        return hash(Provenance)

    def __repr__(self) -> str:
        return f"Provenance({self._fields})"
