"""Functions as ONNX files, for ONNX Runtime in any language: one folder of NAME.onnx and manifest.json.

    onnx.export(models, "facejax-onnx")

Weights are inside of each file. The files hold `facejax.export.functions`, with these differences:

    motion           one motion per call: without the batch axis; any number of transitions and frames
    decoder          as there, any number of frames
    decoder_linear   as there
    lstm             one curve per call: without the batch axis; any number of frames

`prepare` is not among them: its QR factorisation and triangular solve have no operator in ONNX. A face is prepared by
facejax, and its arrays (`functions.face_arrays`) are inputs of the decoders. `chain` is `motion` followed by `decoder`.

Needs the packages jax2onnx, onnx and onnxruntime.
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
from facejax.export import onnx_forms, onnx_graph, plain_jaxpr
from facejax.export.functions import BATCH, Function, Models, Spec
from facejax.inference.expressions import Expressions
from facejax.io import atomic

NAMES = ("motion", "decoder", "decoder_linear", "lstm")
OPSET = 21
PACKAGES = ("jax2onnx", "onnx", "onnxruntime")
_OPERATORS = {onnx_forms.TAKE: "Gather", onnx_forms.ELU: "Elu"}


def export(
    models: Models,
    out: str | os.PathLike[str],
    *,
    functions: Sequence[str] | None = None,
    networks: Expressions | None = None,
    opset: int = OPSET,
) -> Path:
    """Write functions of models as ONNX files and return the folder, which is replaced on success.

    Args:
      functions: of `NAMES`; default: all that the models have.
      networks: expression networks for "lstm"; default: the released ones.
      opset: version of the ONNX operators.

    Raises:
      ValueError: an unknown function, or one that the models do not have.
      ImportError: jax2onnx, onnx or onnxruntime is not installed.
    """
    found = catalogue(models, functions, networks=networks)
    require_packages()
    rows: dict[str, Any] = {}
    with atomic.replace_folder(out) as folder:
        for name, function in found.items():
            data = convert(function, opset=opset).SerializeToString()
            (folder / f"{name}.onnx").write_bytes(data)
            rows[name] = describe(function) | {"file": f"{name}.onnx", "bytes": len(data)}
        manifest = {
            "functions": rows,
            "labels": list(models.labels),
            "opset": opset,
            "versions": {name: metadata.version(name) for name in ("facejax", "jax", *PACKAGES)},
            "made_by": "facejax export onnx --out DIR",
            "about": dict(models.about),
        }
        text = json.dumps(manifest, indent=2, default=str)
        (folder / "manifest.json").write_text(text + "\n", "utf-8")
    return Path(out)


def catalogue(
    models: Models, names: Sequence[str] | None = None, *, networks: Expressions | None = None
) -> dict[str, Function]:
    """Return the functions that `export` writes, with their inputs as in the files.

    Raises:
      ValueError: an unknown name, or one that the models do not have.
    """
    if unknown := [name for name in names or () if name not in NAMES]:
        raise ValueError(f"functions: expected some of {', '.join(NAMES)}, got {', '.join(unknown)}")
    own = exported.catalogue(models, names, networks=networks)
    return {name: _without_batch(function) for name, function in own.items() if name in NAMES}


def describe(function: Function) -> dict[str, Any]:
    """Return the names, shapes and dtypes of inputs and outputs as values for JSON; symbolic sizes are strings."""

    def row(shape: Sequence[Any], dtype: Any) -> dict[str, Any]:
        return {"shape": [size if isinstance(size, int) else str(size) for size in shape], "dtype": str(dtype)}

    return {
        "inputs": {name: row(spec.shape, spec.dtype) for name, spec in function.inputs.items()},
        "outputs": {name: row(one.shape, one.dtype) for name, one in function.outputs_spec().items()},
    }


def convert(function: Function, *, opset: int = OPSET) -> Any:
    """Return a function of `catalogue` as an `onnx.ModelProto`, its parameters as constants.

    Raises:
      ImportError: jax2onnx, onnx or onnxruntime is not installed.
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
    """Raise `ImportError` that names the packages that are missing."""
    missing = [name for name in PACKAGES if importlib.util.find_spec(name) is None]
    if missing:
        raise ImportError(f"ONNX export needs the packages {', '.join(missing)}: see docs/howto/onnx.md")


def _without_batch(function: Function) -> Function:
    """Return a function of one sample, and of the decoders one that maps it over the batch.

    Whole batches are decoded piece by piece, in numbers that are known when a function is traced.
    """
    batched = [bool(spec.shape) and spec.shape[0] == BATCH for spec in function.inputs.values()]
    if not function.name.startswith("decoder"):
        rows = zip(function.inputs.items(), batched, strict=True)
        inputs = {name: Spec(spec.shape[1:], spec.dtype) if lead else spec for (name, spec), lead in rows}
        return dataclasses.replace(function, inputs=inputs)
    alone = [Spec(spec.shape[1:]) if lead else spec for spec, lead in zip(function.inputs.values(), batched, strict=True)]
    shapes = dataclasses.replace(function, inputs=dict(zip(function.inputs, alone, strict=True))).arguments({})

    def call(params: exported.Arrays, *inputs: Any) -> tuple[jax.Array, ...]:
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
