"""A 3D morphable model: faces as a mean and principal components (Blanz & Vetter 1999; Seo & Luo 2021, 2.1).

It models any values at the vertices: shape, colours or normals, each with a model of its own. `direction` finds the
change of a face that increases an attribute; `fit_identity_expression` models identity and expression separately.

    shape = morphable.fit(heads, components=40)
    nearest = morphable.apply(shape, morphable.project(shape, head))
    older = head + 10 * morphable.direction(heads, ages, unit=True)

Vocabulary
  values       (N, C) numbers of one face: C of them at each of N vertices that correspond between faces. Coordinates
               in mm have C = 3, colours too.
  examples     (M, N, C) values of M faces.
  components   (k, N, C) orthonormal, the widest first: the paper's eigenshapes s_i and eigencolours t_i.
  deviation    (k,) standard deviation of the examples along each component, summed over vertices, in the
               values' unit; variances divide by M.
  coefficients (..., k) in standard deviations: the paper's weights alpha_i or beta_i over the deviation.
  attribute    a property of which each example has a score: age, femaleness, the curvature of the nose.

Fits work in float64 on the host and return float32.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from facejax.geometry.precision import HIGHEST
from facejax.models import pca

ROUNDING = 1e-6  # of a share of variance, from parameters in float32


class MorphableModel(NamedTuple):
    """mean + sum_i coefficients[i] deviation[i] components[i]."""

    mean: Array  # (N, C)
    components: Array  # (k, N, C), orthonormal, the widest first
    deviation: Array  # (k,)
    total_variance: Array  # (), of all directions, summed over vertices


class IdentityExpressionModel(NamedTuple):
    """Neutral faces, and displacements from them: C = 3."""

    identity: MorphableModel
    expression: MorphableModel


def fit(examples: np.ndarray, *, components: int) -> MorphableModel:
    """Fit the mean and principal components of examples (M, N, C), by a thin singular value decomposition.

    Directions without variance are dropped, so that there may be fewer components than requested. Examples must fit
    into memory; `facejax.models.decoders.linear.pca.prepare` computes the same components from batches.

    Raises:
      ValueError: examples of another shape, not finite or all equal, or more than M - 1 components.
    """
    return _fit("examples", _examples("examples", examples), "components", components)


@jax.jit
def apply(
    params: MorphableModel,
    coefficients: Float[Array | np.ndarray, " ..."],  # looser than (..., k), so that a scalar gets the error below
) -> Float[Array, "... N C"]:
    """Return the values of faces with coefficients in standard deviations; zero is the mean.

    Raises:
      ValueError: wrong number of coefficients.
    """
    return _apply(params, "coefficients", coefficients)


@jax.jit
def project(params: MorphableModel, values: Float[Array | np.ndarray, "*lead N C"]) -> Float[Array, "*lead k"]:
    """Return the coefficients of the nearest faces: `apply` of them is the orthogonal projection of the values.

    Coefficients are not regularised; magnitudes far above 3 indicate values unlike the examples.

    Raises:
      ValueError: wrong shape.
    """
    if jnp.shape(values)[-2:] != params.mean.shape:
        n, c = params.mean.shape
        raise ValueError(f"values: expected (..., {n}, {c}), got {jnp.shape(values)}")
    along = jnp.einsum("...nc,knc->...k", values - params.mean, params.components, precision=HIGHEST)
    return along / params.deviation


def direction(examples: np.ndarray, scores: np.ndarray, *, unit: bool = False) -> Float[Array, "N C"]:
    """Return the change of a face (N, C) that increases an attribute: sum_i mu_i (S_i - mean), Seo & Luo 2021, eq. 1.

    S are examples (M, N, C) and mu their scores (M,). The S_i - mean sum to zero, so that adding a constant to mu has
    no effect: the sum is M cov(mu, S), and cov(mu, S) itself for mu centred and divided by M. It scales with the number
    of examples and with the unit of the scores.

    unit=True divides by sum_i mu_i^2, mu centred. That is cov(mu, S) / var(mu), the slope of the regression of faces on
    scores, in the values' unit per unit of score: added to the expected face at a score, it gives the expected face at
    that score plus one. The score that a linear regression predicts from the face then increases by one if the
    regression interpolates all examples, as with fewer examples than coordinates, and by its R^2 otherwise.

    Raises:
      ValueError: wrong shapes, values that are not finite, or, with `unit`, scores that are all equal.
    """
    examples, scores = _examples("examples", examples), np.asarray(scores, np.float64)
    if scores.shape != examples.shape[:1]:
        raise ValueError(f"scores: expected ({len(examples)},), got {scores.shape}")
    if not np.isfinite(scores).all():
        raise ValueError(f"scores: expected finite numbers, got {scores[~np.isfinite(scores)][0]}")
    if unit and np.ptp(scores) == 0:
        raise ValueError(f"scores: expected at least two that differ, got {scores[0]} for every example")
    centred = scores - scores.mean()
    total = np.tensordot(centred, examples - examples.mean(axis=0), axes=1)
    return jnp.asarray(total / np.sum(centred**2) if unit else total, jnp.float32)


def fit_identity_expression(
    neutral: np.ndarray, displacements: np.ndarray, *, identity: int, expression: int
) -> IdentityExpressionModel:
    """Fit separate models of identity and expression.

    The expression model is the expression-specific 3DMM of Otberdout et al. 2023, 4.2: principal components of
    displacements, which `facejax.models.decoders.linear.pca` fits to landmarks.

    Args:
      neutral: (P, N, 3) neutral faces in mm, one per subject.
      displacements: (F, N, 3) frames in mm, each relative to its own subject's neutral.
      identity: number of identity components.
      expression: number of expression components.

    Raises:
      ValueError: as `fit`, or different numbers of vertices.
    """
    neutral, displacements = _examples("neutral", neutral), _examples("displacements", displacements)
    if neutral.shape[1:] != displacements.shape[1:] or neutral.shape[2] != 3:
        raise ValueError(
            "neutral and displacements: expected (P, N, 3) and (F, N, 3) with one N, "
            f"got {neutral.shape} and {displacements.shape}"
        )
    return IdentityExpressionModel(
        _fit("neutral", neutral, "identity", identity), _fit("displacements", displacements, "expression", expression)
    )


@jax.jit
def face(
    model: IdentityExpressionModel,
    identity: Float[Array | np.ndarray, "... k"],
    expression: Float[Array | np.ndarray, "... l"],
) -> Float[Array, "... N 3"]:
    """Return vertices (..., N, 3) in mm from identity coefficients (..., k) and expression coefficients (..., l).

    Leading axes broadcast: one identity serves all frames. Zero expression coefficients are the mean expression; the
    neutral expression is `project(model.expression, zeros)`, up to the truncation of the components.

    Raises:
      ValueError: wrong numbers of coefficients, or leading axes that do not broadcast.
    """
    try:
        jnp.broadcast_shapes(jnp.shape(identity)[:-1], jnp.shape(expression)[:-1])
    except ValueError:
        shapes = f"{jnp.shape(identity)} and {jnp.shape(expression)}"
        raise ValueError(f"identity and expression: expected leading axes that broadcast, got {shapes}") from None
    return _apply(model.identity, "identity", identity) + _apply(model.expression, "expression", expression)


def variance_kept(params: MorphableModel) -> Float[np.ndarray, " k"]:
    """Return the share of the examples' variance kept by the first 1 ... k components, (k,) float64 on the host."""
    return np.cumsum(np.square(params.deviation, dtype=np.float64)) / np.float64(params.total_variance)


def components_for(params: MorphableModel, share: float) -> int:
    """Return the least number of components that keep a share of the variance, such as 0.99.

    Raises:
      ValueError: a share outside (0, 1], or larger than all k components keep.
    """
    if not 0 < share <= 1:
        raise ValueError(f"share: expected more than 0 and at most 1, got {share}")
    kept = variance_kept(params)
    enough = kept >= share - ROUNDING
    if not enough[-1]:
        raise ValueError(f"share: expected at most {kept[-1]:.6f}, which {len(kept)} components keep, got {share}")
    return int(np.argmax(enough)) + 1


def _fit(name: str, examples: np.ndarray, option: str, components: int) -> MorphableModel:
    """Fit a model; `name` and `option` are the caller's argument names for error messages."""
    count = len(examples)
    if not 1 <= components < count:
        raise ValueError(f"{option}: expected 1 to {count - 1} components of {count} examples, got {components}")
    flat = examples.reshape(count, -1)
    # Relative to the first example: equal examples then give exact zeros, not rounding errors.
    centred = flat - flat[0]
    if not centred.any():
        raise ValueError(f"{name}: expected at least two that differ, got {count} alike")
    shift = centred.mean(axis=0)
    centred -= shift
    axes, singular = pca.from_samples(centred)
    k = min(components, int(np.sum(singular > 1e-6 * singular[0])))
    fitted = (
        (flat[0] + shift).reshape(examples.shape[1:]),
        axes[:k].reshape(k, *examples.shape[1:]),
        singular[:k] / np.sqrt(count),
        np.sum(singular**2) / count,
    )
    return MorphableModel(*(jnp.asarray(x, jnp.float32) for x in fitted))


def _apply(params: MorphableModel, name: str, coefficients: Array | np.ndarray) -> Array:
    """Apply a model; `name` is the caller's argument name for error messages."""
    if jnp.shape(coefficients)[-1:] != params.deviation.shape:
        raise ValueError(f"{name}: expected (..., {len(params.deviation)}), got {jnp.shape(coefficients)}")
    along = coefficients * params.deviation
    return params.mean + jnp.einsum("...k,knc->...nc", along, params.components, precision=HIGHEST)


def _examples(name: str, values: np.ndarray) -> np.ndarray:
    """Return examples (M, N, C) in float64, after checking them."""
    values = np.asarray(values, np.float64)
    if values.ndim != 3 or len(values) < 2 or values.size == 0:
        raise ValueError(f"{name}: expected (M, N, C) with M of 2 or more, got {values.shape}")
    bad = np.flatnonzero(~np.isfinite(values).all(axis=(1, 2)))
    if len(bad):
        raise ValueError(f"{name}: expected finite numbers, got others in example {bad[0]}")
    return values
