"""Linear maps from landmark to vertex displacements: the bars that a decoder has to clear.

`ridge` is ridge regression of 3 N numbers on 3 L. `pca` is the 3DMM's way (Otberdout et al. 2023, 4.2): k
principal components of the vertex displacements, whose coefficients are fitted to the landmarks with a
Gaussian prior. Both are affine, are fitted from batches that need not fit into memory, and share `apply`.

    params = linear.ridge.fit([(landmarks, vertices)], alpha=1e-3)
    dense = linear.apply(params, landmarks)

L landmarks, N vertices, F frames; displacements from neutral in mm. Batches are pairs of landmarks (B, L,
3) and vertices (B, N, 3) in any iterable that can be gone through several times. Fits work in float64 and
return float32.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

Batches = Iterable[tuple[np.ndarray, np.ndarray]]


class LinearMap(NamedTuple):
    """vertex_mean + (x - landmark_mean) @ factors[0] @ factors[1] ..., over flattened coordinates."""

    landmark_mean: jax.Array  # (L, 3)
    vertex_mean: jax.Array  # (N, 3)
    factors: tuple[jax.Array, ...]  # (3 L, 3 N), or (3 L, k) and (k, 3 N)


class Model(NamedTuple):
    """`fit(batches, *, alpha, **options)` is `solve(prepare(batches, **options), alpha=alpha)`."""

    fit: Callable[..., LinearMap]
    prepare: Callable[..., Any]
    solve: Callable[..., LinearMap]


class Moments(NamedTuple):
    """What ridge regression needs to know of F frames."""

    landmark_mean: np.ndarray  # (L, 3)
    vertex_mean: np.ndarray  # (N, 3)
    covariance: np.ndarray  # (3 L, 3 L)
    cross: np.ndarray  # (3 L, 3 N)


class Basis(NamedTuple):
    """The k widest directions of F frames' vertex displacements."""

    landmark_mean: np.ndarray  # (L, 3)
    vertex_mean: np.ndarray  # (N, 3)
    components: np.ndarray  # (k, 3 N), orthonormal rows, the widest first
    landmarks: np.ndarray  # (k, 3 L): what a unit of each component does to the landmarks
    variance: np.ndarray  # (k,) mm^2
    total_variance: float  # mm^2, of all directions


@jax.jit
def apply(params: LinearMap, landmarks: jax.Array) -> jax.Array:
    """Vertex displacements (..., N, 3) from landmark displacements (..., L, 3), in mm."""
    expected = params.landmark_mean.shape
    if landmarks.shape[-2:] != expected:
        raise ValueError(f"landmarks: expected (..., {expected[0]}, 3), got {landmarks.shape}")
    # Sizes are named, so that there may be no frames.
    x = (landmarks - params.landmark_mean).reshape(*landmarks.shape[:-2], 3 * expected[0])
    for factor in params.factors:
        x = x @ factor
    return params.vertex_mean + x.reshape(*x.shape[:-1], *params.vertex_mean.shape)


def affine(landmark_mean: np.ndarray, vertex_mean: np.ndarray, *factors: np.ndarray) -> LinearMap:
    """Parameters in float32 from means (L, 3), (N, 3) and one or more factors whose product is (3 L, 3 N)."""
    return LinearMap(
        jnp.asarray(landmark_mean, jnp.float32),
        jnp.asarray(vertex_mean, jnp.float32),
        tuple(jnp.asarray(factor, jnp.float32) for factor in factors),
    )


def choose(
    model: Model, folds: Sequence[tuple[Batches, Batches]], alphas: Sequence[float], **options
) -> tuple[float, np.ndarray]:
    """The alpha with the least held-out error, and the errors (A,) of all: mean distance per vertex in mm.

    A fold is (batches to fit, batches held out); hold out whole subjects. `options` go to
    `model.prepare`, which runs once per fold.
    """
    totals, count = np.zeros(len(alphas)), 0
    for train, held_out in folds:
        prepared = model.prepare(train, **options)
        solved = [model.solve(prepared, alpha=alpha) for alpha in alphas]
        for landmarks, vertices in held_out:
            count += vertices.shape[0] * vertices.shape[1]
            for i, params in enumerate(solved):
                totals[i] += np.sum(np.asarray(_distances(params, landmarks, vertices)), dtype=np.float64)
    if count == 0 or len(alphas) == 0:
        raise ValueError("expected held-out frames and at least one alpha, got none")
    return float(alphas[int(np.argmin(totals))]), totals / count


@jax.jit
def _distances(params: LinearMap, landmarks: jax.Array, vertices: jax.Array) -> jax.Array:
    """Distance of each vertex, summed over it: (B,)."""
    off = apply(params, landmarks) - vertices
    return jnp.sum(jnp.sqrt(jnp.sum(off * off, axis=-1)), axis=-1)


def _moments(batches: Batches) -> Moments:
    """One pass, about the first batch's mean: subtracting the means later then loses no digits."""
    count, shift, sums, covariance, cross = 0, None, None, 0.0, 0.0
    for x, y, points in _flat(batches):
        if shift is None:
            shift, shapes = (x.mean(axis=0), y.mean(axis=0)), points
            sums = [np.zeros_like(shift[0]), np.zeros_like(shift[1])]
        x, y = x - shift[0], y - shift[1]
        count += len(x)
        sums[0] += x.sum(axis=0)
        sums[1] += y.sum(axis=0)
        covariance += x.T @ x
        cross += x.T @ y
    if shift is None:
        raise ValueError("expected at least one batch, got none")
    mean_x, mean_y = sums[0] / count, sums[1] / count
    return Moments(
        (shift[0] + mean_x).reshape(shapes[0]),
        (shift[1] + mean_y).reshape(shapes[1]),
        covariance / count - np.outer(mean_x, mean_x),
        cross / count - np.outer(mean_x, mean_y),
    )


def _solve_ridge(moments: Moments, *, alpha: float) -> LinearMap:
    """(covariance + alpha I) W = cross, with alpha in mm^2."""
    check_alpha(alpha)
    penalised = moments.covariance + alpha * np.eye(len(moments.covariance))
    # Without a penalty a landmark that never moves makes this singular; then the least-norm solution is
    # meant.
    solution = (
        np.linalg.solve(penalised, moments.cross)
        if alpha > 0
        else np.linalg.lstsq(penalised, moments.cross, rcond=1e-12)[0]
    )
    return affine(moments.landmark_mean, moments.vertex_mean, solution)


def _basis(batches: Batches, *, components: int, passes: int = 3, seed: int = 0) -> Basis:
    """Principal components by subspace iteration (Halko et al. 2011, 4.5), `passes` through the batches.

    The full covariance would need (3 N)^2 numbers. 40 directions more than asked for are followed, so
    that the ones kept converge: the error falls with (variance k + 40 / variance k)^passes.
    """
    if components < 1 or passes < 1:
        raise ValueError(f"expected components and passes of 1 or more, got {components} and {passes}")
    rng = np.random.default_rng(seed)
    directions = None
    for _ in range(passes):
        count, sum_x, sum_y, image, loads, square = 0, 0.0, 0.0, 0.0, 0.0, 0.0
        for x, y, points in _flat(batches):
            shapes = points
            if directions is None:
                width = min(components + 40, y.shape[1])
                directions = _orthonormal(rng.standard_normal((y.shape[1], width)))
            seen = y @ directions
            count += len(x)
            sum_x, sum_y, square = sum_x + x.sum(axis=0), sum_y + y.sum(axis=0), square + np.sum(y**2)
            image, loads = image + y.T @ seen, loads + x.T @ seen
        if count < 2:
            raise ValueError(f"expected at least two frames, got {count}")
        mean_x, mean_y = sum_x / count, sum_y / count
        image = image / count - np.outer(mean_y, mean_y @ directions)  # covariance @ directions
        loads = loads / count - np.outer(mean_x, mean_y @ directions)
        small = directions.T @ image
        followed, directions = directions, _orthonormal(image)
    variance, turn = np.linalg.eigh((small + small.T) / 2)
    order = np.argsort(variance)[::-1][:components]
    # Directions in which nothing moves are no components.
    order = order[variance[order] > 1e-12 * max(variance[order[0]], 1e-300)]
    turn, variance = turn[:, order], variance[order]
    return Basis(
        mean_x.reshape(shapes[0]),
        mean_y.reshape(shapes[1]),
        (followed @ turn).T,
        # cov(landmarks, coefficient) / variance: the component's own rows where landmarks are vertices.
        (loads @ turn / variance).T,
        variance,
        float(square / count - np.sum(mean_y**2)),
    )


def _orthonormal(columns: np.ndarray) -> np.ndarray:
    """An orthonormal basis (D, k) of the span of columns (D, m), k <= m.

    By the Gram matrix, twice over for the digits that squaring loses: two thin products, where a Householder QR of
    9,780 x 260 takes ten times as long.
    """
    for _ in range(2):
        values, vectors = np.linalg.eigh(columns.T @ columns)
        kept = values > 1e-13 * values[-1]
        columns = columns @ (vectors[:, kept] / np.sqrt(values[kept]))
    return columns


def _solve_pca(basis: Basis, *, alpha: float) -> LinearMap:
    """Coefficients (Y^T Y + alpha diag(1 / variance))^-1 Y^T x: most probable under noise of variance alpha."""
    check_alpha(alpha)
    y = basis.landmarks.T
    normal = y.T @ y + alpha * np.diag(1 / basis.variance)
    encoder = np.linalg.lstsq(normal, y.T, rcond=1e-12)[0].T
    return affine(basis.landmark_mean, basis.vertex_mean, encoder, basis.components)


def model(prepare: Callable, solve: Callable) -> Model:
    """A model from its two halves, `prepare(batches, **options)` and `solve(prepared, *, alpha)`."""

    def fit(batches: Batches, *, alpha: float, **options) -> LinearMap:
        """Fit to batches with regularisation `alpha` in mm^2."""
        return solve(prepare(batches, **options), alpha=alpha)

    return Model(fit, prepare, solve)


def _flat(batches: Batches):
    """(landmarks (B, 3 L), vertices (B, 3 N), their point shapes), float64."""
    for landmarks, vertices in batches:
        shapes = (np.shape(landmarks)[1:], np.shape(vertices)[1:])
        if len(landmarks) != len(vertices) or any(len(s) != 2 or s[1] != 3 for s in shapes):
            raise ValueError(
                f"batches: expected (B, L, 3) and (B, N, 3), got {np.shape(landmarks)}, {np.shape(vertices)}"
            )
        flat = [np.asarray(a, np.float64).reshape(len(a), -1) for a in (landmarks, vertices)]
        yield *flat, shapes


def check_alpha(alpha: float) -> None:
    """Raise `ValueError` for a regularisation below 0."""
    if not alpha >= 0:
        raise ValueError(f"alpha: expected 0 or more, got {alpha}")


ridge = model(_moments, _solve_ridge)
pca = model(_basis, _solve_pca)
