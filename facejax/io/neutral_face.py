"""Reader of neutral faces, converted to the models' vertex order, millimetres, y up and z forward."""

from __future__ import annotations

import os

from facejax.io import meshes
from facejax.landmarks import canonical_frame
from facejax.landmarks.canonical_frame import Face, FaceError, Topology


def read(path: str | os.PathLike[str], topology: Topology) -> Face:
    """Read a neutral face in one of the topologies that `canonical_frame.fit` accepts.

    Raises:
      MeshError: the file is damaged, or its mesh has another topology or an unknown unit.
    """
    vertices = meshes.read(path).vertices
    try:
        return canonical_frame.fit(vertices, topology, name=str(path))
    except FaceError as error:
        raise meshes.MeshError(str(error)) from error
