"""Smoothstep: values and slopes; NumPy arrays give NumPy arrays, JAX arrays JAX arrays."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from facejax.geometry.interpolation import smoothstep


@pytest.mark.parametrize(("low", "high"), [(0.0, 1.0), (-5.0, 15.0), (8.0, 2.0)])
def test_values_against_the_polynomial(low, high):
    x = np.linspace(-20, 20, 401)
    expected = np.interp((x - low) / (high - low), [0, 1], [0, 1])
    np.testing.assert_allclose(smoothstep(x, low, high), 3 * expected**2 - 2 * expected**3, atol=1e-14)


def test_it_is_symmetric_and_has_slope_zero_at_both_ends():
    t = np.linspace(0, 1, 101)
    np.testing.assert_allclose(smoothstep(t) + smoothstep(1 - t), 1, atol=1e-15)
    assert (np.diff(smoothstep(t)) > 0).all()
    slope = jax.vmap(jax.grad(smoothstep))(jnp.array([-0.5, 0.0, 0.5, 1.0, 1.5]))
    np.testing.assert_allclose(slope, [0, 0, 1.5, 0, 0], atol=1e-6)


def test_arrays_keep_their_kind_and_dtype():
    for dtype in (np.float32, np.float64):
        found = smoothstep(np.linspace(-1, 2, 7, dtype=dtype))
        assert type(found) is np.ndarray and found.dtype == dtype
    x = jnp.linspace(-1, 2, 7)
    found = jax.jit(smoothstep)(x)
    assert isinstance(found, jax.Array) and isinstance(smoothstep(x), jax.Array) and found.dtype == x.dtype
    np.testing.assert_allclose(found, smoothstep(np.asarray(x)), atol=1e-6)
