"""Mathematics on arrays: the sphere of motions, the SRVF transform, alignment, radial basis functions.

Modules are imported when they are first used: `host` and `interpolation` need no JAX.
"""

from __future__ import annotations

import importlib
from types import ModuleType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from facejax.geometry import align, host, interpolation, rbf, sphere, srvf

__all__ = ["align", "host", "interpolation", "rbf", "sphere", "srvf"]


def __getattr__(name: str) -> ModuleType:
    if name in __all__:
        return importlib.import_module(f"{__name__}.{name}")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
