"""From a face's landmarks to its mesh, on tiny balls: traced faces, batches in pieces, and files."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from facejax.data.mesh_subset import of_split
from facejax.mesh import hierarchy as mesh_hierarchy
from facejax.mesh import strain
from facejax.models.decoders import gpmm, gpmm_fit, gpmm_residual, linear, residual
from facejax.training.recipes import fit_gpmm


def built(store, *, carried, gate):
    """Parameters whose network says something, though it was never trained."""
    train = of_split(store, "train")
    base = fit_gpmm.fit(train, components=20, carried=(carried,)).params
    hierarchy = mesh_hierarchy.build(base.face, store.faces, factors=(2, 2, 2, 2), lengths=3)
    ones = jnp.ones(())
    scale = residual.Scale(jnp.asarray(base.face, jnp.float32), jnp.zeros((5, 3)), ones, 0.2 * ones)
    network = residual.init(jax.random.key(0), hierarchy, scale)
    spoken = network.weights | {"shared": 0.1 * jax.random.normal(jax.random.key(1), network.weights["shared"].shape)}
    tables = strain.vertex_triangles(store.faces, len(base.face))
    return gpmm_residual.GPMMResidual(base, network._replace(weights=spoken, gate=jnp.float32(gate)), hierarchy, tables)


def decode(params, marks, neutral, **options):
    return gpmm_residual.apply(params, gpmm_residual.prepare(params, neutral), marks, **options)


@pytest.fixture(scope="module")
def params(ball_store):
    return built(ball_store, carried=True, gate=0.5)


@pytest.fixture(scope="module")
def person(ball_store):
    return of_split(ball_store, "test").person(1)


def test_it_is_the_linear_answer_and_the_networks_share(params, person):
    neutral, marks, _ = person
    base = np.asarray(linear.apply(gpmm.linear_map(params.base, neutral), marks))
    rest = np.broadcast_to(neutral, base.shape)
    whole = residual.apply(params.network, params.hierarchy, params.tables, marks, base, rest)
    found = np.asarray(decode(params, marks, neutral))
    np.testing.assert_allclose(found, whole, atol=2e-5)
    assert np.abs(found - base).max() > 1e-3
    closed = params.replace(network=params.network._replace(gate=jnp.zeros(())))
    np.testing.assert_array_equal(decode(closed, marks, neutral), base)
    np.testing.assert_array_equal(decode(params, marks, neutral, refined=False), base)


@pytest.mark.parametrize("lead", [(), (1,), (3, 2), (37,)], ids=str)
def test_leading_axes_are_free_and_pieces_do_not_show(params, person, lead):
    neutral, marks, _ = person
    rng = np.random.default_rng(0)
    many = marks[rng.integers(len(marks), size=lead)]
    found = np.asarray(decode(params, many, neutral))
    assert found.shape == (*lead, *neutral.shape)
    one_by_one = [decode(params, row[None], neutral)[0] for row in many.reshape(-1, *marks.shape[1:])]
    np.testing.assert_allclose(found.reshape(-1, *neutral.shape), np.asarray(one_by_one), atol=2e-5)


def test_another_prior_is_another_model(params, person):
    neutral, marks, _ = person
    closed = params.replace(network=params.network._replace(gate=jnp.zeros(())))
    first = np.asarray(decode(closed, marks, neutral))
    doubtful = closed.base.replace(prior=closed.base.prior.replace(noise=10.0))
    assert np.abs(np.asarray(decode(closed.replace(base=doubtful), marks, neutral)) - first).max() > 0.1
    np.testing.assert_array_equal(decode(closed, marks, neutral), first)


def test_told_of_noise_it_trusts_landmarks_less(params, person):
    neutral, marks, moved = person
    noisy = (marks + 2 * np.random.default_rng(0).standard_normal(marks.shape)).astype(np.float32)
    found = [np.asarray(decode(params, noisy, neutral, noise=noise)) for noise in (0.0, 2.0)]
    errors = [np.linalg.norm(vertices - moved, axis=-1).mean() for vertices in found]
    assert errors[1] < 0.8 * errors[0]
    trusting = decode(params, marks, neutral, noise=1e-6)
    np.testing.assert_allclose(trusting, decode(params, marks, neutral, refined=False), atol=1e-4)
    # What it finds out by itself is as good, and harms landmarks that are right little.
    found = np.asarray(decode(params, noisy, neutral, noise=None))
    assert np.linalg.norm(found - moved, axis=-1).mean() < 1.1 * errors[1]
    right = [np.linalg.norm(np.asarray(decode(params, marks, neutral, **options)) - moved, axis=-1).mean()
             for options in ({"noise": None}, {"refined": False})]  # fmt: skip
    assert right[0] < 1.2 * right[1]
    with pytest.raises(ValueError, match="noise: expected 0 mm or more, got -1"):
        decode(params, marks, neutral, noise=-1)
    with pytest.raises(ValueError, match="expected one or more frames"):
        decode(params, marks[:0], neutral, noise=None)
    assert decode(params, marks[:0], neutral).shape == (0, *neutral.shape)
    with pytest.raises(ValueError, match="stores only a linear map fitted to noise-free landmarks"):
        gpmm.with_landmark_noise(params.base.replace(components=np.zeros((0, 162, 3)), variance=np.zeros(0)), 0.5)


def test_a_face_may_be_traced_and_differentiated(params, person):
    neutral, marks, _ = person

    def decode(face, marks):
        return gpmm_residual.apply(params, gpmm_residual.prepare(params, face), marks)

    expected = decode(neutral, marks[:3])
    np.testing.assert_allclose(jax.jit(decode)(neutral, marks[:3]), expected, atol=2e-4)
    faces = np.stack([neutral, neutral + 1])
    np.testing.assert_allclose(jax.vmap(decode, (0, None))(faces, marks[:3])[0], expected, atol=2e-4)
    slope = jax.grad(lambda face: jnp.sum(decode(face, marks[:2]) ** 2))(neutral)
    assert np.isfinite(slope).all() and np.abs(slope).max() > 0


@pytest.mark.parametrize("carried", [True, False])
def test_a_file_holds_all_to_half_precision(ball_store, person, carried):
    params = built(ball_store, carried=carried, gate=0.25)
    tree = jax.tree.map(np.asarray, gpmm_residual.pack(params))
    again = gpmm_residual.unpack(tree, params.hierarchy, ball_store.faces)
    assert again.base.prior == params.base.prior and float(again.network.gate) == 0.25
    neutral, marks, _ = person
    found, expected = (np.asarray(decode(p, marks, neutral)) for p in (again, params))
    assert np.abs(found - expected).max() < 5e-3 * np.abs(expected).max()


def test_a_file_of_linear_data_is_as_good_as_the_model():
    """The landmarks move in fewer directions than they have coordinates, and nothing is noise."""
    rng = np.random.default_rng(0)
    ball = trimesh.creation.icosphere(subdivisions=2)
    rest, faces, marks = (
        50 * np.asarray(ball.vertices),
        np.asarray(ball.faces, np.int32),
        np.array([0, 20, 61, 99, 140]),
    )
    shapes = rng.normal(size=(6, *rest.shape)) * 10.0 ** -np.arange(6.0)[:, None, None]
    moved = np.einsum("fk,knx->fnx", rng.normal(size=(80, 6)), shapes)
    prior = gpmm.Prior(carried=False, smooth=0.0, noise=1e-12)
    base = gpmm_fit.fit([gpmm_fit.Person(rest, moved[:, marks], moved)], faces, marks, prior=prior)
    hierarchy = mesh_hierarchy.build(rest, faces, factors=(2, 2, 2, 2), lengths=3)
    one = jnp.ones(())
    network = residual.init(
        jax.random.key(0), hierarchy, residual.Scale(jnp.asarray(rest), jnp.zeros((5, 3)), one, one)
    )
    params = gpmm_residual.GPMMResidual(base, network, hierarchy, strain.vertex_triangles(faces, len(rest)))
    again = gpmm_residual.unpack(jax.tree.map(np.asarray, gpmm_residual.pack(params)), hierarchy, faces)
    errors = [np.abs(np.asarray(decode(p, moved[:, marks], rest)) - moved).max() for p in (params, again)]
    assert errors[0] < 1e-3 and errors[1] < 1.5 * errors[0]


def test_fewer_components_weigh_less(params):
    tree = gpmm_residual.pack(params, components=3)
    assert tree["base"]["components"].shape[0] == 3 and tree["base"]["variance"].shape == (3,)
    with pytest.raises(KeyError):
        gpmm_residual.unpack({"base": {}, "network": {}}, params.hierarchy, params.base.faces)
