"""Radial basis functions: compared with a loop and with SciPy; invariances; every error message."""

import warnings

import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jax.test_util import check_grads
from scipy.interpolate import RBFInterpolator
from scipy.spatial.transform import Rotation

from facejax.geometry import rbf

KERNELS = tuple(rbf.KERNELS)
DEFINITE = tuple(name for name in KERNELS if rbf.KERNELS[name].definite)
# Kernel, and whether the affine term is used; without it only definite kernels are allowed.
FORMS = [(name, True) for name in KERNELS] + [(name, False) for name in DEFINITE]
# SciPy's name, and its epsilon times the unit.
PEERS = {
    "gaussian": ("gaussian", 2**-0.5),
    "multiquadric": ("multiquadric", 1.0),
    "thin_plate": ("thin_plate_spline", 1.0),
    "triharmonic": ("cubic", 1.0),
}


@pytest.fixture(scope="module")
def head(template):
    """Landmarks and vertices of MakeHuman's head, mm."""
    return template.vertices[template.landmarks].astype(np.float64), template.vertices.astype(np.float64)


def random(seed, *shape):
    return np.random.default_rng(seed).normal(size=shape)


def scattered(seed, count=12):
    """Return landmarks (count, 3) in a box, with a minimum distance between them, as on a face."""
    grid = np.stack(np.meshgrid(*[np.arange(3.0)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    rng = np.random.default_rng(seed)
    return 10 * (rng.permutation(grid)[:count] + rng.uniform(-0.2, 0.2, (count, 3)))


def loop_warp(rest, displacements, vertices, phi, unit, smoothing=0.0, affine=True):
    """Return s(v) of the vertices by loops: fill the system, solve it, sum over the landmarks."""
    count, extra = len(rest), 4 if affine else 0
    system, right = np.zeros((count + extra, count + extra)), np.zeros((count + extra, 3))
    for i in range(count):
        for j in range(count):
            system[i, j] = phi(np.linalg.norm(rest[i] - rest[j]) / unit) + smoothing * (i == j)
        if affine:
            system[i, count:] = system[count:, i] = [1, *rest[i]]
        right[i] = displacements[i]
    found = np.linalg.solve(system, right)
    out = []
    for v in vertices:
        row = [phi(np.linalg.norm(v - c) / unit) for c in rest] + ([1, *v] if affine else [])
        out.append(np.array(row) @ found)
    return np.array(out)


PHI = {
    "gaussian": lambda r: np.exp(-(r**2) / 2),
    "multiquadric": lambda r: -np.sqrt(1 + r**2),
    "thin_plate": lambda r: r**2 * np.log(r) if r > 0 else 0.0,
    "triharmonic": lambda r: r**3,
    "wendland_c2": lambda r: max(1 - r, 0) ** 4 * (4 * r + 1),
}


@pytest.mark.parametrize(("kernel", "affine"), FORMS)
@pytest.mark.parametrize("smoothing", [0.0, 0.3])
def test_against_a_loop(kernel, affine, smoothing):
    rest, d, vertices = scattered(0), random(1, 12, 3), 10 * random(2, 7, 3)
    sigma = 4.0 if kernel == "wendland_c2" else 1.0
    found = rbf.fit(rest, kernel=kernel, sigma=sigma, smoothing=smoothing, affine=affine)
    distance = [min(np.linalg.norm(rest[i] - rest[j]) for j in range(12) if j != i) for i in range(12)]
    np.testing.assert_allclose(found.unit, sigma * np.mean(distance), rtol=1e-12)
    expected = loop_warp(rest, d, vertices, PHI[kernel], found.unit, smoothing, affine)
    np.testing.assert_allclose(rbf.apply(found, d, vertices), expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("smoothing", [0.0, 0.1, 3.0])
@pytest.mark.parametrize("kernel", PEERS)
def test_against_scipy(head, kernel, smoothing):
    rest, vertices = head
    found = rbf.fit(rest, kernel=kernel, sigma=0.8, smoothing=smoothing)
    d = random(3, 5, 68, 3)
    name, factor = PEERS[kernel]
    peer = RBFInterpolator(
        rest, np.moveaxis(d, 1, 0).reshape(68, -1), kernel=name, epsilon=factor / found.unit, degree=1,
        smoothing=smoothing,
    )  # fmt: skip
    expected = np.moveaxis(peer(vertices).reshape(-1, 5, 3), 1, 0)
    got = rbf.apply(found, d, vertices)
    assert np.abs(got - expected).max() < 1e-4 * np.abs(expected).max()
    near = np.linalg.norm(vertices - rest.mean(axis=0), axis=1) < 60
    assert np.abs(got - expected)[:, near].max() < 1e-4 * np.abs(expected)[:, near].max()


@pytest.mark.parametrize(("kernel", "affine"), FORMS)
def test_landmarks_are_met(head, kernel, affine):
    rest, _ = head
    d = 10 * random(4, 3, 68, 3).astype(np.float32)
    found = rbf.fit(rest, kernel=kernel, affine=affine)
    np.testing.assert_allclose(rbf.weights(found, rest), np.eye(68), atol=1e-6)
    np.testing.assert_allclose(rbf.apply(found, d, rest), d, atol=1e-4)


@pytest.mark.parametrize("kernel", KERNELS)
@given(seed=st.integers(0, 2**32 - 1), scale=st.sampled_from([1e-3, 1.0, 100.0]))
@settings(max_examples=10, deadline=None)
def test_an_affine_motion_is_carried_on_exactly(kernel, seed, scale):
    rest, vertices = scale * scattered(seed), scale * 10 * random(seed, 20, 3)
    matrix, shift = random(seed + 1, 3, 3), scale * random(seed + 2, 3)
    moved = rbf.apply(rbf.fit(rest, kernel=kernel), rest @ matrix + shift, vertices)
    expected = vertices @ matrix + shift
    assert np.abs(moved - expected).max() < 1e-5 * np.abs(expected).max()


@pytest.mark.parametrize("kernel", KERNELS)
@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=5, deadline=None)
def test_the_rest_may_turn_and_grow_and_its_landmarks_be_renumbered(kernel, seed):
    rest, vertices, d = scattered(seed), 10 * random(seed, 20, 3), random(seed + 1, 12, 3)
    plain = np.asarray(rbf.apply(rbf.fit(rest, kernel=kernel), d, vertices))
    limit = 1e-5 * np.abs(plain).max()

    order = np.random.default_rng(seed).permutation(12)
    renumbered = rbf.apply(rbf.fit(rest[order], kernel=kernel), d[order], vertices)
    np.testing.assert_allclose(renumbered, plain, atol=limit)

    turn, shift = Rotation.random(rng=seed).as_matrix(), random(seed + 2, 3)
    turned = rbf.apply(rbf.fit(2 * rest @ turn.T + shift, kernel=kernel), d @ turn.T, 2 * vertices @ turn.T + shift)
    np.testing.assert_allclose(turned, plain @ turn.T, atol=limit)


def test_it_is_linear_in_the_displacements(head):
    rest, vertices = head
    found, a, b = rbf.fit(rest), random(5, 68, 3), random(6, 68, 3)
    both = rbf.apply(found, 2 * a - 3 * b, vertices)
    np.testing.assert_allclose(
        both, 2 * rbf.apply(found, a, vertices) - 3 * rbf.apply(found, b, vertices), rtol=1e-4, atol=1e-4
    )
    np.testing.assert_array_equal(rbf.apply(found, np.zeros((68, 3), np.float32), vertices), 0)


@pytest.mark.parametrize("kernel", KERNELS)
def test_smoothing_lets_go_of_the_landmarks_but_not_of_affine_motion(head, kernel):
    rest, _ = head
    d = random(7, 68, 3)
    missed = [
        np.abs(rbf.apply(rbf.fit(rest, kernel=kernel, smoothing=s), d, rest) - d).mean()
        for s in (0.0, 0.01, 1.0, 100.0)
    ]
    assert missed[0] < 1e-5 and np.all(np.diff(missed) > 0)
    still = rbf.apply(rbf.fit(rest, kernel=kernel, smoothing=10.0), rest, rest)
    np.testing.assert_allclose(still, rest, atol=1e-3)


@pytest.mark.parametrize("kernel", DEFINITE)
def test_without_the_affine_term_far_vertices_stay(head, kernel):
    rest, _ = head
    far = rest + [0, 0, 500.0]
    np.testing.assert_array_equal(rbf.apply(rbf.fit(rest, kernel=kernel, affine=False), random(8, 68, 3), far), 0)


def test_warp_against_a_loop_with_leading_axes():
    w, several, d = random(9, 5, 4), random(11, 3, 1, 5, 4), random(10, 3, 2, 4, 3)
    with jax.enable_x64(True):
        one, each = rbf.warp(w, d), rbf.warp(several, d)
    for i, j, n in np.ndindex(3, 2, 5):
        np.testing.assert_allclose(one[i, j, n], sum(w[n, k] * d[i, j, k] for k in range(4)), atol=1e-14)
        np.testing.assert_allclose(each[i, j, n], sum(several[i, 0, n, k] * d[i, j, k] for k in range(4)), atol=1e-14)


def test_warp_gradients():
    with jax.enable_x64(True):
        check_grads(
            lambda w, d: jnp.sum(jnp.sin(rbf.warp(w, d))),
            (random(9, 5, 4), random(10, 2, 4, 3)),
            order=1,
            modes=("fwd", "rev"),
            eps=1e-6,
            atol=1e-6,
            rtol=1e-6,
        )


def test_displacements_may_be_traced_and_vertices_may_not(head):
    rest, vertices = head
    found = rbf.fit(rest)
    d = jnp.asarray(random(12, 68, 3), jnp.float32)
    gradient = jax.jit(jax.grad(lambda d: rbf.apply(found, d, vertices).sum()))(d)
    np.testing.assert_allclose(gradient, np.repeat(rbf.weights(found, vertices).sum(0)[:, None], 3, 1), rtol=1e-3)
    for call in (lambda v: rbf.apply(found, d, v), lambda v: rbf.weights(found, v), lambda v: rbf.fit(v).inverse):
        with pytest.raises(ValueError, match="`weights` outside jit"):
            jax.jit(call)(jnp.asarray(vertices))


def motion(frames=6):
    """Return displacements (frames, 68, 3) of about 5 mm that start and end at 0."""
    return np.sin(np.linspace(0, np.pi, frames))[:, None, None] * 3 * random(13, 68, 3)


@pytest.mark.parametrize("kernel", ["multiquadric", "gaussian"])
def test_refit_agrees_where_it_should(head, kernel):
    rest, vertices = head
    found, d = rbf.fit(rest, kernel=kernel), motion()[1:]
    again = rbf.refit(rest, d, vertices, kernel=kernel)
    once = np.asarray(rbf.apply(found, d, vertices))
    np.testing.assert_allclose(rbf.refit(rest, d, rest, kernel=kernel), d, atol=1e-4)
    np.testing.assert_allclose(again[0], once[0], atol=1e-4)
    np.testing.assert_allclose(rbf.refit(rest, d[:1], vertices, kernel=kernel)[0], once[0], atol=1e-4)
    bend = np.stack([rest @ (s * random(14, 3, 3)) + s for s in (0.05, 0.1, 0.02)])
    np.testing.assert_allclose(
        rbf.refit(rest, bend, vertices, kernel=kernel), rbf.apply(found, bend, vertices), atol=2e-4
    )
    # Elsewhere the result depends on the path: the landmarks return to rest, the vertices do not.
    np.testing.assert_allclose(d[-1], 0, atol=1e-12)
    np.testing.assert_allclose(once[-1], 0, atol=1e-9)
    assert np.abs(again[-1]).max() > 0.05
    assert np.abs(again - once).max() > 0.1


def test_refit_against_a_loop():
    rest, vertices = scattered(15), 10 * random(16, 6, 3)
    d = 0.5 * random(17, 3, 12, 3)
    at, landmarks, expected = vertices.copy(), rest, []
    for here in d:
        unit = rbf.fit(landmarks, kernel="gaussian", sigma=1.0).unit
        step = loop_warp(landmarks, rest + here - landmarks, at, PHI["gaussian"], unit)
        at, landmarks = at + step, rest + here
        expected.append(at - vertices)
    np.testing.assert_allclose(rbf.refit(rest, d, vertices, kernel="gaussian", sigma=1.0), expected, atol=1e-5)


def test_refit_names_the_frame_where_landmarks_meet(head, monkeypatch):
    rest, vertices = head
    d = np.zeros((4, 68, 3))
    d[2, 66] = rest[62] - rest[66]
    with pytest.raises(ValueError, match="frame 3: landmarks 62 and 66 coincide"):
        rbf.refit(rest, d, vertices)
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)  # what a caller gets: only tests check shapes
    with pytest.raises(ValueError, match=r"displacements: expected \(T, 68, 3\), got \(4, 67, 3\)"):
        rbf.refit(rest, d[:, 1:], vertices)


def with_row(row, value):
    rest = scattered(18)
    rest[row] = value
    return rest


FLAT = scattered(19) * [1, 1, 0]


@pytest.mark.parametrize(
    ("call", "match"),
    [
        (lambda: rbf.fit(scattered(0)[:3]), "needs 4 that are not coplanar, got 3"),
        (lambda: rbf.fit(scattered(0)[:1], kernel="gaussian", affine=False), "at least 2, got 1"),
        (lambda: rbf.fit(scattered(0)[:, :2]), r"landmarks: expected \(K, 3\), got shape \(12, 2\)"),
        (lambda: rbf.fit(with_row(5, np.nan)), "landmarks: row 5 is not finite"),
        (lambda: rbf.fit(with_row(9, scattered(18)[4])), "landmarks 4 and 9 coincide"),
        (lambda: rbf.fit(FLAT), "coplanar.*affine=False"),
        (lambda: rbf.fit(scattered(0), kernel="cubic"), "expected one of gaussian, .*, got 'cubic'"),
        (lambda: rbf.fit(scattered(0), sigma=0), "sigma: expected a positive number of landmark spacings, got 0"),
        (lambda: rbf.fit(scattered(0), sigma=np.inf), "sigma: expected a positive"),
        (lambda: rbf.fit(scattered(0), smoothing=-1), "smoothing: expected 0 or more, got -1"),
        (lambda: rbf.fit(scattered(0), kernel="triharmonic", affine=False), "triharmonic needs its affine term"),
        (lambda: rbf.fit(scattered(0), kernel="gaussian", sigma=1e3), "gaussian of width 1000 is too wide"),
        (lambda: rbf.weights(rbf.fit(scattered(0)), with_row(3, np.inf)), "vertices: row 3 is not finite"),
        (lambda: rbf.weights(rbf.fit(scattered(0)), np.zeros((0, 3))), r"vertices: expected \(K, 3\)"),
        (lambda: rbf.warp(jnp.ones((5, 4)), jnp.ones((3, 3))), r"got \(5, 4\) and \(3, 3\)"),
        (lambda: rbf.warp(jnp.ones((5, 4)), jnp.ones((4, 2))), r"displacements \(\.\.\., L, 3\)"),
        (
            lambda: rbf.warp(jnp.ones((5, 4)), jnp.ones((4, 3), int)),
            "displacements: expected a floating dtype, got int32",
        ),
    ],
)
def test_wrong_input_is_named(call, match, monkeypatch):
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)  # what a caller gets: only tests check shapes
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(ValueError, match=match):
            call()


def test_landmarks_in_a_plane_do_without_the_affine_term():
    found = rbf.fit(FLAT, kernel="gaussian", affine=False)
    d = random(20, 12, 3)
    np.testing.assert_allclose(rbf.apply(found, d, FLAT), d, atol=1e-5)
