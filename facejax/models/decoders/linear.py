"""Linear maps from landmark to vertex displacements: the baselines of every decoder.

`ridge` is ridge regression of 3 N numbers on 3 L. `pca` is the 3DMM of Otberdout et al. 2023, 4.2: k principal
components of the vertex displacements, whose coefficients are fitted to the landmarks with a Gaussian prior. Both are
affine, are fitted from batches that need not fit into memory, and share `apply`.

    params = linear.ridge.fit([(landmarks, vertices)], alpha=1e-3)
    dense = linear.apply(params, landmarks)

L landmarks, N vertices, F frames; displacements from neutral in mm. Batches are pairs of landmarks (B, L, 3) and
vertices (B, N, 3) in any iterable that can be iterated several times. Fits work in float64 and return float32.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from facejax.geometry.precision import HIGHEST
from facejax.models import pca as principal

Batches = Iterable[tuple[np.ndarray, np.ndarray]]


class LinearMap(NamedTuple):
    """vertex_mean + (x - landmark_mean) @ factors[0] @ factors[1] ..., over flattened coordinates."""

    landmark_mean: Array  # (L, 3)
    vertex_mean: Array  # (N, 3)
    factors: tuple[Array, ...]  # (3 L, 3 N), or (3 L, k) and (k, 3 N)


class Model(NamedTuple):
    """Functions of a linear model; `fit(batches, *, alpha)` is `solve(prepare(batches), alpha=alpha)`."""

    fit: Callable[..., LinearMap]
    prepare: Callable[..., Any]
    solve: Callable[..., LinearMap]


class Moments(NamedTuple):
    """The first and second moments of F frames, which ridge regression needs."""

    landmark_mean: np.ndarray  # (L, 3)
    vertex_mean: np.ndarray  # (N, 3)
    covariance: np.ndarray  # (3 L, 3 L)
    cross: np.ndarray  # (3 L, 3 N)


class Basis(NamedTuple):
    """The k leading principal components of F frames' vertex displacements."""

    landmark_mean: np.ndarray  # (L, 3)
    vertex_mean: np.ndarray  # (N, 3)
    components: np.ndarray  # (k, 3 N), orthonormal rows, the widest first
    landmarks: np.ndarray  # (k, 3 L): the landmark displacements of a unit of each component
    variance: np.ndarray  # (k,) mm^2
    total_variance: float  # mm^2, over all directions


@jax.jit
def apply(params: LinearMap, landmarks: Float[Array | np.ndarray, "... L 3"]) -> Float[Array, "... N 3"]:
    """Return vertex displacements from landmark displacements, in mm.

    Raises:
      ValueError: wrong number of landmarks.
    """
    expected = params.landmark_mean.shape
    if landmarks.shape[-2:] != expected:
        raise ValueError(f"landmarks: expected (..., {expected[0]}, 3), got {landmarks.shape}")
    # The last size is explicit (not -1), so that zero frames work.
    x = (landmarks - params.landmark_mean).reshape(*landmarks.shape[:-2], 3 * expected[0])
    for factor in params.factors:
        x = jnp.matmul(x, factor, precision=HIGHEST)
    return params.vertex_mean + x.reshape(*x.shape[:-1], *params.vertex_mean.shape)


def affine(
    landmark_mean: Float[Array | np.ndarray, "L 3"],
    vertex_mean: Float[Array | np.ndarray, "N 3"],
    *factors: Float[Array | np.ndarray, "_ _"],
) -> LinearMap:
    """Return a map in float32 from means and one or more factors whose product is (3 L, 3 N)."""
    return LinearMap(
        jnp.asarray(landmark_mean, jnp.float32),
        jnp.asarray(vertex_mean, jnp.float32),
        tuple(jnp.asarray(factor, jnp.float32) for factor in factors),
    )


def choose(
    model: Model, folds: Sequence[tuple[Batches, Batches]], alphas: Sequence[float], **options: Any
) -> tuple[float, Float[np.ndarray, " A"]]:
    """Return the alpha with the least held-out error, and the errors of all: mean distance per vertex in mm.

    A fold is (batches to fit, batches held out); hold out whole subjects. `options` are passed to `model.prepare`,
    which runs once per fold.

    Raises:
      ValueError: no held-out frames, or no alphas.
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
def _distances(params: LinearMap, landmarks: Array, vertices: Array) -> Array:
    """Return the sum of the vertex distances of each frame, (B,)."""
    error = apply(params, landmarks) - vertices
    return jnp.sum(jnp.sqrt(jnp.sum(error * error, axis=-1)), axis=-1)


def _moments(batches: Batches) -> Moments:
    """Compute moments in one pass.

    Sums are taken about the first batch's mean, so that subtracting the means afterwards does not cancel digits.
    """
    count, shift_x, shift_y, shapes = 0, np.zeros(()), np.zeros(()), ((0, 3), (0, 3))
    sum_x, sum_y, covariance, cross = np.zeros(()), np.zeros(()), np.zeros(()), np.zeros(())
    for x, y, points in _flat(batches):
        if not count:
            shift_x, shift_y, shapes = x.mean(axis=0), y.mean(axis=0), points
        x, y = x - shift_x, y - shift_y
        count += len(x)
        sum_x, sum_y = sum_x + x.sum(axis=0), sum_y + y.sum(axis=0)
        covariance, cross = covariance + x.T @ x, cross + x.T @ y
    if not count:
        raise ValueError("expected at least one batch, got none")
    mean_x, mean_y = sum_x / count, sum_y / count
    return Moments(
        (shift_x + mean_x).reshape(shapes[0]),
        (shift_y + mean_y).reshape(shapes[1]),
        covariance / count - np.outer(mean_x, mean_x),
        cross / count - np.outer(mean_x, mean_y),
    )


def _solve_ridge(moments: Moments, *, alpha: float) -> LinearMap:
    """Solve (covariance + alpha I) W = cross, with alpha in mm^2."""
    check_alpha(alpha)
    penalised = moments.covariance + alpha * np.eye(len(moments.covariance))
    # Without a penalty, a landmark that never moves makes this singular: take the least-norm solution.
    solution = (
        np.linalg.solve(penalised, moments.cross)
        if alpha > 0
        else np.linalg.lstsq(penalised, moments.cross, rcond=1e-12)[0]
    )
    return affine(moments.landmark_mean, moments.vertex_mean, solution)


def _basis(batches: Batches, *, components: int, passes: int = 3, seed: int = 0) -> Basis:
    """Compute principal components by subspace iteration (Halko et al. 2011, 4.5), in `passes` through the batches.

    The full covariance would need (3 N)^2 numbers. 40 more directions than requested are iterated, so that the kept
    ones converge: the error falls with (variance k + 40 / variance k)^passes.
    """
    if components < 1 or passes < 1:
        raise ValueError(f"expected components and passes of 1 or more, got {components} and {passes}")
    rng = np.random.default_rng(seed)
    directions = followed = np.zeros((0, 0))
    shapes, count = ((0, 3), (0, 3)), 0
    mean_x = mean_y = small = loads = np.zeros(())
    square = 0.0
    for _ in range(passes):
        count, square = 0, 0.0
        sum_x, sum_y, image, loads = np.zeros(()), np.zeros(()), np.zeros(()), np.zeros(())
        for x, y, points in _flat(batches):
            shapes = points
            if not directions.size:
                width = min(components + 40, y.shape[1])
                directions = principal.orthonormal_basis(rng.standard_normal((y.shape[1], width)))
            projected = y @ directions
            count += len(x)
            sum_x, sum_y, square = sum_x + x.sum(axis=0), sum_y + y.sum(axis=0), square + float(np.sum(y**2))
            image, loads = image + y.T @ projected, loads + x.T @ projected
        if count < 2:
            raise ValueError(f"expected at least two frames, got {count}")
        mean_x, mean_y = sum_x / count, sum_y / count
        image = image / count - np.outer(mean_y, mean_y @ directions)  # covariance @ directions
        loads = loads / count - np.outer(mean_x, mean_y @ directions)
        small = directions.T @ image
        followed, directions = directions, principal.orthonormal_basis(image)
    variance, rotation = principal.from_covariance((small + small.T) / 2)
    variance, rotation = variance[:components], rotation[:, :components]
    # Directions without variance are dropped.
    kept = variance > 1e-12 * max(variance[0], 1e-300)
    variance, rotation = variance[kept], rotation[:, kept]
    return Basis(
        mean_x.reshape(shapes[0]),
        mean_y.reshape(shapes[1]),
        (followed @ rotation).T,
        # cov(landmarks, coefficient) / variance: the component's own rows where landmarks are vertices.
        (loads @ rotation / variance).T,
        variance,
        float(square / count - np.sum(mean_y**2)),
    )


def _solve_pca(basis: Basis, *, alpha: float) -> LinearMap:
    """Solve for (Y^T Y + alpha diag(1 / variance))^-1 Y^T x, the MAP coefficients under noise variance alpha."""
    check_alpha(alpha)
    y = basis.landmarks.T
    normal = y.T @ y + alpha * np.diag(1 / basis.variance)
    encoder = np.linalg.lstsq(normal, y.T, rcond=1e-12)[0].T
    return affine(basis.landmark_mean, basis.vertex_mean, encoder, basis.components)


def model(prepare: Callable[..., Any], solve: Callable[..., LinearMap]) -> Model:
    """Return a model made of `prepare(batches, **options)` and `solve(prepared, *, alpha)`."""

    def fit(batches: Batches, *, alpha: float, **options: Any) -> LinearMap:
        """Fit to batches with regularisation `alpha` in mm^2."""
        return solve(prepare(batches, **options), alpha=alpha)

    return Model(fit, prepare, solve)


def _flat(batches: Batches) -> Iterator[tuple[np.ndarray, np.ndarray, tuple[tuple[int, ...], tuple[int, ...]]]]:
    """Yield (landmarks (B, 3 L), vertices (B, 3 N), their point shapes), in float64."""
    for landmarks, vertices in batches:
        shapes = (np.shape(landmarks)[1:], np.shape(vertices)[1:])
        if len(landmarks) != len(vertices) or any(len(s) != 2 or s[1] != 3 for s in shapes):
            raise ValueError(
                f"batches: expected (B, L, 3) and (B, N, 3), got {np.shape(landmarks)}, {np.shape(vertices)}"
            )
        x, y = (np.asarray(a, np.float64).reshape(len(a), -1) for a in (landmarks, vertices))
        yield x, y, shapes


def check_alpha(alpha: float) -> None:
    """Raise `ValueError` for a negative regularisation."""
    if not alpha >= 0:
        raise ValueError(f"alpha: expected 0 or more, got {alpha}")


ridge = model(_moments, _solve_ridge)
pca = model(_basis, _solve_pca)
