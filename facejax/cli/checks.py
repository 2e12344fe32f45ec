"""Checks of arguments that need no model; they run before JAX is imported and before any file is written.

What only the contents of a file can tell (a damaged mesh, landmarks of another face) is checked by its reader.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from facejax.cli import labels
from facejax.cli.arguments import Animate, Data, Demo, Export, Fit, Generate, Labels, MakeHuman, Prepare, Register, View
from facejax.inference import checks
from facejax.models import labels as label_names

MAX_PEOPLE = 1000  # of a corpus, or of sample faces
MAX_FRAMES = 100_000  # of all samples together
MAX_NOISE_MM = 2.0  # `data.synthetic.noise.MAX_SIGMA_MM`
EXPORT_MANIFEST = "manifest.json"  # `export.manifest.FILE`
MESHES = (".ply", ".obj", ".glb", ".npz", ".npy")
LANDMARKS = (".json", ".pp", ".txt", ".csv", ".xyz", ".lnd", ".bnd", ".npy", ".npz", ".pkl")
KERNELS = ("gaussian", "multiquadric", "thin_plate", "triharmonic", "wendland_c2")  # of `geometry.rbf`
# Options of `facejax data prepare` that not every importer has, by importer.
IMPORTER_OPTIONS = {
    "folder": ("fps", "rest", "gaps"),
    "coma": ("fps", "rest", "gaps"),
    "d3dfacs": ("fps", "rest", "gaps"),
    "florence4d": ("fps", "rest", "gaps"),
    "vocaset": ("fps", "gaps", "template"),
    "bu3dfe": ("fps",),
    "bu4dfe": ("fps", "rest", "gaps"),
    "livelink": ("fps", "actors"),
}
# What belongs to one source of motion of `facejax animate` only.
SOURCE_OPTIONS = {
    "expression": ("whole",),
    "end": ("start", "then", "seed"),
    "livelink": ("begin", "seconds", "keep_rest"),
}


def check(command: Any) -> None:
    """Raise `ValueError`, or the error of a file's reader, for arguments that the command cannot use."""
    command = command.what if isinstance(command, Data) else command
    for name, least, most in (("seed", 0, 2**32 - 1), ("frames", 2, 10_000), ("samples", 1, 1_000)):
        value = getattr(command, name, None)
        if isinstance(value, int) and not least <= value <= most:
            more = "; --count writes a corpus of many" if name == "samples" and value > most else ""
            raise ValueError(f"--{name} must lie in {least}..{most}, got {value}{more}")
    if (intensity := getattr(command, "intensity", None)) is not None:
        checks.check_intensity(intensity)
    if (fps := getattr(command, "fps", None)) is not None:
        check_fps(fps)
    if (formats := getattr(command, "formats", None)) is not None:
        check_formats(formats)
    _CHECKS[type(command)](command)


def check_formats(formats: Sequence[str]) -> None:
    """Raise `ValueError` for a format that cannot be written on this machine."""
    if not formats:
        raise ValueError("--formats: expected at least one")
    if "mp4" in formats:
        from facejax.viz import video

        try:
            video.check("animation.mp4")
        except ImportError as error:
            raise ValueError(f"--formats mp4: {error}") from error


def check_fps(fps: float) -> None:
    """Raise `ValueError` unless frames per second lie above 0, up to 1000."""
    if not 0 < fps <= 1000:
        raise ValueError(f"--fps must lie above 0, up to 1000, got {fps}")


def check_total_frames(samples: int, frames: Iterable[int]) -> None:
    """Raise `ValueError` where `samples` motions, whose transitions have `frames` each, exceed `MAX_FRAMES` in all."""
    if (total := samples * sum(frames)) > MAX_FRAMES:
        raise ValueError(f"{samples} samples have {total} frames, expected up to {MAX_FRAMES}: use fewer, or --count")


def check_output_folder(folder: Path) -> None:
    """Raise `ValueError` where a folder cannot be made or written to; make nothing."""
    existing = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    if not existing.is_dir():
        raise ValueError(f"{folder}: cannot be made ({existing} is not a folder); name another folder with --out")
    if not os.access(existing, os.W_OK | os.X_OK):
        raise ValueError(f"{folder}: not writable; name another folder with --out")


def page_path(file: Path, out: Path | None) -> Path:
    """Return where `facejax view` writes its page: beside the file, in the folder `out`, or at `out`."""
    page = file.with_suffix(".html") if out is None else out / f"{file.stem}.html" if out.is_dir() else out
    if page.suffix.lower() != ".html":
        raise ValueError(f"{page}: the page's name must end in .html")
    return page


def _generate(command: Generate) -> None:
    names = () if command.end is None else (command.start, command.end, *command.then)
    if command.count is None:
        for name in ("people", "meshes", "shard", "distributed"):
            if getattr(command, name) != getattr(Generate, name):
                raise ValueError(f"--{name} requires --count")
        if not names:
            raise ValueError("--end is missing: the final expression; `facejax labels` lists them")
        if command.landmarks is not None and command.face is None:
            raise ValueError(f"--landmarks {command.landmarks} requires --face: the scan that they belong to")
    else:
        _check_corpus(command)
    _check_labels(names, command.model)
    if command.count is None and command.frames != "natural":
        check_total_frames(command.samples, [command.frames] * (len(names) - 1))
    _check_mesh(command.face)
    _check_landmarks(command.landmarks)
    check_output_folder(command.out)


def _check_corpus(command: Generate) -> None:
    for name in ("samples", "fps", "formats", "landmarks"):
        if getattr(command, name) != getattr(Generate, name):
            raise ValueError(f"--{name} cannot be combined with --count")
    if command.frames == "natural":
        raise ValueError("--frames natural cannot be combined with --count: all motions of a corpus have one length")
    if command.end is None and (command.then or command.start != Generate.start):
        raise ValueError("--end is missing: --start and --then need it; without all three, labels are drawn at random")
    if command.people and command.face:
        raise ValueError(f"--people {command.people} cannot be combined with --face {command.face}")
    if not 0 <= command.people <= MAX_PEOPLE:
        raise ValueError(f"--people must lie in 0..{MAX_PEOPLE}, got {command.people}")
    if command.shard is not None and command.shard < 1:
        raise ValueError(f"--shard must be 1 or more, got {command.shard}")
    checks.check_count(command.count or 0)


def _animate(command: Animate) -> None:
    given = [name for name in SOURCE_OPTIONS if getattr(command, name) is not None]
    if len(given) != 1:
        flags = " and ".join(f"--{name}" for name in given)
        raise ValueError(f"animate: expected one of --expression, --end and --livelink, got {flags or 'none'}")
    if command.mesh is None and command.landmarks is not None:
        raise ValueError(f"--landmarks {command.landmarks} requires --mesh: the mesh that they belong to")
    if command.mesh is not None and command.person is not None:
        raise ValueError(f"--person {command.person} cannot be combined with --mesh {command.mesh}")
    for source in set(SOURCE_OPTIONS) - set(given):
        for name in SOURCE_OPTIONS[source]:
            if getattr(command, name) != getattr(Animate, name):
                raise ValueError(f"--{name.replace('_', '-')} requires --{source}, got --{given[0]}")
    if command.person is not None and command.person < 0:
        raise ValueError(f"--person must be 0 or more, got {command.person}")
    if command.kernel is not None and command.kernel not in KERNELS:
        raise ValueError(f"kernel: expected one of {', '.join(KERNELS)}, got {command.kernel!r}")
    if command.sigma is not None and not 0 < command.sigma < math.inf:
        raise ValueError(f"sigma: expected a positive number of landmark spacings, got {command.sigma}")
    if not 0 <= command.smoothing < math.inf:
        raise ValueError(f"smoothing: expected 0 or more, got {command.smoothing}")
    if command.livelink is not None:
        if not (command.seconds > 0 and command.begin >= 0):
            raise ValueError(
                f"expected --begin of 0 or more and --seconds above 0, got {command.begin:g} and {command.seconds:g}"
            )
        if not command.livelink.is_file():
            from facejax.io import livelink

            livelink.read(command.livelink)
    elif command.expression is not None:
        if command.frames == "natural":
            raise ValueError("--frames natural requires --end; without --frames an expression has its own length")
        known = labels.read_labels(command.model, released=labels.EXPRESSIONS)
        checks.check_expression(command.expression, known)
    else:
        _check_labels((command.start, command.end or "", *command.then), command.model)
    _check_mesh(command.mesh)
    _check_landmarks(command.landmarks)
    check_output_folder(command.out)


def _register(command: Register) -> None:
    _check_mesh(command.scan)
    _check_landmarks(command.landmarks)
    check_output_folder(command.out)


def _makehuman(command: MakeHuman) -> None:
    if command.sample is not None and not 1 <= command.count <= MAX_PEOPLE:
        raise ValueError(f"--count must lie in 1..{MAX_PEOPLE}, got {command.count}")
    if not 0 <= command.noise <= MAX_NOISE_MM:
        raise ValueError(f"--noise must lie in 0..{MAX_NOISE_MM:g} mm, got {command.noise}")
    for folder in (command.sample, command.out):
        if folder is not None:
            check_output_folder(folder)


def _prepare(command: Prepare) -> None:
    for name in ("fps", "rest", "gaps", "template", "actors"):
        if getattr(command, name) not in (None, False) and name not in IMPORTER_OPTIONS[command.source]:
            raise ValueError(f"--{name} is not supported by the {command.source} importer")
    if not command.root.is_dir():
        raise ValueError(f"{command.root}: no such folder")
    for table in (command.labels, command.people, command.cuts):
        if table is not None and not table.is_file():
            raise ValueError(f"{table}: no such file")
    _check_mesh(command.template)
    _check_landmarks(command.landmarks)
    for name in ("meshes", "workers", "actors"):
        if (value := getattr(command, name)) is not None and value < 1:
            raise ValueError(f"--{name} must be 1 or more, got {value}")
    check_output_folder(command.out.absolute().parent)


def _fit(command: Fit) -> None:
    from facejax.data import dataset

    dataset.open_dataset(command.data)
    if command.out.suffix != ".safetensors":
        raise ValueError(f"--out {command.out}: expected a file that ends in .safetensors")
    check_output_folder(command.out.absolute().parent)


def _export(command: Export) -> None:
    labels.read_labels(command.model)
    if command.out.is_dir() and any(command.out.iterdir()) and not (command.out / EXPORT_MANIFEST).is_file():
        raise ValueError(f"{command.out}: holds other files than an export; name an empty folder with --out")
    check_output_folder(command.out)


def _view(command: View) -> None:
    page = page_path(command.file, command.out)
    if command.file.suffix.lower() == ".html":
        if not command.file.is_file():
            raise ValueError(f"{command.file}: no such file")
        if page != command.file:
            raise ValueError(f"{command.file} is a page already; leave out --out to open it")
        return
    _check_mesh(command.file)
    check_output_folder(page.absolute().parent)


def _check_labels(names: Sequence[str], model: Path | None) -> None:
    """Check the labels of a motion, and the model file, by the file's metadata; no labels are drawn later."""
    known = labels.read_labels(model)
    if names:
        label_names.check_transitions(names)
        label_names.check_labels(names, known)


def _check_mesh(path: Path | None) -> None:
    """Raise the reader's own error for a mesh that is missing or of an unknown format."""
    if path is not None and not (path.is_file() and path.suffix.lower() in MESHES):
        from facejax.io import meshes

        meshes.read(path)


def _check_landmarks(path: Path | None) -> None:
    """Raise the reader's own error for a landmark file that is missing or of an unknown format."""
    if path is not None and not (path.is_file() and path.suffix.lower() in LANDMARKS):
        from facejax.io import landmarks

        landmarks.read(path)


_CHECKS: dict[type, Any] = {
    Generate: _generate,
    Animate: _animate,
    Register: _register,
    Demo: lambda command: check_output_folder(command.out),
    Labels: lambda command: None,
    MakeHuman: _makehuman,
    Prepare: _prepare,
    Fit: _fit,
    Export: _export,
    View: _view,
}
