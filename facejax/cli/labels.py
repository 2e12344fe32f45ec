"""`facejax labels`: the expressions that a model file was trained on, read from the file's metadata without JAX."""

from __future__ import annotations

import os
from importlib import resources
from pathlib import Path

from facejax.cli.arguments import Labels
from facejax.io import weights

MODELS = "makehuman4d.safetensors"  # `models.bundle.RELEASED`, which cannot be imported without JAX
EXPRESSIONS = "expressions.safetensors"  # `inference.expressions.RELEASED`


def read_labels(path: str | os.PathLike[str] | None = None, *, released: str = MODELS) -> tuple[str, ...]:
    """Return the labels of a model file, by default of a released one.

    Raises:
      WeightsError: the file is missing, damaged, or has no labels.
    """
    path = Path(str(resources.files("facejax.assets").joinpath(released))) if path is None else path
    found = weights.load_metadata(path).get("labels")
    if not isinstance(found, list) or not all(isinstance(name, str) for name in found):
        raise weights.WeightsError(f"{path} does not describe facejax models ('labels')")
    return tuple(found)


def run(command: Labels) -> None:
    """Print one label a line."""
    print("\n".join(read_labels(command.model)))
