"""All forms of PCA against the full singular value decomposition and against each other."""

import numpy as np
import pytest

from facejax.models import pca

M, D = 60, 12


@pytest.fixture
def centred():
    rng = np.random.default_rng(0)
    samples = rng.normal(size=(M, D)) * np.geomspace(8, 0.1, D)
    return samples - samples.mean(axis=0)


def same_axes(found, expected):
    np.testing.assert_allclose(np.abs(np.sum(found * expected, axis=1)), 1, atol=1e-6)


def test_all_forms_find_the_axes_of_the_plain_decomposition(centred):
    _, singular, right = np.linalg.svd(centred, full_matrices=True)
    rows, values = pca.from_samples(centred)
    variance, columns = pca.from_covariance(centred.T @ centred / M)
    np.testing.assert_allclose(values, singular, rtol=1e-12)
    np.testing.assert_allclose(variance, singular**2 / M, rtol=1e-9)
    same_axes(rows, right)
    same_axes(columns.T, right)
    same_axes(pca.leading_components(centred.astype(np.float32), 4), right[:4])


def test_the_root_of_a_covariance_squares_to_it_and_has_orthogonal_columns(centred):
    covariance = centred.T @ centred / M
    root = pca.covariance_root(covariance)
    np.testing.assert_allclose(root @ root.T, covariance, atol=1e-12)
    gram = root.T @ root
    np.testing.assert_allclose(gram, np.diag(np.diag(gram)), atol=1e-10)


def test_an_orthonormal_basis_spans_the_columns_and_drops_dependent_ones(centred):
    columns = centred[:, :3] * [1e4, 1.0, 1e-2]
    basis = pca.orthonormal_basis(np.concatenate([columns, columns[:, :1] + columns[:, 1:2]], axis=1))
    assert basis.shape == (M, 3)
    np.testing.assert_allclose(basis.T @ basis, np.eye(3), atol=1e-9)
    np.testing.assert_allclose(basis @ (basis.T @ columns), columns, rtol=1e-6, atol=1e-6)
