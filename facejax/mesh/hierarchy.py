"""The multi-resolution hierarchy of a mesh decoder, built once per template.

Decimated meshes, upsampling maps and spirals. Levels run from fine (0, the template itself) to coarse.
Every coarse vertex is one of the template's. All tables are NumPy arrays, so that a hierarchy is a plain
pytree: pass it to jitted functions as an argument, since tables that are closed over become constants
that XLA spends seconds folding.
"""

from __future__ import annotations

import hashlib
import os
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from facejax.io import atomic
from facejax.mesh import decimation, graph, spirals, stencils
from facejax.mesh.stencils import Stencil

FORMAT = 1  # increase it when the same template and options give different tables
FACTORS = (4.0, 4.0, 4.0, 4.0)
# Fine to coarse, as in the published sparse-to-dense decoder (Otberdout et al. 2023).
LENGTHS = (15, 14, 9, 9)
Tables = tuple[np.ndarray, ...]  # one per level
_STORED = ("kept", "faces", "spirals", "corners", "weights")


class Hierarchy(NamedTuple):
    """Levels 0..n of a template with N_0 = N vertices; every tuple runs from fine to coarse."""

    kept: Tables  # n + 1 of (N_i,) int32: the level's vertices, as indices into the template
    faces: Tables  # n + 1 of (F_i, 3) int32
    spirals: Tables  # n of (N_i, S_i) int32; N_i marks the dummy vertex, which reads zero
    corners: Tables  # n of (N_i, 3) int32: the vertices of level i + 1 under each vertex
    weights: Tables  # n of (N_i, 3) float32: their barycentric weights, >= 0, sum 1
    # Derived from the tables above, for `spiral_conv`:
    climbs: tuple[Stencil, ...]  # n: the spirals of level i on a signal of level i + 1
    surface: Stencil  # the spirals of level 0 on a signal of level 0

    @property
    def sizes(self) -> tuple[int, ...]:
        """The number of vertices of each level."""
        return tuple(len(kept) for kept in self.kept)


def build(
    vertices: np.ndarray,
    faces: np.ndarray,
    *,
    factors: Sequence[float] = FACTORS,
    lengths: Sequence[int | None] | int | None = LENGTHS,
    reference: int | None = None,
    dilation: int = 1,
    cache: str | os.PathLike[str] | None = None,
) -> Hierarchy:
    """Build the hierarchy of a template.

    Args:
      vertices: (N, 3).
      faces: (F, 3).
      factors: by which the number of vertices is divided from level to level.
      lengths: of the spirals, one for all levels or one per level but the coarsest; None takes int(mean + 2 std) of the
        two-ring sizes.
      reference: the vertex towards which spirals start, by default the one with the largest z: the tip of the nose in
        the canonical frame.
      dilation: of the spirals.
      cache: a folder; the result is stored there under a hash of all inputs.

    Raises:
      ValueError: an invalid mesh, an option out of range, or a mesh too small for the factors.
    """
    vertices, faces = graph.check(vertices, faces)
    if not isinstance(lengths, Sequence):
        lengths = [lengths] * len(factors)
    if len(factors) == 0 or len(lengths) != len(factors):
        raise ValueError(f"expected one length per factor, got {len(lengths)} and {len(factors)}")
    reference = int(np.argmax(vertices[:, 2])) if reference is None else reference
    if not 0 <= reference < len(vertices):
        raise ValueError(f"reference: expected a vertex in 0..{len(vertices) - 1}, got {reference}")
    options = (FORMAT, [float(factor) for factor in factors], list(lengths), reference, dilation)
    path = None
    if cache is not None:
        digest = hashlib.sha256(repr((options, vertices.shape, faces.shape)).encode())
        digest.update(vertices.tobytes() + faces.tobytes())
        path = Path(cache) / f"hierarchy-{digest.hexdigest()[:20]}.npz"
        if (found := _read(path)) is not None:
            return found
    hierarchy = _build(vertices, faces, factors, lengths, reference, dilation)
    if path is not None:
        _write(path, hierarchy)
    return hierarchy


def save(hierarchy: Hierarchy) -> dict[str, np.ndarray | jax.Array]:
    """Return the tables by name (`spirals/0`), for any file of named arrays; `load` derives the stencils."""
    return {f"{field}/{i}": table for field in _STORED for i, table in enumerate(getattr(hierarchy, field))}


def load(arrays: Mapping[str, np.ndarray]) -> Hierarchy:
    """Return the hierarchy of the tables that `save` gave. Raises `ValueError` for missing or inconsistent tables."""
    levels = sum(name.startswith("kept/") for name in arrays)
    counts = (levels, levels, *[levels - 1] * 3)
    names = [[f"{field}/{i}" for i in range(n)] for field, n in zip(_STORED, counts, strict=True)]
    expected = {name for group in names for name in group}
    if levels < 2 or expected != set(arrays):
        wrong = sorted(expected ^ set(arrays)) or ["kept/0"]
        raise ValueError(f"hierarchy: missing or unexpected tables {', '.join(wrong)}")
    kept, faces, tables, corners, weights = (tuple(np.asarray(arrays[name]) for name in group) for group in names)
    sizes = [len(level) for level in kept]
    for i in range(levels - 1):
        shapes = (tables[i].shape[:1], corners[i].shape, weights[i].shape)
        if shapes != ((sizes[i],), (sizes[i], 3), (sizes[i], 3)):
            raise ValueError(f"level {i}: expected tables for {sizes[i]} vertices, got shapes {shapes}")
        low, high = min(tables[i].min(), corners[i].min()), (tables[i].max(), corners[i].max())
        if low < 0 or high[0] > sizes[i] or high[1] >= sizes[i + 1]:
            raise ValueError(f"level {i}: a table has a vertex index out of range")
    return _complete(kept, faces, tables, corners, weights)


def _build(
    vertices: np.ndarray,
    faces: np.ndarray,
    factors: Sequence[float],
    lengths: Sequence[int | None],
    reference: int,
    dilation: int,
) -> Hierarchy:
    kept, triangles = [np.arange(len(vertices), dtype=np.int32)], [faces]
    tables: list[np.ndarray] = []
    corners: list[np.ndarray] = []
    weights: list[np.ndarray] = []
    origin = vertices[reference]
    for factor, length in zip(factors, lengths, strict=True):
        nearest = int(np.argmin(np.linalg.norm(vertices - origin, axis=1)))
        tables.append(spirals.build(vertices, faces, reference=nearest, length=length, dilation=dilation))
        chosen, coarse, _ = decimation.decimate(vertices, faces, factor)
        corner, weight = decimation.upsampling(vertices, vertices[chosen], coarse)
        corners.append(corner)
        weights.append(weight)
        vertices, faces = vertices[chosen], coarse
        kept.append(kept[-1][chosen])
        triangles.append(faces)
    return _complete(tuple(kept), tuple(triangles), tuple(tables), tuple(corners), tuple(weights))


def _complete(kept: Tables, faces: Tables, tables: Tables, corners: Tables, weights: Tables) -> Hierarchy:
    levels = zip(tables, corners, weights, kept[1:], strict=True)
    climbs = tuple(stencils.build(table, corner, weight, len(coarse)) for table, corner, weight, coarse in levels)
    return Hierarchy(kept, faces, tables, corners, weights, climbs, stencils.flat(tables[0]))


def _read(path: Path) -> Hierarchy | None:
    """Return a cached hierarchy; None where there is none or the file is damaged, so that it is rebuilt."""
    try:
        # Opened here, because np.load does not close a file that it cannot read.
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as arrays:
            return load(dict(arrays))
    except (OSError, ValueError, EOFError, zipfile.BadZipFile):
        return None


def _write(path: Path, hierarchy: Hierarchy) -> None:
    with atomic.replace_file(path) as temporary, open(temporary, "wb") as file:
        np.savez(file, **save(hierarchy))  # pyright: ignore[reportArgumentType]  the stub takes names for allow_pickle
