"""Functions as ONNX files, for ONNX Runtime in any language: one folder of NAME.onnx and manifest.json.

    onnx.export(models, "runs/onnx")

Weights are inside of each file. The files hold `facejax.export.functions`, with these differences:

    motion            one motion per call: without the batch axis; any number of transitions and frames
    decoder           as there, any number of frames
    decoder_linear    as there

`prepare` is not among them: its QR factorisation and triangular solve have no operator in ONNX. A face is prepared by
facejax, and its arrays (`functions.face_arrays`) are inputs of the decoders. `chain` is `motion` followed by `decoder`.
`lstm` reads a symbolic number of frames in a way that jax2onnx does not convert.

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
from jax.extend import core

from facejax.export import functions as exported
from facejax.export import manifest, onnx_forms, onnx_graph, plain_jaxpr
from facejax.export.functions import BATCH
from facejax.export.signature import Arrays, Function, Spec
from facejax.inference.pipeline import Models
from facejax.io import atomic
from facejax.models.decoders.gpmm_residual import GPMMResidual

NAMES = ("motion", "decoder", "decoder_linear")
OPSET = 21  # of which ONNX Runtime for browsers has all operators
PACKAGES = ("jax2onnx", "onnx", "onnxruntime")
CONVERTER = "0.17.1"  # of jax2onnx; it asks for an older orbax-checkpoint than facejax, and uses none of it
_OPERATORS = {onnx_forms.TAKE: "Gather", onnx_forms.ELU: "Elu"}


class PackagesMissing(RuntimeError):
    """A package that writes ONNX files is not installed."""


def export(
    models: Models,
    out: str | os.PathLike[str],
    *,
    functions: Sequence[str] | None = None,
    opset: int = OPSET,
    command: str = "facejax export onnx",
) -> list[Path]:
    """Write functions of models to a folder, which is replaced at the end; return its files, the manifest first.

    Args:
      functions: of `NAMES`; default: all that the models have.
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
        names = write(models, folder, functions, opset=opset)
        write_manifest(models, folder, names, opset=opset, format="onnx", command=command)
    return [out / name for name in (manifest.FILE, *(f"{name}.onnx" for name in names))]


def write(
    models: Models, folder: Path, functions: Sequence[str] | None = None, *, opset: int = OPSET
) -> dict[str, Function]:
    """Write NAME.onnx of functions to a folder and return the functions."""
    found = catalogue(models, functions)
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


def catalogue(models: Models, names: Sequence[str] | None = None) -> dict[str, Function]:
    """Return the functions that `export` writes, with their inputs as in the files; default: all that models have.

    Raises:
      ValueError: an unknown name, or one that the models do not have.
    """
    if unknown := [name for name in names or () if name not in NAMES]:
        raise ValueError(f"functions: expected some of {', '.join(NAMES)}, got {', '.join(unknown)}")
    if names is None:
        names = [name for name in NAMES if isinstance(models.decoder, GPMMResidual) or name != "decoder_linear"]
    return {name: _without_batch(function) for name, function in exported.catalogue(models, names).items()}


def convert(function: Function, *, opset: int = OPSET) -> Any:
    """Return a function of `catalogue` as an `onnx.ModelProto`, its parameters as constants.

    Raises:
      PackagesMissing: jax2onnx, onnx or onnxruntime is not installed.
    """
    require_packages()
    arguments = function.arguments()
    closed = jax.make_jaxpr(lambda *inputs: function.call(function.params, *inputs))(*arguments)
    # Traced before jax2onnx traces it, which replaces functions of JAX meanwhile.
    plain = jax.make_jaxpr(lambda *inputs: plain_jaxpr.evaluate(closed, inputs))(*arguments)
    run = core.jaxpr_as_fun(plain)
    with _quiet():
        _register_operators()
        model = importlib.import_module("jax2onnx").to_onnx(
            lambda *inputs: tuple(run(*inputs)),
            arguments,
            model_name=function.name,
            opset=opset,
            input_names=list(function.inputs),
            output_names=list(function.outputs),
        )
    onnx_graph.hoist_constants(model.graph)
    onnx_graph.remove_unused(model.graph)
    return model


def require_packages() -> None:
    """Raise `PackagesMissing` that names the packages that are missing."""
    if missing := [name for name in PACKAGES if importlib.util.find_spec(name) is None]:
        raise PackagesMissing(
            f"ONNX files need the packages {', '.join(missing)}: run `pip install 'facejax[onnx]'` and "
            f"`pip install --no-deps jax2onnx=={CONVERTER}`"
        )


def _without_batch(function: Function) -> Function:
    """Return a function of one sample, and of the decoders one that maps it over the batch.

    Whole batches are decoded piece by piece, in numbers that are known when a function is traced.
    """
    specs = function.inputs.values()
    batched = [bool(spec.shape) and spec.shape[0] == BATCH for spec in specs]
    alone = [Spec(spec.shape[1:], spec.dtype) if lead else spec for spec, lead in zip(specs, batched, strict=True)]
    single = dataclasses.replace(function, inputs=dict(zip(function.inputs, alone, strict=True)))
    if not function.name.startswith("decoder"):
        return single
    shapes = single.arguments({})

    def call(params: Arrays, *inputs: Any) -> tuple[jax.Array, ...]:
        one = jax.make_jaxpr(lambda *sample: function.call(params, *sample))(*shapes)
        axes = [0 if lead else None for lead in batched]
        return tuple(jax.vmap(lambda *sample: plain_jaxpr.evaluate(one, sample), axes)(*inputs))

    return dataclasses.replace(function, call=call)


def _register_operators() -> None:
    """Tell jax2onnx the operators of the primitives of `facejax.export.onnx_forms`."""
    system = importlib.import_module("jax2onnx.plugins.plugin_system")
    for primitive, operator in _OPERATORS.items():
        if primitive in system.PLUGIN_REGISTRY:
            continue

        class Plugin(system.PrimitiveLeafPlugin):
            _operator = operator

            def lower(self, ctx: Any, eqn: Any) -> None:
                inputs = [ctx.get_value_for_var(v, name_hint=ctx.fresh_name("input")) for v in eqn.invars]
                like = ctx.get_value_for_var(eqn.outvars[0], name_hint=ctx.fresh_name("output"))
                made = getattr(ctx.builder, self._operator)(*inputs, _outputs=[like.name], **eqn.params)
                made.type, made.shape = like.type, like.shape
                ctx.bind_value_for_var(eqn.outvars[0], made)

        system.register_primitive(
            jaxpr_primitive=primitive, jax_doc="", onnx=[], since="", context="primitives.facejax", component=primitive,
            testcases=[],
        )(Plugin)  # fmt: skip


@contextlib.contextmanager
def _quiet() -> Generator[None]:
    """Silence the converter's warnings, of which none says what is wrong with a model."""
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        yield
    finally:
        logging.disable(before)
