"""Readers and writers of meshes, landmarks, animations and weights. All readers accept untrusted files.

`save` writes an animation in the format of the path's suffix (`facejax.io.export`), `load_mesh` reads a mesh
(`facejax.io.meshes.read`). Both are imported on first use, because images and videos need `facejax.viz`.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from facejax.io import landmarks, meshes
    from facejax.io.export import save
    from facejax.io.meshes import read as load_mesh

__all__ = ["landmarks", "load_mesh", "meshes", "save"]


def __getattr__(name: str) -> Any:
    if name == "save":
        return importlib.import_module("facejax.io.export").save
    if name == "load_mesh":
        return importlib.import_module("facejax.io.meshes").read
    if name in __all__:
        return importlib.import_module(f"facejax.io.{name}")
    raise AttributeError(f"module 'facejax.io' has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__
