"""Weights files: trees of arrays in safetensors format, with metadata.

A file contains raw arrays and a JSON header, and no code. Leaves are named by their path in the tree, such as
`weights/blocks/0/kernel`. Loading needs a tree of the expected shapes, such as `jax.eval_shape` of
an `init`, and checks names, shapes and dtypes against it, so that a file of another model or version is rejected as a
whole.

JAX is imported inside functions, so that `load_metadata` answers without it.
"""

import json
import os
from pathlib import Path
from typing import Any

import ml_dtypes
import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save as _serialise

from facejax.io import atomic, errors

Tree = Any
_HEADER = "facejax"
DTYPES = {"BOOL": np.dtype(bool), "BF16": np.dtype(ml_dtypes.bfloat16)} | {
    f"{kind.upper()}{8 * size}": np.dtype(f"{kind}{size}")
    for kind in "fiu"
    for size in (1, 2, 4, 8)
    if kind + str(size) != "f1"
}


class WeightsError(errors.FileError):
    """A weights file is missing, damaged, or of another model."""


def names(tree: Tree) -> dict[str, Any]:
    """Return the leaves of a tree by name (`a/0/b`), in the order of `jax.tree.leaves`.

    Raises:
      ValueError: two leaves have the same name.
    """
    import jax

    leaves = {}
    for path, leaf in jax.tree_util.tree_flatten_with_path(tree)[0]:
        name = jax.tree_util.keystr(path, simple=True, separator="/")
        if name in leaves:
            raise ValueError(f"two leaves of the tree are both named {name!r}; rename a key that contains '/'")
        leaves[name] = leaf
    return leaves


def save(path: str | os.PathLike[str], tree: Tree, *, metadata: dict[str, Any] | None = None) -> None:
    """Save trained parameters, any tree of arrays, and JSON-serialisable `metadata` as safetensors, atomically."""
    path = Path(path)
    arrays = {name: np.asarray(leaf, order="C") for name, leaf in names(tree).items()}
    header = {_HEADER: json.dumps(metadata or {}, sort_keys=True)}
    data = _serialise(arrays, metadata=header)
    with atomic.replace_file(path) as temporary:
        temporary.write_bytes(data)


def load(path: str | os.PathLike[str], like: Tree) -> tuple[Tree, dict[str, Any]]:
    """Read a tree of NumPy arrays, and the metadata.

    Args:
      path: a safetensors file.
      like: the expected tree, with arrays or `jax.ShapeDtypeStruct` as leaves.

    Raises:
      WeightsError: naming the file and every leaf that is missing, unexpected, or of another shape or dtype.
    """
    import jax

    with _open(path) as file:
        metadata, expected = _metadata(path, file), names(like)
        # From the header, before any array is read.
        stated = {name: _shape_and_dtype(file, name) for name in file.keys()}  # noqa: SIM118 (not a mapping)
        if wrong := mismatches(expected, stated):
            raise WeightsError(f"{path} does not match the model: {'; '.join(wrong)}")
        found = {name: file.get_tensor(name) for name in expected}
    return jax.tree.unflatten(jax.tree.structure(like), [found[name] for name in expected]), metadata


def load_metadata(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Read only the metadata, such as the configuration from which to build `like`."""
    with _open(path) as file:
        return _metadata(path, file)


def mismatches(expected: dict[str, Any], found: dict[str, Any]) -> list[str]:
    """Return one line per leaf name that is missing, unexpected, or differs in shape or dtype."""
    wrong = []
    for name in expected.keys() | found.keys():
        if name not in found:
            wrong.append(f"{name} is missing")
        elif name not in expected:
            wrong.append(f"{name} is unexpected")
        elif _describe(expected[name]) != _describe(found[name]):
            wrong.append(f"{name} should be {_describe(expected[name])}, is {_describe(found[name])}")
    return sorted(wrong)


def _describe(leaf: Any) -> str:
    return f"{np.dtype(leaf.dtype).name}{list(leaf.shape)}"


def _shape_and_dtype(file: safe_open, name: str) -> Any:
    """Return the shape and dtype of a tensor in the header; an unsupported dtype becomes void."""
    import jax

    part = file.get_slice(name)
    return jax.ShapeDtypeStruct(tuple(part.get_shape()), DTYPES.get(part.get_dtype(), np.dtype("V1")))


def _open(path: str | os.PathLike[str]) -> safe_open:
    try:
        return safe_open(path, framework="np")
    except FileNotFoundError:
        raise WeightsError(f"{path}: no such weights file") from None
    except (SafetensorError, OSError) as error:
        raise WeightsError(
            f"{path} is not a complete safetensors file ({error}); download or write it again"
        ) from error


def _metadata(path: str | os.PathLike[str], file: safe_open) -> dict[str, Any]:
    try:
        return json.loads((file.metadata() or {})[_HEADER])
    except (KeyError, json.JSONDecodeError):
        raise WeightsError(f"{path} is a safetensors file, but its header lacks the {_HEADER!r} entry") from None
