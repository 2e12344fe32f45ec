"""Loss functions: Wasserstein with gradient penalty for motion, displacement L1 for meshes, steps for LSTMs.

Vocabulary: a *sample* is any pytree of arrays; a *condition* is the conditioning input of generator and
critic (here: the two labels). `score(sample, condition)` is the critic of ONE sample and returns a scalar.
Mesh losses take displacements in millimetres with leading axes free; they sum over x, y, z and take the mean
over the vertices and the leading axes, so that values are "millimetres (L1) per vertex".

Functions that take arrays are jitted; those that take a `score` are left to the caller's jit. In signatures `_` is a
size that the function compares itself, for a message of its own.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Integer, Key, Real

from facejax.geometry import sphere
from facejax.geometry.sphere import AnyArray, safe_sqrt

Sample = Any
Condition = Any
Score = Callable[[Sample, Condition], jax.Array]


def gradient_penalty(
    score: Score, key: Key[Array, ""], real: Sample, fake: Sample, condition: Condition
) -> Float[Array, ""]:
    """Return the mean of (|grad score(x)| - 1)^2 with x uniform on the chords between real and fake samples.

    `real`, `fake`: pytrees whose leaves are (B, ...); one position in [0, 1) per sample, shared by all
    leaves; the norm is the Euclidean one over all leaves together. Otberdout et al. 2023, last term of eq
    2, and eq 5; this term is conditioned too, which eq 2 leaves out. Where the gradient vanishes
    the norm's derivative is taken as 0.
    """
    tau = jax.random.uniform(key, (jax.tree.leaves(real)[0].shape[0],))

    def squared_slope(tau: jax.Array, real: Sample, fake: Sample, condition: Condition) -> jax.Array:
        between = jax.tree.map(lambda r, f: (1.0 - tau) * r + tau * f, real, fake)
        slope = jax.grad(score)(between, condition)
        return jnp.asarray(sum(jnp.sum(jnp.square(leaf)) for leaf in jax.tree.leaves(slope)))

    squared = jax.vmap(squared_slope)(tau, real, fake, condition)
    flat = squared == 0.0  # the branch is chosen before the root, so that its derivative never divides by 0
    norm = jnp.where(flat, 0.0, jnp.sqrt(jnp.where(flat, 1.0, squared)))
    return jnp.mean(jnp.square(norm - 1.0))


def critic(
    score: Score,
    key: Key[Array, ""],
    real: Sample,
    fake: Sample,
    condition: Condition,
    *,
    penalty: float = 10.0,
) -> tuple[Float[Array, ""], dict[str, Float[Array, ""]]]:
    """Return the critic's loss, E[score(fake)] - E[score(real)] + penalty * gradient penalty.

    Samples and conditions have a leading axis B. Returns the loss and its terms: `wasserstein` (the estimated
    distance, E[score(real)] - E[score(fake)]) and `slope` (the penalty before its weight).
    Otberdout et al. 2023, eq 2, with the condition in all three terms.
    """
    judge = jax.vmap(score)
    distance = jnp.mean(judge(real, condition)) - jnp.mean(judge(fake, condition))
    slope = gradient_penalty(score, key, real, fake, condition)
    return penalty * slope - distance, {"wasserstein": distance, "slope": slope}


def generator(score: Score, fake: Sample, condition: Condition) -> Float[Array, ""]:
    """Return the generator's adversarial loss, -E[score(fake)]; samples and conditions have a leading axis B."""
    return -jnp.mean(jax.vmap(score)(fake, condition))


@jax.jit
def tangent_l1(predicted: Float[AnyArray, "*shape"], target: Float[AnyArray, "*shape"]) -> Float[Array, ""]:
    """Return the mean absolute difference of two arrays of tangent vectors (..., T-1, L, 3), or of any equal shapes.

    Otberdout et al. 2023, eq 6; the mean over entries, not the sum.
    """
    _same_shape(predicted, target)
    return jnp.mean(jnp.abs(predicted - target))


def flow_matching(
    field: Callable[..., Any],
    key: Key[Array, ""],
    source: Sample,
    target: Sample,
    condition: Condition,
    scale: Float[AnyArray, "B C"],
) -> Float[Array, ""]:
    """Return the mean squared error of a velocity field against geodesics between samples of source and target.

    Samples are (y, s): y (B, 1, 1, C) on a unit sphere, s (B, S). `field(state, time, condition) -> (v, rate)` takes
    ONE state and returns a tangent vector at y and the rate of s. One time in [0, 1) per sample. Along a geodesic the
    velocity is log(source, target), transported in parallel. Squares are taken in units of `scale` (B, C) along y's
    entries, so that directions of small variance count as much as others; the mean is over all entries. Chen & Lipman
    2024, eq. 15.
    """
    (y0, s0), (y1, s1) = source, target
    time = jax.random.uniform(key, y0.shape[:1])
    way = sphere.log(y0, y1)
    y = sphere.exp(y0, time[:, None, None, None] * way)
    wanted = sphere.transport(y0, y, way)
    between = y, s0 + time[:, None] * (s1 - s0)
    found, rate = jax.vmap(field)(between, time, condition)
    off = (found - wanted)[:, 0, 0] / scale
    return jnp.mean(jnp.concatenate([off, rate - (s1 - s0)], axis=-1) ** 2)


@jax.jit
def displacement_l1(predicted: Float[AnyArray, "*lead N 3"], target: Float[AnyArray, "*lead _ 3"]) -> Float[Array, ""]:
    """Return the L1 error of displacements (..., N, 3) in mm: sum over xyz, mean over vertices and leading axes.

    Otberdout et al. 2023, eq 8.
    """
    _same_shape(predicted, target)
    return jnp.mean(jnp.sum(jnp.abs(predicted - target), axis=-1))


@jax.jit
def weighted_l1(
    predicted: Float[AnyArray, "*lead N 3"], target: Float[AnyArray, "*lead _ 3"], weights: Float[AnyArray, " _"]
) -> Float[Array, ""]:
    """Return `displacement_l1` with every vertex's error times its weight (N,); the mean still divides by N.

    Otberdout et al. 2023, eq 9. Takes meshes or displacements: the neutral face cancels in the difference.
    """
    _same_shape(predicted, target)
    if weights.shape != predicted.shape[-2:-1]:
        raise ValueError(f"weights: expected shape {predicted.shape[-2:-1]}, one per vertex, got {weights.shape}")
    return jnp.mean(weights * jnp.sum(jnp.abs(predicted - target), axis=-1))


@partial(jax.jit, static_argnames="reduction")
def s2d(
    predicted: Float[AnyArray, "*lead N 3"],
    target: Float[AnyArray, "*lead _ 3"],
    weights: Float[AnyArray, " _"],
    *,
    beta1: Real[ArrayLike, ""] = 1.0,
    beta2: Real[ArrayLike, ""] = 0.1,
    reduction: str = "paper",
) -> Float[Array, ""]:
    """Return the mesh decoder's loss on displacements (..., N, 3) in mm, with vertex weights (N,).

    `paper`: beta1 * displacement_l1 + beta2 * weighted_l1 (Otberdout et al. 2023, 3.2). Both terms measure
    the same residual, so with weights of 1 this is (beta1 + beta2) times the first term alone. `reference`:
    as in the authors' code: the two factors are swapped, and the weighted term is a sum over the
    vertices, so that it outweighs the other about N times. Raises `ValueError` for another reduction.
    """
    plain = displacement_l1(predicted, target)
    weighted = weighted_l1(predicted, target, weights)
    if reduction == "paper":
        return beta1 * plain + beta2 * weighted
    if reduction == "reference":
        return beta2 * plain + beta1 * weighted * predicted.shape[-2]
    raise ValueError(f"reduction: expected 'paper' or 'reference', got {reduction!r}")


@partial(jax.jit, static_argnames="mode")
def landmark_weights(
    vertices: Float[AnyArray, "N _"],
    landmark_indices: Integer[AnyArray, " L"],
    *,
    mode: str = "linear",
    edge_length: Real[ArrayLike, ""] | None = None,
) -> Float[Array, " N"]:
    """Return vertex weights (N,) in [0, 1]: 1 at the landmarks, falling with the distance d to the nearest one.

    `vertices` (N, 3), `landmark_indices` (L,) of vertices. `linear`: 1 - d / d_max, which the authors'
    published weights follow. `inverse`: the paper's 1 / d, clipped to 1 / edge_length (it is infinite at the
    landmarks), then divided by its largest value; give `edge_length` as the mean edge
    length of the mesh, in the unit of the vertices. `none`: 1 everywhere.
    """
    if vertices.ndim != 2 or vertices.shape[1] != 3:
        raise ValueError(f"vertices: expected shape (N, 3), got {vertices.shape}")
    if mode not in ("linear", "inverse", "none"):
        raise ValueError(f"mode: expected 'linear', 'inverse' or 'none', got {mode!r}")
    if mode == "none":
        return jnp.ones_like(vertices[:, 0])
    offsets = vertices[:, None] - vertices[landmark_indices]
    distance = safe_sqrt(jnp.min(jnp.sum(jnp.square(offsets), axis=-1), axis=-1))
    if mode == "linear":
        farthest = jnp.max(distance)
        # The farthest vertex may round below 0. Where all vertices are landmarks, all weights are 1.
        return jnp.maximum(1.0 - distance / jnp.where(farthest > 0, farthest, 1.0), 0.0)
    if edge_length is None:
        raise ValueError("edge_length: mode 'inverse' needs the mean edge length of the mesh, got None")
    return jnp.asarray(edge_length) / jnp.maximum(distance, edge_length)


@jax.jit
def next_step(
    predicted: Float[AnyArray, "*lead T L 3"], target: Float[AnyArray, "*lead T L 3"], mask: Bool[AnyArray, "*lead _"]
) -> Float[Array, ""]:
    """Return the mean squared error of steps (..., T, L, 3) over the frames where the mask (..., T) is set.

    Seo and Luo 2021, L_disp: a sum in the formula, a mean in the text; here the mean. An empty mask gives 0.
    """
    _same_steps(predicted, target, mask)
    error = jnp.mean(jnp.square(predicted - target), axis=(-2, -1))
    return _masked_mean(error, mask)


@jax.jit
def path_distance(
    predicted: Float[AnyArray, "*lead T L 3"], target: Float[AnyArray, "*lead T L 3"], mask: Bool[AnyArray, "*lead _"]
) -> Float[Array, ""]:
    """Return the mean distance of the positions that steps (..., T, L, 3) add up to, where the mask (..., T) is set.

    Errors of single steps accumulate; this measures the positions. It is a distance, not its square: the optimal
    prediction is then the median of the possible paths, which is near an actual one, while the mean need not be.
    """
    _same_steps(predicted, target, mask)
    missed = jnp.cumsum(jnp.where(mask[..., None, None], predicted - target, 0), axis=-3)
    return _masked_mean(jnp.mean(safe_sqrt(jnp.sum(jnp.square(missed), axis=-1)), axis=-1), mask)


@jax.jit
def step_energy(steps: Float[AnyArray, "*lead T L 3"], mask: Bool[AnyArray, "*lead _"]) -> Float[Array, " 2"]:
    """Return the mean squares (2,) of steps (..., T, L, 3) and of their differences in time, where the mask is set."""
    _same_steps(steps, steps, mask)
    parts = ((steps, mask), (jnp.diff(steps, axis=-3), mask[..., 1:] & mask[..., :-1]))
    return jnp.stack([_masked_mean(jnp.mean(jnp.square(values), axis=(-2, -1)), where) for values, where in parts])


@jax.jit
def energy_ratio(
    predicted: Float[AnyArray, "*lead T L 3"], mask: Bool[AnyArray, "*lead _"], reference: Float[AnyArray, " 2"]
) -> Float[Array, ""]:
    """Return the penalty (r - 1)^2 on the ratio r of the motion's root mean square to that of the training set.

    Summed over two ratios, of steps (..., T, L, 3) and of their differences, both over all sequences where the mask
    (..., T) is set; `reference` (2,) is the `step_energy` of the training set. A network trained on squared errors
    predicts the mean of the possible motions, which moves less than any of them. An empty mask gives 0.
    """
    ratio = safe_sqrt(step_energy(predicted, mask) / reference)
    return jnp.where(jnp.any(mask), jnp.sum(jnp.square(ratio - 1)), 0)


def _masked_mean(values: AnyArray, mask: AnyArray) -> jax.Array:
    return jnp.sum(jnp.where(mask, values, 0)) / jnp.maximum(jnp.sum(mask), 1)


def _same_steps(predicted: AnyArray, target: AnyArray, mask: AnyArray) -> None:
    _same_shape(predicted, target)
    if predicted.ndim < 3 or mask.shape != predicted.shape[:-2]:
        raise ValueError(f"mask: expected shape {predicted.shape[:-2]}, one per frame of steps, got {mask.shape}")


def _same_shape(predicted: AnyArray, target: AnyArray) -> None:
    if predicted.shape != target.shape:
        raise ValueError(f"predicted, target: expected equal shapes, got {predicted.shape} and {target.shape}")
