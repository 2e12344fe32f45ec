"""Inference composed: labels and a neutral face in, landmarks and meshes out.

    models = pipeline.load()
    landmarks = pipeline.landmarks(models, key, ["neutral", "high_smile", "neutral"], neutral)
    vertices = pipeline.meshes(models, landmarks, neutral)

Millimetres. A neutral face is (N, 3) vertices in the models' topology; T frames, L landmarks, S samples.
"""

from __future__ import annotations

import difflib
import functools
import os
from collections.abc import Sequence
from importlib import resources
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import traverse_util

from facejax import weights
from facejax.geometry import align, srvf
from facejax.io import dress
from facejax.mesh import topology
from facejax.models import charts, decoder, motion, starts

RATE = 30.0  # frames per second of the motions that the generator learnt
RELEASED = "makehuman4d.safetensors"


class Face(NamedTuple):
    """The topology that the models were trained on."""

    vertices: np.ndarray  # (N, 3) a neutral face to start from: the average of the population
    faces: np.ndarray  # (F, 3) triangles
    landmark_index: np.ndarray  # (L,) vertices
    source_index: np.ndarray  # (N,) vertices of MakeHuman's body, or empty: another topology
    mask: np.ndarray  # (N,) bool, the face region


class Models(NamedTuple):
    """Everything that inference needs."""

    labels: tuple[str, ...]  # neutral first
    face: Face
    props: dress.Props  # eyes and teeth of the template, for pictures; without landmarks: none
    motion: motion.Params
    starts: starts.Params  # where a motion starts that does not start at neutral
    hierarchy: Any
    decoder: Any
    about: dict[str, Any]  # how the weights were made


def load(path: str | os.PathLike | None = None) -> Models:
    """The released models, or those of a file. Raises `weights.WeightsError`."""
    path = path or resources.files("facejax.assets").joinpath(RELEASED)
    about = weights.load_metadata(path)
    try:
        like = _structure(about["shapes"])
    except (KeyError, TypeError) as error:
        raise weights.WeightsError(f"{path} does not describe facejax models ({error})") from error
    tree, about = weights.load(path, like)
    try:
        tree["hierarchy"] = topology.load(tree["hierarchy"])
    except ValueError as error:
        raise weights.WeightsError(f"{path}: {error}") from error
    # The face and its props stay on the host: they are read by exporters, not by networks.
    moved = {name: jax.tree.map(jnp.asarray, tree[name]) for name in ("motion", "starts", "hierarchy", "decoder")}
    return Models(labels=tuple(about["labels"]), about=about, **tree | moved)


def save(path: str | os.PathLike, models: Models) -> None:
    """Write models to one safetensors file; `about` gains what `load` needs."""
    tree = models._asdict()
    about = tree.pop("about") | {"labels": list(tree.pop("labels"))}
    tree["hierarchy"] = topology.save(models.hierarchy)
    leaves = {name: (np.asarray(x).dtype.name, np.shape(x)) for name, x in weights.names(tree).items()}
    weights.save(path, tree, metadata=about | {"shapes": leaves})


def landmarks(
    models: Models,
    key: jax.Array,
    labels: Sequence[str],
    neutral: np.ndarray | jax.Array,
    *,
    samples: int | None = None,
    frames: int = 30,
    intensity: float = 1.0,
) -> jax.Array:
    """Landmark motion through `labels`: (T, L, 3), or (S, T, L, 3) with `samples`.

    `frames` is the length of one transition; T = 1 + (frames - 1) x transitions, joints not repeated. A motion that
    does not start at neutral starts at a peak drawn for it (`facejax.models.starts`), scaled to the face. `intensity`
    scales all displacements from neutral.

    Raises `ValueError` for an unknown label, a wrong vertex count, or options out of range.
    """
    if not 0 <= intensity <= 2:
        raise ValueError(f"intensity must lie in 0..2, got {intensity}")
    rest = neutral_landmarks(models, neutral)
    unitless = displacements(models, key, labels, samples=1 if samples is None else samples, frames=frames)
    moved = rest + intensity * jnp.linalg.norm(rest - rest.mean(axis=0)) * unitless
    return moved if samples is not None else moved[0]


def displacements(
    models: Models, key: jax.Array, labels: Sequence[str], *, samples: int, frames: int = 30
) -> jax.Array:
    """Displacements from neutral (S, T, L, 3) through `labels`, unitless: divided by the face's landmark norm."""
    indices = label_indices(models, labels)
    if len(indices) < 2:
        raise ValueError(f"labels: expected at least a start and an end, got {list(labels)}")
    for before, after in zip(labels[:-1], labels[1:], strict=True):
        if before == after:
            raise ValueError(f"labels: {before!r} follows itself; a transition needs two different labels")
    if frames < 2 or samples < 1:
        raise ValueError(f"frames must be 2 or more and samples 1 or more, got {frames} and {samples}")
    pairs = jnp.asarray(np.stack([indices[:-1], indices[1:]], axis=1), jnp.int32)
    return _compose(models.motion, models.starts, jax.random.split(key, samples), pairs, frames=frames)


def meshes(models: Models, landmarks: jax.Array, neutral: np.ndarray | jax.Array) -> jax.Array:
    """Landmarks (..., T, L, 3) of a face and its neutral vertices (N, 3) -> vertices (..., T, N, 3)."""
    rest = neutral_landmarks(models, neutral)
    if landmarks.shape[-2:] != rest.shape:
        raise ValueError(f"landmarks: expected (..., {rest.shape[0]}, 3), got {landmarks.shape}")
    return _decode(models.decoder, models.hierarchy, landmarks - rest, jnp.asarray(neutral, jnp.float32))


def captions(labels: Sequence[str], *, frames: int = 30) -> tuple[tuple[int, str], ...]:
    """(first frame, "neutral → high_smile") of each transition."""
    pairs = zip(labels[:-1], labels[1:], strict=True)
    return tuple((i * (frames - 1), f"{start} → {end}") for i, (start, end) in enumerate(pairs))


def neutral_landmarks(models: Models, neutral: np.ndarray | jax.Array) -> jax.Array:
    """The landmarks (L, 3) of a neutral face (N, 3). Raises `ValueError` for another vertex count."""
    expected = models.face.vertices.shape
    if np.shape(neutral) != expected:
        raise ValueError(f"neutral: expected vertices {expected} in the models' topology, got {np.shape(neutral)}")
    return jnp.asarray(neutral, jnp.float32)[models.face.landmark_index]


def label_indices(models: Models, labels: Sequence[str]) -> np.ndarray:
    """Indices of label names. Raises `ValueError` with the nearest names for an unknown one."""
    for name in labels:
        if name not in models.labels:
            near = difflib.get_close_matches(name, models.labels, n=3, cutoff=0.4)
            hint = f"did you mean {', '.join(near)}?" if near else f"there are {', '.join(models.labels)}"
            raise ValueError(f"unknown label {name!r}: {hint}")
    return np.array([models.labels.index(name) for name in labels], np.int32)


@functools.partial(jax.jit, static_argnames="frames")
def _compose(generator, beginnings, keys, pairs, *, frames):
    """Unitless displacements from neutral (S, T, L, 3) through P transitions (P, 2)."""

    def one(key):
        def transition(displacement, inputs):
            key, first, (start, end) = inputs
            motion_key, start_key = jax.random.split(key)
            q, log_length = motion.sample(generator, motion_key, start, end)
            travel = srvf.decode(q, log_length, jnp.zeros_like(displacement))[-1]
            # The motion was made for somebody who starts there, and ends at a peak of `end`.
            meant = starts.sample(beginnings, start_key, travel, start, end)
            here = jnp.where(first, meant, displacement)
            curve = _settle(srvf.decode(q, log_length, meant), here)
            if frames != curve.shape[0]:
                curve = align.resample(curve, frames=frames)
            return curve[-1], curve

        first = jnp.arange(len(pairs)) == 0
        inputs = (jax.random.split(key, len(pairs)), first, pairs)
        _, curves = jax.lax.scan(transition, jnp.zeros_like(beginnings.mean[0]), inputs)
        rest = curves[:, 1:].reshape(-1, *curves.shape[2:])
        return jnp.concatenate([curves[0, :1], rest])

    return jax.vmap(one)(keys)


def _settle(curve: jax.Array, start: jax.Array) -> jax.Array:
    """Let a curve (T, L, 3) begin at `start` (L, 3), and end where it was going.

    The generator knows labels, not where the face stands. Added up as they come, transitions would drift ever further
    from any face; here what separates the two beginnings fades in proportion to the path covered: no jump, no motion
    where there was none, and every transition ends at a peak of its own label. A way home ends at neutral exactly.
    """
    steps = jnp.sqrt(jnp.sum(jnp.diff(curve, axis=0) ** 2, axis=(1, 2)))
    covered = jnp.concatenate([jnp.zeros(1), jnp.cumsum(steps)]) / jnp.maximum(jnp.sum(steps), 1e-12)
    return curve + (1 - covered)[:, None, None] * (start - curve[0])


@jax.jit
def _decode(params, hierarchy, displacements, neutral):
    return neutral + decoder.apply(params, hierarchy, displacements)


def _structure(shapes: dict[str, list]) -> dict[str, Any]:
    """The tree to expect, rebuilt from the leaf names, dtypes and shapes that a file states.

    Raises `KeyError` or `TypeError` where the names are not those of our records.
    """
    flat = {name: jax.ShapeDtypeStruct(tuple(shape), np.dtype(dtype)) for name, (dtype, shape) in shapes.items()}
    nested = traverse_util.unflatten_dict(flat, sep="/")
    tables = {f"{table}/{i}": leaf for table, rows in nested["hierarchy"].items() for i, leaf in rows.items()}
    networks = {}
    for name in ("motion", "decoder"):
        weights = nested[name]["weights"]
        networks[name] = weights | {key: _listed(weights[key]) for key in ("blocks", "convs") if key in weights}
    return {
        "face": Face(**nested["face"]),
        "props": dress.Props(**nested["props"]),
        "motion": motion.Params(charts.Chart(**nested["motion"]["chart"]), networks["motion"]),
        "starts": starts.Params(**nested["starts"]),
        "hierarchy": tables,
        "decoder": decoder.Params(decoder.Scale(**nested["decoder"]["scale"]), networks["decoder"]),
    }


def _listed(rows: dict[str, Any]) -> list:
    return [rows[str(i)] for i in range(len(rows))]
