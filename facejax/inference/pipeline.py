"""Inference composed: labels and a neutral face in, landmarks and meshes out.

    models = pipeline.load()
    landmarks = pipeline.landmarks(models, key, ["neutral", "high_smile", "neutral"], neutral)
    vertices = pipeline.meshes(models, landmarks, neutral)

Millimetres. A neutral face is (N, 3) vertices in the models' topology; T frames, L landmarks, S samples.
"""

from __future__ import annotations

import difflib
import os
from collections.abc import Sequence
from importlib import resources
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import traverse_util

from facejax.inference import composition
from facejax.io import weights
from facejax.mesh import hierarchy as mesh_hierarchy
from facejax.models.decoders import gpmm_residual, s2d_dec
from facejax.models.motion import generators, start_poses, tangent_pca
from facejax.viz import eyes_teeth

RATE = 30.0  # frames per second at which motions are played
FRAMES = 30  # of a transition, as the generator learnt them
RELEASED = "makehuman4d.safetensors"
S2D, REFINED = "s2d", "refined"  # kinds of decoder
COMPONENTS = 200  # of the best linear answer, in a file: as many more gain 0.001 mm, and weigh 4 MB


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
    props: eyes_teeth.Props  # eyes and teeth of the template, for pictures; without landmarks: none
    motion: generators.Params
    starts: start_poses.Params  # peaks from which a motion starts that does not start at neutral
    hierarchy: mesh_hierarchy.Hierarchy
    decoder: s2d_dec.Params | gpmm_residual.Params  # S2D-Dec, or the best linear answer refined
    about: dict[str, Any]  # how the weights were made


def load(path: str | os.PathLike | None = None) -> Models:
    """The released models, or those of a file. Raises `weights.WeightsError`."""
    path = path or resources.files("facejax.assets").joinpath(RELEASED)
    about = weights.load_metadata(path)
    try:
        like = _structure(about["shapes"], about["generator"])
    except (KeyError, TypeError) as error:
        raise weights.WeightsError(f"{path} does not describe facejax models ({error})") from error
    tree, about = weights.load(path, like)
    try:
        tree["hierarchy"] = mesh_hierarchy.load(tree["hierarchy"])
        if about.get("decoder", S2D) == REFINED:
            tree["decoder"] = gpmm_residual.unpack(tree["decoder"], tree["hierarchy"], tree["face"].faces)
    except (ValueError, KeyError, TypeError) as error:
        raise weights.WeightsError(f"{path}: {error}") from error
    # The face and its props stay on the host: they are read by exporters, not by networks.
    networks = ["motion", "starts", "hierarchy"]
    networks += ["decoder"] if isinstance(tree["decoder"], s2d_dec.Params) else []
    moved = {name: jax.tree.map(jnp.asarray, tree[name]) for name in networks}
    return Models(labels=tuple(about["labels"]), about=about, **tree | moved)


def save(path: str | os.PathLike, models: Models) -> None:
    """Write models to one safetensors file; `about` gains what `load` needs."""
    tree = models._asdict()
    refined = isinstance(models.decoder, gpmm_residual.Params)
    about = tree.pop("about") | {"labels": list(tree.pop("labels")), "generator": generators.kind(models.motion)}
    about["decoder"] = REFINED if refined else S2D
    tree["hierarchy"] = mesh_hierarchy.save(models.hierarchy)
    if refined:
        tree["decoder"] = gpmm_residual.pack(models.decoder, components=COMPONENTS)
    leaves = {name: (np.asarray(x).dtype.name, np.shape(x)) for name, x in weights.names(tree).items()}
    weights.save(path, tree, metadata=about | {"shapes": leaves})


def landmarks(
    models: Models,
    key: jax.Array,
    labels: Sequence[str],
    neutral: np.ndarray | jax.Array,
    *,
    samples: int | None = None,
    frames: int | Sequence[int] = FRAMES,
    intensity: float = 1.0,
) -> jax.Array:
    """Landmark motion through `labels`: (T, L, 3), or (S, T, L, 3) with `samples`.

    `frames` is the length of one transition, or one number for each; T = 1 + sum of (frames - 1), joints not repeated.
    `durations` gives natural ones. A motion that does not start at neutral starts at a peak drawn for it
    (`facejax.models.starts`), scaled to the face. `intensity` scales all displacements from neutral.

    Raises `ValueError` for an unknown label, a wrong vertex count, or options out of range.
    """
    if not 0 <= intensity <= 2:
        raise ValueError(f"intensity must lie in 0..2, got {intensity}")
    rest = neutral_landmarks(models, neutral)
    unitless = displacements(models, key, labels, samples=1 if samples is None else samples, frames=frames)
    moved = rest + intensity * jnp.linalg.norm(rest - rest.mean(axis=0)) * unitless
    return moved if samples is not None else moved[0]


def displacements(
    models: Models, key: jax.Array, labels: Sequence[str], *, samples: int, frames: int | Sequence[int] = FRAMES
) -> jax.Array:
    """Displacements from neutral (S, T, L, 3) through `labels`, unitless: divided by the face's landmark norm."""
    numbers = _numbers(models, labels)
    each = lengths(labels, frames)
    return composition.compose(models.motion, models.starts, key, numbers, samples=samples, frames=each)


def durations(models: Models, key: jax.Array, labels: Sequence[str], *, rate: float = RATE) -> tuple[int, ...]:
    """How many frames each transition takes at `rate` frames per second, as people perform it.

    Generated with the motion: give `landmarks` the same key, and these as its `frames`. Of several samples, the first.
    """
    if not rate > 0:
        raise ValueError(f"rate must be above 0 frames per second, got {rate}")
    pairs = composition.pairs_of(_numbers(models, labels))
    drawn = composition.draw(models.motion, models.starts, composition.keys_of(key, 1), pairs)
    seconds = np.exp(np.asarray(drawn.log_seconds[0]))
    return tuple(max(2, 1 + round(float(x) * rate)) for x in seconds)


def lengths(labels: Sequence[str], frames: int | Sequence[int]) -> tuple[int, ...]:
    """One length for each transition. Raises `ValueError` for another number of them, or fewer than two frames."""
    count = len(labels) - 1
    found = (frames,) * count if np.ndim(frames) == 0 else tuple(frames)
    if len(found) != count:
        raise ValueError(f"frames: expected one number, or {count} for {count} transitions, got {len(found)}")
    if any(n != int(n) or n < 2 for n in found):
        raise ValueError(f"frames: expected whole numbers of 2 or more, got {frames}")
    return tuple(int(n) for n in found)


def meshes(
    models: Models,
    landmarks: jax.Array,
    neutral: np.ndarray | jax.Array,
    *,
    refined: bool = True,
    noise: float | None = 0.0,
) -> jax.Array:
    """Landmarks (..., T, L, 3) of a face and its neutral vertices (N, 3) -> vertices (..., T, N, 3).

    Without `refined` the linear answer alone, much faster and little worse; `noise` tells by how many mm landmarks are
    off, such as those of a detector; None finds it out. Both as in `expand.apply`; S2D-Dec refuses `noise`.
    """
    rest = neutral_landmarks(models, neutral)
    if landmarks.shape[-2:] != rest.shape:
        raise ValueError(f"landmarks: expected (..., {rest.shape[0]}, 3), got {landmarks.shape}")
    if isinstance(models.decoder, gpmm_residual.Params):
        return jnp.asarray(neutral, jnp.float32) + gpmm_residual.apply(
            models.decoder, landmarks - rest, neutral, refined=refined, noise=noise
        )
    if noise != 0:
        raise ValueError("noise: S2D-Dec cannot be told of it; the best linear answer can (`facejax.expand`)")
    return _decode(models.decoder, models.hierarchy, landmarks - rest, jnp.asarray(neutral, jnp.float32))


def captions(labels: Sequence[str], *, frames: int | Sequence[int] = FRAMES) -> tuple[tuple[int, str], ...]:
    """(first frame, "neutral → high_smile") of each transition."""
    begins = np.cumsum([0] + [count - 1 for count in lengths(labels, frames)])
    pairs = zip(labels[:-1], labels[1:], strict=True)
    return tuple((int(begin), f"{start} → {end}") for begin, (start, end) in zip(begins, pairs, strict=False))


def neutral_landmarks(models: Models, neutral: np.ndarray | jax.Array) -> jax.Array:
    """The landmarks (L, 3) of a neutral face (N, 3).

    Raises `ValueError` for another vertex count, or a size that no head has in millimetres.
    """
    expected = models.face.vertices.shape
    if np.shape(neutral) != expected:
        raise ValueError(f"neutral: expected vertices {expected} in the models' topology, got {np.shape(neutral)}")
    if not isinstance(neutral, jax.core.Tracer):
        size, usual = (
            np.linalg.norm(np.ptp(np.asarray(x)[models.face.landmark_index], axis=0))
            for x in (neutral, models.face.vertices)
        )
        if not usual / 3 < size < 3 * usual:
            raise ValueError(
                f"neutral: its landmarks span {size:.4g}, expected about {usual:.0f} mm: give vertices in millimetres"
            )
    return jnp.asarray(neutral, jnp.float32)[models.face.landmark_index]


def label_indices(models: Models, labels: Sequence[str]) -> np.ndarray:
    """Indices of label names. Raises `ValueError` with the nearest names for an unknown one."""
    _check_names(labels)
    for name in labels:
        if name not in models.labels:
            near = difflib.get_close_matches(name, models.labels, n=3, cutoff=0.4)
            hint = f"did you mean {', '.join(near)}?" if near else f"there are {', '.join(models.labels)}"
            raise ValueError(f"unknown label {name!r}: {hint}")
    return np.array([models.labels.index(name) for name in labels], np.int32)


def _check_names(labels: Sequence[str]) -> None:
    if isinstance(labels, str):
        raise ValueError(f"labels: expected a sequence of names, got the one name {labels!r}")


def _numbers(models: Models, labels: Sequence[str]) -> np.ndarray:
    _check_names(labels)
    for before, after in zip(labels[:-1], labels[1:], strict=True):
        if before == after:
            raise ValueError(f"labels: {before!r} follows itself; a transition needs two different labels")
    if len(labels) < 2:
        raise ValueError(f"labels: expected at least a start and an end, got {list(labels)}")
    return label_indices(models, labels)


@jax.jit
def _decode(params, hierarchy, displacements, neutral):
    return neutral + s2d_dec.apply(params, hierarchy, displacements)


def _structure(shapes: dict[str, list], generator: str) -> dict[str, Any]:
    """The tree to expect, rebuilt from the leaf names, dtypes and shapes that a file states.

    Raises `KeyError` or `TypeError` where the names are not those of our records.
    """
    flat = {name: jax.ShapeDtypeStruct(tuple(shape), np.dtype(dtype)) for name, (dtype, shape) in shapes.items()}
    nested = traverse_util.unflatten_dict(flat, sep="/")
    tables = {f"{table}/{i}": leaf for table, rows in nested["hierarchy"].items() for i, leaf in rows.items()}
    networks = {}
    for name in ("motion", "decoder"):
        networks[name] = _listed(nested[name].get("weights", {}))
    return {
        "face": Face(**nested["face"]),
        "props": eyes_teeth.Props(**nested["props"]),
        "motion": generators.KINDS[generator](tangent_pca.Chart(**nested["motion"]["chart"]), networks["motion"]),
        "starts": start_poses.Params(**nested["starts"]),
        "hierarchy": tables,
        "decoder": (
            _listed(nested["decoder"])
            if "base" in nested["decoder"]
            else s2d_dec.Params(s2d_dec.Scale(**nested["decoder"]["scale"]), networks["decoder"])
        ),
    }


def _listed(tree: Any) -> Any:
    """A nested dict whose numbered entries, "0" to the last, are lists again."""
    if not isinstance(tree, dict):
        return tree
    rows = {name: _listed(rows) for name, rows in tree.items()}
    return [rows[str(i)] for i in range(len(rows))] if "0" in rows else rows
