"""Corpora of generated motions on disk, as written by `facejax.inference.corpus`: shards and an index.

    FOLDER/index.json          schema, request, and each shard's first sequence, count, bytes and SHA-256; written last
    FOLDER/shards/000000.npz   landmarks (n, T, L, 3) mm, labels (n, P + 1), person (n,), optional vertices (n, T, N, 3)

Files may be untrusted: shard names cannot leave the folder, sizes are bounded, nothing is unpickled.
"""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from facejax.io import atomic, errors, npz

SCHEMA = 1
MAX_INDEX_BYTES = 3 << 23
_SHARD_NAME = re.compile(r"shards/\d{6,9}\.npz")


class Shard(NamedTuple):
    """An entry of the index: one file of `count` sequences, the first of which has number `first`."""

    file: str
    first: int
    count: int  # pyright: ignore[reportIncompatibleMethodOverride] (a key of the index)
    bytes: int
    sha256: str


class CorpusError(errors.FileError):
    """A corpus is missing, incomplete or damaged."""


@dataclasses.dataclass(frozen=True, eq=False)
class Corpus:
    """A corpus on disk. Iterating reads its shards in order."""

    path: Path
    index: dict[str, Any]
    shards: tuple[Shard, ...]

    def __len__(self) -> int:
        return self.shards[-1].first + self.shards[-1].count

    def read(self, number: int) -> dict[str, np.ndarray]:
        """Return the arrays of one shard.

        Raises:
          CorpusError: the file cannot be read, or does not match the index.
        """
        shard = self.shards[number]
        path = self.path / shard.file
        names = ("landmarks", "labels", "person", "vertices")[: 3 + self.index["request"]["meshes"]]
        try:
            if path.stat().st_size != shard.bytes:
                raise ValueError(f"{path.stat().st_size} bytes, expected {shard.bytes}")
            arrays = npz.read_npz(path, names)
            if set(arrays) != set(names) or any(len(array) != shard.count for array in arrays.values()):
                raise ValueError(f"expected {shard.count} of each of {', '.join(names)}")
            _check(arrays, self.index)
        except (OSError, *npz.DAMAGE_ERRORS) as error:
            raise CorpusError(f"{path}: {error}; generate it again") from error
        return arrays

    def __iter__(self) -> Iterator[dict[str, np.ndarray]]:
        return map(self.read, range(len(self.shards)))

    def verify(self) -> None:
        """Compare the SHA-256 of every shard with the index.

        Raises:
          CorpusError: naming the first shard that differs.
        """
        for shard in self.shards:
            if atomic.sha256(self.path / shard.file) != shard.sha256:
                raise CorpusError(f"{self.path / shard.file} is damaged: delete it and generate it again")


def load(path: str | Path) -> Corpus:
    """Open a corpus by its folder.

    Raises:
      CorpusError: the folder has no index, as while the corpus is unfinished, or the index is damaged.
    """
    path = Path(path)
    place = path / "index.json"
    try:
        if place.stat().st_size > MAX_INDEX_BYTES:
            raise ValueError(f"more than {MAX_INDEX_BYTES} bytes")
        index = json.loads(place.read_bytes())
        if index["schema"] != SCHEMA:
            raise ValueError(f"schema {index['schema']}, expected {SCHEMA}")
        for name in ("labels", "people"):
            if not (isinstance(index[name], list) and all(isinstance(word, str) for word in index[name])):
                raise ValueError(f"{name}: expected names, got {str(index[name])[:60]}")
        if index["unit"] != "mm" or type(index["length"]) is not int:
            raise ValueError(f"expected millimetres and a length in frames, got {index['unit']} and {index['length']}")
        shards = tuple(Shard(**entry) for entry in index["shards"])
        total = 0
        for shard in shards:
            # The index is JSON: fields may have any type.
            if not (type(shard.file) is str and _SHARD_NAME.fullmatch(shard.file)):
                raise ValueError(f"invalid shard name {shard.file!r}, expected shards/000000.npz and so on")
            if shard.first != total or not shard.count > 0:
                raise ValueError(
                    f"{shard.file} has first {shard.first} and count {shard.count}, "
                    f"expected first {total} and a count above 0"
                )
            total += shard.count
        if total != index["request"]["count"] or not isinstance(index["request"]["meshes"], bool):
            raise ValueError(f"{total} sequences, expected {index['request']['count']}")
    except FileNotFoundError:
        raise CorpusError(
            f"{path} has no index.json: it is not a corpus, or generation has not finished; generate it again"
        ) from None
    except OSError as error:
        raise CorpusError(f"{place}: cannot be read: {error.strerror or error}") from error
    except (ValueError, KeyError, TypeError, IndexError, RecursionError) as error:
        raise CorpusError(f"{place} is damaged ({error})") from error
    return Corpus(path, index, shards)


def _check(arrays: dict[str, np.ndarray], index: dict[str, Any]) -> None:
    """Raise `ValueError` where the arrays of a shard contradict the index."""
    for name in ("landmarks", "vertices"):
        if name in arrays and (arrays[name].ndim != 4 or arrays[name].shape[1:4:2] != (index["length"], 3)):
            raise ValueError(f"{name} are {arrays[name].shape}, expected (n, {index['length']}, K, 3)")
        if name in arrays and not np.isfinite(arrays[name]).all():
            raise ValueError(f"{name} are not all finite")
    for name, known in (("labels", index["labels"]), ("person", index["people"])):
        numbers = arrays[name]
        if numbers.dtype.kind not in "iu" or numbers.min() < 0 or numbers.max() >= len(known):
            raise ValueError(f"{name}: expected integers below {len(known)}, the number of names in the index")
