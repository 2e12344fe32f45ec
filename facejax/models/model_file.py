"""Checks of a model file's metadata, field by field; importing this module does not import JAX.

A file's metadata holds the names of the labels, the kinds of the generator and of the decoder, and the dtype and shape
of every array. Sizes that several arrays share, such as the number of labels, must agree.
"""

from __future__ import annotations

import math
import os
from typing import Any

from facejax.io.weights import DTYPES, WeightsError

S2D, REFINED = "s2d", "refined"  # values of "decoder" in a file's metadata: S2D-Dec, or GPMM and residual decoder
GENERATORS = ("gan", "reference", "flow")
MAX_LABELS, MAX_LABEL_CHARS = 10_000, 200
MAX_ARRAYS, MAX_AXES = 10_000, 8

# Shapes of arrays. Letters are sizes that must agree within a file; `...` stands for any further axes.
# N vertices, F triangles, L landmarks, K labels, T steps of an SRVF, R directions and D directions of poses.
_FACE = {
    "face/vertices": "N 3", "face/faces": "F 3", "face/landmark_index": "L", "face/source_index": "source",
    "face/mask": "N",
}  # fmt: skip
_MOTION = {
    "motion/chart/p": "T L 3", "motion/chart/basis": "R T L 3", "motion/chart/mean": "K K R",
    "motion/chart/scale": "K K R", "motion/chart/scalar_mean": "K K 2", "motion/chart/scalar_std": "2",
    "motion/chart/gain": "K D R+2", "motion/chart/residual": "", "motion/chart/pose_mean": "K L 3",
    "motion/chart/pose_basis": "D L 3", "motion/chart/pose_scale": "D",
    "starts/poses": "K peaks D", "starts/count": "K", "starts/root": "K D D",
}  # fmt: skip
_GENERATOR = {
    "flow": {
        "labels": "2 K embedding", "stem/kernel": "inputs width", "stem/bias": "width",
        "blocks/0/kernel": "width width", "gates/0/kernel": "context width",
        "head/kernel": "width R+3", "head/bias": "R+3",
    },
    "gan": {
        "labels": "2 K embedding", "stem/kernel": "inputs width", "stem/bias": "width", "skip": "noise R+2",
        "head/kernel": "width R+2", "head/bias": "R+2",
    },
    "reference": {"stem/kernel": "inputs outputs", "stem/bias": "outputs", "length/bias": "1"},
}  # fmt: skip
_DECODER = {
    S2D: {
        "scale/landmark_mean": "L 3", "scale/landmark_std": "", "scale/vertex_mean": "N 3", "scale/vertex_std": "",
        "weights/dense/kernel": "L*3 ...", "weights/convs/0/kernel": "...",
    },
    REFINED: {
        "base/face": "N 3", "base/motion": "N", "base/hold": "N", "base/landmark_index": "L", "base/prior": "3",
        "base/mean": "N 3", "network/gate": "", "network/scale/face": "N 3", "network/scale/landmark_mean": "L 3",
        "network/scale/landmark_std": "", "network/scale/unit": "", "network/weights/own": "N ...",
        "network/weights/readout": "N C 3", "network/weights/shared": "C 3",
        "network/weights/climb/dense/kernel": "L*3 ...", "network/weights/mix/0/kernel": "...",
        "network/weights/mix/1/kernel": "...",
    },
}  # fmt: skip
# A file holds either the GPMM's statistics or its linear map.
_STATISTICS = {"components": "modes N*3", "variance": "modes"}
_MAP = {"map": "L*3 N*3", "landmark_mean": "L 3"}


def check_metadata(path: str | os.PathLike[str], about: Any) -> None:
    """Raise `WeightsError` for a field that is missing or invalid, or for sizes that do not agree."""
    labels = read_labels(path, about)
    generator, decoder = about.get("generator"), about.get("decoder", S2D)
    _check_choice(path, "generator", generator, GENERATORS)
    _check_choice(path, "decoder", decoder, (S2D, REFINED))
    shapes = _check_shapes(path, about.get("shapes"))
    rules = _FACE | _MOTION | {f"motion/weights/{name}": rule for name, rule in _GENERATOR[generator].items()}
    rules |= {f"decoder/{name}": rule for name, rule in _DECODER[decoder].items()}
    if decoder == REFINED:
        base = _STATISTICS if "decoder/base/components" in shapes else _MAP
        rules |= {f"decoder/base/{name}": rule for name, rule in base.items()}
    sizes: dict[str, tuple[int, str]] = {"K": (len(labels), f"{len(labels)} names in 'labels'")}
    for name, rule in rules.items():
        if name not in shapes:
            raise _error(path, "shapes", f"{name} is missing")
        _check_shape(path, name, shapes[name], rule, sizes)
    (source, _), (count, _) = sizes["source"], sizes["N"]
    if source not in (0, count):
        raise _error(path, "shapes", f"face/source_index has {source} entries, expected 0 or {count}")


def read_labels(path: str | os.PathLike[str], about: Any, *, least: int = 2) -> tuple[str, ...]:
    """Return the labels of a file's metadata. Raises `WeightsError` unless they are `least` or more distinct names."""
    names = about.get("labels") if isinstance(about, dict) else None
    if not isinstance(names, list):
        raise _error(path, "labels", f"expected a list of names, got {_short(names)}")
    if not least <= len(names) <= MAX_LABELS:
        raise _error(path, "labels", f"expected {least} to {MAX_LABELS} names, got {len(names)}")
    seen = set[str]()
    for i, name in enumerate(names):
        if not isinstance(name, str) or not 0 < len(name) <= MAX_LABEL_CHARS or not name.isprintable():
            raise _error(path, "labels", f"entry {i} is {_short(name)}, expected a name")
        if name in seen:
            raise _error(path, "labels", f"entry {i} repeats the name {name!r}")
        seen.add(name)
    return tuple(names)


def _check_choice(path: str | os.PathLike[str], field: str, value: object, choices: tuple[str, ...]) -> None:
    if not isinstance(value, str) or value not in choices:
        raise _error(path, field, f"expected one of {', '.join(choices)}, got {_short(value)}")


def _check_shapes(path: str | os.PathLike[str], found: object) -> dict[str, tuple[int, ...]]:
    """Return the shape of each array by name."""
    if not isinstance(found, dict) or not 0 < len(found) <= MAX_ARRAYS:
        raise _error(
            path, "shapes", f"expected the dtypes and shapes of up to {MAX_ARRAYS} arrays, got {_short(found)}"
        )
    names = {dtype.name for dtype in DTYPES.values()}
    shapes: dict[str, tuple[int, ...]] = {}
    for name, entry in found.items():
        match entry:
            case [str(dtype), list(shape)] if dtype in names and len(shape) <= MAX_AXES:
                if all(type(n) is int and n >= 0 for n in shape) and math.prod(shape) < 2**40:
                    shapes[name] = tuple(shape)
                    continue
            case _:
                pass
        raise _error(path, "shapes", f"{name} is {_short(entry)}, expected a dtype and a shape")
    return shapes


def _check_shape(
    path: str | os.PathLike[str], name: str, shape: tuple[int, ...], rule: str, sizes: dict[str, tuple[int, str]]
) -> None:
    """Compare a shape with its rule; a size that is new is entered in `sizes` with where it stands."""
    axes, parts = list(shape), rule.split()
    if parts[-1:] == ["..."]:
        parts = parts[:-1]
        axes = axes[: len(parts)]
    if len(axes) != len(parts):
        raise _error(path, "shapes", f"{name} has the shape {list(shape)}, expected ({', '.join(rule.split())})")
    for size, part in zip(axes, parts, strict=True):
        letter, times, more = _parse(part)
        where = ""
        if letter.isdigit():
            expected = int(letter)
        else:
            if letter not in sizes and size >= more and (size - more) % times == 0:
                sizes[letter] = (size - more) // times, name
            known, source = sizes.get(letter, (0, name))
            expected = known * times + more
            where = f" with {letter} = {known} ({source})"
        if size != expected:
            raise _error(
                path, "shapes", f"{name} has the shape {list(shape)}, expected ({', '.join(rule.split())}){where}"
            )


def _parse(part: str) -> tuple[str, int, int]:
    """Return letter, factor and summand of an entry of a rule such as `N`, `N*3` or `R+2`."""
    if "*" in part:
        letter, factor = part.split("*")
        return letter, int(factor), 0
    if "+" in part:
        letter, summand = part.split("+")
        return letter, 1, int(summand)
    return part, 1, 0


def _error(path: str | os.PathLike[str], field: str, problem: str) -> WeightsError:
    return WeightsError(f"{path} does not describe facejax models: field {field!r}: {problem}")


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:77]}..."
