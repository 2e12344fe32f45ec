"""The drawn meshes of a dataset as batches of displacements from neutral, read from disk as they are needed.

N vertices, L landmarks, millimetres.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np

from facejax.data import dataset

Batch = tuple[np.ndarray, np.ndarray]


@dataclasses.dataclass(frozen=True)
class MeshSubset:
    """Some of a dataset's meshes. Iterating gives (landmarks (n, L, 3), vertices (n, N, 3)), n <= size, in order."""

    data: dataset.Dataset
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

    def where(self, keep: np.ndarray) -> MeshSubset:
        """Those under a mask (G,)."""
        return dataclasses.replace(self, at=self.at[keep], owner=self.owner[keep])

    def rows(self, which: np.ndarray) -> MeshSubset:
        """Those at positions (n,), rising, of this selection."""
        return dataclasses.replace(self, at=self.at[which], owner=self.owner[which])

    def of_labels(self, labels: Sequence[str], *, without: bool = False) -> MeshSubset:
        """Those of frames that show one of the labels, or none of them."""
        return self.where(np.isin(self.labels, list(labels)) != without)

    @property
    def labels(self) -> np.ndarray:
        """The label of each mesh's recording, (G,) strings."""
        return self.data.row_labels()[self.data.drawn[self.at]]

    @property
    def recordings(self) -> np.ndarray:
        """The number of each mesh's recording, (G,)."""
        counts = [s.frames for s in self.data.sequences]
        return np.repeat(np.arange(len(counts)), counts)[self.data.drawn[self.at]]

    @property
    def subjects(self) -> np.ndarray:
        """Whose meshes there are, in order."""
        return np.unique(self.owner)

    def groups(self, by: str) -> np.ndarray:
        """What each mesh belongs to, (G,): its subject's number, or of `by="labels"` its label."""
        if by not in ("subjects", "labels"):
            raise ValueError(f"by: expected 'subjects' or 'labels', got {by!r}")
        return self.owner if by == "subjects" else self.labels

    def folds(self, count: int, *, by: str = "subjects") -> list[tuple[MeshSubset, MeshSubset]]:
        """(fit, held out) for each of `count` groups of subjects, or of labels, in sorted order.

        Of fewer subjects (or labels) than `count`, one each. Raises `ValueError` where there is only one.
        """
        of = self.groups(by)
        names = np.unique(of)
        if count < 2 or len(names) < 2:
            raise ValueError(f"expected 2 or more folds and {by}, got {count} and {len(names)}")
        parts = np.array_split(names, min(count, len(names)))
        return [(self.where(~np.isin(of, part)), self.where(np.isin(of, part))) for part in parts]

    def thin(self, step: int) -> MeshSubset:
        """Every `step`-th mesh."""
        return self.where(np.arange(self.count) % step == 0)

    def person(self, subject: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """A subject's neutral face (N, 3) and its meshes as `read` gives them."""
        return np.asarray(self.data.neutral[subject]), *self.read(np.flatnonzero(self.owner == subject))


def of_split(data: dataset.Dataset, *splits: str, size: int = 256) -> MeshSubset:
    """The meshes of the subjects of one or more splits, in the order in which they are stored."""
    found = [data.meshes(split) for split in splits]
    at, owner = (np.concatenate(part) for part in zip(*found, strict=True))
    order = np.argsort(at, kind="stable")
    return MeshSubset(data, at[order], owner[order], size)
