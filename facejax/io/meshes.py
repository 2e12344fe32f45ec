"""Readers and writers of triangle meshes in PLY, OBJ, GLB, NPZ and NPY files.

The vertex order is preserved; polygons become triangle fans; everything but positions and faces is ignored. Files may
be untrusted: counts are checked against the file size before memory is allocated, and nothing is unpickled.
"""

import array
import os
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple, TypedDict, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from facejax.io import atomic, errors, glb_reader, npz, ply
from facejax.io.npz import DAMAGE_ERRORS, MAX_BYTES

_MAX_OBJ_BYTES = 2**26
_MAX_LINE_CHARS = 2**20
_FRAME_NAME = re.compile(r"\d{6,}\.(ply|obj|npz)")
_Wanted = TypeVar("_Wanted")
_Found = TypeVar("_Found")


class MeshError(errors.FileError):
    """A mesh file cannot be used; the message names the file, the problem and its location."""


class Mesh(NamedTuple):
    """A triangle mesh."""

    vertices: np.ndarray  # (N, 3) float64, in the file's unit
    faces: np.ndarray | None  # (F, 3) int32


def read(path: str | os.PathLike[str]) -> Mesh:
    """Read a mesh; the suffix is .ply, .obj, .glb, .npz (`vertices`, optional `faces`) or .npy (vertices).

    Of a .glb, whose unit is the metre, the largest mesh is read, without animation: see `facejax.io.glb_reader`.

    Raises:
      MeshError: the file is missing, truncated, empty or not a mesh; a vertex is not finite; a vertex index is out of
        range.
    """
    path = Path(path)
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise MeshError(f"{path}: unknown mesh format {path.suffix!r}; expected {', '.join(_READERS)}")
    try:
        size = path.stat().st_size
        if not path.is_file():
            raise MeshError(f"{path}: not a file")
        if not 0 < size <= MAX_BYTES:
            raise MeshError(f"{path}: {size} bytes; expected 1 to {MAX_BYTES}")
        vertices, faces = reader(path)
    except MeshError:
        raise
    except FileNotFoundError:
        raise MeshError(f"{path}: no such file") from None
    except OSError as error:
        raise MeshError(f"{path}: cannot be read: {error.strerror or error}") from error
    except DAMAGE_ERRORS as error:
        raise MeshError(f"{path}: {error}") from error
    return _checked(path, vertices, faces)


class AnimationExtra(TypedDict, total=False):
    """Landmarks and frame rate of an animation, as far as its file has them."""

    landmarks: np.ndarray  # as in the file, unchecked
    fps: float


def read_animation(
    path: str | os.PathLike[str], *, bare: bool = False
) -> tuple[np.ndarray, np.ndarray | None, AnimationExtra]:
    """Read an NPZ of `vertices` (T, N, 3) or (N, 3) and `faces`, and optional `landmarks` and `fps`.

    Only the first frame is checked.

    Args:
      path: the file.
      bare: allow a file without faces, and return None for them.

    Returns:
      vertices, faces (F, 3) int32, and a dict with those of "landmarks" and "fps" that the file contains.

    Raises:
      MeshError: as `read`.
    """
    path = Path(path)
    found = _as_mesh_error(path, npz.read_npz, ("vertices", "faces", "landmarks", "fps"))
    vertices, faces = found.pop("vertices"), found.pop("faces", None)
    if faces is None and not bare:
        raise MeshError(f"{path}: has no triangles")
    if vertices.ndim not in (2, 3) or 0 in vertices.shape:
        raise MeshError(f"{path}: vertices must be (T, N, 3) or (N, 3), got {vertices.shape}")
    first = _checked(path, vertices if vertices.ndim == 2 else vertices[0], faces)
    extra: AnimationExtra = {"landmarks": found["landmarks"]} if "landmarks" in found else {}
    if "fps" in found:
        if found["fps"].size != 1 or found["fps"].dtype.kind not in "fiu":
            raise MeshError(f"{path}: fps must be one number, got {found['fps'].shape} {found['fps'].dtype}")
        extra["fps"] = float(found["fps"].item())
    return vertices, first.faces if bare or faces is None else faces.astype(np.int32), extra


def count_frames(path: str | os.PathLike[str]) -> int:
    """Return the number of frames in an NPZ of `vertices` (T, N, 3), without reading them.

    Raises:
      MeshError: as `read_animation`, or `vertices` have another shape.
    """
    shape = _as_mesh_error(Path(path), npz.npz_shape, "vertices")
    if len(shape) != 3 or 0 in shape or shape[2] != 3:
        raise MeshError(f"{path}: vertices must be (T, N, 3), got {shape}")
    return shape[0]


def write(path: str | os.PathLike[str], vertices: ArrayLike, faces: ArrayLike | None = None) -> None:
    """Write a mesh in the format of the suffix (.ply binary, .obj text, .npz), atomically and without loss.

    Args:
      path: the file.
      vertices: (N, 3) float32 or float64; other dtypes are converted to float64.
      faces: (F, 3) int, or None.

    Raises:
      ValueError: the suffix is unknown, or an array has another shape or dtype.
    """
    path = Path(path)
    writer = _WRITERS.get(path.suffix.lower())
    if writer is None:
        raise ValueError(f"{path}: unknown mesh format {path.suffix!r}; expected {', '.join(_WRITERS)}")
    vertices = np.asarray(vertices)
    vertices = vertices if vertices.dtype == np.float32 else vertices.astype(np.float64)
    if vertices.ndim != 2 or vertices.shape[1] != 3:
        raise ValueError(f"{path}: vertices must be (N, 3), got {vertices.shape}")
    faces = np.zeros((0, 3), np.int32) if faces is None else np.asarray(faces)
    if faces.ndim != 2 or faces.shape[1] != 3 or not np.issubdtype(faces.dtype, np.integer):
        raise ValueError(f"{path}: faces must be (F, 3) integers, got {faces.shape} {faces.dtype}")
    with atomic.replace_file(path) as temporary:
        writer(temporary, vertices, faces.astype(np.int32))


def write_sequence(
    folder: str | os.PathLike[str], vertices: ArrayLike, faces: ArrayLike | None, *, format: str = "ply"
) -> None:
    """Write vertices (T, N, 3) as frames 000001.ply, 000002.ply, ... in a folder, which is replaced atomically.

    Raises:
      ValueError: the format is unknown, or the folder contains anything but frames.
    """
    folder = Path(folder)
    if f".{format}" not in _WRITERS:
        raise ValueError(f"unknown frame format {format!r}; expected ply, obj or npz")
    if folder.exists():
        other = [entry.name for entry in folder.iterdir() if not _FRAME_NAME.fullmatch(entry.name)]
        if other:
            raise ValueError(f"{folder}: contains {other[0]!r}, which is not a frame; use an empty folder")
    with atomic.replace_folder(folder) as temporary:
        for t, frame in enumerate(np.asarray(vertices)):
            write(temporary / f"{t + 1:06d}.{format}", frame, faces)


def _read_obj(path: Path) -> tuple[np.ndarray, np.ndarray]:
    if (size := path.stat().st_size) > _MAX_OBJ_BYTES:
        raise ValueError(f"{size} bytes of text; at most {_MAX_OBJ_BYTES} are read: save it as binary PLY")
    vertices, faces = array.array("d"), array.array("q")  # lists would take six times as much memory
    for number, line in _lines(path):
        kind, *rest = line.split(maxsplit=1)[:2] or [""]
        if kind not in ("v", "f") or not rest:
            continue
        fields = rest[0].split("#")[0].split()
        try:
            if kind == "v":
                x, y, z = fields[:3]
                vertices.extend((float(x), float(y), float(z)))
                continue
            corner = [int(field.split("/")[0]) for field in fields]
        except ValueError:
            raise ValueError(f"line {number}: cannot be parsed: {line[:60]!r}") from None
        if len(corner) < 3 or 0 in corner:
            raise ValueError(f"line {number}: expected 3 or more corners, counted from 1: {line[:60]!r}")
        # Negative indices count back from the last vertex.
        corner = [i - 1 if i > 0 else len(vertices) // 3 + i for i in corner]
        if max(map(abs, corner)) > ply.MAX_ROWS or len(vertices) + len(faces) > 3 * ply.MAX_ROWS - 3 * len(corner):
            raise ValueError(f"line {number}: more than {ply.MAX_ROWS} vertices or triangles")
        for i in range(1, len(corner) - 1):
            faces.extend((corner[0], corner[i], corner[i + 1]))
    return np.frombuffer(vertices, np.float64).reshape(-1, 3), np.frombuffer(faces, np.int64).reshape(-1, 3)


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """Yield numbered lines; one that ends in a backslash is joined with the next."""
    with path.open(encoding="utf-8", errors="replace") as stream:
        begun, number = "", 0
        for number, line in enumerate(iter(lambda: stream.readline(_MAX_LINE_CHARS + 1), ""), 1):
            if len(line) > _MAX_LINE_CHARS or len(begun) > _MAX_LINE_CHARS:
                raise ValueError(f"line {number}: more than {_MAX_LINE_CHARS} characters")
            if line.endswith("\\\n"):
                begun += line[:-2] + " "
                continue
            yield number, begun + line.rstrip("\n")
            begun = ""
        if begun:
            yield number, begun


def _read_npz(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    found = npz.read_npz(path, ("vertices", "faces"))
    return found["vertices"], found.get("faces")


def _read_npy(path: Path) -> tuple[np.ndarray, None]:
    return npz.read_npy(path), None


def _as_mesh_error(path: Path, reader: Callable[[Path, _Wanted], _Found], wanted: _Wanted) -> _Found:
    try:
        return reader(path, wanted)
    except FileNotFoundError:
        raise MeshError(f"{path}: no such file") from None
    except (OSError, *DAMAGE_ERRORS) as error:
        raise MeshError(f"{path}: {error}") from error


def _checked(path: Path, vertices: np.ndarray, faces: np.ndarray | None) -> Mesh:
    if vertices.dtype.kind not in "fiu":
        raise MeshError(f"{path}: vertices must be real numbers, got {vertices.dtype}")
    with np.errstate(invalid="ignore"):  # values that are not finite are rejected below
        vertices = vertices.astype(np.float64)
    if vertices.ndim != 2 or vertices.shape[1] != 3:
        raise MeshError(f"{path}: vertices must be (N, 3), got {vertices.shape}")
    if not len(vertices):
        raise MeshError(f"{path}: contains no vertices")
    if not np.isfinite(vertices).all():  # the check by row, as below, would take ten times as long
        bad = np.flatnonzero(~np.isfinite(vertices).all(1))
        raise MeshError(f"{path}: vertex {bad[0]} is not finite: {vertices[bad[0]].tolist()} ({len(bad)} in all)")
    if faces is None or not np.size(faces):
        return Mesh(vertices, None)
    if faces.ndim != 2 or faces.shape[1] != 3 or faces.dtype.kind not in "iu":
        raise MeshError(f"{path}: faces must be (F, 3) integers, got {faces.shape} {faces.dtype}")
    if faces.min() < 0 or faces.max() >= len(vertices):
        bad = np.flatnonzero(((faces < 0) | (faces >= len(vertices))).any(1))
        raise MeshError(f"{path}: triangle {bad[0]} is {faces[bad[0]].tolist()}; vertices are 0..{len(vertices) - 1}")
    return Mesh(vertices, faces.astype(np.int32))


def _write_obj(path: Path, vertices: np.ndarray, faces: np.ndarray) -> None:
    digits = 9 if vertices.dtype == np.float32 else 17
    with path.open("w", encoding="ascii", newline="\n") as stream:
        np.savetxt(stream, vertices, f"v %.{digits}g %.{digits}g %.{digits}g")
        np.savetxt(stream, faces + 1, "f %d %d %d")


def _write_npz(path: Path, vertices: np.ndarray, faces: np.ndarray) -> None:
    np.savez(path, vertices=vertices, faces=faces)


_READERS: dict[str, Callable[[Path], tuple[np.ndarray, np.ndarray | None]]] = {
    ".ply": ply.read, ".obj": _read_obj, ".glb": glb_reader.read, ".npz": _read_npz, ".npy": _read_npy,
}  # fmt: skip
_WRITERS = {".ply": ply.write, ".obj": _write_obj, ".npz": _write_npz}
