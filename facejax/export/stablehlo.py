"""Export to StableHLO: functions that run from a folder of files, without this package and without its code.

    stablehlo.export(models, "runs/export")
    functions = stablehlo.load("runs/export")
    vertices = functions["decoder"](landmarks=landmarks, **prepared)["vertices"]

The folder holds `NAME.stablehlo`, a function serialised by `jax.export`; `weights.safetensors`, the arrays of all
functions; and `manifest.json` (`facejax.export.manifest`). A serialised function takes two dicts, its weights and its
inputs, and returns a dict of outputs. Batch and time are symbolic: they are chosen in each call. There is no gradient.
"""

from __future__ import annotations

import dataclasses
import datetime
import json
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax import export as jax_export
from jax.typing import ArrayLike
from jaxlib import version as jaxlib_version

import facejax
from facejax.export import functions as catalogue
from facejax.export import manifest
from facejax.export.manifest import ExportError
from facejax.export.signature import Dimension, Function, Spec
from facejax.inference import expressions
from facejax.inference.expressions import Expressions
from facejax.inference.pipeline import Models
from facejax.io import atomic, weights

PLATFORMS = ("cpu", "cuda", "rocm", "tpu")
WEIGHTS = "weights.safetensors"
COMPATIBILITY = (
    "JAX guarantees that releases up to 6 months newer and up to 3 weeks older than these versions of jax and jaxlib "
    "load the functions; for others, export again"
)


@dataclasses.dataclass(frozen=True)
class LoadedFunction:
    """A function of an export: call it with its inputs as keywords, and get a dict of its outputs."""

    name: str
    inputs: dict[str, Spec]
    outputs: dict[str, Spec]
    params: dict[str, Any]
    exported: jax_export.Exported
    run: Callable[..., dict[str, jax.Array]]  # of params and inputs, compiled once for each set of shapes

    def __call__(self, **arrays: ArrayLike) -> dict[str, jax.Array]:
        """Return the outputs by name, shapes and dtypes as in `outputs`.

        Raises:
          ValueError: an input that is missing, unknown, or of a shape that does not fit `inputs`.
        """
        if set(arrays) != set(self.inputs):
            wrong = ", ".join(sorted(set(arrays) ^ set(self.inputs)))
            raise ValueError(f"{self.name}: expected the inputs {', '.join(self.inputs)}; missing or unknown: {wrong}")
        converted = {name: _convert(name, arrays[name], spec.dtype) for name, spec in self.inputs.items()}
        _check_shapes(self.name, self.inputs, {name: np.shape(array) for name, array in converted.items()})
        return self.run(self.params, converted)


def export(
    models: Models,
    out: str | os.PathLike[str],
    *,
    functions: Sequence[str] | None = None,
    platforms: Sequence[str] = PLATFORMS,
    networks: Expressions | None = None,
    command: str = "facejax export stablehlo",
) -> list[Path]:
    """Write functions of models to a folder, which is replaced at the end; return its files, the manifest first.

    Args:
      functions: names of `functions.NAMES`; default: all that the models have.
      platforms: that the functions can run on, of `PLATFORMS`.
      networks: expression networks of "lstm"; default: the released ones.
      command: how to write the export again, for the manifest.

    Raises:
      ValueError: an unknown function or platform, or a folder that holds anything else than an export.
    """
    out = Path(os.path.abspath(out))
    manifest.check_folder(out)
    if not platforms or not set(platforms) <= set(PLATFORMS):
        raise ValueError(f"platforms: expected some of {', '.join(PLATFORMS)}, got {', '.join(platforms) or 'none'}")
    if networks is None and (functions is None or "lstm" in functions):
        networks = expressions.load()
    # Without x64: the functions are of float32.
    with jax.enable_x64(False), atomic.replace_folder(out) as temporary:
        found = catalogue.catalogue(models, functions, networks=networks)
        arrays = {name: np.asarray(array) for function in found.values() for name, array in function.params.items()}
        weights.save(temporary / WEIGHTS, arrays)
        entries: dict[str, Any] = {}
        for name, function in found.items():
            file = temporary / f"{name}.stablehlo"
            file.write_bytes(_serialise(function, platforms))
            entries[name] = _stored(file) | manifest.describe(function)
        described = {name: {"shape": list(array.shape), "dtype": str(array.dtype)} for name, array in arrays.items()}
        index = {
            "format": "stablehlo",
            "version": manifest.VERSION,
            "facejax": facejax.__version__,
            "jax": jax.__version__,
            "jaxlib": jaxlib_version.__version__,
            "calling_convention_version": jax_export.maximum_supported_calling_convention_version,
            "platforms": list(platforms),
            "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
            "compatibility": COMPATIBILITY,
            "command": command,
            "labels": list(models.labels),
            "expressions": [] if networks is None else list(networks.labels),
            "functions": entries,
            "weights": _stored(temporary / WEIGHTS) | {"arrays": described},
        }
        (temporary / manifest.FILE).write_text(json.dumps(index, indent=1) + "\n", encoding="utf-8")
    return [out / name for name in (manifest.FILE, WEIGHTS, *(f"{name}.stablehlo" for name in found))]


def load(folder: str | os.PathLike[str]) -> dict[str, LoadedFunction]:
    """Return the functions of an export by name.

    A serialised function is a program, which JAX compiles and runs: load exports from sources that you trust.

    Raises:
      ExportError: a file or a field of the manifest that is missing, damaged, or does not fit the others.
      WeightsError: weights that do not fit the manifest.
    """
    folder = Path(folder)
    index = manifest.read(folder)
    like = {
        name: jax.ShapeDtypeStruct(tuple(row["shape"]), np.dtype(row["dtype"]))
        for name, row in index["weights"]["arrays"].items()
    }
    arrays, _ = weights.load(manifest.check_file(folder, index["weights"]), like)
    found = {}
    for name, entry in index["functions"].items():
        path = manifest.check_file(folder, entry)
        inputs, outputs = manifest.specs(entry["inputs"]), manifest.specs(entry["outputs"])
        exported = _deserialise(path, index)
        expected = {key: Spec(like[key].shape, str(like[key].dtype)) for key in entry["params"]}
        _check_signature(path, exported, expected, inputs, outputs)
        params = {key: arrays[key] for key in entry["params"]}
        found[name] = LoadedFunction(name, inputs, outputs, params, exported, jax.jit(exported.call))
    return found


def _serialise(function: Function, platforms: Sequence[str]) -> bytearray:
    def call(params: dict[str, Any], inputs: dict[str, Any]) -> dict[str, Any]:
        found = function.call(params, *(inputs[name] for name in function.inputs))
        return dict(zip(function.outputs, found, strict=True))

    inputs = dict(zip(function.inputs, function.arguments(), strict=True))
    return jax_export.export(jax.jit(call), platforms=platforms)(function.params, inputs).serialize()


def _stored(path: Path) -> dict[str, Any]:
    return {"file": path.name, "sha256": atomic.sha256(path)}


def _deserialise(path: Path, index: dict[str, Any]) -> jax_export.Exported:
    try:
        return jax_export.deserialize(bytearray(path.read_bytes()))
    except Exception as error:  # whatever the parsers of flatbuffers and MLIR raise
        raise ExportError(
            f"{path}: jax {jax.__version__} cannot load it ({type(error).__name__}: {error}); it was written with jax "
            f"{index['jax']} on {index['date']}, and {index['compatibility']}"
        ) from error


def _check_signature(
    path: Path,
    exported: jax_export.Exported,
    params: dict[str, Spec],
    inputs: dict[str, Spec],
    outputs: dict[str, Spec],
) -> None:
    """Compare a serialised function with what the manifest says of it."""
    try:
        (found_params, found_inputs), _ = jax.tree.unflatten(exported.in_tree, exported.in_avals)
        found_outputs = jax.tree.unflatten(exported.out_tree, exported.out_avals)
        groups = {
            "params": (params, dict(found_params)),
            "inputs": (inputs, dict(found_inputs)),
            "outputs": (outputs, dict(found_outputs)),
        }
    except (TypeError, ValueError) as error:
        raise ExportError(f"{path}: expected a function of two dicts ({error}); export again") from error
    for kind, (expected, found) in groups.items():
        if set(expected) != set(found):
            wrong = ", ".join(sorted(set(expected) ^ set(found)))
            raise ExportError(f"{path}: {kind} differ from {manifest.FILE}: {wrong}; export again")
        for name, spec in expected.items():
            shape = tuple(map(str, found[name].shape))
            dtype = str(found[name].dtype)
            if shape != tuple(map(str, spec.shape)) or dtype != spec.dtype:
                got = f"{dtype} ({', '.join(shape)})"
                raise ExportError(f"{path}: {kind} {name} is {got}, in {manifest.FILE} {_text(spec)}; export again")


def _convert(name: str, value: ArrayLike, dtype: str) -> Any:
    """Return a value as an array of a dtype. Raises `ValueError` for one of another kind, such as text."""
    array = value if isinstance(value, jax.Array) else np.asarray(value)
    if not np.can_cast(array.dtype, dtype, casting="same_kind"):
        raise ValueError(f"{name}: expected {dtype}, got {array.dtype}")
    return array.astype(dtype)


def _check_shapes(function: str, inputs: dict[str, Spec], shapes: dict[str, tuple[int, ...]]) -> None:
    """Raise `ValueError` for a shape that does not fit, with the sizes that other inputs give to symbols."""
    sizes: dict[str, int] = {}
    for name, spec in inputs.items():
        fits = len(shapes[name]) == len(spec.shape)
        for expected, size in zip(spec.shape, shapes[name], strict=False):
            if isinstance(expected, Dimension):
                symbol, rest = divmod(size - expected.offset, expected.factor)
                fits &= rest == 0 and symbol >= 1 and sizes.setdefault(expected.symbol, symbol) == symbol
            else:
                fits &= expected == size
        if not fits:
            known = "".join(f"; {symbol} is {size}" for symbol, size in sizes.items())
            raise ValueError(f"{function}: {name}: expected {_text(spec)}, got {shapes[name]}{known}")


def _text(spec: Spec) -> str:
    return f"{spec.dtype} ({', '.join(map(str, spec.shape))})"
