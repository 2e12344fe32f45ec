"""Linear models against scikit-learn: principal components and dictionary learning of mesh displacements.

    python -m benchmarks.linear [--json FILE] [--quick]

* `pca_fit`: 220 components of 3,260 vertices by three passes over 2,000 meshes in batches, in float64; peer:
  scikit-learn's randomised PCA of the same rank and number of passes on all data at once, in float32.
* `dictionary_fit`: 64 atoms by one pass of online dictionary learning; peer: scikit-learn's MiniBatchDictionaryLearning
  with the same number of atoms, penalty, batch size and passes, coded by coordinate descent.
* `pca_apply_b16`: a batch of landmarks to meshes; peer: the same two products in NumPy.

Meshes are sums of 100 smooth directions and noise. The components and the dictionary must explain as much of their
variance as the peer's do, before anything is timed. About a minute.
"""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Callable

import jax.numpy as jnp
import numpy as np

from benchmarks import _equal, _measure
from facejax.models.decoders import dictionary, linear

PASSES, BATCH = 3, 256
L1 = 30.0  # penalty of a code in mm; gives a few atoms per mesh


@dataclasses.dataclass(frozen=True)
class Config(_measure.Options):
    """Options of the benchmark."""

    vertices: int = 3260
    """Number of vertices."""
    meshes: int = 2000
    """Number of meshes."""
    components: int = 220
    """Number of principal components."""
    atoms: int = 64
    """Number of dictionary atoms."""
    landmarks: int = 68
    """Number of landmarks."""


def run(config: Config) -> _measure.Found:
    """Measure and return the rows."""
    landmark_index = np.arange(config.landmarks) * (config.vertices // config.landmarks)
    meshes = _meshes(config)
    batches = [(part[:, landmark_index], part) for part in np.array_split(meshes, -(-config.meshes // BATCH))]
    rows = [_pca(config, batches, meshes)]
    rows.append(_dictionary(config, batches, meshes, landmark_index))
    rows.append(_apply(config, batches))
    return rows, []


def _meshes(config: Config) -> np.ndarray:
    """Return synthetic displacements (F, N, 3) in mm."""
    rng = np.random.default_rng(0)
    place = np.linspace(0, 1, config.vertices)
    waves = np.cos(np.pi * np.arange(100)[:, None] * place)
    directions = np.einsum("kn,kc->kcn", waves, rng.normal(size=(100, 3))).reshape(100, 3, -1).transpose(0, 2, 1)
    weights = rng.normal(size=(config.meshes, 100)) / (1 + np.arange(100))
    found = np.tensordot(weights, directions, 1) + 0.01 * rng.normal(size=(config.meshes, config.vertices, 3))
    return found.astype(np.float32)


def _pca(config: Config, batches: list, meshes: np.ndarray) -> _measure.Row:
    from sklearn.decomposition import PCA

    rows = meshes.reshape(len(meshes), -1)
    peer = PCA(config.components, svd_solver="randomized", n_oversamples=40, iterated_power=PASSES - 1, random_state=0)
    ours = lambda: linear.pca.prepare(batches, components=config.components, passes=PASSES)  # noqa: E731
    theirs = lambda: peer.fit(rows)  # noqa: E731
    count = 20  # the largest; the last ones are noise of equal variance
    centred = rows - rows.mean(axis=0)
    kept, expected = (_explained(centred, found[:count]) for found in (ours().components, theirs().components_))
    _equal.check(np.array(kept), np.array(expected))
    sides = {"facejax": lambda: ours().components, "scikit-learn": lambda: theirs().components_}
    options = {"peers": ["scikit-learn"], "repeats": 3, "items": len(meshes), "unit": "meshes"}
    return _measure.row("pca_fit", sides, **options)


def _dictionary(config: Config, batches: list, meshes: np.ndarray, landmark_index: np.ndarray) -> _measure.Row:
    from sklearn.decomposition import MiniBatchDictionaryLearning

    rows = meshes.reshape(len(meshes), -1)
    rows = rows - rows.mean(axis=0)
    passes = {"max_iter": 1, "max_no_improvement": None, "tol": 0.0}
    peer = MiniBatchDictionaryLearning(
        config.atoms, alpha=L1, batch_size=BATCH, fit_algorithm="cd", random_state=0, **passes
    )

    def ours() -> np.ndarray:
        options = {"landmark_index": landmark_index, "atoms": config.atoms, "l1": L1, "l2": 0.0, "passes": 1}
        return dictionary.model.prepare(batches, **options).atoms

    def theirs() -> np.ndarray:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # it warns that one pass has not converged
            return peer.fit(rows).components_

    kept, expected = (_explained(rows, atoms) for atoms in (ours(), theirs()))
    if not kept > 0.95 * expected:
        raise RuntimeError(f"the dictionary explains {kept:.3f} of the variance, scikit-learn's {expected:.3f}")
    options = {"peers": ["scikit-learn"], "repeats": 3, "items": len(meshes), "unit": "meshes"}
    return _measure.row("dictionary_fit", {"facejax": ours, "scikit-learn": theirs}, **options)


def _explained(rows: np.ndarray, atoms: np.ndarray) -> float:
    """Return the share of the variance in the span of the atoms."""
    q = np.linalg.qr(np.asarray(atoms, np.float64).T)[0]
    return float(np.sum((rows @ q) ** 2) / np.sum(rows.astype(np.float64) ** 2))


def _apply(config: Config, batches: list) -> _measure.Row:
    params = linear.pca.fit(batches, alpha=1e-2, components=config.components)
    marks = jnp.asarray(batches[0][0][:16])
    numbers = [np.asarray(x) for x in (marks, params.landmark_mean, params.vertex_mean)]
    factors = [np.asarray(factor) for factor in params.factors]

    def by_numpy() -> np.ndarray:
        x = (numbers[0] - numbers[1]).reshape(len(marks), -1)
        for factor in factors:
            x = x @ factor
        return numbers[2] + x.reshape(len(marks), -1, 3)

    ours: Callable = lambda: linear.apply(params, marks)  # noqa: E731
    _equal.check(ours(), by_numpy())
    gflop = 2e-9 * len(marks) * sum(factor.size for factor in factors)
    sides = {"facejax": ours, "NumPy": by_numpy}
    return _measure.row("pca_apply_b16", sides, peers=["NumPy"], gflop=gflop, items=len(marks), unit="meshes")


if __name__ == "__main__":
    _measure.main("linear", Config, run)
