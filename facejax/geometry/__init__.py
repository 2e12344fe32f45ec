"""Pure mathematics on arrays: the sphere of motions, the SRVF transform, alignment, radial basis functions."""

from facejax.geometry import align, rbf, sphere, srvf

__all__ = ["align", "rbf", "sphere", "srvf"]
