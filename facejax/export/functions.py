"""Catalogue of the functions that are exported: pure functions of named arrays, with their parameters as an argument.

    found = functions.catalogue(models)
    vertices, = found["decoder"].call(found["decoder"].params, *arrays)

Parameters are a dict of arrays by name, such as `decoder/network/gate`, and hold only what the function reads, so that
the functions of one catalogue share one file of weights. Inputs and outputs are float32, labels and indices int32.

N vertices, L landmarks, D directions of a start pose, n numbers of noise; millimetres.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.interpreters import partial_eval

from facejax.export.signature import Arrays, Dimension, Function, Spec
from facejax.inference import expressions, pipeline
from facejax.inference.expressions import Expressions
from facejax.inference.pipeline import Models, Noise, PreparedFace
from facejax.io import weights
from facejax.mesh import stencils
from facejax.mesh.hierarchy import Hierarchy
from facejax.models import expression_lstm
from facejax.models.decoders import gpmm, gpmm_residual, linear
from facejax.models.motion import generators

NAMES = ("motion", "prepare", "decoder", "decoder_linear", "chain", "lstm")


BATCH, TRANSITIONS, FRAMES = Dimension("batch"), Dimension("transitions"), Dimension("frames")


def catalogue(
    models: Models, names: Sequence[str] | None = None, *, networks: Expressions | None = None
) -> dict[str, Function]:
    """Return functions by name; by default all that the models have.

    Args:
      names: of `NAMES`. "decoder_linear" needs a GPMM decoder.
      networks: expression networks for "lstm"; default: the released ones.

    Raises:
      ValueError: an unknown name, or one that the models do not have.
    """
    has_linear = isinstance(models.decoder, gpmm_residual.GPMMResidual)
    possible = [name for name in NAMES if has_linear or name != "decoder_linear"]
    names = possible if names is None else names
    if unknown := [name for name in names if name not in possible]:
        raise ValueError(f"functions: expected some of {', '.join(possible)}, got {', '.join(unknown)}")
    models = _for_inference(models)
    build: dict[str, Callable[[], Function]] = {
        "motion": lambda: _motion(models),
        "prepare": lambda: _prepare(models),
        "decoder": lambda: _decoder(models, refined=True),
        "decoder_linear": lambda: _decoder(models, refined=False),
        "chain": lambda: _chain(models),
        "lstm": lambda: _lstm(expressions.load() if networks is None else networks),
    }
    return {name: build[name]() for name in names}


def face_arrays(face: PreparedFace) -> Arrays:
    """Return a prepared face as arrays by name, for landmarks without noise.

    `neutral` (N, 3), `rest` (L, 3) and `size` (); with a GPMM decoder also its linear map: `landmark_mean` (L, 3),
    `vertex_mean` (N, 3) and the factors `map_0`, ..., of which the first is (3 L, 3 N) or (3 L, k); mm.
    """
    arrays: Arrays = {"neutral": face.neutral, "rest": face.landmarks, "size": face.size}
    if face.decoder is not None:
        found = face.decoder.map
        arrays |= {"landmark_mean": found.landmark_mean, "vertex_mean": found.vertex_mean}
        arrays |= {f"map_{i}": factor for i, factor in enumerate(found.factors)}
    return arrays


def face_from_arrays(arrays: Mapping[str, Any]) -> PreparedFace:
    """Return the prepared face of `face_arrays`, without the statistics that noisy landmarks need."""
    neutral, decoder = arrays["neutral"], None
    if "map_0" in arrays:
        factors = tuple(arrays[f"map_{i}"] for i in range(sum(name.startswith("map_") for name in arrays)))
        face_map = linear.LinearMap(arrays["landmark_mean"], arrays["vertex_mean"], factors)
        none = jnp.zeros((0, *neutral.shape), neutral.dtype)
        statistics = gpmm.FaceStatistics(arrays["vertex_mean"], none)
        decoder = gpmm_residual.PreparedFace(neutral, statistics, face_map)
    return PreparedFace(neutral, arrays["rest"], arrays["size"], decoder)


def _motion(models: Models) -> Function:
    def call(models: Models, choice: Any, blur: Any, noise: Any, labels: Any, *inputs: Any) -> tuple[jax.Array]:
        timeline, rest, size, intensity = inputs
        random = Noise(choice, blur, noise)
        return (pipeline.motion_on_timeline(models, random, labels, rest, size, timeline, intensity),)

    marks = Spec((len(models.face.landmark_index), 3))
    inputs = _noise(models) | {"rest": marks, "size": Spec(()), "intensity": Spec((BATCH,))}
    return _function("motion", call, models, inputs, ("landmarks",))


def _prepare(models: Models) -> Function:
    names = tuple(_face(models))

    def call(models: Models, neutral: Any) -> tuple[jax.Array, ...]:
        arrays = face_arrays(pipeline.prepare(models, neutral))
        return tuple(arrays[name] for name in names)

    return _function("prepare", call, models, {"neutral": Spec(np.shape(models.face.vertices))}, names)


def _decoder(models: Models, *, refined: bool) -> Function:
    face = {name: spec for name, spec in _face(models).items() if name != "size"}  # the unit of motions only

    def call(models: Models, *inputs: Any) -> tuple[jax.Array]:
        *arrays, landmarks = inputs
        prepared = face_from_arrays({"size": jnp.ones(()), **dict(zip(face, arrays, strict=True))})
        return (pipeline.vertices(models, prepared, landmarks, refined=refined),)

    inputs = face | {"landmarks": Spec((BATCH, len(models.face.landmark_index), 3))}
    return _function("decoder" if refined else "decoder_linear", call, models, inputs, ("vertices",))


def _chain(models: Models) -> Function:
    face = _face(models)

    def call(models: Models, choice: Any, blur: Any, noise: Any, labels: Any, *inputs: Any) -> tuple[jax.Array]:
        timeline, *arrays, intensity = inputs
        prepared = face_from_arrays(dict(zip(face, arrays, strict=True)))
        random = Noise(choice, blur, noise)
        landmarks = pipeline.motion_on_timeline(
            models, random, labels, prepared.landmarks, prepared.size, timeline, intensity
        )
        return (pipeline.vertices(models, prepared, landmarks),)

    inputs = _noise(models) | face | {"intensity": Spec((BATCH,))}
    return _function("chain", call, models, inputs, ("vertices",))


def _lstm(networks: Expressions) -> Function:
    from_neutral = networks.config.start == "neutral"

    def call(params: Any, label: Any, curve: Any, known: Any, *neutral: Any) -> tuple[jax.Array]:
        own = jax.tree.map(lambda leaf: leaf[label], params["lstm"])
        first = expressions.unit_landmarks(neutral[0]) if neutral else None
        return (expression_lstm.continue_curve(own, curve, known, first),)

    points = (networks.config.landmarks, 3)
    inputs = {
        "label": Spec((), "int32"),
        "curve": Spec((BATCH, FRAMES, *points)),
        "known": Spec((), "int32"),
    }
    inputs |= {"neutral": Spec((BATCH, *points))} if from_neutral else {}
    found = _function("lstm", call, {"lstm": networks.params}, inputs, ("continued",))
    return dataclasses.replace(found, constraints=("frames >= 2",))


def _noise(models: Models) -> dict[str, Spec]:
    """Return the inputs of a motion's noise, labels and timeline."""
    drawn = len(models.motion.chart.p) + 1
    return {
        "choice": Spec((BATCH,)),
        "blur": Spec((BATCH, models.starts.poses.shape[2])),
        "noise": Spec((BATCH, TRANSITIONS, generators.noise_size(models.motion))),
        "labels": Spec((BATCH, Dimension("transitions", offset=1)), "int32"),
        "timeline": Spec((FRAMES, Dimension("transitions", factor=drawn))),
    }


def _face(models: Models) -> dict[str, Spec]:
    """Return the arrays of a prepared face."""
    neutral = jax.ShapeDtypeStruct(np.shape(models.face.vertices), np.float32)
    shapes = jax.eval_shape(lambda neutral: face_arrays(pipeline.prepare(models, neutral)), neutral)
    return {name: Spec(shapes[name].shape) for name in _sorted_face(shapes)}


def _for_inference(models: Models) -> Models:
    """Return models without the tables that only gradients read."""

    def smaller(hierarchy: Hierarchy) -> Hierarchy:
        climbs = tuple(map(stencils.without_transpose, hierarchy.climbs))
        return hierarchy._replace(climbs=climbs, surface=stencils.without_transpose(hierarchy.surface))

    decoder = models.decoder
    if isinstance(decoder, gpmm_residual.GPMMResidual):
        decoder = decoder.replace(hierarchy=smaller(decoder.hierarchy))
    return models.replace(hierarchy=smaller(models.hierarchy), decoder=decoder)


def _sorted_face(arrays: Mapping[str, Any]) -> list[str]:
    """Return the names of a prepared face in the order of `face_arrays`, which tracing sorts by name."""
    order = ("neutral", "rest", "size", "landmark_mean", "vertex_mean")
    return sorted(arrays, key=lambda name: (order.index(name), name) if name in order else (len(order), name))


def _function(
    name: str,
    call: Callable[..., tuple[jax.Array, ...]],
    tree: Any,
    inputs: dict[str, Spec],
    outputs: tuple[str, ...],
) -> Function:
    """Return a function of the leaves of `tree` that it reads, by name."""
    leaves, structure = weights.names(tree), jax.tree.structure(tree)
    arrays = {path: _as_float32(leaf) for path, leaf in leaves.items()}

    def flat(params: Arrays, *values: Any) -> tuple[jax.Array, ...]:
        # Leaves that are not among the parameters are not read: zeros, for their shape.
        rows = [params[path] if path in params else jnp.zeros(leaf.shape, leaf.dtype) for path, leaf in arrays.items()]
        return call(jax.tree.unflatten(structure, rows), *values)

    whole = Function(name, jax.jit(flat), arrays, inputs, outputs)
    sizes = dict.fromkeys(whole.symbols, 2)
    traced = jax.make_jaxpr(flat)(arrays, *whole.arguments(sizes))
    _, used = partial_eval.dce_jaxpr(traced.jaxpr, [True] * len(traced.jaxpr.outvars))
    read = [path for path, reads in zip(sorted(arrays), used, strict=False) if reads and arrays[path].size]
    return dataclasses.replace(whole, params={path: arrays[path] for path in read})


def _as_float32(leaf: Any) -> jax.Array:
    values = jnp.asarray(leaf)
    return values.astype(jnp.float32) if jnp.issubdtype(values.dtype, jnp.floating) else values
