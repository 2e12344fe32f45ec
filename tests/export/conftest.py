"""Compile quickly: these tests run each function once or twice."""

import jax
import pytest


@pytest.fixture(autouse=True, scope="module")
def few_optimisations():
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", False)
