"""`facejax labels`: the expressions that a model file was trained on, read from the file's metadata without JAX."""

from __future__ import annotations

import os
from importlib import resources
from pathlib import Path

from facejax.cli.arguments import Labels
from facejax.io import weights
from facejax.models import model_file

MODELS = "makehuman4d.safetensors"  # `models.bundle.RELEASED`, which cannot be imported without JAX
EXPRESSIONS = "expressions.safetensors"  # `inference.expressions.RELEASED`


def read_labels(path: str | os.PathLike[str] | None = None, *, released: str = MODELS) -> tuple[str, ...]:
    """Return the labels of a model file, by default of a released one.

    Raises:
      WeightsError: the file is missing, damaged, or has no labels.
    """
    path = Path(str(resources.files("facejax.assets").joinpath(released))) if path is None else path
    return model_file.read_labels(path, weights.load_metadata(path))


def run(command: Labels) -> None:
    """Print one label a line."""
    print("\n".join(read_labels(command.model)))
