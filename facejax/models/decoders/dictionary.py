"""DL-3DMM: dictionary learning of displacements as sparse combinations of atoms, fitted to the landmarks.

The dictionary-learning morphable model of Ferrari et al. 2017, a baseline of Otberdout et al. 2023, 4.2. Atoms D come
from online dictionary learning (Mairal et al. 2010): each batch of displacements x is coded by the elastic net,

    a = argmin 1/2 |x - a D|^2 + l1 |a|_1 + l2/2 |a|^2,

then each atom is updated by block coordinate descent on the accumulated statistics of all codes, and projected onto the
unit ball. Landmarks are fitted by ridge regression on the atoms' own landmarks. The interface is that of
`facejax.models.decoders.linear`, whose `apply` and `choose` serve here too:

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
from jaxtyping import Array, Float, Int, Real

from facejax.models.decoders import linear

with warnings.catch_warnings():
    # jaxopt warns on import that it is no longer developed; the solver used here is complete.
    warnings.simplefilter("ignore", DeprecationWarning)
    import jaxopt  # pyright: ignore[reportMissingTypeStubs]

ATOMS = 220
L1 = 1.0  # in mm sqrt(3 N): atoms that explain less get a zero code
L2 = 0.1
BATCH = 256


class Dictionary(NamedTuple):
    """Atoms learned from F frames."""

    landmark_mean: np.ndarray  # (L, 3)
    vertex_mean: np.ndarray  # (N, 3)
    atoms: np.ndarray  # (k, 3 N), norm at most 1
    landmarks: np.ndarray  # (k, 3 L): the landmark displacements of a unit of each atom


@partial(jax.jit, static_argnames="steps")
def sparse_code(
    atoms: Float[Array | np.ndarray, "k D"],
    x: Float[Array | np.ndarray, "B D"],
    *,
    l1: float | Real[Array, ""] = L1,
    l2: float | Real[Array, ""] = L2,
    steps: int = 200,
) -> Float[Array, "B k"]:
    """Return the elastic-net codes of rows x in atoms, by accelerated proximal gradient descent."""
    gram, correlation = atoms @ atoms.T, x @ atoms.T
    # An upper bound of the largest eigenvalue (row sums, or trace). The problem is divided by it, so that a step size
    # of 1 is safe and needs no line search, which takes sixty times as long.
    curvature = jnp.minimum(jnp.max(jnp.sum(jnp.abs(gram), axis=1)), jnp.trace(gram)) + l2

    def smooth(a: Array) -> Array:
        return (0.5 * jnp.sum((a @ gram) * a) - jnp.sum(correlation * a) + 0.5 * l2 * jnp.sum(a**2)) / curvature

    solver = jaxopt.ProximalGradient(smooth, jaxopt.prox.prox_lasso, stepsize=1.0, maxiter=steps, tol=1e-6)
    return solver.run(jnp.zeros_like(correlation), hyperparams_prox=l1 / curvature).params


def _learn(
    batches: linear.Batches, *, landmark_index: Int[np.ndarray, " L"], atoms: int = ATOMS, l1: float = L1,
    l2: float = L2, passes: int = 2, seed: int = 0,
) -> Dictionary:  # fmt: skip
    """Learn atoms in `passes` through the batches, which are held in memory and shuffled by the seed.

    `landmark_index` (L,) are the vertices at which the atoms' landmark displacements are read.
    """
    if atoms < 1 or passes < 1 or l1 < 0 or l2 < 0:
        raise ValueError(f"expected atoms and passes of 1 or more and penalties of 0 or more: {atoms, passes, l1, l2}")
    x, y, shapes = _concatenate(batches)
    means = x.mean(axis=0, dtype=np.float64), y.mean(axis=0, dtype=np.float64)
    y = y - means[1].astype(np.float32)
    rng = np.random.default_rng(seed)
    first = y[rng.choice(len(y), atoms, replace=len(y) < atoms)]
    first = first + 1e-3 * rng.standard_normal(first.shape, np.float32) * np.sqrt(np.mean(y**2))
    atoms_now = jnp.asarray(first / np.maximum(np.linalg.norm(first, axis=1, keepdims=True), 1e-12))
    statistics = jnp.zeros((atoms, atoms)), jnp.zeros((atoms, y.shape[1]))
    for _ in range(passes):
        # Each pass resets the sufficient statistics: codes in the atoms of an earlier pass are out of date.
        statistics = jax.tree.map(jnp.zeros_like, statistics)
        order = rng.permutation(len(y))
        for low in range(0, len(y), BATCH):
            batch = jnp.asarray(y[order[low : low + BATCH]])
            codes = sparse_code(atoms_now, batch, l1=l1, l2=l2)
            atoms_now, statistics = _update(atoms_now, statistics, batch, codes)
    learned = np.asarray(atoms_now, np.float64)
    at_landmarks = learned.reshape(len(learned), -1, 3)[:, np.asarray(landmark_index)].reshape(len(learned), -1)
    return Dictionary(means[0].reshape(shapes[0]), means[1].reshape(shapes[1]), learned, at_landmarks)


@jax.jit
def _update(atoms: Array, statistics: tuple[Array, Array], x: Array, codes: Array) -> tuple[Array, tuple[Array, Array]]:
    """Update atoms and statistics by a batch, by block coordinate descent (Mairal et al. 2010, algorithm 2)."""
    code_gram, code_data = statistics[0] + codes.T @ codes, statistics[1] + codes.T @ x

    def update(i: Array, atoms: Array) -> Array:
        use = code_gram[i, i]
        atom = atoms[i] + (code_data[i] - code_gram[i] @ atoms) / jnp.maximum(use, 1e-12)
        atom = atom / jnp.maximum(jnp.linalg.norm(atom), 1.0)
        return atoms.at[i].set(jnp.where(use > 1e-9, atom, atoms[i]))

    return jax.lax.fori_loop(0, len(atoms), update, atoms), (code_gram, code_data)


def _solve(learned: Dictionary, *, alpha: float) -> linear.LinearMap:
    """Solve for codes (Y^T Y + alpha I)^-1 Y^T x of the landmarks, with alpha in mm^2 per squared unit of a code."""
    linear.check_alpha(alpha)
    y = learned.landmarks.T
    encoder = np.linalg.lstsq(y.T @ y + alpha * np.eye(y.shape[1]), y.T, rcond=1e-12)[0].T
    return linear.affine(learned.landmark_mean, learned.vertex_mean, encoder, learned.atoms)


def _concatenate(
    batches: linear.Batches,
) -> tuple[np.ndarray, np.ndarray, tuple[tuple[int, ...], tuple[int, ...]]]:
    """Return landmarks (F, 3 L) and vertices (F, 3 N) of all batches in float32, and their point shapes."""
    pairs = [(np.asarray(x, np.float32), np.asarray(y, np.float32)) for x, y in batches]
    if not pairs:
        raise ValueError("expected at least one batch, got none")
    x, y = np.concatenate([x for x, _ in pairs]), np.concatenate([y for _, y in pairs])
    return x.reshape(len(x), -1), y.reshape(len(y), -1), (x.shape[1:], y.shape[1:])


model = linear.model(_learn, _solve)
