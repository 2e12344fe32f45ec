"""A folder of static files: a page that generates new motions in the visitor's browser.

    web.export(models, "runs/web")

The folder holds the page, the functions "motion" and "decoder" as ONNX files, prepared faces, and ONNX Runtime for
browsers. Any static server serves it; the page asks no other server for anything. See docs/howto/web.md.

N vertices, L landmarks, E points of eyes and teeth; millimetres.
"""

from __future__ import annotations

import base64
import json
import os
import shutil
import subprocess
import tarfile
import tempfile
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from facejax.data.synthetic import assets, makehuman
from facejax.export import functions, manifest, onnx
from facejax.inference import pipeline
from facejax.inference.pipeline import Models
from facejax.io import atomic, cache
from facejax.models.motion import generators
from facejax.viz import eyes_teeth, html_viewer, render, scene

RUNTIME, RUNTIME_VERSION = "onnxruntime-web", "1.23.2"
RUNTIME_FILES = ("ort.wasm.min.mjs", "ort-wasm-simd-threaded.mjs", "ort-wasm-simd-threaded.wasm")
PAGE = ("index.html", "style.css", "app.js", "drawing.js", "generator.js", "motion.js", "worker.js")
PEOPLE = 3  # of the synthetic population, besides the average face
Neutral = Float[np.ndarray, "N 3"]


class RuntimeMissing(RuntimeError):
    """ONNX Runtime for browsers cannot be found or fetched."""


def export(
    models: Models,
    out: str | os.PathLike[str],
    *,
    faces: Mapping[str, Neutral] | None = None,
    runtime: str | os.PathLike[str] | None = None,
    command: str = "facejax export web",
) -> list[Path]:
    """Write the page to a folder, which is replaced at the end; return its files, the page first.

    Args:
      faces: neutral faces (N, 3) in mm by the names that the page shows; default: `default_faces`.
      runtime: a folder of `RUNTIME_FILES`, such as dist of the npm package onnxruntime-web; default: fetched by npm.

      command: how to write the export again, for the manifest.

    Raises:
      ValueError: a face in another topology, no face, or a folder that holds anything else than an export.
      RuntimeMissing: `runtime` lacks a file, or npm does not fetch the package.
      onnx.PackagesMissing: a package of `onnx.PACKAGES` is not installed.
    """
    onnx.require_packages()
    out = Path(os.path.abspath(out))
    manifest.check_folder(out)
    found = default_faces(models) if faces is None else dict(faces)
    if not found:
        raise ValueError("faces: expected one or more, got none")
    with jax.enable_x64(False), atomic.replace_folder(out) as folder:
        add_runtime(folder / "onnxruntime", runtime)
        for name in PAGE:
            source = resources.files("facejax.viz").joinpath("web", name)
            (folder / name).write_bytes(source.read_bytes())
        written = onnx.write(models, folder, ("motion", "decoder"))
        _write_model(models, found, folder)
        onnx.write_manifest(models, folder, written, format="web", command=command, runtime=RUNTIME_VERSION)
        names = sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())
    return [out / name for name in ("index.html", *(name for name in names if name != "index.html"))]


def default_faces(models: Models) -> dict[str, Neutral]:
    """Return the mean face of the models; and some people, if MakeHuman's assets are in the cache already."""
    found = {"Average": np.asarray(models.face.vertices, np.float32)}
    built = cache.folder() / f"makehuman-{assets.VERSION}-{assets.BUILD}.npz"
    if built.exists() and len(models.face.source_index) == len(models.face.vertices):
        people = [makehuman.subject(index).vertices for index in range(PEOPLE)]
        same = all(person.shape == found["Average"].shape for person in people)
        found |= {f"Person {i + 1}": person for i, person in enumerate(people)} if same else {}
    return found


def add_runtime(folder: Path, source: str | os.PathLike[str] | None = None) -> None:
    """Copy ONNX Runtime for browsers into a folder: from a folder, or from npm's package of `RUNTIME_VERSION`.

    Raises:
      RuntimeMissing: a file is missing, or npm does not fetch the package.
    """
    folder.mkdir(parents=True, exist_ok=True)
    if source is not None:
        for name in RUNTIME_FILES:
            if not (Path(source) / name).is_file():
                raise RuntimeMissing(f"{source}: {name} of {RUNTIME} {RUNTIME_VERSION} is missing")
            shutil.copyfile(Path(source) / name, folder / name)
        return
    package = f"{RUNTIME}@{RUNTIME_VERSION}"
    manual = f"run `npm pack {package}` elsewhere, unpack it, and give its folder package/dist as --runtime"
    npm = shutil.which("npm")
    if npm is None:
        raise RuntimeMissing(f"npm is not installed, which fetches {package}; {manual}")
    with tempfile.TemporaryDirectory() as temporary:
        command = [npm, "pack", package, "--pack-destination", temporary, "--ignore-scripts"]
        done = subprocess.run(command, cwd=temporary, capture_output=True, text=True, check=False)
        archives = list(Path(temporary).glob("*.tgz"))
        if done.returncode or not archives:
            lines = [line.strip() for line in done.stderr.splitlines() if line.strip()]
            reason = next((line for line in lines if "error" in line.lower()), lines[-1] if lines else "no output")
            raise RuntimeMissing(f"npm does not fetch {package} ({reason}); {manual}")
        with tarfile.open(archives[0]) as archive:
            for name in RUNTIME_FILES:
                stream = archive.extractfile(f"package/dist/{name}")
                assert stream is not None
                (folder / name).write_bytes(stream.read())


def _write_model(models: Models, faces: Mapping[str, Neutral], folder: Path) -> None:
    """Write model.json and the files of faces."""
    extras = [_extras(models, neutral) for neutral in faces.values()]
    jaw = _jaw(models)
    arrays: list[dict[str, Any]] = []
    rows: list[dict[str, Any]] = []
    for i, (name, neutral) in enumerate(faces.items()):
        prepared = functions.face_arrays(pipeline.prepare(models, np.asarray(neutral, np.float32)))
        points = [np.asarray(part.vertices, np.float32).reshape(-1, 3) for part in extras[i]]
        own = {key: np.asarray(value, np.float32) for key, value in prepared.items()}
        data, arrays = pack(own | {"extras": np.concatenate([np.zeros((0, 3), np.float32), *points])})
        (folder / f"face{i}.bin").write_bytes(data)
        rows.append({"name": name, "file": f"face{i}.bin", "jaw": np.asarray(neutral)[jaw].ravel().tolist()})
    view, triangles, surface = _drawing(models, extras[0])
    last = extras[0][-1].vertices.shape[-2] if extras[0] else 0
    page = {
        "labels": list(models.labels),
        "faces": rows,
        "arrays": arrays,
        "drawn": len(models.motion.chart.p) + 1,
        "noise": {"blur": models.starts.poses.shape[2], "noise": generators.noise_size(models.motion)},
        "start": _start(list(models.labels)),
        "view": view,
        "lower": {"jaw": jaw.tolist(), "teeth": [view["points"] - last, view["points"]]},
        "triangles": base64.b64encode(triangles.astype("<u4").tobytes()).decode(),
        "surface": base64.b64encode(surface.tobytes()).decode(),
    }
    (folder / "model.json").write_text(json.dumps(page), "utf-8")


def pack(arrays: Mapping[str, np.ndarray]) -> tuple[bytes, list[dict[str, Any]]]:
    """Return arrays as bytes, and name, shape and offsets of each; matrices of linear maps in 16 bits.

    Each row of a map is stored as whole numbers and one scale, an error of at most 1/65,000 of its largest entry.
    """
    data = bytearray()
    rows: list[dict[str, Any]] = []

    def add(values: np.ndarray) -> int:
        offset = len(data)
        data.extend(np.ascontiguousarray(values).tobytes())
        data.extend(bytes(-len(data) % 4))
        return offset

    for name, values in arrays.items():
        row: dict[str, Any] = {"name": name, "shape": list(values.shape)}
        if name.startswith("map_"):
            scale = np.maximum(np.abs(values).max(axis=1), 1e-30) / 32767
            row["offset"] = add(np.round(values / scale[:, None]).astype("<i2"))
            row["scales"] = add(scale.astype("<f4"))
        else:
            row["offset"] = add(values.astype("<f4"))
        rows.append(row)
    return bytes(data), rows


def _drawing(models: Models, extras: tuple[scene.Part, ...]) -> tuple[dict[str, Any], np.ndarray, np.ndarray]:
    """Return the view for `drawing.js`, the triangles, and colour and gloss (points, 4) of every point."""
    vertices, faces = np.asarray(models.face.vertices, np.float32), np.asarray(models.face.faces)
    parts = [scene.Part(vertices, faces, np.asarray(scene.SKIN, np.float32), render.SKIN_GLOSS), *extras]
    sizes = [part.vertices.shape[-2] for part in parts]
    offsets = np.cumsum([0, *sizes])
    triangles = [np.asarray(part.faces) + offset for part, offset in zip(parts, offsets, strict=False)]
    surface = [
        np.column_stack([scene.colours(part), np.full(size, part.gloss)])
        for part, size in zip(parts, sizes, strict=True)
    ]
    view = {
        "points": int(offsets[-1]),
        "face": len(vertices),
        "faces": sum(len(rows) for rows in triangles),
        "landmarks": 0,
        **html_viewer.camera_and_light(vertices[None]),
    }
    shown = np.concatenate([*triangles, render.close_largest_hole(vertices, faces)])
    return view, shown, np.round(np.clip(np.concatenate(surface), 0, 1) * 255).astype(np.uint8)


def _extras(models: Models, neutral: Neutral) -> tuple[scene.Part, ...]:
    """Return eyes, upper and lower teeth of a face at rest; none without 68 landmarks."""
    marks = np.asarray(neutral, np.float32)[np.asarray(models.face.landmark_index)]
    return eyes_teeth.parts(eyes_teeth.template(), marks, marks[None])


def _jaw(models: Models) -> np.ndarray:
    """Return the vertices at the landmarks of the jaw, which the lower teeth follow."""
    index = np.asarray(models.face.landmark_index)
    return index[list(eyes_teeth.JAW)] if len(index) == eyes_teeth.LANDMARKS else index[:0]


def _start(labels: list[str]) -> list[int]:
    """Return the labels that the page begins with."""
    smile = labels.index("high_smile") if "high_smile" in labels else 1
    return [0, smile, 0]
