"""The drawn meshes of a dataset as batches of displacements from neutral, read from disk as they are needed.

N vertices, L landmarks, millimetres.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np

from facejax.data import store

Batch = tuple[np.ndarray, np.ndarray]


@dataclasses.dataclass(frozen=True)
class Meshes:
    """Some of a dataset's meshes. Iterating gives (landmarks (n, L, 3), vertices (n, N, 3)), n <= size, in order."""

    data: store.Store
    at: np.ndarray  # (G,) positions in `data.vertices`
    owner: np.ndarray  # (G,) subject of each
    size: int = 256

    def __iter__(self) -> Iterator[Batch]:
        for low in range(0, len(self.at), self.size):
            yield self.read(np.arange(low, min(low + self.size, len(self.at))))

    def read(self, which: np.ndarray) -> Batch:
        """The meshes at positions (n,) of this selection."""
        moved = self.data.vertices[self.at[which]] - self.data.neutral[self.owner[which]]
        return moved[:, self.data.landmark_index], moved

    @property
    def count(self) -> int:
        """How many meshes there are."""
        return len(self.at)

    def where(self, keep: np.ndarray) -> Meshes:
        """Those under a mask (G,)."""
        return dataclasses.replace(self, at=self.at[keep], owner=self.owner[keep])

    def of_labels(self, labels: Sequence[str], *, without: bool = False) -> Meshes:
        """Those of frames that show one of the labels, or none of them."""
        named = self.data.row_labels()[self.data.drawn[self.at]]
        return self.where(np.isin(named, list(labels)) != without)

    def folds(self, count: int) -> list[tuple[Meshes, Meshes]]:
        """(fit, held out) for each of `count` groups of subjects."""
        groups = np.array_split(np.unique(self.owner), count)
        return [(self.where(~np.isin(self.owner, g)), self.where(np.isin(self.owner, g))) for g in groups]


def of_split(data: store.Store, split: str, *, size: int = 256) -> Meshes:
    """The meshes of a split's subjects."""
    return Meshes(data, *data.meshes(split), size)
