"""The unit sphere of motions: exponential, logarithm, distance, geodesics, transport and means.

Glossary
    T   frames of a motion; a point has T-1 steps (S in signatures).
    L   landmarks.
    C   in signatures: the 3 axes, or any number of coordinates from 2 on.
    p, q, r   points: arrays (..., T-1, L, 3) with inner(p, p) = 1, so their Frobenius norm is sqrt(T-1).
    u, v, w   tangent vectors at a point, of the same shape: inner(p, v) = 0.

The last three axes are fixed; leading axes are free and broadcast. The maps are equations 3, 4 and 10 of
Otberdout et al. 2023 ("Generating Multiple 4D Expression Transitions by Learning Face Landmark Trajectories");
the angle is taken by atan2, which is accurate near 0 and near pi, where an arc cosine loses half the digits.

Singular points. `exp` is smooth everywhere and `log` at the identity too; their series take over from a
radius that depends on the dtype. `norm` and `distance` have a kink at 0, and `distance` one at the antipode:
the gradient there is 0. At the antipode `log` has no limit; it returns pi times a fixed tangent direction,
with gradient 0, and `geodesic` and `transport` follow the half circle along that direction. No value or gradient
is NaN; a point that is zero, the SRVF of a constant curve, has logarithm and distance 0.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Real

AnyArray = jax.Array | np.ndarray
"""What array functions accept: they are jitted, so that NumPy arrays become JAX arrays."""


@jax.jit
def safe_sqrt(squared: Float[AnyArray, "*shape"]) -> Float[Array, "*shape"]:
    """Return the square root of an array of any shape; 0, with derivative 0, where it is not positive."""
    # The argument is made safe before the root is taken: a `where` after it alone would propagate a NaN gradient.
    positive = squared > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, squared, 1)), 0)


@jax.jit
def inner(a: Float[AnyArray, "*#lead S L C"], b: Float[AnyArray, "*#lead S L C"]) -> Float[Array, "*lead"]:
    """Return the inner product (...) of a and b (..., T-1, L, 3): the sum over landmarks and axes, the mean over steps.

    Raises `ValueError` on shapes that end differently, or on a dtype that is not floating.
    """
    _check(a, b)
    # Flattened to one axis: XLA's code for a CPU takes three times as long to sum over rows of three.
    return jnp.sum(_flat(a) * _flat(b), axis=-1) / a.shape[-3]


@jax.jit
def norm(a: Float[AnyArray, "*lead S L C"]) -> Float[Array, "*lead"]:
    """Return the norm (...) of a (..., T-1, L, 3); its gradient at 0 is 0."""
    return safe_sqrt(inner(a, a))


@jax.jit
def project(p: Float[AnyArray, "*#lead S L C"], v: Float[AnyArray, "*#lead S L C"]) -> Float[Array, "*lead S L C"]:
    """Return the component (..., T-1, L, 3) of v tangent at the point p. p may have any length."""
    # Dividing by <p, p> costs one product and makes the result independent of rounding in the length of p.
    squared = inner(p, p)
    along = inner(p, v) / jnp.where(squared > 0, squared, 1)
    return jnp.asarray(v) - _wide(along) * p


@jax.jit
def exp(p: Float[AnyArray, "*#lead S L C"], v: Float[AnyArray, "*#lead S L C"]) -> Float[Array, "*lead S L C"]:
    """Return the exponential (exp) map at p of a tangent vector v, a point: cos|v| p + sin|v| v/|v| (eq. 3).

    It has unit norm where v is tangent at p; `project` a vector that may not be.
    """
    cosine, sinc = _cos_sinc(inner(v, v))
    return _wide(cosine) * p + _wide(sinc) * v


@jax.jit
def log(p: Float[AnyArray, "*#lead S L C"], q: Float[AnyArray, "*#lead S L C"]) -> Float[Array, "*lead S L C"]:
    """Return the logarithm (log) map at p of a point q: the tangent vector of norm distance(p, q) to it (eq. 4)."""
    _check(p, q)
    along = _log(p, q)
    return _wide(along.scale) * _tangent(p, q, along)


@jax.jit
def distance(p: Float[AnyArray, "*#lead S L C"], q: Float[AnyArray, "*#lead S L C"]) -> Float[Array, "*lead"]:
    """Return the angle (...) between p and q, in [0, pi]; its gradient is 0 at p = q and at p = -q."""
    _, _, squared, cosine, _ = _split(p, q)
    empty = (squared == 0) & (cosine == 0)
    return jnp.arctan2(safe_sqrt(squared), jnp.where(empty, 1, cosine))


@jax.jit
def geodesic(
    p: Float[AnyArray, "*#lead S L C"], q: Float[AnyArray, "*#lead S L C"], tau: Real[ArrayLike, "*#lead"]
) -> Float[Array, "*lead S L C"]:
    """Return the point (..., T-1, L, 3) at the fraction tau (...) of the shortest arc from p to q.

    Equation 10 with its parentheses restored, (sin((1-tau) theta) p + sin(tau theta) q) / sin theta, written
    as exp(p, tau log(p, q)): no quotient of sines at 0 and at pi. tau outside [0, 1] extrapolates along the
    circle.
    """
    _check(p, q)
    # The logarithm is not written to memory: sums over p, q and their difference give its coefficients, and the point
    # is a combination of the same arrays.
    along = _log(p, q)
    way = jnp.asarray(tau, jnp.result_type(p, q)) * along.scale
    cosine, sinc = _cos_sinc(jnp.square(way) * along.squared)
    return _wide(cosine) * p + _wide(sinc * way) * _tangent(p, q, along)


@jax.jit
def transport(
    p: Float[AnyArray, "*#lead S L C"], q: Float[AnyArray, "*#lead S L C"], v: Float[AnyArray, "*#lead S L C"]
) -> Float[Array, "*lead S L C"]:
    """Transport the tangent vector v from p to q, parallel along their geodesic: (..., T-1, L, 3)."""
    # On tangent vectors at p, transport is the reflection across the hyperplane normal to p + q. A reflection
    # keeps lengths to the last digit, also near the antipode, where 1 + <p, q> would cancel.
    _check(p, q, v)
    middle = p + q
    antipode = _wide(inner(middle, middle) <= jnp.finfo(middle.dtype).eps ** 2)
    middle = jnp.where(antipode, _fixed_direction(p, inner(p, p)), middle)
    return jnp.asarray(v) - _wide(2 * inner(middle, v) / inner(middle, middle)) * middle


@jax.jit
def extrinsic_mean(qs: Float[AnyArray, "*lead K S L C"]) -> Float[Array, "*lead S L C"]:
    """Return the mean (..., T-1, L, 3) of the points qs (..., K, T-1, L, 3), normalised to the sphere.

    Where the mean vanishes, as that of two antipodes does, the first point is returned.
    """
    _check_set(qs)
    average = jnp.mean(qs, axis=-4)
    length = norm(average)
    usable = length > jnp.finfo(qs.dtype).eps
    return jnp.where(_wide(usable), average / _wide(jnp.where(usable, length, 1)), qs[..., 0, :, :, :])


@jax.jit(static_argnames=("steps",))
def karcher_mean(
    qs: Float[AnyArray, "*lead K S L C"], *, steps: int = 100, tolerance: Real[ArrayLike, ""] | None = None
) -> Float[Array, "*lead S L C"]:
    """Return the Karcher (Fréchet) mean (..., T-1, L, 3) of points qs (..., K, T-1, L, 3).

    It minimises the sum of squared distances. From the extrinsic mean, p moves to exp(p, mean log(p, qs)) until the
    norm of that mean is at most `tolerance` (radians; by default 16 times the spacing of the dtype at 1) in the whole
    batch, or for `steps` steps. The mean is unique when all points lie within pi/2 of one point. Gradients are exact in
    both modes: they come from the stationarity condition, not from the iterations.
    """
    _check_set(qs)
    if steps < 1:
        raise ValueError(f"steps: expected at least 1, got {steps}")
    tolerance = float(16 * jnp.finfo(qs.dtype).eps) if tolerance is None else tolerance

    return _karcher(steps, qs, jnp.asarray(tolerance, qs.dtype))


def _check(*points: AnyArray) -> None:
    shapes = [jnp.shape(point) for point in points]
    if any(len(shape) < 3 for shape in shapes) or len({shape[-3:] for shape in shapes}) > 1:
        raise ValueError(f"expected arrays (..., T-1, L, 3) that end alike, got shapes {shapes}")
    for point in points:
        if not jnp.issubdtype(jnp.result_type(point), jnp.floating):
            raise ValueError(f"expected a floating dtype, got {jnp.result_type(point)}")


def _check_set(qs: AnyArray) -> None:
    if jnp.ndim(qs) < 4 or qs.shape[-4] == 0:
        raise ValueError(f"expected at least one point, (..., K, T-1, L, 3), got shape {jnp.shape(qs)}")


def _wide(scalars: jax.Array) -> jax.Array:
    """Reshape one number per point (...) to (..., 1, 1, 1)."""
    return jnp.asarray(scalars)[..., None, None, None]


def _cos_sinc(squared: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return cos x and sin x / x from x squared, of which both are smooth functions."""
    near = squared < jnp.finfo(squared.dtype).eps ** 0.25
    s = jnp.where(near, squared, 0)
    x = jnp.sqrt(jnp.where(near, 1, squared))
    cosine = 1 + s * (-1 / 2 + s * (1 / 24 + s * (-1 / 720 + s / 40320)))
    sinc = 1 + s * (-1 / 6 + s * (1 / 120 + s * (-1 / 5040 + s / 362880)))
    return jnp.where(near, cosine, jnp.cos(x)), jnp.where(near, sinc, jnp.sin(x) / x)


class _Along(NamedTuple):
    """Coefficients of log(p, q) = scale (q - sign p - lean p); at the antipode, scale times a fixed direction at p."""

    scale: jax.Array
    squared: jax.Array  # squared norm of the vector that is scaled
    sign: jax.Array
    lean: jax.Array
    antipode: jax.Array
    own: jax.Array  # <p, p>


def _log(p: AnyArray, q: AnyArray) -> _Along:
    sign, lean, squared, cosine, own = _split(p, q)
    eps = jnp.finfo(squared.dtype).eps
    near = (cosine > 0) & (squared < eps**0.25 * cosine**2)
    far = ~near & (squared > eps**2)

    # theta / |u| = atan2(|u|, cosine) / |u|; below the radius, where autodiff would cancel, its series.
    safe_cosine = jnp.where(near, cosine, 1)
    x = jnp.where(near, squared, 0) / safe_cosine**2
    series = (1 + x * (-1 / 3 + x * (1 / 5 - x / 7))) / safe_cosine
    sine = jnp.sqrt(jnp.where(far, squared, 1))
    ratio = jnp.where(near, series, jnp.where(far, jnp.arctan2(sine, cosine) / sine, 0))

    antipode = ~near & ~far & (cosine < 0)
    return _Along(jnp.where(antipode, jnp.pi, ratio), jnp.where(antipode, 1, squared), sign, lean, antipode, own)


def _split(p: AnyArray, q: AnyArray) -> tuple[jax.Array, ...]:
    """Return sign, lean, |u|^2, <p, q> and <p, p>, where u = q - sign p - lean p is tangent at p."""
    cosine = inner(p, q)
    # Near p (or -p) the difference d is free of rounding, and projecting it instead of q keeps small angles to full
    # relative precision; in exact arithmetic the projection is the same. |d|^2 is twice |u|^2 at most.
    sign = jnp.where(cosine < 0, -1, 1).astype(cosine.dtype)
    d = q - _wide(sign) * p
    own, along = inner(p, p), inner(p, d)
    lean = along / jnp.where(own > 0, own, 1)
    squared = jnp.where(own > 0, jnp.maximum(inner(d, d) - lean * along, 0), 0)
    return sign, lean, squared, cosine, own


def _tangent(p: AnyArray, q: AnyArray, along: _Along) -> jax.Array:
    """Return the vector (..., T-1, L, 3), tangent at p, that `_Along.scale` multiplies."""
    found = (q - _wide(along.sign) * p) - _wide(along.lean) * p
    return jnp.where(_wide(along.antipode), _fixed_direction(p, along.own), found)


def _fixed_direction(p: AnyArray, own: jax.Array) -> jax.Array:
    """Return a unit tangent vector at p: the first axis projected, or the second where p is nearer the first."""
    first = jnp.zeros(p.shape[-3:], p.dtype).at[0, 0, 0].set(1)
    second = jnp.zeros(p.shape[-3:], p.dtype).at[0, 0, 1].set(1)
    leans = jnp.abs(p[..., 0, 0, 0]) > jnp.abs(p[..., 0, 0, 1])
    # `project` and `norm` of a coordinate axis, without a pass over p.
    part, steps = jnp.where(leans, p[..., 0, 0, 1], p[..., 0, 0, 0]), p.shape[-3]
    lean = part / (steps * jnp.where(own > 0, own, 1))
    direction = jnp.where(_wide(leans), second, first) - _wide(lean) * p
    return lax.stop_gradient(direction / _wide(jnp.sqrt((1 - lean * part) / steps)))


def _flat(point: AnyArray) -> jax.Array:
    """Flatten (..., T-1, L, 3) to (..., D)."""
    return jnp.reshape(point, (*point.shape[:-3], math.prod(point.shape[-3:])))


def _pull(p: jax.Array, qs: jax.Array) -> jax.Array:
    """Return the mean of log(p, qs) over the points: minus the gradient of half the mean squared distance."""
    return jnp.mean(log(p[..., None, :, :, :], qs), axis=-4)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _karcher(steps: int, qs: jax.Array, tolerance: jax.Array) -> jax.Array:
    def unfinished(carry: tuple[int | jax.Array, jax.Array, jax.Array]) -> jax.Array:
        step, _, v = carry
        return (step < steps) & jnp.any(norm(v) > tolerance)

    def move(carry: tuple[int | jax.Array, jax.Array, jax.Array]) -> tuple[int | jax.Array, jax.Array, jax.Array]:
        step, p, v = carry
        p = exp(p, v)
        # Rounding of the length of p would accumulate over the steps.
        p = p / _wide(norm(p))
        return step + 1, p, _pull(p, qs)

    start = extrinsic_mean(qs)
    return lax.while_loop(unfinished, move, (0, start, _pull(start, qs)))[1]


@_karcher.defjvp
def _karcher_jvp(
    steps: int, primals: tuple[jax.Array, ...], tangents: tuple[jax.Array, ...]
) -> tuple[jax.Array, jax.Array]:
    qs, tolerance = primals
    p = _karcher(steps, qs, tolerance)

    def hessian(x: jax.Array) -> jax.Array:
        # The identity along p; at tangent vectors the derivative of -pull, with K + 1 distinct eigenvalues at
        # most.
        u = project(p, x)
        return x - u - project(p, jax.jvp(lambda p: _pull(p, qs), (p,), (u,))[1])

    def solve(matvec: Callable[[jax.Array], jax.Array], b: jax.Array) -> jax.Array:
        return jax.scipy.sparse.linalg.cg(matvec, b, tol=float(4 * jnp.finfo(b.dtype).eps), maxiter=100)[0]

    # pull(p, qs) = 0, differentiated: hessian(dp) = d pull / d qs. A bare `cg` cannot be transposed under jit
    # (it ties its starting point to b), so the linear solve is declared around it.
    _, change = jax.jvp(lambda qs: _pull(p, qs), (qs,), (tangents[0],))
    return p, lax.custom_linear_solve(hessian, change, solve, symmetric=True)
