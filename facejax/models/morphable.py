"""A 3D morphable model: faces as a mean and principal components (Blanz & Vetter 1999; Seo & Luo 2021, 2.1).

Any values that examples have at their vertices will do: shape, colours, normals, each with a model of its own.
`direction` finds what to add to a face for more of an attribute, and `fit_identity_expression` keeps identity and expression apart.

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
  attribute    what a score says of each example: age, femaleness, how hooked a nose is.

Fits work in float64 on the host and return float32.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

ROUNDING = 1e-6  # of a share of variance, from parameters in float32
PRECISION = jax.lax.Precision.HIGHEST  # GPUs multiply float32 with ten bits of mantissa unless told otherwise


class MorphableModel(NamedTuple):
    """mean + sum_i coefficients[i] deviation[i] components[i]."""

    mean: jax.Array  # (N, C)
    components: jax.Array  # (k, N, C), orthonormal, the widest first
    deviation: jax.Array  # (k,)
    total_variance: jax.Array  # (), of all directions, summed over vertices


class IdentityExpressionModel(NamedTuple):
    """Neutral faces, and displacements from them: C = 3."""

    identity: MorphableModel
    expression: MorphableModel


def fit(examples: np.ndarray, *, components: int) -> MorphableModel:
    """Mean and principal components of examples (M, N, C), by a thin singular value decomposition.

    Directions in which nothing varies are no components, so that there may be fewer than asked for. Examples have to
    fit into memory; `facejax.models.linear.pca.prepare` finds the same components of those that do not.

    Raises `ValueError` for examples of another shape, not finite or all alike, and for more components than M - 1.
    """
    return _fit("examples", _examples("examples", examples), "components", components)


@jax.jit
def apply(params: MorphableModel, coefficients: jax.Array) -> jax.Array:
    """Values (..., N, C) of faces with coefficients (..., k) in standard deviations; zero is the mean."""
    return _apply(params, "coefficients", coefficients)


@jax.jit
def project(params: MorphableModel, values: jax.Array) -> jax.Array:
    """Coefficients (..., k) of the faces nearest to values (..., N, C): `apply` of them is the orthogonal projection.

    Coefficients far beyond 3 say that these are no faces like the examples; nothing holds them back.
    """
    if jnp.shape(values)[-2:] != params.mean.shape:
        n, c = params.mean.shape
        raise ValueError(f"values: expected (..., {n}, {c}), got {jnp.shape(values)}")
    along = jnp.einsum("...nc,knc->...k", values - params.mean, params.components, precision=PRECISION)
    return along / params.deviation


def direction(examples: np.ndarray, scores: np.ndarray, *, unit: bool = False) -> jax.Array:
    """What to add to a face for more of an attribute, (N, C): sum_i mu_i (S_i - mean), Seo & Luo 2021, equation 1.

    S are examples (M, N, C) and mu their scores (M,). The S_i - mean add up to zero, so that a constant added to mu
    changes nothing: the sum is M cov(mu, S), and cov(mu, S) itself for mu centred and divided by M. It grows with the
    number of examples and with the unit of the scores.

    unit=True divides by sum_i mu_i^2, mu centred. That is cov(mu, S) / var(mu), the slope of the regression of faces on
    scores, in the values' unit per unit of score: added to the face that is expected at a score, it gives the one at
    that score plus one. A linear regression of scores on faces then rises by one as well where it meets every example's
    score, as with fewer examples than coordinates, and by its R^2 otherwise.

    Raises `ValueError` for wrong shapes, numbers that are not finite, and with `unit` for scores that are all alike.
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
    """Identity and expression apart, with so many components each.

    From neutral faces (P, N, 3), one per subject, and from F frames' displacements (F, N, 3), each from its own
    subject's neutral, both in mm. The model of expressions is the expression-specific 3DMM of Otberdout et al. 2023,
    4.2: principal components of such displacements, which `facejax.models.linear.pca` fits to landmarks.

    Raises `ValueError` where `fit` does, and for vertices that do not correspond.
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
def face(model: IdentityExpressionModel, identity: jax.Array, expression: jax.Array) -> jax.Array:
    """Vertices (..., N, 3) in mm, of identity coefficients (..., k) and expression coefficients (..., l).

    Their leading axes broadcast: one identity does for all frames. Zero expression coefficients are the mean
    expression; neutral's are `project(two.expression, zeros)`, as near as the components come to it.
    """
    try:
        jnp.broadcast_shapes(jnp.shape(identity)[:-1], jnp.shape(expression)[:-1])
    except ValueError:
        shapes = f"{jnp.shape(identity)} and {jnp.shape(expression)}"
        raise ValueError(f"identity and expression: expected leading axes that broadcast, got {shapes}") from None
    return _apply(model.identity, "identity", identity) + _apply(model.expression, "expression", expression)


def variance_kept(params: MorphableModel) -> np.ndarray:
    """Share of the examples' variance (k,) that the first 1 ... k components keep, float64 on the host."""
    return np.cumsum(np.square(params.deviation, dtype=np.float64)) / np.float64(params.total_variance)


def components_for(params: MorphableModel, share: float) -> int:
    """The least number of components that keep a share of the variance, such as 0.99.

    Raises `ValueError` for a share that is not in (0, 1], or that all k components do not keep.
    """
    if not 0 < share <= 1:
        raise ValueError(f"share: expected more than 0 and at most 1, got {share}")
    kept = variance_kept(params)
    enough = kept >= share - ROUNDING
    if not enough[-1]:
        raise ValueError(f"share: expected at most {kept[-1]:.6f}, which {len(kept)} components keep, got {share}")
    return int(np.argmax(enough)) + 1


def _fit(name: str, examples: np.ndarray, option: str, components: int) -> MorphableModel:
    """`fit`, with the caller's own names for what is wrong."""
    count = len(examples)
    if not 1 <= components < count:
        raise ValueError(f"{option}: expected 1 to {count - 1} components of {count} examples, got {components}")
    flat = examples.reshape(count, -1)
    # About the first example: those that are all alike then leave zeros, and no rounding to take for a component.
    centred = flat - flat[0]
    if not centred.any():
        raise ValueError(f"{name}: expected at least two that differ, got {count} alike")
    shift = centred.mean(axis=0)
    centred -= shift
    _, singular, right = np.linalg.svd(centred, full_matrices=False)
    k = min(components, int(np.sum(singular > 1e-6 * singular[0])))
    fitted = (
        (flat[0] + shift).reshape(examples.shape[1:]),
        right[:k].reshape(k, *examples.shape[1:]),
        singular[:k] / np.sqrt(count),
        np.sum(singular**2) / count,
    )
    return MorphableModel(*(jnp.asarray(x, jnp.float32) for x in fitted))


def _apply(params: MorphableModel, name: str, coefficients: jax.Array) -> jax.Array:
    """`apply`, with the caller's own name for the coefficients."""
    if jnp.shape(coefficients)[-1:] != params.deviation.shape:
        raise ValueError(f"{name}: expected (..., {len(params.deviation)}), got {jnp.shape(coefficients)}")
    along = coefficients * params.deviation
    return params.mean + jnp.einsum("...k,knc->...nc", along, params.components, precision=PRECISION)


def _examples(name: str, values: np.ndarray) -> np.ndarray:
    """Examples (M, N, C) in float64, two or more."""
    values = np.asarray(values, np.float64)
    if values.ndim != 3 or len(values) < 2 or values.size == 0:
        raise ValueError(f"{name}: expected (M, N, C) with M of 2 or more, got {values.shape}")
    bad = np.flatnonzero(~np.isfinite(values).all(axis=(1, 2)))
    if len(bad):
        raise ValueError(f"{name}: expected finite numbers, got others in example {bad[0]}")
    return values
