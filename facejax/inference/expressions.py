"""Released expression networks: from the name of an expression to the motion of the landmarks (SL21).

    networks = expressions.load()
    curve = expressions.displacements(networks, "anger")  # (T, 68, 3)

E expressions, T frames, L landmarks. Curves are displacements from neutral, unitless: divided by the norm of the
centred neutral landmarks, in the face's frame (y up, z forward). `inference.retarget` applies them to a mesh.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from importlib import resources
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax.typing import DTypeLike

from facejax.inference import checks
from facejax.io import weights
from facejax.models import expression_lstm, model_file
from facejax.models.labels import Labels
from facejax.models.records import Provenance

RELEASED = "expressions.safetensors"
STOP = 0.01  # an expression has ended when its energy falls below this fraction of the maximum


class Expressions(struct.PyTreeNode):
    """One network per expression: a pytree of arrays, an argument of compiled functions."""

    labels: Labels = struct.field(pytree_node=False)
    params: expression_lstm.ExpressionLSTM  # stacked, (E, ...)
    config: expression_lstm.Config = struct.field(pytree_node=False)
    rate: float = struct.field(pytree_node=False)  # frames per second
    frames: int = struct.field(pytree_node=False)  # of the longest training sequence, its tail included
    about: Provenance = struct.field(pytree_node=False, default=Provenance())


def load(path: str | os.PathLike[str] | None = None) -> Expressions:
    """Read the released networks, or those of a file. Raises `weights.WeightsError`."""
    file: Any = path or resources.files("facejax.assets").joinpath(RELEASED)
    about = weights.load_metadata(file)
    labels, config, rate, frames = _check_metadata(file, about)
    like = _structure(config, len(labels))
    tree, about = weights.load(file, like)
    params = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), tree)
    return Expressions(Labels(labels), params, config, rate, frames, Provenance(about.get("about", {})))


def _check_metadata(file: Any, about: dict[str, Any]) -> tuple[tuple[str, ...], expression_lstm.Config, float, int]:
    """Return labels, configuration, rate and frames. Raises `WeightsError` for a missing or invalid field."""

    def refuse(field: str, expected: str, value: object) -> weights.WeightsError:
        return weights.WeightsError(
            f"{file} does not describe expression networks: field {field!r}: "
            f"expected {expected}, got {repr(value)[:80]}"
        )

    labels = model_file.read_labels(file, about, least=1)
    config: Any = about.get("config")
    rate, frames = about.get("rate"), about.get("frames")
    known = expression_lstm.Config._fields
    if not isinstance(config, dict) or not config.keys() <= set(known):
        raise refuse("config", f"a mapping with {', '.join(known)}", config)
    for name, low, high in (("landmarks", 1, 10_000), ("hidden", 1, 10_000), ("layers", 1, 100)):
        if name in config and not (type(config[name]) is int and low <= config[name] <= high):
            raise refuse(f"config/{name}", f"a whole number from {low} to {high}", config[name])
    if config.get("start", "zero") not in expression_lstm.STARTS:
        raise refuse("config/start", f"one of {', '.join(expression_lstm.STARTS)}", config["start"])
    carry, components = config.get("carry", 0.0), config.get("components")
    if type(carry) not in (int, float) or not 0 <= carry <= 1:
        raise refuse("config/carry", "a number from 0 to 1", carry)
    if components is not None and not (type(components) is int and 1 <= components <= 30_000):
        raise refuse("config/components", "a whole number from 1, or null", components)
    if not isinstance(rate, int | float) or not 0 < rate <= 1000:
        raise refuse("rate", "frames per second above 0, up to 1000", rate)
    if type(frames) is not int or not 2 <= frames <= 100_000:
        raise refuse("frames", "a whole number from 2 to 100000", frames)
    return labels, expression_lstm.Config(**config), float(rate), frames


def save(path: str | os.PathLike[str], networks: Expressions) -> None:
    """Write networks to one safetensors file, in half precision: curves change by a relative 2e-4."""
    halved = jax.tree.map(lambda leaf: np.asarray(leaf, np.float16), networks.params.weights)
    described = {
        "labels": list(networks.labels),
        "config": networks.config._asdict(),
        "rate": networks.rate,
        "frames": networks.frames,
        "about": dict(networks.about),
    }
    weights.save(path, networks.params._replace(weights=halved), metadata=described)


def network(networks: Expressions, label: str) -> expression_lstm.ExpressionLSTM:
    """Return the network of one expression. Raises `ValueError` for an unknown name, with the closest ones."""
    checks.check_expression(label, networks.labels)
    at = networks.labels.index(label)
    return jax.tree.map(lambda leaf: leaf[at], networks.params)


def displacements(
    networks: Expressions,
    label: str,
    neutral: np.ndarray | jax.Array | None = None,
    *,
    frames: int | None = None,
    prefix: np.ndarray | jax.Array | None = None,
    stop: float = STOP,
) -> jax.Array:
    """Generate the motion of an expression from neutral, (T, L, 3) or (..., T, L, 3), unitless.

    Args:
      neutral: (..., L, 3) landmarks at rest in any unit; needed by networks that start from the neutral face, ignored
        by others.
      frames: maximal length; default: that of the longest training sequence.
      prefix: (..., P, L, 3) unitless first frames to continue.
      stop: the motion ends at `expression_lstm.expression_length` of this fraction (of several faces, the last one's);
        0: after `frames`.

    Raises:
      ValueError: an unknown label or a wrong shape.
    """
    params, first = network(networks, label), None
    frames = networks.frames if frames is None else frames
    shape = (networks.config.landmarks, 3)
    if networks.config.start == "neutral":
        if neutral is None or np.shape(neutral)[-2:] != shape:
            got = None if neutral is None else np.shape(neutral)
            raise ValueError(f"neutral: expected landmarks at rest (..., {shape[0]}, 3), got {got}")
        first = unit_landmarks(neutral)
    if not 0 <= stop < 1:
        raise ValueError(f"stop must lie in 0..1, got {stop}")
    curve = expression_lstm.generate(
        params, first, None if prefix is None else jnp.asarray(prefix), frames=frames, stop=stop
    )
    if not stop:
        return curve
    return curve[..., : int(jnp.max(expression_lstm.expression_length(curve, fraction=stop))), :, :]


def unit_landmarks(neutral: np.ndarray | jax.Array) -> jax.Array:
    """Return landmarks (..., L, 3) centred and divided by their norm, as networks that start from them read them."""
    centred = jnp.asarray(neutral) - jnp.mean(jnp.asarray(neutral), axis=-2, keepdims=True)
    return centred / jnp.sqrt(jnp.sum(centred**2, axis=(-2, -1), keepdims=True))


def _structure(config: expression_lstm.Config, count: int) -> expression_lstm.ExpressionLSTM:
    """Return the tree of shapes and dtypes that a file holds."""
    size = config.landmarks * 3

    def make() -> expression_lstm.ExpressionLSTM:
        basis = None if config.components is None else jnp.zeros((size, config.components))
        scale = expression_lstm.Scale(jnp.ones(()), jnp.zeros((config.landmarks, 3)), jnp.ones(()), jnp.ones(()), basis)
        return expression_lstm.init(jax.random.key(0), scale, config=config)

    one = jax.eval_shape(make)  # a file's sizes are untrusted: nothing is allocated

    def stacked(dtype: DTypeLike) -> Callable[[jax.Array], jax.ShapeDtypeStruct]:
        return lambda leaf: jax.ShapeDtypeStruct((count, *leaf.shape), dtype)

    return expression_lstm.ExpressionLSTM(
        jax.tree.map(stacked(jnp.float32), one.scale), jax.tree.map(stacked(jnp.float16), one.weights)
    )
