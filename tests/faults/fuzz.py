"""Damaged files for a reader: `python tests/faults/fuzz.py READER --files N --seed S` prints one JSON line.

Small valid files are mutated at random: bytes are flipped, cut, copied or blanked, numbers replaced by huge, negative
and invalid ones. In an NPZ the arrays are mutated and zipped again, so that checksums are valid. A reader may reject a
file with its documented error, or accept it; any other exception is a crash. Other files must not change.
"""

import argparse
import io
import json
import pickle
import random
import re
import sys
import tempfile
import time
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from facejax.models import bundle

NUMBERS = [b"0", b"-1", b"1e308", b"-1e-308", b"nan", b"inf", b"1000000000000", b"99999999999999999999999999", b"2.5"]
NUMBERS += [b"true", b"null", b"[]", b"{}", b'"a"', b"../../../etc/passwd", b"4294967295", b"2147483648", b""]
VERTICES = np.array([[0, 0, 0], [90, 0, 0], [0, 90, 0], [0, 0, 90], [60, 60, 60.0]])
FACES = np.array([[0, 1, 2], [0, 2, 3], [1, 2, 4]], np.int32)

BND = "\n".join(f"{7 * i % 5} {i * 1.5} {i % 7} {i % 5}" for i in range(83)).encode() + b"\n"


class Reader(NamedTuple):
    suffix: str
    files: list[bytes]
    read: Callable[[Path], object]  # also uses what it read
    errors: tuple[type[Exception], ...]


def mutated(rng: random.Random, data: bytes) -> bytes:
    """A few changes of bytes."""
    found = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 4, 16))):
        at = rng.randrange(len(found) + 1)
        kind = rng.randrange(8)
        if kind == 0 and found:
            found[min(at, len(found) - 1)] ^= 1 << rng.randrange(8)
        elif kind == 1:
            del found[at:]
        elif kind == 2:
            del found[at : at + rng.randrange(1, 64)]
        elif kind == 3:
            found[at:at] = found[at : at + rng.randrange(1, 256)]
        elif kind == 4:
            found[at:at] = rng.randbytes(rng.randrange(1, 16))
        elif kind == 5:
            width = rng.choice((1, 2, 4, 8))
            found[at : at + width] = rng.choice((b"\xff", b"\x00", b"\x7f", b"\x80")) * width
        elif kind == 6 and (places := list(re.finditer(rb"-?\d+(\.\d+)?", found))):
            place = rng.choice(places)
            found[place.start() : place.end()] = rng.choice(NUMBERS)
        elif places := list(re.finditer(rb"[A-Za-z_]{2,}", found)):
            one, other = rng.choice(places), rng.choice(places)
            found[one.start() : one.end()] = other.group()
    return bytes(found)


def mutated_zip(rng: random.Random, data: bytes) -> bytes:
    """The same for one member of an archive, or now and then for the archive itself."""
    if rng.random() < 0.2:
        return mutated(rng, data)
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name = rng.choice(list(members))
    members[name] = mutated(rng, members[name])
    if rng.random() < 0.1:
        members[rng.choice(("../escaped.npy", "/tmp/escaped.npy", "a/../../escaped.npy", name + "x"))] = members[name]
    if rng.random() < 0.05:
        del members[name]
    made = io.BytesIO()
    with warnings.catch_warnings(), zipfile.ZipFile(made, "w") as archive:
        warnings.simplefilter("ignore")
        for name, content in members.items():
            archive.writestr(name, content)
    return made.getvalue()


def npz(**fields) -> bytes:
    made = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of names in dtypes
        np.savez(made, **fields)
    return made.getvalue()


def npy(array) -> bytes:
    made = io.BytesIO()
    np.save(made, array, allow_pickle=True)
    return made.getvalue()


def written(write: Callable, suffix: str, *args, **options) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"file{suffix}"
        write(path, *args, **options)
        return path.read_bytes()


def ply(form: str) -> bytes:
    """With more elements and properties than are read."""
    head = (
        f"ply\nformat {form} 1.0\ncomment c\nelement vertex 5\nproperty float x\nproperty double y\nproperty float z\n"
    )
    head += "property uchar red\nelement face 3\nproperty list uchar int vertex_indices\nproperty short s\n"
    head += "element edge 1\nproperty int a\nend_header\n"
    if form == "ascii":
        rows = [f"{x} {y} {z} 9" for x, y, z in VERTICES] + [f"3 {a} {b} {c} 1" for a, b, c in FACES] + ["7"]
        return (head + "\n".join(rows) + "\n").encode()
    order = "<" if "little" in form else ">"
    points = np.zeros(5, [("x", f"{order}f4"), ("y", f"{order}f8"), ("z", f"{order}f4"), ("r", "u1")])
    points["x"], points["y"], points["z"] = VERTICES.T
    corners = np.zeros(3, [("n", "u1"), ("v", f"{order}i4", 3), ("s", f"{order}i2")])
    corners["n"], corners["v"] = 3, FACES
    return head.encode() + points.tobytes() + corners.tobytes() + np.array([7], f"{order}i4").tobytes()


OBJ = b"# c\no a\n" + b"".join(b"v %g %g %g\n" % tuple(row) for row in VERTICES) + b"vt 0 0\nvn 0 0 1\n"
OBJ += b"f 1/1/1 2/1/1 3/1/1\nf 1 3 4 5\nf -3 -2 -1\nusemtl m\n"


def readers() -> dict[str, Callable[[], Reader]]:
    """By name."""
    from facejax.data import corpora, dataset
    from facejax.data.importers import base, tables
    from facejax.inference import pipeline
    from facejax.io import landmarks, livelink, meshes, safe_pickle, weights

    def mesh(suffix: str, *contents: bytes) -> Reader:
        return Reader(suffix, list(contents), meshes.read, (meshes.MeshError,))

    def marks(suffix: str, *contents: bytes) -> Reader:
        def read(path: Path) -> object:
            return landmarks.read(path, VERTICES, FACES)

        return Reader(suffix, list(contents), read, (landmarks.LandmarkError,))

    def animation() -> Reader:
        data = npz(vertices=np.stack([VERTICES, VERTICES + 1]).astype("f4"), faces=FACES, fps=np.float64(30.0))
        return Reader(
            ".npz", [data], lambda path: (meshes.read_animation(path), meshes.count_frames(path)), (meshes.MeshError,)
        )

    def in_folder(name: str, others: dict[str, bytes], open_: Callable[[Path], object]) -> Callable[[Path], object]:
        def read(path: Path) -> object:
            with tempfile.TemporaryDirectory(dir=path.parent) as folder:
                for other, content in others.items():
                    (Path(folder) / other).parent.mkdir(parents=True, exist_ok=True)
                    (Path(folder) / other).write_bytes(content)
                (Path(folder) / name).write_bytes(path.read_bytes())
                return open_(Path(folder))

        return read

    def dataset_index() -> Reader:
        arrays = {"faces": FACES, "neutral": VERTICES[None].astype("f4"), "vertices": VERTICES[None].astype("f4")}
        arrays |= {"landmarks": VERTICES[None, :2].astype("f4"), "drawn": np.zeros(1, np.int64)}
        arrays["landmark_index"] = np.arange(2, dtype=np.int32)
        row = dataset.Sequence(0, "smile", 0, 1, 0, 0, 0, 0, 1.0, "a")._asdict()
        index = {"schema": 1, "name": "n", "labels": ["neutral", "smile"], "rate": 30.0, "spec": {}, "sequences": [row]}
        index |= {"shapes": {name: array.shape for name, array in arrays.items()}, "notes": []}
        index["subjects"] = [{"name": "A", "split": "train"}]

        def use(path: Path) -> object:
            found = dataset.open_dataset(path)
            return found.labels, found.people(), found.row_subjects(), found.row_labels(), found.meshes("train")

        whole = {f"{name}.npy": npy(array) for name, array in arrays.items()}
        return Reader(
            ".json", [json.dumps(index).encode()], in_folder("index.json", whole, use), (dataset.DatasetError,)
        )

    def corpus_index() -> Reader:
        data = npz(landmarks=np.zeros((2, 3, 5, 3), "f4"), labels=np.zeros((2, 2), "i4"), person=np.zeros(2, "i4"))
        shard = corpora.Shard("shards/000000.npz", 0, 2, len(data), "0" * 64)._asdict()
        index = {"schema": 1, "unit": "mm", "length": 3, "labels": ["neutral"], "people": ["A"], "shards": [shard]}
        index["request"] = {"count": 2, "meshes": False}

        def use(path: Path) -> object:
            found = corpora.load(path)
            return len(found), list(found)

        reader = in_folder("index.json", {"shards/000000.npz": data}, use)
        return Reader(".json", [json.dumps(index).encode()], reader, (corpora.CorpusError,))

    def released() -> Reader:
        tree = {"a": np.arange(6, dtype="f4"), "b": {"0": np.zeros((2, 3), "i4")}}
        data = written(weights.save, ".safetensors", tree, metadata={"labels": ["neutral"]})
        return Reader(".safetensors", [data], lambda path: weights.load(path, tree), (weights.WeightsError,))

    def models() -> Reader:
        """The header of the released models, over no numbers."""
        from importlib import resources

        data = resources.files("facejax.assets").joinpath(bundle.RELEASED).read_bytes()
        size = int.from_bytes(data[:8], "little")
        return Reader(".safetensors", [data[: 8 + size + 4096]], pipeline.load, (weights.WeightsError,))

    def csv() -> Reader:
        text = b"subject,recording,label\nA,one,smile\n# c\nB,two,frown\n"
        return Reader(
            ".csv", [text], lambda path: tables.read(path, ("subject", "recording", "label")), (base.SourceError,)
        )

    def recording() -> Reader:
        names = ",".join(["Timecode", "BlendShapeCount", *livelink.BLENDSHAPES, "HeadYaw", "HeadPitch", "HeadRoll"])
        names += "".join(f",{side}Eye{axis}" for side in ("Left", "Right") for axis in ("Yaw", "Pitch", "Roll"))
        rows = [
            f"13:02:{s:02d}:{f:02d}.000,61," + ",".join(f"{0.01 * i:.3f}" for i in range(61))
            for s in (1, 2)
            for f in range(3)
        ]
        return Reader(".csv", ["\n".join([names, *rows]).encode()], livelink.read, (livelink.RecordingError,))

    def pickled() -> Reader:
        data = {"a": VERTICES, "names": ["x", "y"], "deep": {1: (2, 3.5, None)}, "i": FACES, "s": np.float64(2.0)}
        return Reader(
            ".pkl", [pickle.dumps(data, protocol=p) for p in range(5)], safe_pickle.read, (safe_pickle.PickleError,)
        )

    glb = written(_write_glb, ".glb")
    static = {"lmk_face_idx": np.array([0, 1]), "lmk_b_coords": np.full((2, 3), 1 / 3)}
    pp = b'<!DOCTYPE PickedPoints>\n<PickedPoints>\n <point x="0" y="0" z="0" active="1" name="0"/>\n'
    pp += b' <point x="90" y="0" z="0" active="1" name="1"/>\n</PickedPoints>\n'
    indices, points = (
        json.dumps({"indices": [0, 2, 4]}).encode(),
        json.dumps({"points": VERTICES[:2].tolist()}).encode(),
    )
    on_faces = json.dumps({"faces": [0, 2], "weights": [[0.2, 0.3, 0.5], [1, 0, 0]]}).encode()
    return {
        "ply": lambda: mesh(".ply", *map(ply, ("ascii", "binary_little_endian", "binary_big_endian"))),
        "obj": lambda: mesh(".obj", OBJ),
        "glb": lambda: mesh(".glb", glb),
        "npz": lambda: mesh(".npz", npz(vertices=VERTICES, faces=FACES)),
        "npy": lambda: mesh(".npy", npy(VERTICES), npy(np.asfortranarray(VERTICES.astype(">f4")))),
        "animation": animation,
        "landmarks_json": lambda: marks(".json", indices, points, on_faces),
        "landmarks_pp": lambda: marks(".pp", pp),
        "landmarks_text": lambda: marks(".txt", b"0 0 0\n90 0 0\n0 90 0\n", b"0\n2\n4\n"),
        "landmarks_npz": lambda: marks(".npz", npz(**static)),
        "landmarks_pkl": lambda: marks(".pkl", pickle.dumps(static, protocol=2), pickle.dumps(static, protocol=4)),
        "landmarks_npy": lambda: marks(".npy", npy(np.array(static, dtype=object))),
        "pickle": pickled,
        "bnd": lambda: Reader(".bnd", [BND], landmarks.read, (landmarks.LandmarkError,)),
        "csv": csv,
        "livelink": recording,
        "safetensors": released,
        "models": models,
        "dataset": dataset_index,
        "corpus": corpus_index,
    }  # fmt: skip


def _write_glb(path: Path) -> None:
    from facejax import io as facejax_io

    facejax_io.save(path, VERTICES, FACES)


def run(name: str, count: int, seed: int) -> dict:
    """Count how often a reader accepted, rejected and crashed."""
    from tests.faults._record import peak_mb

    reader, rng = readers()[name](), random.Random(f"{name} {seed}")
    outcome = {"reader": name, "files": count, "taken": 0, "refused": 0, "crashed": [], "slowest_s": 0.0}
    with tempfile.TemporaryDirectory() as root:
        beside = Path(root) / "beside"
        beside.write_bytes(b"whole")
        folder = Path(root) / "in"
        folder.mkdir()
        path = folder / f"file{reader.suffix}"
        for content in reader.files:
            path.write_bytes(content)
            if name != "models":
                reader.read(path)
        for number in range(count):
            whole = rng.choice(reader.files)
            content = (mutated_zip if reader.suffix == ".npz" else mutated)(rng, whole)
            path.write_bytes(content)
            begun = time.perf_counter()
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("error")
                    reader.read(path)
                outcome["taken"] += 1
            except reader.errors as error:
                outcome["refused"] += 1
                if "\n" in str(error) or str(path.parent) not in str(error):
                    outcome["crashed"].append([number, f"does not name the file in one line: {error!r}"])
            except Exception as error:
                outcome["crashed"].append([number, repr(error)])
            outcome["slowest_s"] = max(outcome["slowest_s"], time.perf_counter() - begun)
            left = sorted(p.name for p in Path(root).rglob("*"))
            if left != ["beside", path.name, "in"] or beside.read_bytes() != b"whole":
                outcome["crashed"].append([number, f"left {left}"])
    outcome["peak_mb"] = peak_mb()
    return outcome


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("readers", nargs="*")
    parser.add_argument("--files", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    known = readers()
    for name in given.readers or known:
        print(json.dumps(run(name, given.files, given.seed)), flush=True)


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[2]))
    main()
