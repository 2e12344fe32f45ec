"""Model files: labels, the mesh topology, a generator of motion and a mesh decoder in one record.

    models = bundle.load()
    bundle.save("own.safetensors", models)

N vertices, F triangles, L landmarks; millimetres.
"""

from __future__ import annotations

import os
from importlib import resources
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct, traverse_util

from facejax.io import weights
from facejax.mesh import hierarchy as mesh_hierarchy
from facejax.models import model_file
from facejax.models.decoders import gpmm_residual, s2d_dec
from facejax.models.labels import Labels
from facejax.models.motion import generators, start_poses, tangent_pca
from facejax.models.records import HostLeaf, Provenance

RELEASED = "makehuman4d.safetensors"
COMPONENTS = 200  # of the GPMM in a file; twice as many gain 0.001 mm and add 4 MB


class Face(struct.PyTreeNode):
    """The mesh topology that the models were trained on."""

    vertices: HostLeaf  # (N, 3) the mean neutral face of the population, mm
    faces: HostLeaf  # (F, 3) triangles
    landmark_index: HostLeaf  # (L,) vertices
    source_index: HostLeaf  # (N,) vertices of MakeHuman's body; empty for another topology
    mask: HostLeaf  # (N,) bool, the face region


class Models(struct.PyTreeNode):
    """All models that inference needs: a pytree of arrays, an argument of compiled functions."""

    face: Face
    motion: generators.Generator
    starts: start_poses.StartPoses  # distribution of the poses from which a motion starts
    hierarchy: mesh_hierarchy.Hierarchy
    decoder: s2d_dec.S2DDec | gpmm_residual.GPMMResidual  # S2D-Dec, or GPMM estimate plus residual decoder
    labels: Labels = struct.field(pytree_node=False)
    about: Provenance = struct.field(pytree_node=False, default=Provenance())


def load(path: str | os.PathLike[str] | None = None) -> Models:
    """Read the released models, or those of a file.

    Raises:
      WeightsError: a file that is missing, damaged or not a facejax model; the message names the field.
    """
    path = path or str(resources.files("facejax.assets").joinpath(RELEASED))
    about = weights.load_metadata(path)
    model_file.check_metadata(path, about)
    try:
        like = _structure(about["shapes"], about["generator"])
    except (KeyError, TypeError, ValueError) as error:
        raise weights.WeightsError(f"{path} does not describe facejax models: field 'shapes': {error}") from error
    tree, about = weights.load(path, like)
    tree.pop("props", None)
    _check_indices(path, tree["face"])
    try:
        tree["hierarchy"] = mesh_hierarchy.load(tree["hierarchy"])
        if about.get("decoder", model_file.S2D) == model_file.REFINED:
            tree["decoder"] = gpmm_residual.unpack(tree["decoder"], tree["hierarchy"], tree["face"].faces)
    except (ValueError, KeyError, TypeError) as error:
        raise weights.WeightsError(f"{path}: {error}") from error
    # The face stays on the host: exporters read it, networks do not.
    networks = ["motion", "starts", "hierarchy"]
    networks += ["decoder"] if isinstance(tree["decoder"], s2d_dec.S2DDec) else []
    moved = {name: jax.tree.map(jnp.asarray, tree[name]) for name in networks}
    return Models(labels=Labels(about["labels"]), about=Provenance(about), **tree | moved)


def save(path: str | os.PathLike[str], models: Models) -> None:
    """Write models to one safetensors file, with the metadata that `load` needs."""
    tree: dict[str, Any] = {
        name: getattr(models, name) for name in ("face", "motion", "starts", "hierarchy", "decoder")
    }
    about = {**models.about, "labels": list(models.labels), "generator": generators.kind(models.motion)}
    about["decoder"] = model_file.S2D
    tree["hierarchy"] = mesh_hierarchy.save(models.hierarchy)
    if isinstance(models.decoder, gpmm_residual.GPMMResidual):
        about["decoder"] = model_file.REFINED
        tree["decoder"] = gpmm_residual.pack(models.decoder, components=COMPONENTS)
    leaves = {name: (np.asarray(x).dtype.name, np.shape(x)) for name, x in weights.names(tree).items()}
    weights.save(path, tree, metadata=about | {"shapes": leaves})


def _check_indices(path: str | os.PathLike[str], face: Face) -> None:
    """Raise `WeightsError` for a triangle or a landmark of a vertex that does not exist, and for invalid positions."""
    for name in ("faces", "landmark_index"):
        index = np.asarray(getattr(face, name))
        if index.dtype.kind not in "iu" or index.size == 0 or index.min() < 0 or index.max() >= len(face.vertices):
            raise weights.WeightsError(f"{path}: face/{name}: expected indices of {len(face.vertices)} vertices")
    if face.vertices.dtype.kind != "f" or not np.isfinite(face.vertices).all():
        raise weights.WeightsError(f"{path}: face/vertices: expected finite numbers")


def _structure(shapes: dict[str, list[Any]], generator: str) -> dict[str, Any]:
    """Return the expected tree, rebuilt from the leaf names, dtypes and shapes in a file's metadata.

    Raises:
      KeyError, TypeError: names that do not match the records.
    """
    flat = {name: jax.ShapeDtypeStruct(tuple(shape), np.dtype(dtype)) for name, (dtype, shape) in shapes.items()}
    nested = traverse_util.unflatten_dict(flat, sep="/")
    tables = {f"{table}/{i}": leaf for table, rows in nested["hierarchy"].items() for i, leaf in rows.items()}
    networks: dict[str, Any] = {}
    for name in ("motion", "decoder"):
        networks[name] = _restore_lists(nested[name].get("weights", {}))
    tree = {
        "face": Face(**nested["face"]),
        "motion": generators.KINDS[generator](tangent_pca.TangentPCA(**nested["motion"]["chart"]), networks["motion"]),
        "starts": start_poses.StartPoses(**nested["starts"]),
        "hierarchy": tables,
        "decoder": (
            _restore_lists(nested["decoder"])
            if "base" in nested["decoder"]
            else s2d_dec.S2DDec(s2d_dec.Scale(**nested["decoder"]["scale"]), networks["decoder"])
        ),
    }
    # Files of versions before 0.2 also contain the template's eyes and teeth, which `load` discards.
    return tree | ({"props": nested["props"]} if "props" in nested else {})


def _restore_lists(tree: Any) -> Any:
    """Return a nested dict in which dicts with keys "0", "1", ... are lists."""
    if not isinstance(tree, dict):
        return tree
    rows: dict[str, Any] = {name: _restore_lists(rows) for name, rows in tree.items()}
    return [rows[str(i)] for i in range(len(rows))] if "0" in rows else rows
