"""The carried morphable model against the whole Gaussian written out, ridge regression and PCA; what its prior does."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from facejax.mesh import deformation_transfer
from facejax.models.decoders import gpmm, gpmm_fit, linear

BALL = trimesh.creation.icosphere(subdivisions=1)  # 42 vertices
N, FACES = len(BALL.vertices), np.asarray(BALL.faces)
PICKED = np.array([0, 9, 17, 30])
RANK, FRAMES = 5, 30
MEAN = 50 * np.asarray(BALL.vertices)
MODES = np.random.default_rng(99).normal(size=(RANK, N, 3)) * np.arange(RANK, 0, -1)[:, None, None] / 2


def person(seed, *, frames=FRAMES, neutral=None, modes=MODES):
    """A ball of its own shape, moved as the mean ball is: displacements are carried from there."""
    rng = np.random.default_rng(seed)
    if neutral is None:
        neutral = MEAN @ (np.eye(3) + 0.2 * rng.normal(size=(3, 3)))
    moved = np.einsum("fr,rnx->fnx", rng.normal(size=(frames, len(modes))), modes)
    if neutral is not MEAN:
        moved = deformation_transfer.DeformationTransfer(
            MEAN, neutral, FACES, deformation_transfer.anchor_weights(np.full(N, 2.0))
        )(moved)
    return gpmm_fit.Person(neutral, moved[:, PICKED], moved)


@pytest.fixture(scope="module")
def people():
    return [person(seed) for seed in range(4)]


def fit(people, *prior, **options):
    return gpmm_fit.fit(people, FACES, PICKED, prior=gpmm.Prior(*prior), **options)


def error(params, someone):
    found = linear.apply(gpmm.linear_map(params, someone.neutral), someone.landmarks)
    return float(np.linalg.norm(found - someone.vertices, axis=-1).mean())


def test_the_survey_is_the_plain_loop(people):
    some = [people[0], people[1]._replace(landmarks=people[1].landmarks[:7], vertices=people[1].vertices[:7])]
    face, motion = gpmm_fit.mean_face_and_motion(some)
    np.testing.assert_allclose(face, (some[0].neutral + some[1].neutral) / 2)
    frames = [np.sum(frame**2, axis=-1) for each in some for frame in each.vertices]
    np.testing.assert_allclose(motion, np.sqrt(np.mean(frames, axis=0)))


@pytest.mark.parametrize("noise", [1e-2, 1.0])
def test_plain_and_without_the_smooth_prior_it_is_ridge_regression(people, noise):
    found = gpmm.linear_map(fit(people, False, 0.0, noise), people[2].neutral)
    expected = linear.ridge.fit([(p.landmarks, p.vertices) for p in people], alpha=noise)
    for a, b in zip((*found[:2], *found.factors), (*expected[:2], *expected.factors), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6)


def test_carried_to_the_one_face_that_there_is_it_is_pca():
    known = [person(seed, neutral=MEAN) for seed in range(3)]
    found = gpmm.linear_map(fit(known, True, 0.0, 0.3, components=3), MEAN)
    expected = linear.pca.fit([(p.landmarks, p.vertices) for p in known], alpha=0.3, components=3)
    np.testing.assert_allclose(found.factors[0], expected.factors[0] @ expected.factors[1], atol=1e-5)
    np.testing.assert_allclose(found.vertex_mean, expected.vertex_mean, atol=1e-5)


@pytest.mark.parametrize("carried", [True, False], ids=["carried", "plain"])
def test_against_the_whole_gaussian(people, carried):
    """Mean and covariance of all 3 N coordinates on the face, conditioned on the landmarks'."""
    prior = gpmm.Prior(carried, 0.3, 0.05)
    params, new = fit(people, *dataclasses.astuple(prior), components=4), person(7)
    if carried:
        carrier = deformation_transfer.DeformationTransfer(
            params.face, new.neutral, FACES, deformation_transfer.anchor_weights(params.motion)
        )
        mean = carrier(params.mean[None])[0].ravel()
        spread = sum(
            variance * np.outer(moved, moved)
            for variance, component in zip(params.variance, params.components, strict=True)
            for moved in [carrier(component[None]).ravel()]
        )
    else:
        flat = np.concatenate([p.vertices for p in people]).reshape(-1, 3 * N)
        mean, spread = flat.mean(axis=0), np.cov(flat.T, bias=True)
    for i in range(N):
        for j in range(N):
            far = np.sum((params.face[i] - params.face[j]) ** 2)
            alike = np.mean([np.exp(-far / (2 * scale**2)) for scale in gpmm.SMOOTH_SCALES_MM])
            spread[3 * i : 3 * i + 3, 3 * j : 3 * j + 3] += (
                prior.smooth**2 * params.motion[i] * params.motion[j] * alike * np.eye(3)
            )
    at = (3 * PICKED[:, None] + np.arange(3)).ravel()
    gain = np.linalg.solve(spread[np.ix_(at, at)] + prior.noise * np.eye(len(at)), spread[at])
    expected = mean + (new.landmarks.reshape(FRAMES, -1) - mean[at]) @ gain
    found = linear.apply(gpmm.linear_map(params, new.neutral), new.landmarks)
    np.testing.assert_allclose(found, expected.reshape(FRAMES, N, 3), atol=2e-4)


@pytest.mark.parametrize("carried", [True, False], ids=["carried", "plain"])
@pytest.mark.parametrize("only", [None, np.array([3, 9, 5, 41])], ids=["all", "some"])
def test_answers_of_a_few_frames_are_those_of_the_map(people, carried, only):
    params, new = fit(people, carried, 0.1, 1e-2, components=4), person(7)
    whole = linear.apply(gpmm.linear_map(params, new.neutral), new.landmarks)
    known = gpmm_fit.covariances(params, new.neutral, vertex_index=only)
    found = gpmm_fit.predict(known, params.prior, new.landmarks)
    np.testing.assert_allclose(found, whole if only is None else whole[:, only], atol=1e-4)


def test_another_prior_is_that_of_a_fit_with_it(people):
    params, new = fit(people, True, 0.1, 1e-2, components=4), person(7)
    other = gpmm.Prior(True, 0.3, 1.0)
    found = gpmm_fit.predict(gpmm_fit.covariances(params, new.neutral), other, new.landmarks)
    expected = linear.apply(
        gpmm.linear_map(fit(people, *dataclasses.astuple(other), components=4), new.neutral), new.landmarks
    )
    np.testing.assert_allclose(found, expected, atol=1e-4)


def test_what_is_carried_is_right_on_new_faces(people):
    new = person(7)
    carried, plain = fit(people, True, 0.0, 1e-4, components=RANK), fit(people, False, 0.0, 1e-4)
    assert error(carried, new) < 0.05 * np.linalg.norm(new.vertices, axis=-1).mean()
    assert error(carried, new) < 0.5 * error(plain, new)


def test_the_smooth_prior_takes_up_what_nobody_showed():
    """One mode seen, and a landmark pushed another way: its neighbours follow, the far side does not."""
    known = [person(seed, neutral=MEAN, modes=MODES[:1]) for seed in range(2)]
    across = np.cross(MODES[0, PICKED[0]], [1.0, 2.0, 3.0])
    across /= np.linalg.norm(across)
    marks = np.zeros((2, len(PICKED), 3))
    marks[1, 0] = across

    def followed(smooth):
        params = fit(known, False, smooth, 1e-6)
        at_rest, pushed = np.asarray(linear.apply(gpmm.linear_map(params, MEAN), marks))
        return (pushed - at_rest) @ across, params.motion

    assert np.abs(followed(0.0)[0]).max() < 0.05
    along, motion = followed(0.1)
    assert along[PICKED[0]] == pytest.approx(1, abs=1e-3)  # less noise than motion: the landmark is met
    order = np.argsort(np.linalg.norm(MEAN - MEAN[PICKED[0]], axis=-1))
    share = along / motion  # near points move alike, each as far as it usually moves
    assert share[order[1:6]].min() > 3 * np.abs(share[order[-5:]]).max()


def test_what_never_moves_stays():
    modes = np.where(MEAN[:, 2, None] < -20, 0.0, MODES)
    known = [person(seed, neutral=MEAN, modes=modes) for seed in range(2)]
    for carried in (True, False):
        params = fit(known, carried, 0.3, 1e-3, components=4)
        found = linear.apply(gpmm.linear_map(params, MEAN), person(7).landmarks)
        assert np.abs(found[:, MEAN[:, 2] < -20]).max() < 1e-6 < np.abs(found).max()


@pytest.mark.parametrize("carried", [True, False], ids=["carried", "plain"])
def test_a_face_may_be_traced_vectorised_and_differentiated(people, carried):
    params = fit(people, carried, 0.3, 0.05, components=4)
    faces = np.stack([person(seed).neutral for seed in (7, 8)])
    marks = person(7).landmarks[0]

    def decode(neutral):
        return linear.apply(gpmm.linear_map(params, neutral), marks)

    each = [decode(face) for face in faces]
    np.testing.assert_allclose(jax.jit(jax.vmap(decode))(faces), each, atol=2e-4)
    with jax.enable_x64(True):
        value = lambda neutral: jnp.sum(jnp.sin(decode(neutral)))  # noqa: E731
        slope = jax.grad(value)(jnp.asarray(faces[0]))
        assert slope.dtype == np.float64
        step = np.random.default_rng(0).normal(size=slope.shape)
        along = (value(faces[0] + 1e-5 * step) - value(faces[0] - 1e-5 * step)) / 2e-5
        np.testing.assert_allclose(np.sum(slope * step), along, rtol=1e-6, atol=1e-9)


def test_wrong_input_is_named(people):
    params = fit(people, False, 0.0, 1e-2)
    with pytest.raises(ValueError, match=r"neutral: expected vertices \(42, 3\), got \(41, 3\)"):
        gpmm.linear_map(params, MEAN[1:])
    with pytest.raises(ValueError, match="at least one person with a frame"):
        fit([], False, 0.0, 1e-2)
    with pytest.raises(ValueError, match="at least one person with a frame"):
        fit([person(0, frames=0)], True, 0.0, 1e-2)


@pytest.mark.parametrize("noise", [0.0, 0.3, 1.5])
def test_noise_of_landmarks_is_found(noise):
    """Faces that move in few ways; what is none of them is noise."""
    rng = np.random.default_rng(0)
    ball = trimesh.creation.icosphere(subdivisions=2)
    rest, faces = 50 * np.asarray(ball.vertices), np.asarray(ball.faces, np.int32)
    at = rng.permutation(len(rest))[:30].astype(np.int32)
    shapes = rng.normal(size=(4, *rest.shape))
    moved = np.einsum("fk,knx->fnx", rng.normal(size=(200, 4)), shapes)
    prior = gpmm.Prior(carried=False, smooth=0.0, noise=1e-8)
    params = gpmm_fit.fit([gpmm_fit.Person(rest, moved[:100, at], moved[:100])], faces, at, prior=prior)
    marks = moved[100:, at] + noise * rng.standard_normal((100, 30, 3))
    known = gpmm.on_face(params, rest)
    assert gpmm.estimate_landmark_noise(params, known, marks) == pytest.approx(noise, rel=0.05, abs=0.01)
    # One frame tells as well, less surely.
    assert gpmm.estimate_landmark_noise(params, known, marks[:1]) == pytest.approx(noise, rel=0.4, abs=0.01)
