"""Fixtures that several rooms share. Tiny sizes; one small dataset for the whole session."""

import jax
import numpy as np
import pytest

from facejax.data import makehuman, makehuman4d
from tests import balls


@pytest.fixture(params=["float32", "float64"])
def dtype(request):
    """Either precision, as JAX is told to have it."""
    with jax.enable_x64(request.param == "float64"):
        yield np.dtype(request.param)


@pytest.fixture(scope="session")
def template():
    """The MakeHuman head: 3,260 vertices."""
    return makehuman.template()


@pytest.fixture(scope="session")
def tiny_spec():
    """Six subjects: four train, one validates, one tests. Level 1, the cheapest that is not linear."""
    return makehuman4d.Spec(level=1, subjects=6, meshes=60)


@pytest.fixture(scope="session")
def tiny_store(tiny_spec, tmp_path_factory):
    """A small makehuman4d on disk."""
    return makehuman4d.prepare(tiny_spec, folder=tmp_path_factory.mktemp("data"))


@pytest.fixture(scope="session")
def ball_store():
    """A dataset in memory that is learnt in no time, see `tests.balls`."""
    return balls.store_of_balls()
