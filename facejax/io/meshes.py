"""Triangle meshes in PLY, OBJ, GLB, NPZ and NPY files.

Vertex order is kept exactly; polygons are cut into fans; everything but positions and faces is ignored. A
file is a claim to be checked: counts are held against the bytes that are there before memory is taken, and
nothing is unpickled.
"""

import array
import os
import re
import shutil
import tempfile
from pathlib import Path
from typing import NamedTuple

import numpy as np

from facejax.io import atomic, glb_reader, npz, ply
from facejax.io.npz import DAMAGE_ERRORS, MAX_BYTES

_TEXT_LIMIT = 2**26  # bytes of an OBJ
_LINE_LIMIT = 2**20
_FRAME = re.compile(r"\d{6,}\.(ply|obj|npz)")


class MeshError(atomic.FileError):
    """A mesh file cannot be used; the message names the file, what is wrong and where."""


class Mesh(NamedTuple):
    """vertices: (N, 3) float64, in the file's unit. faces: (F, 3) int32, or None."""

    vertices: np.ndarray
    faces: np.ndarray | None


def read(path: str | os.PathLike) -> Mesh:
    """Reads a mesh by the file's suffix: .ply, .obj, .glb, .npz (`vertices`, optional `faces`) or .npy (vertices).

    Of a .glb, which counts in metres, the largest mesh is taken, at rest: see `facejax.io.glb`.

    Raises:
      MeshError: the file is missing, unreadable, cut short, empty or not a mesh; a vertex is not finite; a
      face names
        a vertex that is not there.
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


def read_animation(path: str | os.PathLike, *, bare: bool = False) -> tuple[np.ndarray, np.ndarray | None, dict]:
    """Reads an NPZ of `vertices` (T, N, 3) or (N, 3) and `faces`; and what else it holds of `landmarks` and `fps`.

    `bare`: it may lack faces, which are None then. Frames after the first are not looked at.

    Raises:
      MeshError: as `read`.
    """
    path = Path(path)
    found = _told(path, npz.read_npz, ("vertices", "faces", "landmarks", "fps"))
    vertices, faces = found.pop("vertices"), found.pop("faces", None)
    if faces is None and not bare:
        raise MeshError(f"{path}: has no triangles, nothing to show")
    if vertices.ndim not in (2, 3) or 0 in vertices.shape:
        raise MeshError(f"{path}: vertices must be (T, N, 3) or (N, 3), got {vertices.shape}")
    first = _checked(path, vertices if vertices.ndim == 2 else vertices[0], faces)
    extra = {"landmarks": found["landmarks"]} if "landmarks" in found else {}
    if "fps" in found:
        if found["fps"].size != 1 or found["fps"].dtype.kind not in "fiu":
            raise MeshError(f"{path}: fps must be one number, got {found['fps'].shape} {found['fps'].dtype}")
        extra["fps"] = float(found["fps"].item())
    return vertices, first.faces if bare else faces.astype(np.int32), extra


def count_frames(path: str | os.PathLike) -> int:
    """How many frames an NPZ of `vertices` (T, N, 3) holds; its numbers are not read.

    Raises:
      MeshError: as `read_animation`, or other `vertices`.
    """
    shape = _told(Path(path), npz.npz_shape, "vertices")
    if len(shape) != 3 or 0 in shape or shape[2] != 3:
        raise MeshError(f"{path}: vertices must be (T, N, 3), got {shape}")
    return shape[0]


def write(path: str | os.PathLike, vertices, faces=None) -> None:
    """Writes a mesh by suffix (.ply binary, .obj text, .npz), atomically; numbers come back bit for bit.

    Args:
      vertices: (N, 3).
      faces: (F, 3) int, or None.
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


def write_sequence(folder: str | os.PathLike, vertices, faces, *, format="ply") -> None:
    """Writes frames 000001.ply, 000002.ply, ... of vertices (T, N, 3) as a folder, which appears whole.

    Frames of an earlier run are replaced.

    Raises:
      ValueError: the folder holds anything but frames.
    """
    folder = Path(folder)
    if f".{format}" not in _WRITERS:
        raise ValueError(f"unknown frame format {format!r}; expected ply, obj or npz")
    if folder.exists():
        other = [entry.name for entry in folder.iterdir() if not _FRAME.fullmatch(entry.name)]
        if other:
            raise ValueError(f"{folder}: holds {other[0]!r}, which is no frame; name an empty folder")
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{folder.name}-", dir=folder.parent) as temporary:
        fresh = Path(temporary) / "frames"
        fresh.mkdir()
        for t, frame in enumerate(np.asarray(vertices)):
            write(fresh / f"{t + 1:06d}.{format}", frame, faces)
        if folder.exists():
            shutil.rmtree(folder)
        os.replace(fresh, folder)


def _read_obj(path: Path):
    if (size := path.stat().st_size) > _TEXT_LIMIT:
        raise ValueError(f"{size} bytes of text; at most {_TEXT_LIMIT} are read: save it as binary PLY")
    vertices, faces = array.array("d"), array.array("q")  # a list would take six times as much
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
            raise ValueError(f"line {number}: cannot be understood: {line[:60]!r}") from None
        if len(corner) < 3 or 0 in corner:
            raise ValueError(f"line {number}: expected 3 or more corners from 1 on: {line[:60]!r}")
        # Negative numbers count back from the latest vertex.
        corner = [i - 1 if i > 0 else len(vertices) // 3 + i for i in corner]
        if max(map(abs, corner)) > ply.MAX_ROWS or len(vertices) + len(faces) > 3 * ply.MAX_ROWS - 3 * len(corner):
            raise ValueError(f"line {number}: a vertex beyond {ply.MAX_ROWS}, or more triangles; that many are read")
        for i in range(1, len(corner) - 1):
            faces.extend((corner[0], corner[i], corner[i + 1]))
    return np.frombuffer(vertices, np.float64).reshape(-1, 3), np.frombuffer(faces, np.int64).reshape(-1, 3)


def _lines(path: Path):
    """Numbered lines, those that end in a backslash joined with the next."""
    with path.open(encoding="utf-8", errors="replace") as stream:
        begun = ""
        for number, line in enumerate(iter(lambda: stream.readline(_LINE_LIMIT + 1), ""), 1):
            if len(line) > _LINE_LIMIT or len(begun) > _LINE_LIMIT:
                raise ValueError(f"line {number}: more than {_LINE_LIMIT} characters")
            if line.endswith("\\\n"):
                begun += line[:-2] + " "
                continue
            yield number, begun + line.rstrip("\n")
            begun = ""
        if begun:
            yield number, begun


def _read_npz(path: Path):
    found = npz.read_npz(path, ("vertices", "faces"))
    return found.get("vertices"), found.get("faces")


def _read_npy(path: Path):
    return npz.read_npy(path), None


def _told(path: Path, reader, *options):
    try:
        return reader(path, *options)
    except FileNotFoundError:
        raise MeshError(f"{path}: no such file") from None
    except (OSError, *DAMAGE_ERRORS) as error:
        raise MeshError(f"{path}: {error}") from error


def _checked(path: Path, vertices, faces) -> Mesh:
    vertices = np.asarray(vertices)
    if vertices.dtype.kind not in "fiu":
        raise MeshError(f"{path}: vertices must be real numbers, got {vertices.dtype}")
    with np.errstate(invalid="ignore"):  # of numbers that are none: refused below
        vertices = vertices.astype(np.float64)
    if vertices.ndim != 2 or vertices.shape[1] != 3:
        raise MeshError(f"{path}: vertices must be (N, 3), got {vertices.shape}")
    if not len(vertices):
        raise MeshError(f"{path}: holds no vertices")
    if not np.isfinite(vertices).all():  # row by row, as below, would take ten times as long
        bad = np.flatnonzero(~np.isfinite(vertices).all(1))
        raise MeshError(f"{path}: vertex {bad[0]} is not finite: {vertices[bad[0]].tolist()} ({len(bad)} in all)")
    if faces is None or not np.size(faces):
        return Mesh(vertices, None)
    faces = np.asarray(faces)
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


_READERS = {".ply": ply.read, ".obj": _read_obj, ".glb": glb_reader.read, ".npz": _read_npz, ".npy": _read_npy}
_WRITERS = {".ply": ply.write, ".obj": _write_obj, ".npz": _write_npz}
