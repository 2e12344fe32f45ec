"""Registered 4D meshes in folders: found, held against one another, and read one frame at a time.

    ROOT/SUBJECT/EXPRESSION/*.ply .obj .npy .npz   one mesh a frame, in natural order: frame2 before frame10
    ROOT/SUBJECT/EXPRESSION.npz                    or all frames: `vertices` (T, N, 3), and `faces` if there are any
    ROOT/SUBJECT/neutral.ply .obj .npy .npz        the face at rest; else the first frame of the first sequence

What else lies there is passed over. N vertices, F triangles."""

from __future__ import annotations

import dataclasses
import hashlib
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from facejax.io import meshes

SUFFIXES = (".ply", ".obj", ".npy", ".npz")
NEUTRAL = "neutral"
ALIKE = 3.0  # no mesh of a tree is so many times as large as another: faces are not, but other units are


class FolderError(ValueError):
    """A folder of meshes cannot be used; the message names the file or folder, what was expected and what is there."""


class Take(NamedTuple):
    """One recording."""

    subject: int
    label: str
    path: Path  # a folder, or an NPZ
    frames: tuple[Path, ...]  # of a folder


class Tree(NamedTuple):
    """What lies under a root, named but not read."""

    root: Path
    names: tuple[str, ...]  # of the subjects, sorted
    neutral: tuple[Path | None, ...]  # of each subject
    takes: tuple[Take, ...]  # sorted by subject and label
    stray: tuple[Path, ...]  # meshes in no place of the layout

    @property
    def labels(self) -> tuple[str, ...]:
        """The expressions, neutral first, the others sorted."""
        return (NEUTRAL, *sorted({take.label for take in self.takes}))

    def fingerprint(self) -> str:
        """SHA-256, in hexadecimal, of the sorted names and sizes of all files that are read."""
        found = [path for path in self.neutral if path] + [p for take in self.takes for p in take.frames or [take.path]]
        rows = sorted((path.relative_to(self.root).as_posix(), path.stat().st_size) for path in found)
        text = "".join(f"{name}\t{size}\n" for name, size in rows)
        return hashlib.sha256(text.encode("utf-8", "surrogateescape")).hexdigest()

    def notes(self) -> list[str]:
        """What was passed over, and who has no neutral mesh."""
        notes = []
        without = [name for name, path in zip(self.names, self.neutral, strict=True) if path is None]
        if without:
            notes.append(f"no neutral mesh, at rest in the first frame of the first sequence: {some(without)}")
        if self.stray:
            names = [path.relative_to(self.root).as_posix() for path in self.stray]
            notes.append(f"passed over, as meshes outside the folders of expressions: {some(names)}")
        return notes


@dataclasses.dataclass
class Common:
    """What all meshes of a tree share, as the first of them has it; the triangles as the first that has any."""

    name: str
    vertices: np.ndarray  # (N, 3)
    faces: np.ndarray | None = None  # (F, 3)
    faces_of: str = ""

    def check(self, name: str, mesh: meshes.Mesh) -> np.ndarray:
        """The vertices (N, 3) of a mesh. Raises `FolderError` where it is not like the others."""
        if len(mesh.vertices) != len(self.vertices):
            raise FolderError(
                f"{name}: {len(mesh.vertices)} vertices, expected {len(self.vertices)} as in {self.name}: "
                "meshes have to be registered"
            )
        if mesh.faces is not None:
            if self.faces is None:
                self.faces, self.faces_of = mesh.faces, name
            self._check_faces(name, mesh.faces)
        times = size(mesh.vertices) / size(self.vertices)
        if not 1 / ALIKE < times < ALIKE:
            raise FolderError(f"{name}: {times:.3g} times as large as {self.name}; expected one unit for all meshes")
        return mesh.vertices

    def _check_faces(self, name: str, faces: np.ndarray) -> None:
        if len(faces) != len(self.faces):
            raise FolderError(f"{name}: {len(faces)} triangles, expected {len(self.faces)} as in {self.faces_of}")
        other = np.flatnonzero((faces != self.faces).any(axis=1))
        if len(other):
            got, expected = (x[other[0]].tolist() for x in (faces, self.faces))
            raise FolderError(f"{name}: triangle {other[0]} is {got}, expected {expected} as in {self.faces_of}")


def scan(root: Path) -> Tree:
    """Find the meshes under a root, without reading them. Raises `FolderError`, naming the folder that is amiss."""
    if not root.is_dir():
        raise FolderError(f"{root}: {'not a folder' if root.exists() else 'no such folder'}")
    subjects = [path for path in _entries(root) if path.is_dir()]
    if not subjects:
        raise FolderError(f"{root}: holds no folders; expected SUBJECT/EXPRESSION/*.ply or SUBJECT/EXPRESSION.npz")
    neutral, takes, stray = [], [], []
    for index, folder in enumerate(subjects):
        own, there = {}, [p for p in _entries(folder) if p.is_dir() or p.suffix.lower() in SUFFIXES]
        rest = [path for path in there if not path.is_dir() and path.stem.lower() == NEUTRAL]
        if len(rest) > 1:
            raise FolderError(f"{folder}: {rest[0].name} and {rest[1].name}, expected one face at rest")
        neutral.append(rest[0] if rest else None)
        for path in there:
            if path in rest:
                continue
            if not path.is_dir() and path.suffix.lower() != ".npz":
                stray.append(path)
                continue
            take = Take(index, _label(path), path, _frames_of(path))
            if take.label in own:
                raise FolderError(f"{path}: the expression {take.label!r} is {own[take.label].path.name} already")
            own[take.label] = take
        if not own:
            raise FolderError(f"{folder}: holds no expressions; expected EXPRESSION/*.ply or EXPRESSION.npz")
        takes += [own[label] for label in sorted(own, key=natural)]
    return Tree(root, tuple(path.name for path in subjects), tuple(neutral), tuple(takes), tuple(stray))


def frames(take: Take, rate: float, which: Sequence[int] | None = None) -> Iterator[tuple[str, meshes.Mesh]]:
    """Each frame of a recording, or those of some numbers, with its name for errors; of a folder one at a time.

    Raises `FolderError` where a frame cannot be read or is not finite, or an NPZ says another `rate`.
    """
    if take.frames:
        for path in take.frames if which is None else [take.frames[i] for i in which]:
            yield str(path), _read(meshes.read, path)
        return
    vertices, faces, extra = _read(meshes.read_animation, take.path, bare=True)
    if vertices.ndim != 3:
        raise FolderError(f"{take.path}: vertices must be (T, N, 3), got {vertices.shape}")
    if not abs(extra.get("fps", rate) - rate) <= 1e-3 * rate:
        raise FolderError(f"{take.path}: fps is {extra['fps']:g}, expected {rate:g}: one rate for all")
    for i in range(len(vertices)) if which is None else which:
        bad = np.flatnonzero(~np.isfinite(vertices[i]).all(axis=1))
        if len(bad):
            raise FolderError(f"{take.path}: frame {i}: vertex {bad[0]} is not finite: {vertices[i, bad[0]].tolist()}")
        yield f"{take.path}: frame {i}", meshes.Mesh(vertices[i].astype(np.float64), faces)


def neutral(tree: Tree, subject: int, rate: float) -> tuple[str, meshes.Mesh]:
    """A subject's mesh at rest, and its name for errors."""
    path = tree.neutral[subject]
    if path is not None:
        return str(path), _read(meshes.read, path)
    return next(frames(next(take for take in tree.takes if take.subject == subject), rate, [0]))


def common(tree: Tree, rate: float) -> Common:
    """What the meshes share, as the first subject at rest has it, and the first triangles there are.

    Raises `FolderError` where no mesh has any, or one of those before differs.
    """
    name, mesh = neutral(tree, 0, rate)
    if size(mesh.vertices) == 0:
        raise FolderError(f"{name}: all vertices lie at one point")
    found = Common(name, mesh.vertices)
    found.check(name, mesh)
    rests = (neutral(tree, subject, rate) for subject in range(1, len(tree.names)))
    for meshes_ in (rests, *(frames(take, rate) for take in tree.takes)):
        while found.faces is None and (following := next(meshes_, None)):
            found.check(*following)
    if found.faces is None:
        raise FolderError(f"{tree.root}: no mesh has triangles; expected them in one file at least")
    return found


def size(vertices: np.ndarray) -> float:
    """The longest side of the box around vertices (N, 3)."""
    return float(np.ptp(vertices, axis=0).max())


def natural(name: str) -> tuple:
    """A key that sorts numbers in names by their value, and letters without regard to case."""
    parts = re.split(r"(\d+)", name.lower())
    # Numbers stand at odd places. The name itself decides between "a1" and "a01".
    return tuple(int(part) if i % 2 else part for i, part in enumerate(parts)), name


def some(names: Sequence[str]) -> str:
    """Three names, and how many more there are."""
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")


def _read(reader, path: Path, **options):
    try:
        return reader(path, **options)
    except meshes.MeshError as error:
        raise FolderError(str(error)) from error


def _entries(folder: Path) -> list[Path]:
    try:
        return sorted((p for p in folder.iterdir() if not p.name.startswith(".")), key=lambda p: natural(p.name))
    except OSError as error:
        raise FolderError(f"{folder}: cannot be read: {error.strerror or error}") from error


def _frames_of(path: Path) -> tuple[Path, ...]:
    """The frames in a folder; none of an NPZ."""
    if not path.is_dir():
        return ()
    found = tuple(p for p in _entries(path) if p.is_file() and p.suffix.lower() in SUFFIXES)
    kinds = sorted({p.suffix.lower() for p in found})
    if not found:
        raise FolderError(f"{path}: holds no frames; expected {', '.join(SUFFIXES)}")
    if len(kinds) > 1:  # most likely every frame twice
        raise FolderError(f"{path}: frames in {' and '.join(kinds)}, expected one format")
    return found


def _label(path: Path) -> str:
    label = re.sub(r"[\s-]", "_", path.name if path.is_dir() else path.stem).lower()
    if label == NEUTRAL:
        raise FolderError(f"{path}: the face at rest is one mesh, {NEUTRAL}.ply say; give a recording another name")
    if ">" in label:  # the mark of a direct transition in a store
        raise FolderError(f"{path}: an expression's name cannot hold '>'")
    return label
