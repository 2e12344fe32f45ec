"""What a dozen commands write, as digests: proof that a change of structure changes no behaviour.

    python -m tests.digests --record    # writes tests/digests.json
    python -m tests.digests             # runs the commands again, and compares; exit code 1 where something differs

Only the command line is used, and only files are read, so the script survives any renaming inside the package. Every
array of a result is recorded by its shape, by the SHA-256 of its values rounded to 1e-6, and by four projections onto
fixed random vectors: where only the digest differs, the projections tell how large the difference is.
Some ten minutes on 2 cores.
"""

import argparse
import csv
import hashlib
import io
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

RECORD = Path(__file__).with_name("digests.json")
DECIMALS = 6
LIVE_LINK = [
    "EyeBlink",
    "EyeLookDown",
    "EyeLookIn",
    "EyeLookOut",
    "EyeLookUp",
    "EyeSquint",
    "EyeWide",
    "MouthSmile",
    "MouthFrown",
    "MouthDimple",
    "MouthStretch",
    "MouthPress",
    "MouthLowerDown",
    "MouthUpperUp",
    "BrowDown",
    "BrowOuterUp",
    "CheekSquint",
    "NoseSneer",
    "Jaw",
    "Mouth",
]
SINGLE = [
    "JawForward",
    "JawOpen",
    "MouthClose",
    "MouthFunnel",
    "MouthPucker",
    "MouthRollLower",
    "MouthRollUpper",
    "MouthShrugLower",
    "MouthShrugUpper",
    "BrowInnerUp",
    "CheekPuff",
    "TongueOut",
]
ANGLES = ("Yaw", "Pitch", "Roll")
POSE = [f"{part}{angle}" for part in ("Head", "LeftEye", "RightEye") for angle in ANGLES]

# Name of the result folder -> the command; `{NAME}` is an earlier command's folder, `{in}` the folder of inputs.
COMMANDS = {
    "labels": "labels",
    "faces": "data makehuman --sample {out} --count 7",
    "smile": "generate --end high_smile --formats glb npz ply obj --out {out}",
    "chain": "generate --end high_smile --then mouth_open --then neutral --samples 2 --seed 3 --formats npz"
    " --out {out}",
    "natural": "generate --end anger --then mouth_side --frames natural --seed 11 --formats npz --out {out}",
    "person": "generate --end surprise --face {faces}/S101.ply --intensity 1.3 --formats npz --out {out}",
    "network": "animate --expression surprise --formats npz glb --out {out}",
    "mesh": "animate --mesh {in}/head.obj --landmarks {in}/marks_cm.json --end anger --formats npz --out {out}",
    "recording": "animate --livelink {in}/take.csv --seconds 2 --person 101 --formats npz --out {out}",
    "driven": "animate --livelink {in}/take.csv --seconds 1 --mesh {in}/head.obj --landmarks {in}/marks_cm.json"
    " --kernel gaussian --sigma 2 --smoothing 0.01 --formats npz --out {out}",
    "register": "register {in}/scan.ply --landmarks {in}/seven.json --out {out}",
    "scanned": "generate --face {in}/scan.ply --landmarks {in}/seven.json --end high_smile --formats npz --out {out}",
    "corpus": "generate --count 12 --people 3 --meshes --shard 6 --seed 5 --out {out}",
    "prepare": "data prepare folder --root {in}/recordings --landmarks {in}/marks.json --meshes 200 --out {out}",
    "livelink": "data prepare livelink --root {in}/livelink --actors 6 --meshes 60 --out {out}",
    "fit": "fit --data {prepare} --out {out}/models.safetensors --quick",
    "own": "generate --model {fit}/models.safetensors --end grin --formats npz --out {out}",
    "makehuman": "data makehuman --level 1 --out {out}",
}
PEOPLE = 7
GLB_DTYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
GLB_NUMBERS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
ROUNDING = 1e-8  # of an array's norm, a tenth of float32's unit roundoff: the last digit of some values differs
RECORDINGS = {"grin": "high_smile", "gape": "mouth_open", "frown": "anger"}


def run(arguments: list[str]) -> str:
    """The standard output of a command in a process of its own."""
    done = subprocess.run(
        [str(Path(sys.executable).with_name("facejax")), *arguments],
        capture_output=True,
        text=True,
        env=dict(os.environ),
    )
    if done.returncode:
        raise SystemExit(f"facejax {' '.join(arguments)}: exit code {done.returncode}\n{done.stderr}")
    return done.stdout


def write_inputs(folder: Path, faces: Path) -> None:
    """A recording, a scan with seven landmarks, a head with 68, and recordings of seven people as meshes."""
    folder.mkdir()
    _write_take(folder / "take.csv", 90)
    (folder / "livelink" / "actor").mkdir(parents=True)
    for i, name in enumerate(("smile", "talk", "blink")):
        _write_take(folder / "livelink" / "actor" / f"{name}.csv", 40, seed=i)
    run(["generate", "--end", "high_smile", "--face", f"{faces}/S102.ply", "--formats", "npz", "--out", str(folder)])
    (made,) = [path for path in folder.glob("*.npz") if "vertices" in np.load(path)]
    head = dict(np.load(made))
    with np.load(_landmark_file(folder)) as found:
        marks = found["landmarks"].reshape(-1, found["landmarks"].shape[-2], 3)[0]
    (folder / "marks.json").write_text(json.dumps({"points": marks.tolist()}))
    _write_obj(folder / "head.obj", head["vertices"][0] * 0.1, head["faces"])
    (folder / "marks_cm.json").write_text(json.dumps({"points": (marks * 0.1).tolist()}))
    # A scan: the same head finer (every triangle in four), turned, moved, and in metres.
    vertices, triangles = _subdivide(head["vertices"][0].astype(np.float64), head["faces"])
    turn = np.array([[0.8, 0.0, 0.6], [0.0, 1.0, 0.0], [-0.6, 0.0, 0.8]])
    place = lambda x: (x @ turn.T + [30.0, -20.0, 500.0]) / 1000  # noqa: E731
    _write_obj(folder / "scan.obj", place(vertices), triangles)
    (folder / "scan.ply").write_bytes(_ply(place(vertices), triangles))
    seven = [36, 39, 42, 45, 30, 48, 54]
    (folder / "seven.json").write_text(json.dumps({"points": place(marks[seven].astype(np.float64)).tolist()}))
    for person in range(PEOPLE):
        for label, end in RECORDINGS.items():
            target = folder / "recordings" / f"p{person}"
            out = folder / "made" / f"p{person}-{label}"
            face = str(faces / f"S{100 + person}.ply")
            run(
                ["generate", "--end", end, "--then", "neutral", "--face", face, "--seed", str(person)]
                + ["--frames", "12", "--formats", "npz", "--out", str(out)]
            )
            (made,) = [path for path in out.glob("*.npz") if "vertices" in np.load(path)]
            target.mkdir(parents=True, exist_ok=True)
            made.rename(target / f"{label}_1.npz")


def digests(folder: Path) -> dict[str, dict]:
    """Relative path of a file, or of an array in it -> what is recorded."""
    found = {}
    for path in sorted(p for p in folder.rglob("*") if p.is_file() and ".training" not in str(p.relative_to(folder))):
        name = str(path.relative_to(folder))
        if path.suffix == ".npz":
            with np.load(path) as arrays:
                found |= {f"{name}:{key}": of_array(arrays[key]) for key in sorted(arrays)}
        elif path.suffix == ".npy":
            found[name] = of_array(np.load(path))
        elif path.suffix == ".safetensors":
            from safetensors.numpy import load_file

            found |= {f"{name}:{key}": of_array(value) for key, value in sorted(load_file(path).items())}
        elif path.suffix in (".ply", ".glb"):
            found[name] = of_array(_numbers(path))
        elif path.suffix == ".obj":
            rows = [line.split()[1:] for line in path.read_text().splitlines() if line.startswith("v ")]
            found[name] = of_array(np.array(rows, np.float64))
        else:  # words and pictures may change
            found[name] = {"file": True}
    return found


def of_array(values: np.ndarray) -> dict:
    """Shape, digest of the rounded values, and four projections."""
    record = {"shape": list(values.shape), "kind": values.dtype.kind}
    if values.dtype.kind not in "fiub":
        return record | {"sha256": hashlib.sha256("\n".join(map(str, values.ravel())).encode()).hexdigest()}
    flat = values.astype(np.float64).ravel()
    rounded = np.round(flat, DECIMALS) + 0.0  # no negative zeros
    record["sha256"] = hashlib.sha256(rounded.tobytes()).hexdigest()
    rng = np.random.default_rng(0)
    record["norm"] = float(np.linalg.norm(flat))
    record["projections"] = [float(flat @ rng.normal(size=flat.size)) for _ in range(4)] if flat.size else []
    return record


def compare(before: dict, now: dict) -> tuple[list[str], list[str]]:
    """Names that agree up to rounding only, and a line for each entry that is missing, new or different.

    The projections say by how much.
    """
    lines, rounded = [], []
    for name in sorted(before.keys() | now.keys()):
        if name not in before or name not in now:
            lines.append(f"{name}: only {'now' if name in now else 'before'}")
        elif before[name] != now[name]:
            a, b = before[name], now[name]
            if a.get("sha256") == b.get("sha256") and a["shape"] == b["shape"]:
                continue
            if a.get("shape") != b.get("shape") or "projections" not in a:
                lines.append(f"{name}: {a.get('shape')} before, {b.get('shape')} now, or other words")
                continue
            gap = np.max(np.abs(np.subtract(a["projections"], b["projections"])))
            share = gap / max(a["norm"], 1e-30)
            if share <= ROUNDING:
                rounded.append(name)
            else:
                lines.append(f"{name}: differs by about {gap:.2g} in all, {share:.2g} of its norm")
    return rounded, lines


def _write_take(path: Path, frames: int, seed: int = 0) -> None:
    """A recording in the columns of Live Link Face: a smile, an opening jaw, blinks; 60 a second."""
    names = SINGLE + [f"{part}{side}" for part in LIVE_LINK for side in ("Left", "Right")]
    t = np.arange(frames) / frames
    values = {name: np.zeros(frames) for name in names}
    bump = np.sin(np.pi * t) ** 2
    values["MouthSmileLeft"], values["MouthSmileRight"] = 0.8 * bump, 0.7 * bump
    values["JawOpen"] = 0.4 * bump * (1 + np.sin(6 * t + seed)) / 2
    values["EyeBlinkLeft"] = values["EyeBlinkRight"] = np.exp(-((t - 0.5) ** 2) / 0.002)
    values["BrowInnerUp"] = 0.1 + 0.3 * bump * (seed + 1) / 3
    with io.StringIO(newline="") as text:
        rows = csv.writer(text, lineterminator="\n")
        rows.writerow(["Timecode", "BlendShapeCount", *names, *POSE])
        for i in range(frames):
            clock = f"10:00:{i // 60:02}:{i % 60:02}.000"
            rows.writerow([clock, 61, *(f"{values[name][i]:.10f}" for name in names), *["0.0"] * len(POSE)])
        path.write_text(text.getvalue())


def _landmark_file(folder: Path) -> Path:
    (path,) = [p for p in folder.glob("*.npz") if "landmarks" in np.load(p) and "vertices" not in np.load(p)]
    return path


def _write_obj(path: Path, vertices: np.ndarray, faces: np.ndarray) -> None:
    lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in vertices] + [f"f {a} {b} {c}" for a, b, c in faces + 1]
    path.write_text("\n".join(lines) + "\n")


def _ply(vertices: np.ndarray, faces: np.ndarray) -> bytes:
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\n"
    head += "property double x\nproperty double y\nproperty double z\n"
    head += f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    rows = np.zeros(len(faces), [("n", "u1"), ("v", "<i4", 3)])
    rows["n"], rows["v"] = 3, faces
    return head.encode() + vertices.astype("<f8").tobytes() + rows.tobytes()


def _subdivide(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    unique, number = np.unique(edges, axis=0, return_inverse=True)
    ab, bc, ca = (number.reshape(3, -1) + len(vertices)).astype(faces.dtype)
    a, b, c = faces.T
    parts = [[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]
    return np.concatenate([vertices, vertices[unique].mean(axis=1)]), np.concatenate([np.stack(p, 1) for p in parts])


def _numbers(path: Path) -> np.ndarray:
    """The numbers in a binary file: of a PLY the vertices and the triangles, of a GLB all accessors, in order."""
    data = path.read_bytes()
    if path.suffix == ".ply":
        head, body = data.split(b"end_header\n", 1)
        count = int(head.split(b"element vertex ")[1].split()[0])
        vertices = np.frombuffer(body, "<f4", 3 * count)
        rows = np.frombuffer(body[12 * count :], [("n", "u1"), ("v", "<i4", 3)])
        return np.concatenate([vertices, rows["v"].ravel()], dtype=np.float64)
    first = int.from_bytes(data[12:16], "little")
    described, binary = json.loads(data[20 : 20 + first]), data[20 + first + 8 :]
    parts = []
    for accessor in described["accessors"]:
        if "bufferView" in accessor:
            view = described["bufferViews"][accessor["bufferView"]]
            start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
            count = accessor["count"] * GLB_NUMBERS[accessor["type"]]
            parts.append(np.frombuffer(binary, GLB_DTYPES[accessor["componentType"]], count, start))
    return np.concatenate(parts, dtype=np.float64)


def main() -> None:
    """Run all commands, then record or compare."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--record", action="store_true")
    parser.add_argument("--only", nargs="+", default=list(COMMANDS), choices=list(COMMANDS))
    chosen = parser.parse_args()
    found: dict[str, dict] = {}
    with tempfile.TemporaryDirectory() as temporary:
        places = {"in": Path(temporary) / "in"} | {name: Path(temporary) / name for name in COMMANDS}
        for name, command in COMMANDS.items():
            needed = name in chosen.only or name in ("faces", "prepare", "fit")
            if not needed:
                continue
            if name not in ("labels", "faces") and not places["in"].exists():
                write_inputs(places["in"], places["faces"])
            words = command.format(out=places[name], **places).split()
            said = run(words)
            here = digests(places[name]) if places[name].exists() else {}
            if name == "labels":
                here["stdout"] = of_array(np.array(said.split()))
            found |= {f"{name}/{key}": value for key, value in here.items()}
            print(f"{name}: {len(here)} files and arrays", flush=True)
    if chosen.record:
        RECORD.write_text(json.dumps(found, indent=1) + "\n")
        return
    before = json.loads(RECORD.read_text())
    known = {key: value for key, value in before.items() if key.split("/")[0] in chosen.only}
    now = {key: value for key, value in found.items() if key.split("/")[0] in chosen.only}
    rounded, lines = compare(known, now)
    print("\n".join(lines))
    same = len(known.keys() | now.keys()) - len(rounded) - len(lines)
    print(f"of {len(known)} files and arrays {same} agree, {len(rounded)} up to rounding, {len(lines)} differ")
    raise SystemExit(bool(lines))


if __name__ == "__main__":
    main()
