"""Inputs that several commands read: the neutral face."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from facejax.inference import pipeline
from facejax.io import neutral_face
from facejax.landmarks import canonical_frame


def read_neutral(path: Path | None, model: Path | None = None) -> tuple[np.ndarray, tuple[str, ...]]:
    """Return the neutral face (N, 3) of a file in the model's topology, and notes on what was assumed.

    Without a path: the average face. Raises `MeshError` for a face in another topology or of unknown unit.
    """
    face = pipeline.load(model).face
    if path is None:
        return np.asarray(face.vertices), ()
    topology = canonical_frame.Topology(
        np.asarray(face.vertices), np.asarray(face.landmark_index), np.asarray(face.source_index)
    )
    found = neutral_face.read(path, topology)
    return found.vertices, found.notes
