"""4D facial expressions as a JAX functional pipeline.

    models = facejax.load()
    landmarks = facejax.pipeline.landmarks(models, key, ["neutral", "high_smile"], models.face.vertices)

Sub-packages and the names below are imported when they are first used: `import facejax` imports no JAX and sets
nothing.
"""

from __future__ import annotations

import importlib

# Not from `typing`, whose import takes longer than the rest; type checkers know the name.
TYPE_CHECKING = False
if TYPE_CHECKING:
    from facejax import (
        augment,
        cli,
        data,
        evaluation,
        export,
        geometry,
        inference,
        io,
        landmarks,
        losses,
        mesh,
        metrics,
        models,
        training,
        viz,
    )
    from facejax.inference import pipeline
    from facejax.models.bundle import load

__version__ = "0.2.0"

__all__ = [
    "__version__",
    "augment",
    "cli",
    "data",
    "evaluation",
    "export",
    "geometry",
    "inference",
    "io",
    "landmarks",
    "load",
    "losses",
    "mesh",
    "metrics",
    "models",
    "pipeline",
    "training",
    "viz",
]


def __getattr__(name: str) -> object:
    if name == "load":
        return importlib.import_module("facejax.models.bundle").load
    if name == "pipeline":
        return importlib.import_module("facejax.inference.pipeline")
    if name in __all__:
        return importlib.import_module(f"facejax.{name}")
    raise AttributeError(f"module 'facejax' has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__
