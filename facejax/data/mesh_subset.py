"""Selections of a dataset's meshes, read from disk in batches of displacements from neutral.

N vertices, L landmarks, G selected meshes; millimetres.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np

from facejax.data import dataset

Batch = tuple[np.ndarray, np.ndarray]


@dataclasses.dataclass(frozen=True)
class MeshSubset:
    """Some of a dataset's meshes. Iterating yields (landmarks (n, L, 3), vertices (n, N, 3)), n <= size, in order."""

    data: dataset.Dataset
    indices: np.ndarray  # (G,) positions in `data.vertices`
    owner: np.ndarray  # (G,) subject of each mesh
    size: int = 256

    def __iter__(self) -> Iterator[Batch]:
        for low in range(0, len(self.indices), self.size):
            yield self.read(np.arange(low, min(low + self.size, len(self.indices))))

    def read(self, rows: np.ndarray) -> Batch:
        """Return displacements of landmarks (n, L, 3) and vertices (n, N, 3) of the meshes at rows (n,)."""
        moved = self.data.vertices[self.indices[rows]] - self.data.neutral[self.owner[rows]]
        return moved[:, self.data.landmark_index], moved

    @property
    def count(self) -> int:
        """The number of meshes."""
        return len(self.indices)

    def where(self, mask: np.ndarray) -> MeshSubset:
        """Return the meshes selected by a mask (G,)."""
        return dataclasses.replace(self, indices=self.indices[mask], owner=self.owner[mask])

    def rows(self, rows: np.ndarray) -> MeshSubset:
        """Return the meshes at ascending rows (n,)."""
        return dataclasses.replace(self, indices=self.indices[rows], owner=self.owner[rows])

    def of_labels(self, labels: Sequence[str], *, without: bool = False) -> MeshSubset:
        """Return the meshes of recordings with one of the labels, or, with `without`, with none of them."""
        return self.where(np.isin(self.labels, list(labels)) != without)

    @property
    def labels(self) -> np.ndarray:
        """The label of each mesh's recording, (G,) strings."""
        return self.data.row_labels()[self.data.drawn[self.indices]]

    @property
    def recordings(self) -> np.ndarray:
        """The number of each mesh's recording, (G,)."""
        counts = [s.frames for s in self.data.sequences]
        return np.repeat(np.arange(len(counts)), counts)[self.data.drawn[self.indices]]

    @property
    def subjects(self) -> np.ndarray:
        """The distinct subjects, ascending."""
        return np.unique(self.owner)

    def groups(self, by: str) -> np.ndarray:
        """Return each mesh's group, (G,): its subject for `by="subjects"`, its label for `by="labels"`.

        Raises:
          ValueError: another `by`.
        """
        if by not in ("subjects", "labels"):
            raise ValueError(f"by: expected 'subjects' or 'labels', got {by!r}")
        return self.owner if by == "subjects" else self.labels

    def folds(self, count: int, *, by: str = "subjects") -> list[tuple[MeshSubset, MeshSubset]]:
        """Split for cross-validation: (fit, held out) for each of `count` groups of subjects, or of labels.

        Groups are formed in sorted order.
        With fewer subjects (or labels) than `count`, each forms its own fold.

        Raises:
          ValueError: there is only one subject (or label), or `count` is below 2.
        """
        groups = self.groups(by)
        names = np.unique(groups)
        if count < 2 or len(names) < 2:
            raise ValueError(f"expected 2 or more folds and {by}, got {count} and {len(names)}")
        parts = np.array_split(names, min(count, len(names)))
        return [(self.where(~np.isin(groups, part)), self.where(np.isin(groups, part))) for part in parts]

    def thin(self, step: int) -> MeshSubset:
        """Return every `step`-th mesh."""
        return self.where(np.arange(self.count) % step == 0)

    def person(self, subject: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return a subject's neutral face (N, 3), and all its meshes as from `read`."""
        return np.asarray(self.data.neutral[subject]), *self.read(np.flatnonzero(self.owner == subject))


def of_split(data: dataset.Dataset, *splits: str, size: int = 256) -> MeshSubset:
    """Return the meshes of all subjects of one or more splits, in stored order, in batches of `size`."""
    parts = [data.meshes(split) for split in splits]
    indices, owner = (np.concatenate(part) for part in zip(*parts, strict=True))
    order = np.argsort(indices, kind="stable")
    return MeshSubset(data, indices[order], owner[order], size)
