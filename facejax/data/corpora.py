"""A corpus of generated motions on disk, which `facejax.corpus` writes: shards with an index.

    FOLDER/index.json            what it is, and every shard's first sequence, count, bytes and SHA-256; written last
    FOLDER/shards/000000.npz     landmarks (n, T, L, 3) mm, labels (n, P + 1), person (n,), maybe vertices (n, T, N, 3)

Files may come from strangers: names cannot leave the folder, sizes are bounded, nothing is unpickled.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from facejax.io import atomic, npz

SCHEMA = 1
INDEX_BYTES = 3 << 23
_SHARD = re.compile(r"shards/\d{6,9}\.npz")


class Shard(NamedTuple):
    """A file of the index."""

    file: str
    first: int
    count: int
    bytes: int
    sha256: str


class CorpusError(atomic.FileError):
    """A corpus that is not whole, or no corpus."""


class Corpus(NamedTuple):
    """A corpus on disk."""

    path: Path
    index: dict[str, Any]
    shards: tuple[Shard, ...]

    def __len__(self) -> int:
        return self.shards[-1].first + self.shards[-1].count

    def read(self, number: int) -> dict[str, np.ndarray]:
        """The arrays of one shard. Raises `CorpusError` where it is not what the index says."""
        shard = self.shards[number]
        path = self.path / shard.file
        wanted = ("landmarks", "labels", "person", "vertices")[: 3 + self.index["request"]["meshes"]]
        try:
            if path.stat().st_size != shard.bytes:
                raise ValueError(f"{path.stat().st_size} bytes, expected {shard.bytes}")
            found = npz.read_npz(path, wanted)
            if set(found) != set(wanted) or any(len(array) != shard.count for array in found.values()):
                raise ValueError(f"expected {shard.count} of each of {', '.join(wanted)}")
            _check(found, self.index)
        except (OSError, *npz.DAMAGE) as error:
            raise CorpusError(f"{path}: {error}; generate it again") from error
        return found

    def __iter__(self) -> Iterator[dict[str, np.ndarray]]:
        return map(self.read, range(len(self.shards)))

    def verify(self) -> None:
        """Read every byte. Raises `CorpusError` naming the first shard that is not as it was written."""
        for shard in self.shards:
            if atomic.sha256(self.path / shard.file) != shard.sha256:
                raise CorpusError(f"{self.path / shard.file} is damaged: delete it and generate it again")


def load(path: str | Path) -> Corpus:
    """A corpus by its folder. Raises `CorpusError` for one that is not finished, damaged, or none."""
    path = Path(path)
    place = path / "index.json"
    try:
        if place.stat().st_size > INDEX_BYTES:
            raise ValueError(f"more than {INDEX_BYTES} bytes")
        index = json.loads(place.read_bytes())
        if index["schema"] != SCHEMA:
            raise ValueError(f"schema {index['schema']}, expected {SCHEMA}")
        for name in ("labels", "people"):
            if not (isinstance(index[name], list) and all(isinstance(word, str) for word in index[name])):
                raise ValueError(f"{name}: expected names, got {str(index[name])[:60]}")
        if index["unit"] != "mm" or type(index["length"]) is not int:
            raise ValueError(f"expected millimetres and a length in frames, got {index['unit']} and {index['length']}")
        shards = tuple(Shard(**entry) for entry in index["shards"])
        at = 0
        for shard in shards:
            if not (isinstance(shard.file, str) and _SHARD.fullmatch(shard.file)):
                raise ValueError(f"{shard.file!r} is no shard's name")
            if shard.first != at or not shard.count > 0:
                raise ValueError(f"{shard.file} has {shard.count} from {shard.first} on, expected some from {at} on")
            at += shard.count
        if at != index["request"]["count"] or not isinstance(index["request"]["meshes"], bool):
            raise ValueError(f"{at} sequences, expected {index['request']['count']}")
    except FileNotFoundError:
        raise CorpusError(f"{path} has no index.json: no corpus, or one that is not finished; generate it") from None
    except OSError as error:
        raise CorpusError(f"{place}: cannot be read: {error.strerror or error}") from error
    except (ValueError, KeyError, TypeError, IndexError, RecursionError) as error:
        raise CorpusError(f"{place} is damaged ({error})") from error
    return Corpus(path, index, shards)


def _check(found: dict[str, np.ndarray], index: dict[str, Any]) -> None:
    """Raise `ValueError` where arrays go against the index."""
    for name in ("landmarks", "vertices"):
        if name in found and (found[name].ndim != 4 or found[name].shape[1:4:2] != (index["length"], 3)):
            raise ValueError(f"{name} are {found[name].shape}, expected (n, {index['length']}, K, 3)")
        if name in found and not np.isfinite(found[name]).all():
            raise ValueError(f"{name} are not all finite")
    for name, known in (("labels", index["labels"]), ("person", index["people"])):
        numbers = found[name]
        if numbers.dtype.kind not in "iu" or numbers.min() < 0 or numbers.max() >= len(known):
            raise ValueError(f"{name}: expected numbers below {len(known)}, as many as the index names")
