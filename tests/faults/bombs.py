"""Files made to exhaust memory: `python tests/faults/bombs.py BOMB FOLDER` reads one and prints the peak in MB.

A careless reader needs many times the file's size: texts of many numbers, polygons of many corners, lists of empty
lists, archives of empty members, headers that declare more data than the file contains.
"""

import json
import pickle
import struct
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

MEGABYTE = 1 << 20
PLY = "ply\nformat {form} 1.0\nelement vertex {n}\nproperty float x\nproperty float y\nproperty float z\n"
FACE = "element face {f}\nproperty list uchar {kind} vertex_indices\n"


class Bomb(NamedTuple):
    name: str  # of the file
    write: Callable[[Path], None]
    reader: str


def many(head: bytes, body: bytes, megabytes: int) -> Callable[[Path], None]:
    """A head, and a body again and again."""

    def write(path: Path) -> None:
        block = body * max(1, MEGABYTE // len(body))
        with path.open("wb") as file:
            file.write(head)
            for _ in range(megabytes):
                file.write(block)

    return write


def ply(form: str, body: bytes, megabytes: int, n: int, f: int, kind: str = "int") -> Callable[[Path], None]:
    head = PLY.format(form=form, n=n) + (FACE.format(f=f, kind=kind) if f else "") + "end_header\n"
    return many(head.encode(), body, megabytes)


def squeezed(path: Path) -> None:
    """An array of zeros of 2 GB in 2 MB."""
    with (
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive,
        archive.open("vertices.npy", "w", force_zip64=True) as file,
    ):
        np.lib.format.write_array_header_1_0(file, {"descr": "<f4", "fortran_order": False, "shape": (178956970, 3)})
        for _ in range(2048):
            file.write(bytes(MEGABYTE))


def members(path: Path) -> None:
    """An archive of a million members of no bytes, written by hand."""
    record = struct.pack("<4s6H3L5H2L", b"PK\1\2", 20, 20, 0, 0, 0, 0, 0, 0, 0, 4, 0, 0, 0, 0, 0, 0) + b"xxxx"
    count = 1_000_000
    with path.open("wb") as file:
        for _ in range(count // 1000):
            file.write(record * 1000)
        file.write(struct.pack("<4s4H2LH", b"PK\5\6", 0, 0, 65535, 65535, count * len(record), 0, 0))


def claims(path: Path) -> None:
    """An NPY that claims 8 TB, in a file without blocks of the same size."""
    with path.open("wb") as file:
        np.lib.format.write_array_header_1_0(file, {"descr": "<f8", "fortran_order": False, "shape": (10**12, 1)})
        file.truncate(file.tell() + 8 * 10**12)


def glb(path: Path) -> None:
    """An accessor of more values than any mesh has, of no bytes."""
    document = {"asset": {"version": "2.0"}, "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}]}
    document["accessors"] = [{"componentType": 5126, "count": 2**31 - 1, "type": "VEC3"}]
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    path.write_bytes(struct.pack("<4sIIII", b"glTF", 2, 20 + len(text), len(text), 0x4E4F534A) + text)


def nested(path: Path) -> None:
    path.write_bytes(b"[" * 1_000_000)


def long_array(path: Path) -> None:
    """Four numbers that claim to be two billion."""
    path.write_bytes(pickle.dumps(np.zeros(4), 2).replace(b"K\x04", b"J\0\0\0\x7f"))


BOMBS = {
    "claimed_rows": Bomb("a.ply", ply("binary_little_endian", bytes(12), 1, 10**12, 0), "mesh"),
    "claimed_faces": Bomb("a.ply", ply("binary_little_endian", bytes(12), 1, 4, 10**11), "mesh"),
    "text": Bomb("a.ply", ply("ascii", b"1 1 1\n", 250, 40_000_000, 0), "mesh"),
    "text_within_bounds": Bomb("a.ply", ply("ascii", b"1 1 1\n", 63, 5_000_000, 0), "mesh"),
    "corners": Bomb("a.ply", ply("binary_little_endian", b"\xff" + bytes(255), 250, 1, 10**6, "char"), "mesh"),
    "ragged": Bomb("a.ply", ply("binary_little_endian", b"\x03\0\0\0\x04\0\0\0\0", 250, 1, 5 * 10**7, "char"), "mesh"),
    "vertices": Bomb("a.ply", ply("binary_little_endian", bytes(12), 250, 2 * 10**7, 0), "mesh"),
    "obj_vertices": Bomb("a.obj", many(b"", b"v 0 0 0\n", 250), "mesh"),
    "obj_within_bounds": Bomb("a.obj", many(b"", b"v 0 0 0\n", 60), "mesh"),
    "obj_corners": Bomb("a.obj", many(b"v 0 0 0\nf", b" 1", 60), "mesh"),
    "obj_faces": Bomb("a.obj", many(b"v 0 0 0\n", b"f 1 1 1\n", 60), "mesh"),
    "deflated": Bomb("a.npz", squeezed, "mesh"),
    "members": Bomb("a.npz", members, "mesh"),
    "claimed_array": Bomb("a.npy", claims, "mesh"),
    "accessor": Bomb("a.glb", glb, "mesh"),
    "lists": Bomb("a.pkl", many(b"", b"]", 250), "pickle"),
    "lists_within_bounds": Bomb("a.pkl", many(b"", b"]", 7), "pickle"),
    "memo": Bomb("a.pkl", lambda path: path.write_bytes(b"\x80\x02]r\xff\xff\xff\x7f."), "pickle"),
    "bytes": Bomb("a.pkl", lambda path: path.write_bytes(b"\x80\x05\x96" + struct.pack("<Q", 2**40) + b"."), "pickle"),
    "array": Bomb("a.pkl", long_array, "pickle"),
    "lines": Bomb("a.csv", many(b"", b"\n", 180), "livelink"),
    "landmarks": Bomb("a.txt", many(b"", b"1\n", 250), "landmarks"),
    "nested_landmarks": Bomb("a.json", nested, "landmarks"),
    "nested_index": Bomb("index.json", nested, "dataset"),
    "index": Bomb("index.json", many(b"[", b"[],", 250), "dataset"),
    "index_within_bounds": Bomb("index.json", many(b"[", b"[],", 23), "dataset"),
    "corpus_index": Bomb("index.json", many(b"[", b"[],", 23), "corpus"),
    "tensors": Bomb("a.safetensors", lambda path: path.write_bytes(struct.pack("<Q", 2**40) + b"{}"), "weights"),
    "header": Bomb("a.safetensors", many(struct.pack("<Q", 90 * MEGABYTE), b"[", 90), "weights"),
}  # fmt: skip


def main() -> None:
    name, folder = sys.argv[1], Path(sys.argv[2])
    bomb = BOMBS[name]
    path = folder / bomb.name
    bomb.write(path)
    from facejax.data import corpora, dataset
    from facejax.io import landmarks, livelink, meshes, safe_pickle, weights
    from tests.faults._record import peak_mb

    readers = {
        "mesh": (meshes.read, meshes.MeshError), "pickle": (safe_pickle.read, safe_pickle.PickleError),
        "livelink": (livelink.read, livelink.RecordingError), "landmarks": (landmarks.read, landmarks.LandmarkError),
        "dataset": (lambda path: dataset.open_dataset(path.parent), dataset.DatasetError),
        "corpus": (lambda path: corpora.load(path.parent), corpora.CorpusError),
        "weights": (lambda path: weights.load(path, {}), weights.WeightsError),
    }  # fmt: skip
    read, error = readers[bomb.reader]
    try:
        read(path)
        said = "read"
    except error as refused:
        said = str(refused)
    print(json.dumps({"said": said, "peak_mb": peak_mb()}))


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[2]))
    main()
