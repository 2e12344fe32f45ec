"""Square-root velocity transform and geodesics by geomstats, in a separate Python environment.

    PYTHON benchmarks/_geomstats.py FOLDER

geomstats 2.8 needs NumPy below 2.4, so it is installed in another virtual environment than JAX. `benchmarks.srvf`
starts this file with that environment's Python; it imports nothing of facejax. FOLDER/curves.npy holds motions (K, T,
D). For every line `TASK` on standard input it runs the task and prints `done`; `save TASK` also writes the result to
FOLDER/TASK.npy. All tasks work on whole arrays, as geomstats does.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

os.environ.setdefault("GEOMSTATS_BACKEND", "numpy")

import numpy as np


def tasks(curves: np.ndarray) -> dict:
    """Return the tasks as functions; as geomstats expects, motions start at the origin, which is omitted."""
    from geomstats.geometry.discrete_curves import SRVTransform
    from geomstats.geometry.euclidean import Euclidean
    from geomstats.geometry.hypersphere import Hypersphere

    frames, numbers = curves.shape[1:]
    transform = SRVTransform(Euclidean(numbers), frames)
    moved = (curves - curves[:, :1])[:, 1:]
    # A curve of unit length has q of unit mean square: a point on the unit sphere of all coordinates.
    lengths = np.linalg.norm(np.diff(curves, axis=1), axis=2).sum(axis=1)[:, None, None]
    points = (transform(moved / lengths) / np.sqrt(frames - 1)).reshape(len(curves), -1)
    sphere = Hypersphere(dim=points.shape[1] - 1)
    first, second = points, np.roll(points, 1, axis=0)

    def halfway() -> np.ndarray:
        tangent = sphere.metric.log(second, base_point=first)
        return sphere.metric.exp(0.5 * tangent, base_point=first)

    return {"encode_decode": lambda: transform.inverse(transform(moved)), "geodesic": halfway}


def main(folder: Path) -> None:
    ready = tasks(np.load(folder / "curves.npy"))
    print("ready", flush=True)
    for line in sys.stdin:
        *save, task = line.split()
        found = ready[task]()
        if save:
            np.save(folder / f"{task}.npy", found)
        print("done", flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
