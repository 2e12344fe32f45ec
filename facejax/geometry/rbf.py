"""Radial basis function interpolation: the motion of a few landmarks extended to every vertex of a mesh.

Glossary
    L, N, T   landmarks, vertices, frames; lengths are in the unit of the input.
    c, v      a landmark at rest, a vertex at rest.
    unit      sigma times the mean distance of a landmark to its nearest other: the width of a kernel then follows the
              density of the landmarks, be they in millimetres or in metres.
    phi       a kernel of r = |v - c| / unit, see `KERNELS`.
    s(v) = sum_i q_i phi(|v - c_i| / unit) + p(v)   the displacement of v, one per axis; p is affine.

The landmarks' own displacements d give q and p (Seo & Luo 2021, equations 3 and 4; one system for the three axes):

    | phi + smoothing I   P | | q |   | d |
    | P'                  0 | | a | = | 0 |      P = [1, c],  p(v) = [1, v] a

The paper prints its Gaussian without the square, exp(-r / 2 sigma^2), and its system without p. With the square the
surface has no spike at a landmark; with p and P'q = 0 an affine motion of the landmarks is reproduced exactly.

The system depends on the rest pose alone: it is solved once per face, and all frames become one matrix product. Stored
are not the coefficients q, which grow by thousands where kernels overlap, but the weights of the landmarks'
displacements at each vertex, [phi(v), 1, v] times the inverse: numbers of about 1, for which float32 is enough. They
are computed in float64 on the host, the system by LAPACK, the part that grows with the mesh by XLA: the threads of
NumPy's products keep spinning for a while and delay JAX's (10,000 vertices: 1 ms instead of 6).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from types import ModuleType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Float32, Float64, Real
from scipy.linalg import lapack
from scipy.spatial import KDTree
from scipy.spatial.distance import cdist

from facejax.geometry.precision import HIGHEST
from facejax.geometry.sphere import AnyArray

COINCIDENT = 1e-6  # of the landmarks' extent: nearer landmarks coincide, flatter sets are coplanar
EXACT = 1e-6  # largest error of the solved system at a landmark, as a fraction of the displacement


class Kernel(NamedTuple):
    """A radial function of r squared (by NumPy or jax.numpy), its default sigma, and whether p may be left out."""

    phi: Callable[[ModuleType, Any], Any]
    sigma: float
    definite: bool


class Rbf(NamedTuple):
    """The solved system of a rest pose."""

    kernel: str
    centres: Float64[np.ndarray, "L 3"]  # landmarks about their centroid, in units
    origin: Float64[np.ndarray, " 3"]  # the centroid
    unit: float
    inverse: Float64[np.ndarray, "E L"]  # E = L + 4, or L without p: maps displacements to coefficients


def fit(
    rest: Real[AnyArray, "L 3"],
    *,
    kernel: str = "multiquadric",
    sigma: float | None = None,
    smoothing: float = 0.0,
    affine: bool = True,
) -> Rbf:
    """Solve the system of landmarks at rest (L, 3), once for all motions of a face.

    Args:
      rest: (L, 3) landmarks at rest.
      kernel: a name in `KERNELS`.
      sigma: its width in landmark spacings, by default the kernel's own; thin_plate and triharmonic have no width, for
        them it only scales the smoothing.
      smoothing: 0 interpolates every landmark, more approximates noisy ones, as in SciPy's RBFInterpolator with
        epsilon 1 / unit (Gaussian: 1 / (unit sqrt 2)).
      affine: False leaves p out: displacements fall to 0 away from the landmarks.

    Raises:
      ValueError: landmarks that are too few, not finite, coincident or coplanar; an option out of range; a kernel so
        wide that the system cannot be solved.
    """
    rest = _points(rest, "landmarks")
    if kernel not in KERNELS:
        raise ValueError(f"kernel: expected one of {', '.join(KERNELS)}, got {kernel!r}")
    sigma = KERNELS[kernel].sigma if sigma is None else sigma
    if not (np.isfinite(sigma) and sigma > 0):
        raise ValueError(f"sigma: expected a positive number of landmark spacings, got {sigma}")
    if not (np.isfinite(smoothing) and smoothing >= 0):
        raise ValueError(f"smoothing: expected 0 or more, got {smoothing}")
    if not (affine or KERNELS[kernel].definite):
        raise ValueError(f"affine=False: {kernel} needs its affine term; gaussian and wendland_c2 do not")
    unit, origin = float(sigma * _spacing(rest, affine)), rest.mean(axis=0)
    centres = (rest - origin) / unit
    system = KERNELS[kernel].phi(np, cdist(centres, centres, "sqeuclidean"))
    system[np.diag_indices(len(rest))] += smoothing
    if affine:
        terms = np.concatenate([np.ones((len(rest), 1)), centres], axis=1)
        system = np.block([[system, terms], [terms.T, np.zeros((4, 4))]])
    wanted = np.eye(len(system), len(rest))
    # LU, as in the paper
    _, _, inverse, info = lapack.dgesv(system, wanted)  # pyright: ignore[reportAttributeAccessIssue]
    missed = np.inf if info else np.abs(system @ inverse - wanted).max()
    if not missed < EXACT:
        raise ValueError(
            f"sigma: {kernel} of width {sigma:g} is too wide for these landmarks: relative error {missed:.0e} at the "
            f"landmarks, expected below {EXACT:g}; make sigma smaller, or add smoothing"
        )
    return Rbf(kernel, centres, origin, unit, np.ascontiguousarray(inverse))


def weights(fit: Rbf, vertices: Real[AnyArray, "N 3"]) -> Float32[np.ndarray, "N L"]:
    """Return the weights (N, L) float32 of the landmarks' displacements at vertices at rest (N, 3).

    A vertex at a landmark has one weight of 1. Computed in float64 on the host, once per face. Raises `ValueError` for
    vertices that are not finite, or traced.
    """
    return np.asarray(_spread(fit, _points(vertices, "vertices"), np.float32))


@jax.jit
def warp(
    weights: Float[AnyArray, "*#lead N L"], displacements: Float[AnyArray, "*#lead L 3"]
) -> Float[Array, "*lead N 3"]:
    """Return the displacements (..., N, 3) of the vertices from those of the landmarks (..., L, 3) and weights (N, L).

    One matrix product for all frames. Weights (..., N, L) broadcast their leading axes with those of the displacements.
    """
    shapes = jnp.shape(weights), jnp.shape(displacements)
    if min(map(len, shapes)) < 2 or shapes[1][-1] != 3 or shapes[0][-1] != shapes[1][-2]:
        raise ValueError(f"expected weights (..., N, L) and displacements (..., L, 3), got {shapes[0]} and {shapes[1]}")
    for name, array in (("weights", weights), ("displacements", displacements)):
        if not jnp.issubdtype(jnp.result_type(array), jnp.floating):
            raise ValueError(f"{name}: expected a floating dtype, got {jnp.result_type(array)}")
    # By default GPUs multiply float32 with ten bits of mantissa. One product for each axis: a batched product of (N, L)
    # by (L, 3) is so narrow that a CPU takes two to four times as long.
    precision = HIGHEST
    axes = [jnp.einsum("...nl,...l->...n", weights, displacements[..., c], precision=precision) for c in range(3)]
    return jnp.stack(axes, axis=-1)


def apply(
    fit: Rbf, displacements: Float[AnyArray, "*lead L 3"], vertices: Real[AnyArray, "N 3"]
) -> Float[Array, "*lead N 3"]:
    """Return the displacements (..., N, 3) of vertices at rest (N, 3), where the landmarks move by (..., L, 3).

    `displacements` may be traced by jit, vmap or grad. `vertices` may not: under jit compute `weights` outside.
    """
    # The weights stay on their device: a round trip to NumPy takes a sixth of the total time.
    return warp(_spread(fit, _points(vertices, "vertices"), np.float32), displacements)


def refit(
    rest: Real[AnyArray, "L 3"],
    displacements: Real[AnyArray, "T L 3"],
    vertices: Real[AnyArray, "N 3"],
    **options: Any,
) -> Float32[np.ndarray, "T N 3"]:
    """Return displacements (T, N, 3) float32 with a new system for every frame, as in Seo & Luo (2021).

    Each step is interpolated from the previous positions of the landmarks (L, 3), displaced from rest by (T, L, 3), at
    the previous positions of the vertices (N, 3); options as of `fit`. It agrees with `apply` at the landmarks, in the
    first frame, and in affine motion. Elsewhere it depends on the path, and vertices need not return to rest when the
    landmarks do. Raises `ValueError`, naming the frame, where moving landmarks coincide.
    """
    rest, start = _points(rest, "landmarks"), _points(vertices, "vertices")
    displacements = np.asarray(displacements, np.float64)
    if displacements.ndim != 3 or displacements.shape[1:] != rest.shape:
        raise ValueError(f"displacements: expected (T, {len(rest)}, 3), got {displacements.shape}")
    out = np.empty((len(displacements), *start.shape), np.float32)
    before, moved = np.zeros_like(rest), start.copy()
    for t, here in enumerate(displacements):
        try:
            found = fit(rest + before, **options)
        except ValueError as error:
            raise ValueError(f"frame {t}: {error}") from error
        moved = moved + np.asarray(_spread(found._replace(inverse=found.inverse @ (here - before)), moved, np.float64))
        out[t], before = moved - start, here
    return out


def _spread(fit: Rbf, vertices: np.ndarray, dtype: type) -> jax.Array:
    """Return the weights (N, L) at vertices (N, 3), of a dtype, on the host, computed in float64."""
    host = jax.devices("cpu")[0]
    # Also within a trace: all inputs are concrete.
    with jax.ensure_compile_time_eval(), jax.enable_x64(True), jax.default_device(host):
        return _spread_on(fit.kernel, dtype, fit[1:], vertices)


@partial(jax.jit, static_argnums=(0, 1))
def _spread_on(kernel: str, dtype: type, fit: tuple[Any, ...], vertices: jax.Array) -> jax.Array:
    centres, origin, unit, inverse = fit
    points = (vertices - origin) / unit
    # Not |v|^2 - 2 v.c + |c|^2 by a product, which cancels at the landmarks.
    squared = sum(jnp.square(points[:, None, axis] - centres[:, axis]) for axis in range(3))
    count = len(centres)
    found = jnp.matmul(KERNELS[kernel].phi(jnp, squared), inverse[:count], precision=HIGHEST)
    if len(inverse) > count:
        # Not by a wider product: appending columns to the basis is one more pass over memory, this sum is fused.
        found += inverse[count] + sum(points[:, None, axis] * inverse[count + 1 + axis] for axis in range(3))
    return found.astype(dtype)


def _gaussian(xp: ModuleType, squared: Any) -> Any:
    return xp.exp(-0.5 * squared)


def _multiquadric(xp: ModuleType, squared: Any) -> Any:
    return -xp.sqrt(1 + squared)


def _thin_plate(xp: ModuleType, squared: Any) -> Any:
    return 0.5 * squared * xp.log(xp.maximum(squared, np.finfo(np.float64).tiny))


def _triharmonic(xp: ModuleType, squared: Any) -> Any:
    return squared * xp.sqrt(squared)


def _wendland_c2(xp: ModuleType, squared: Any) -> Any:
    r = xp.minimum(xp.sqrt(squared), 1)
    return xp.square(xp.square(1 - r)) * (4 * r + 1)


# Signed so that phi is positive definite (for q with P'q = 0): smoothing then smooths. Default kernel and widths are
# the best of `experiments.rbf_warp`, except that the Gaussian stays at 1: 1.25 is 2 % better with split lips, and 50 %
# worse without.
KERNELS = {
    "gaussian": Kernel(_gaussian, 1.0, True),  # exp(-r^2 / 2)
    "multiquadric": Kernel(_multiquadric, 0.5, False),  # -sqrt(1 + r^2)
    "thin_plate": Kernel(_thin_plate, 1.0, False),  # r^2 log r
    "triharmonic": Kernel(_triharmonic, 1.0, False),  # r^3
    "wendland_c2": Kernel(_wendland_c2, 6.0, True),  # (1 - r)^4 (4 r + 1) up to r = 1, then 0
}


def _points(points: AnyArray, name: str) -> np.ndarray:
    """Return points as (K, 3) float64; raises for another shape, a tracer, and the first row that is not finite."""
    if isinstance(points, Tracer):
        raise ValueError(
            f"{name}: expected concrete values, got a tracer; compute `weights` outside jit and `warp` inside"
        )
    points = np.asarray(points, np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or len(points) == 0:
        raise ValueError(f"{name}: expected (K, 3), got shape {points.shape}")
    finite = np.isfinite(points).all(axis=1)
    if not finite.all():
        raise ValueError(f"{name}: row {int(np.argmin(finite))} is not finite: {points[np.argmin(finite)]}")
    return points


def _spacing(rest: np.ndarray, affine: bool) -> float:
    """Return the mean distance of a landmark to its nearest other; raises where the system is singular."""
    if len(rest) < 4 and affine:
        raise ValueError(
            f"landmarks: the affine term needs 4 that are not coplanar, got {len(rest)}; add some, or affine=False"
        )
    if len(rest) < 2:
        raise ValueError("landmarks: expected at least 2, got 1")
    sizes = np.linalg.svd(rest - rest.mean(axis=0), compute_uv=False)
    tree = KDTree(rest)
    pairs = tree.query_pairs(COINCIDENT * sizes[0], output_type="ndarray")
    if len(pairs):
        a, b = min(map(tuple, pairs.tolist()))
        raise ValueError(f"landmarks {a} and {b} coincide at {rest[a]}; leave one out")
    if affine and sizes[2] <= COINCIDENT * sizes[0]:
        raise ValueError("landmarks: coplanar, so the affine term is undetermined; add one, or affine=False")
    return float(np.mean(tree.query(rest, k=2)[0][:, 1]))
