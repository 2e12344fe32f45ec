"""Pure mathematics on arrays: the sphere of motions, the SRVF transform, alignment."""

from facejax.geometry import align, sphere, srvf

__all__ = ["align", "sphere", "srvf"]
