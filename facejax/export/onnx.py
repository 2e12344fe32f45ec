"""Functions as ONNX files, for ONNX Runtime in any language: one folder of NAME.onnx and manifest.json.

    onnx.export(models, "runs/onnx")

Weights are inside of each file. The files hold `facejax.export.functions`, with the same inputs and outputs: any number
of samples, transitions and frames. Motions of a batch are computed one after another.

`prepare` is not among them: its QR factorisation and triangular solve have no operator in ONNX. A face is prepared by
facejax, and its arrays (`functions.face_arrays`) are inputs of the decoders and of the chain.

Needs the packages jax2onnx, onnx and onnxruntime, see docs/howto/onnx.md.
"""

from __future__ import annotations

import contextlib
import dataclasses
import importlib
import importlib.util
import json
import logging
import os
from collections.abc import Generator, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.extend import core
from jax.interpreters import partial_eval

from facejax.export import functions as exported
from facejax.export import manifest, onnx_forms, onnx_graph, plain_jaxpr
from facejax.export.functions import BATCH
from facejax.export.signature import Arrays, Function, Spec
from facejax.inference import expressions
from facejax.inference.expressions import Expressions
from facejax.inference.pipeline import Models
from facejax.io import atomic
from facejax.models.decoders.gpmm_residual import GPMMResidual

NAMES = ("motion", "decoder", "decoder_linear", "chain", "lstm")
OPSET = 21  # of which ONNX Runtime for browsers has all operators
PACKAGES = ("jax2onnx", "onnx", "onnxruntime")
CONVERTER = "0.17.1"  # of jax2onnx; it asks for an older orbax-checkpoint than facejax, and uses none of it
_LOOPED = ("motion", "chain")  # over the batch; the others compute all samples at once
_SAMPLE = "_sample"  # after a name: of one sample of the batch


class PackagesMissing(RuntimeError):
    """A package that writes ONNX files is not installed."""


def export(
    models: Models,
    out: str | os.PathLike[str],
    *,
    functions: Sequence[str] | None = None,
    networks: Expressions | None = None,
    opset: int = OPSET,
    command: str = "facejax export onnx",
) -> list[Path]:
    """Write functions of models to a folder, which is replaced at the end; return its files, the manifest first.

    Args:
      functions: of `NAMES`; default: all that the models have.
      networks: expression networks of "lstm"; default: the released ones.
      opset: version of the ONNX operators.
      command: how to write the export again, for the manifest.

    Raises:
      ValueError: an unknown function, one that the models do not have, or a folder that holds anything else than an
        export.
      PackagesMissing: jax2onnx, onnx or onnxruntime is not installed.
    """
    require_packages()
    out = Path(os.path.abspath(out))
    manifest.check_folder(out)
    with jax.enable_x64(False), atomic.replace_folder(out) as folder:
        if networks is None and (functions is None or "lstm" in functions):
            networks = expressions.load()
        found = write(models, folder, functions, networks=networks, opset=opset)
        named = [] if networks is None else list(networks.labels)
        write_manifest(models, folder, found, opset=opset, format="onnx", command=command, expressions=named)
    return [out / name for name in (manifest.FILE, *(f"{name}.onnx" for name in found))]


def write(
    models: Models,
    folder: Path,
    functions: Sequence[str] | None = None,
    *,
    networks: Expressions | None = None,
    opset: int = OPSET,
) -> dict[str, Function]:
    """Write NAME.onnx of functions to a folder and return the functions."""
    found = catalogue(models, functions, networks=networks)
    for name, function in found.items():
        (folder / f"{name}.onnx").write_bytes(convert(function, opset=opset).SerializeToString())
    return found


def write_manifest(
    models: Models, folder: Path, functions: dict[str, Function], *, opset: int = OPSET, **fields: Any
) -> None:
    """Write the manifest of a folder with functions that `write` returned."""
    rows: dict[str, Any] = {}
    for name, function in functions.items():
        file = folder / f"{name}.onnx"
        stored = {"file": file.name, "bytes": file.stat().st_size, "sha256": atomic.sha256(file)}
        described = manifest.describe(function)
        rows[name] = stored | {"inputs": described["inputs"], "outputs": described["outputs"]}
    index = {
        **fields,
        "version": manifest.VERSION,
        "versions": {name: metadata.version(name) for name in ("facejax", "jax", *PACKAGES)},
        "opset": opset,
        "labels": list(models.labels),
        "functions": rows,
    }
    (folder / manifest.FILE).write_text(json.dumps(index, indent=1) + "\n", "utf-8")


def catalogue(
    models: Models, names: Sequence[str] | None = None, *, networks: Expressions | None = None
) -> dict[str, Function]:
    """Return the functions that `export` writes, in forms that `convert` takes; arguments as of `export`.

    Raises:
      ValueError: an unknown name, or one that the models do not have.
    """
    if unknown := [name for name in names or () if name not in NAMES]:
        raise ValueError(f"functions: expected some of {', '.join(NAMES)}, got {', '.join(unknown)}")
    if names is None:
        names = [name for name in NAMES if isinstance(models.decoder, GPMMResidual) or name != "decoder_linear"]
    parts = ("motion", "decoder") if "chain" in names else ()
    found = exported.catalogue(models, [*dict.fromkeys((*names, *parts))], networks=networks)
    found |= {name: _by_sample(one) for name, one in found.items() if name.startswith("decoder")}
    if "chain" in names:
        found["chain"] = _in_sequence(found["chain"], found["motion"], found["decoder"])
    return {name: found[name] for name in names}


def convert(function: Function, *, opset: int = OPSET) -> Any:
    """Return a function of `catalogue` as an `onnx.ModelProto`, its parameters as constants.

    Raises:
      PackagesMissing: jax2onnx, onnx or onnxruntime is not installed.
    """
    require_packages()
    looped = function.name in _LOOPED
    batched = {name for name, spec in function.inputs.items() if looped and spec.shape[:1] == (BATCH,)}
    inputs = {
        name: Spec(spec.shape[1:], spec.dtype) if name in batched else spec for name, spec in function.inputs.items()
    }
    arguments = dataclasses.replace(function, inputs=inputs).arguments()
    closed = jax.make_jaxpr(lambda *inputs: function.call(function.params, *inputs))(*arguments)
    # Traced before jax2onnx traces it, which replaces functions of JAX meanwhile.
    plain = jax.make_jaxpr(lambda *inputs: plain_jaxpr.evaluate(closed, inputs))(*arguments)
    # Without what only gradients read: a loop would store it for every step.
    used, _ = partial_eval.dce_jaxpr(plain.jaxpr, [True] * len(function.outputs), instantiate=True)
    run = core.jaxpr_as_fun(core.ClosedJaxpr(used, plain.consts))
    with _quiet():
        onnx_forms.register()
        model = importlib.import_module("jax2onnx").to_onnx(
            lambda *inputs: tuple(run(*inputs)),
            arguments,
            model_name=function.name,
            opset=opset,
            input_names=[f"{name}{_SAMPLE}" if name in batched else name for name in function.inputs],
            output_names=[f"{name}{_SAMPLE}" if batched else name for name in function.outputs],
        )
    onnx_graph.hoist_constants(model.graph)
    onnx_graph.remove_unused(model.graph)
    if batched:
        names = [*batched, *function.outputs]
        onnx_graph.map_leading(model.graph, {f"{name}{_SAMPLE}": name for name in names}, BATCH.symbol)
    return model


def require_packages() -> None:
    """Raise `PackagesMissing` that names the packages that are missing."""
    if missing := [name for name in PACKAGES if importlib.util.find_spec(name) is None]:
        raise PackagesMissing(
            f"ONNX files need the packages {', '.join(missing)}: run `pip install 'facejax[onnx]'` and "
            f"`pip install --no-deps jax2onnx=={CONVERTER}`"
        )


def _by_sample(decoder: Function) -> Function:
    """Return a decoder that maps the function of one sample over the leading axes of the landmarks.

    Whole batches are decoded piece by piece, in numbers that are known when a function is traced.
    """
    shapes = [spec.shape[1:] if name == "landmarks" else spec.shape for name, spec in decoder.inputs.items()]
    samples = [jax.ShapeDtypeStruct(shape, np.float32) for shape in shapes]

    def call(params: Arrays, *inputs: Any) -> tuple[jax.Array, ...]:
        *face, landmarks = inputs
        one = jax.make_jaxpr(lambda *sample: decoder.call(params, *sample))(*samples)

        def decode(landmarks: Any) -> list[Any]:
            return plain_jaxpr.evaluate(one, [*face, landmarks])

        for _ in landmarks.shape[:-2]:
            decode = jax.vmap(decode)
        return tuple(decode(landmarks))

    return dataclasses.replace(decoder, call=call)


def _in_sequence(chain: Function, motion: Function, decoder: Function) -> Function:
    """Return the chain as a call of the motion and one of the decoder, by the names of their inputs."""

    def call(params: Arrays, *inputs: Any) -> tuple[jax.Array, ...]:
        arrays = dict(zip(chain.inputs, inputs, strict=True))
        (arrays["landmarks"],) = motion.call(params, *(arrays[name] for name in motion.inputs))
        return decoder.call(params, *(arrays[name] for name in decoder.inputs))

    return dataclasses.replace(chain, call=call)


@contextlib.contextmanager
def _quiet() -> Generator[None]:
    """Silence the converter's warnings, of which none says what is wrong with a model."""
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        yield
    finally:
        logging.disable(before)
