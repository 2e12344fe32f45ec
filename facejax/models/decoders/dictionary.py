"""DL-3DMM: displacements as sparse mixtures of learned atoms, the mixture fitted to the landmarks.

The dictionary-learning morphable model of Ferrari et al. 2017, a baseline of Otberdout et al. 2023, 4.2. Atoms D come
from online dictionary learning (Mairal et al. 2010): each batch of displacements x is coded by the elastic net,

    a = argmin 1/2 |x - a D|^2 + l1 |a|_1 + l2/2 |a|^2,

then each atom moves to where it explains best what all codes so far say, and is kept within the unit ball. Landmarks
are fitted by ridge regression on the atoms' own landmarks. As the models of `facejax.models.linear`, whose `apply` and
`choose` serve here too:

    params = dictionary.model.fit([(landmarks, vertices)], alpha=1e-2, landmark_index=landmark_index)
    dense = linear.apply(params, landmarks)

L landmarks, N vertices, k atoms; displacements from neutral in mm.
"""

from __future__ import annotations

import warnings
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from facejax.models.decoders import linear

with warnings.catch_warnings():
    # It says on import that it is no longer developed; what is used of it here is finished work.
    warnings.simplefilter("ignore", DeprecationWarning)
    import jaxopt

ATOMS = 220
L1 = 1.0  # mm times the root of 3 N coordinates: an atom that explains less is not used
L2 = 0.1
BATCH = 256


class Dictionary(NamedTuple):
    """Atoms learned from F frames."""

    landmark_mean: np.ndarray  # (L, 3)
    vertex_mean: np.ndarray  # (N, 3)
    atoms: np.ndarray  # (k, 3 N), norm at most 1
    landmarks: np.ndarray  # (k, 3 L): what a unit of each atom does to the landmarks


@partial(jax.jit, static_argnames="steps")
def sparse_code(atoms: jax.Array, x: jax.Array, *, l1: float = L1, l2: float = L2, steps: int = 200) -> jax.Array:
    """Elastic-net codes (B, k) of rows x (B, D) in atoms (k, D), by accelerated proximal gradients."""
    gram, seen = atoms @ atoms.T, x @ atoms.T
    # The steepest curvature; the problem is divided by it, so that a step of 1 is safe and needs no line search, which
    # takes sixty times as long. The row sums bound the largest eigenvalue from above.
    steepest = jnp.minimum(jnp.max(jnp.sum(jnp.abs(gram), axis=1)), jnp.trace(gram)) + l2

    def smooth(a):
        return (0.5 * jnp.sum((a @ gram) * a) - jnp.sum(seen * a) + 0.5 * l2 * jnp.sum(a**2)) / steepest

    solver = jaxopt.ProximalGradient(smooth, jaxopt.prox.prox_lasso, stepsize=1.0, maxiter=steps, tol=1e-6)
    return solver.run(jnp.zeros_like(seen), hyperparams_prox=l1 / steepest).params


def _learn(
    batches: linear.Batches, *, landmark_index: np.ndarray, atoms: int = ATOMS, l1: float = L1, l2: float = L2,
    passes: int = 2, seed: int = 0,
) -> Dictionary:  # fmt: skip
    """Learn atoms in `passes` through the batches, held in memory, in an order drawn by the seed.

    `landmark_index` (L,) names the landmarks' vertices, where the atoms' own rows are read.
    """
    if atoms < 1 or passes < 1 or l1 < 0 or l2 < 0:
        raise ValueError(f"expected atoms and passes of 1 or more and penalties of 0 or more: {atoms, passes, l1, l2}")
    x, y, shapes = _gathered(batches)
    means = x.mean(axis=0, dtype=np.float64), y.mean(axis=0, dtype=np.float64)
    y = y - means[1].astype(np.float32)
    rng = np.random.default_rng(seed)
    first = y[rng.choice(len(y), atoms, replace=len(y) < atoms)]
    first = first + 1e-3 * rng.standard_normal(first.shape, np.float32) * np.sqrt(np.mean(y**2))
    atoms_now = jnp.asarray(first / np.maximum(np.linalg.norm(first, axis=1, keepdims=True), 1e-12))
    codes = jnp.zeros((atoms, atoms)), jnp.zeros((atoms, y.shape[1]))
    for _ in range(passes):
        # The last pass starts its books anew: codes in atoms of the first pass say little about the last ones.
        codes = jax.tree.map(jnp.zeros_like, codes)
        order = rng.permutation(len(y))
        for low in range(0, len(y), BATCH):
            batch = jnp.asarray(y[order[low : low + BATCH]])
            atoms_now, codes = _update(atoms_now, codes, batch, sparse_code(atoms_now, batch, l1=l1, l2=l2))
    learned = np.asarray(atoms_now, np.float64)
    at_landmarks = learned.reshape(len(learned), -1, 3)[:, np.asarray(landmark_index)].reshape(len(learned), -1)
    return Dictionary(means[0].reshape(shapes[0]), means[1].reshape(shapes[1]), learned, at_landmarks)


@jax.jit
def _update(atoms: jax.Array, books, x: jax.Array, codes: jax.Array):
    """Block coordinate descent over the atoms: (atoms, books) after a batch. Mairal et al. 2010, algorithm 2."""
    among, with_x = books[0] + codes.T @ codes, books[1] + codes.T @ x

    def move(i, atoms):
        use = among[i, i]
        moved = atoms[i] + (with_x[i] - among[i] @ atoms) / jnp.maximum(use, 1e-12)
        moved = moved / jnp.maximum(jnp.linalg.norm(moved), 1.0)
        return atoms.at[i].set(jnp.where(use > 1e-9, moved, atoms[i]))

    return jax.lax.fori_loop(0, len(atoms), move, atoms), (among, with_x)


def _solve(learned: Dictionary, *, alpha: float) -> linear.LinearMap:
    """Codes (Y^T Y + alpha I)^-1 Y^T x of the landmarks, with alpha in mm^2 per squared unit of a code."""
    linear.check_alpha(alpha)
    y = learned.landmarks.T
    encoder = np.linalg.lstsq(y.T @ y + alpha * np.eye(y.shape[1]), y.T, rcond=1e-12)[0].T
    return linear.affine(learned.landmark_mean, learned.vertex_mean, encoder, learned.atoms)


def _gathered(batches: linear.Batches) -> tuple[np.ndarray, np.ndarray, tuple]:
    """Landmarks (F, 3 L) and vertices (F, 3 N) of all batches in float32, and their point shapes."""
    pairs = [[np.asarray(part, np.float32) for part in batch] for batch in batches]
    if not pairs:
        raise ValueError("expected at least one batch, got none")
    both = [np.concatenate(part) for part in zip(*pairs, strict=True)]
    return *(part.reshape(len(part), -1) for part in both), tuple(part.shape[1:] for part in both)


model = linear.model(_learn, _solve)
