"""The motion GAN: exactly tangent output, unit motions, labels that matter, a toy distribution learned."""

from contextlib import contextmanager

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from jax.test_util import check_grads

from facejax import losses
from facejax.geometry import sphere
from facejax.models.motion import generators, motion3dgan, motion3dgan_reference, tangent_pca
from facejax.training import loop, steps

CONFIG = motion3dgan.Config(steps=5, landmarks=4, labels=3, noise=6, rank=8, pose=4, width=16, blocks=2, embedding=4)
SHAPE = (5, 4, 3)
POSE = jnp.linspace(-1, 1, CONFIG.pose)


def toy(count: int = 240, seed: int = 0):
    """Motions of the six ordered pairs of 3 labels: means 0.4 apart, spread 0.1 to 0.2, two styles each.

    Where they start has nothing to do with how they go on.
    """
    rng = np.random.default_rng(seed)
    p = rng.standard_normal(SHAPE)
    p /= np.sqrt(np.sum(p**2) / SHAPE[0])
    modes = rng.standard_normal((4, *SHAPE))
    pairs = np.array([(a, b) for a in range(3) for b in range(3) if a != b])
    centres = 0.2 * rng.standard_normal((6, *SHAPE))
    which = np.arange(count) % 6
    z = rng.standard_normal((count, 4)) * [1, 0.7, 0.5, 0.3]
    z[:, 0] = np.where(rng.random(count) < 0.5, -1.0, 1.0) + 0.2 * z[:, 0]
    v = centres[which] + 0.1 * (1 + which % 2)[:, None, None, None] * np.einsum("nm,mtlc->ntlc", z, modes)
    v = np.asarray(sphere.project(jnp.float32(p), jnp.float32(v)))
    log_length = 0.3 * which + 0.1 * (1 + which % 2) * rng.standard_normal(count)
    log_seconds = -0.5 * log_length + 0.1 * rng.standard_normal(count)
    made = tangent_pca.Motion(None, log_length.astype(np.float32), log_seconds.astype(np.float32))
    start, end = pairs[which].T
    here = 0.3 * rng.standard_normal((count, *SHAPE[1:])) * (start > 0)[:, None, None]
    return p.astype(np.float32), v, made, start, end, here.astype(np.float32)


def fitted(data, **options):
    return tangent_pca.fit(*data, pose=CONFIG.pose, **options)


@contextmanager
def plain_weights():
    """Initial weights are drawn by NumPy: JAX compiles a program for every shape that it draws."""

    def he_normal():
        def draw(key, shape):
            rng = np.random.default_rng(np.asarray(jax.random.key_data(key)))
            return jnp.asarray(rng.standard_normal(shape) * np.sqrt(2 / np.prod(shape[:-1])), jnp.float32)

        return draw

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(jax.nn.initializers, "he_normal", he_normal)
        yield


@pytest.fixture(scope="module")
def chart():
    return fitted(toy(), labels=3, rank=CONFIG.rank)


@pytest.fixture(scope="module")
def generator(chart):
    params = motion3dgan.generator.init(jax.random.key(0), chart, config=CONFIG)
    head = jax.random.normal(jax.random.key(5), params.weights["head"]["kernel"].shape) * 0.1
    return params._replace(weights=params.weights | {"head": params.weights["head"] | {"kernel": head}})


@pytest.fixture(scope="module")
def critic(chart):
    return motion3dgan.critic.init(jax.random.key(1), chart, config=CONFIG)


def test_chart_directions_are_orthonormal_tangent_and_uncorrelated_within_pairs(chart):
    p, tangents, made, start, end, here = toy()
    basis = np.asarray(chart.basis, np.float64).reshape(CONFIG.rank, -1)
    np.testing.assert_allclose(basis @ basis.T, np.eye(CONFIG.rank), atol=2e-6)
    np.testing.assert_allclose(basis @ p.ravel(), 0, atol=2e-6)
    components = tangents.reshape(len(tangents), -1) @ basis.T
    within, deviation = components.copy(), components.copy()
    poses = np.stack([tangent_pca.encode_pose(chart, h, a) for h, a in zip(here, start, strict=True)])
    for a, b in {*zip(start.tolist(), end.tolist(), strict=True)}:
        rows = (start == a) & (end == b)
        np.testing.assert_allclose(chart.mean[a, b], components[rows].mean(0), atol=1e-5)
        means = made.log_length[rows].mean(), made.log_seconds[rows].mean()
        np.testing.assert_allclose(chart.scalar_mean[a, b], means, rtol=1e-5, atol=1e-6)
        within[rows] -= components[rows].mean(0)
        deviation[rows] = within[rows] - poses[rows] @ np.asarray(chart.gain)[a][:, tangent_pca.SCALARS :]
        own = np.sqrt(np.sum(deviation[rows] ** 2, axis=0) / (rows.sum() - 1))
        np.testing.assert_allclose(chart.scale[a, b][:4], own[:4], rtol=1e-3)
    covariance = within.T @ within / len(within)
    assert np.abs(covariance - np.diag(np.diag(covariance))).max() < 1e-4 * covariance[0, 0]
    assert np.all(np.diff(np.diag(covariance)) <= 1e-9)


def test_chart_spans_the_principal_directions_of_a_full_decomposition(chart):
    tangents = toy()[1].reshape(240, -1)
    values = np.linalg.svd(tangents.astype(np.float64), compute_uv=False) ** 2
    best = values[CONFIG.rank :].sum() / values.sum()
    assert best - 1e-6 <= float(chart.residual) <= best + 1e-3


def test_a_pair_never_seen_gets_the_sum_of_its_labels_effects():
    p, tangents, _, _, _, here = toy()
    rng = np.random.default_rng(1)
    effects = rng.standard_normal((2, 4))
    start, end = np.arange(240) % 4, np.arange(240) // 4 % 4
    seen = (start != 2) | (end != 1)
    log_length = effects[0][start] + effects[1][end]
    made = tangent_pca.Motion(None, log_length[seen], -log_length[seen])
    got = fitted((p, tangents[seen], made, start[seen], end[seen], here[seen]), labels=4, rank=8)
    wanted = effects[0][2] + effects[1][1]
    np.testing.assert_allclose(got.scalar_mean[2, 1], (wanted, -wanted), rtol=1e-5)


def test_coordinates_that_follow_the_pose_are_expected_to():
    """A direction of the start that moves the coordinates: regression finds it, and takes it out of the spread."""
    p, tangents, made, start, end, here = toy(1200)
    chart = fitted(toy(1200), labels=3, rank=8)
    poses = jax.vmap(tangent_pca.encode_pose, (None, 0, 0))(chart, here, start)
    moved = tangents + 0.5 * np.asarray(poses)[:, 0, None, None, None] * np.asarray(chart.basis)[3]
    found = fitted((p, moved, made, start, end, here), labels=3, rank=8)
    along = np.einsum("rtlc,tlc->r", found.basis, chart.basis[3])
    poses = jax.vmap(tangent_pca.encode_pose, (None, 0, 0))(found, here, start)
    step = found.gain[1][0, tangent_pca.SCALARS :] @ along
    assert float(step) == pytest.approx(0.5, rel=0.08) and np.asarray(poses).std() == pytest.approx(0.8, abs=0.25)
    before = tangent_pca.conditional_mean(found, 1, 2, jnp.zeros(CONFIG.pose))
    np.testing.assert_allclose(before[tangent_pca.SCALARS :], found.mean[1, 2], atol=1e-6)
    np.testing.assert_allclose(found.scale[1, 2][:3], chart.scale[1, 2][:3], rtol=0.2)


def test_poses_are_inverse_and_neutral_has_only_one(chart):
    pose = jnp.asarray(np.random.default_rng(5).standard_normal(CONFIG.pose), jnp.float32)
    np.testing.assert_allclose(
        tangent_pca.encode_pose(chart, tangent_pca.decode_pose(chart, pose, 2), 2), pose, atol=1e-5
    )
    np.testing.assert_array_equal(tangent_pca.encode_pose(chart, jnp.ones(SHAPE[1:]), 0), 0)
    np.testing.assert_array_equal(tangent_pca.decode_pose(chart, jnp.zeros(CONFIG.pose), 0), 0)


def test_coordinates_and_motion_are_inverse_and_keep_distances(chart):
    a, b = np.random.default_rng(0).standard_normal((2, CONFIG.rank + 2)).astype(np.float32)
    (v, *scalars), (w, *_) = tangent_pca.decode(chart, a, 0, 1), tangent_pca.decode(chart, b, 0, 1)
    np.testing.assert_allclose(tangent_pca.encode(chart, v, *scalars, 0, 1), a, atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(v - w), np.linalg.norm(a[2:] - b[2:]), rtol=1e-5)


def test_chart_refuses_wrong_shapes_too_few_motions_and_nan():
    p, tangents, *rest = toy()
    with pytest.raises(ValueError, match=r"tangents must be \(M, T-1, L, 3\).*got \(240, 5, 3, 3\)"):
        fitted((p, tangents[:, :, :3], *rest), labels=3, rank=8)
    with pytest.raises(ValueError, match="rank 240 needs more than 240 motions; got 240"):
        fitted((p, tangents, *rest), labels=3, rank=240)
    tangents = tangents.copy()
    tangents[17, 0, 0, 0] = np.nan
    with pytest.raises(ValueError, match="motion 17 is not finite"):
        fitted((p, tangents, *rest), labels=3, rank=8)


def test_generator_is_the_plain_loop(generator):
    noise = np.random.default_rng(0).standard_normal(CONFIG.noise)
    chart, weights = jax.tree.map(np.float64, generator)
    pose = np.asarray(POSE, np.float64)
    x = np.concatenate([noise, weights["labels"][0, 2], weights["labels"][1, 1], pose])
    x = x @ weights["stem"]["kernel"] + weights["stem"]["bias"]
    x = x / (1 + np.exp(-x))
    for block in weights["blocks"]:
        y = x @ block["kernel"] + block["bias"]
        x = x + y / (1 + np.exp(-y)) / 2
    deviation = x @ weights["head"]["kernel"]
    deviation[: CONFIG.noise] += noise
    drift = pose @ chart.gain[2]
    tangent = np.zeros(SHAPE)
    for r in range(CONFIG.rank):
        component = chart.mean[2, 1, r] + drift[r + 2] + chart.scale[2, 1, r] * deviation[r + 2]
        tangent += component * chart.basis[r]
    got, *scalars = motion3dgan.generator.apply(generator, jnp.float32(noise), 2, 1, POSE)
    np.testing.assert_allclose(got, tangent, atol=1e-5)
    wanted = chart.scalar_mean[2, 1] + chart.scalar_std * (drift + deviation)[:2]
    np.testing.assert_allclose(scalars, wanted, rtol=1e-5, atol=1e-6)


def test_output_is_tangent_and_samples_have_unit_norm(generator):
    keys = jax.random.split(jax.random.key(3), 50)
    noise = 3.0 * jax.random.normal(jax.random.key(4), (50, CONFIG.noise))
    tangent, *_ = jax.vmap(motion3dgan.generator.apply, (None, 0, None, None, None))(generator, noise, 0, 2, 0 * POSE)
    assert np.abs(sphere.inner(generator.chart.p, tangent)).max() < 1e-6
    q, log_length, log_seconds = jax.vmap(generators.sample, (None, 0, None, None, None))(generator, keys, 1, 0, POSE)
    assert q.shape == (50, *SHAPE) and log_length.shape == (50,)
    np.testing.assert_allclose(sphere.norm(q), 1.0, atol=1e-5)
    assert len(np.unique(np.asarray(log_length))) == len(np.unique(np.asarray(log_seconds))) == 50


def test_untrained_generator_has_the_right_means_and_spreads(chart):
    params = motion3dgan.generator.init(jax.random.key(0), chart, config=CONFIG)
    noise = jax.random.normal(jax.random.key(1), (4000, CONFIG.noise))
    got = jax.vmap(motion3dgan.generator.apply_coordinates, (None, 0, None, None, None))(params, noise, 2, 0, 0 * POSE)
    np.testing.assert_allclose(got[:, 2:].mean(0), chart.mean[2, 0], atol=0.06 * float(chart.scale[2, 0].max()))
    np.testing.assert_allclose(got[:, 2:6].std(0), chart.scale[2, 0, :4], rtol=0.06)
    np.testing.assert_allclose(got[:, :2].mean(0), 0, atol=0.06)
    np.testing.assert_allclose(got[:, :2].std(0), 1, atol=0.06)


def test_labels_their_order_and_the_pose_matter(generator, critic):
    noise, told = jnp.ones(CONFIG.noise), [(0, 1, 0 * POSE), (1, 0, 0 * POSE), (0, 2, 0 * POSE), (1, 0, POSE)]
    outputs = [motion3dgan.generator.apply(generator, noise, *one)[0] for one in told]
    scores = [motion3dgan.critic.apply(critic, outputs[0], 0.1, 0.2, *one) for one in told]
    assert min(np.abs(outputs[0] - other).max() for other in outputs[1:]) > 1e-2
    assert np.abs(outputs[1] - outputs[3]).max() > 1e-3
    assert len({float(score) for score in scores}) == 4


def test_eager_jit_and_vmap_agree(generator, critic):
    noise = jax.random.normal(jax.random.key(2), (3, CONFIG.noise))
    start, end = jnp.array([0, 1, 2]), jnp.array([1, 2, 0])
    batch = jax.vmap(motion3dgan.generator.apply, (None, 0, 0, 0, None))(generator, noise, start, end, POSE)
    scores = jax.vmap(motion3dgan.critic.apply, (None, 0, 0, 0, 0, 0, None))(critic, *batch, start, end, POSE)
    for i in range(3):
        with jax.disable_jit():
            one = motion3dgan.generator.apply(generator, noise[i], int(start[i]), int(end[i]), POSE)
            score = motion3dgan.critic.apply(critic, *one, int(start[i]), int(end[i]), POSE)
        for many, single in zip(batch, one, strict=True):
            np.testing.assert_allclose(many[i], single, rtol=1e-5, atol=1e-5)
        np.testing.assert_allclose(scores[i], score, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("network", ["generator", "critic"])
def test_the_chart_has_no_gradient_and_every_weight_has_one(request, network):
    params = constant = request.getfixturevalue(network)

    def output(params):
        noise = jnp.linspace(-1, 1, CONFIG.noise)
        if network == "generator":
            tangent, *scalars = motion3dgan.generator.apply(params, noise, 1, 2, POSE)
            return jnp.sum(jnp.square(tangent)) + jnp.sum(jnp.square(jnp.stack(scalars)))
        return motion3dgan.critic.apply(params, constant.chart.basis[0], jnp.float32(0.2), jnp.float32(0.1), 1, 2, POSE)

    slope = jax.grad(output)(params)
    assert all(np.all(leaf == 0) for leaf in jax.tree.leaves(slope.chart))
    assert all(np.any(leaf != 0) for leaf in jax.tree.leaves(slope.weights))


def test_gradients_equal_finite_differences(generator):
    def energy(noise):
        tangent, *scalars = motion3dgan.generator.apply(generator, noise, 0, 1, 0 * POSE)
        return jnp.sum(jnp.square(tangent)) + jnp.sum(jnp.square(jnp.stack(scalars)))

    check_grads(energy, (jnp.linspace(-1, 1, CONFIG.noise),), 1, eps=1e-2, rtol=1e-2)


def test_critic_gradient_along_the_tangent_is_the_one_in_coordinates(critic):
    v, w = critic.chart.basis[0] * 0.3, jnp.float32(0.2)
    tangent = jax.grad(motion3dgan.critic.apply, 1)(critic, v, w, w, 0, 1, 0 * POSE)
    values = tangent_pca.encode(critic.chart, v, w, w, 0, 1)
    inner = jax.grad(motion3dgan.critic.apply_coordinates, 1)(critic, values, 0, 1, 0 * POSE)
    np.testing.assert_allclose(np.linalg.norm(tangent), np.linalg.norm(inner[2:]), rtol=1e-5)


def test_wrong_charts_and_noise_are_named(chart, generator):
    with pytest.raises(ValueError, match=r"basis must be \(128, 29, 68, 3\) for 19 labels and .* got \(8, 5, 4, 3\)"):
        motion3dgan.generator.init(jax.random.key(0), chart)
    with pytest.raises(ValueError, match=r"noise must have shape \(6,\); got \(7,\)"):
        motion3dgan.generator.apply(generator, jnp.zeros(7), 0, 1, POSE)


def full_chart(labels: int) -> tangent_pca.TangentPCA:
    f = lambda *shape: jax.ShapeDtypeStruct(shape, jnp.float32)  # noqa: E731
    square = labels, labels
    means = f(*square, 128), f(*square, 128), f(*square, 2), f(2), f(labels, 32, 130), f()
    return tangent_pca.TangentPCA(f(29, 68, 3), f(128, 29, 68, 3), *means, f(labels, 68, 3), f(32, 68, 3), f(32))


def test_the_default_networks_count_under_two_million_numbers():
    size = lambda tree: sum(leaf.size for leaf in jax.tree.leaves(tree))  # noqa: E731
    chart, key = full_chart(19), jax.random.key(0)
    generator = jax.eval_shape(motion3dgan.generator.init, key, chart)
    critic = jax.eval_shape(motion3dgan.critic.init, key, chart)
    assert size(generator.weights) + size(critic.weights) < 1.3e6
    assert size(generator) < 1.6e6


def test_reference_sizes_are_the_published_ones():
    config = motion3dgan_reference.Config(labels=18)
    made = jax.eval_shape(
        lambda k, c: motion3dgan_reference.generator.init(k, c, config=config), jax.random.key(0), full_chart(18)
    )
    stem = made.weights["stem"]
    assert stem["kernel"].shape == (200, 51 * 7 * 1024)
    assert stem["kernel"].size + stem["bias"].size == 73_479_168
    assert [kernel.shape[:2] for kernel in made.weights["convs"]] == [(3, 3)] * 4
    assert [kernel.shape[3] for kernel in made.weights["convs"]] == [512, 256, 128, 1]
    assert motion3dgan_reference._sizes(204, 29) == [(51, 7), (102, 14), (204, 28), (204, 29)]


def test_reference_networks_run_narrow_with_tangent_output(chart):
    config = motion3dgan_reference.Config(steps=5, landmarks=4, labels=3, noise=6, width_divisor=16)
    with plain_weights():
        generator = motion3dgan_reference.generator.init(jax.random.key(0), chart, config=config)
        critic = motion3dgan_reference.critic.init(jax.random.key(1), chart, config=config)
    noise = jax.random.normal(jax.random.key(2), (4, 6))
    tangent, length = jax.vmap(motion3dgan_reference.generator.apply, (None, 0, None, None))(generator, noise, 0, 1)
    assert tangent.shape == (4, *SHAPE) and length.shape == (4,)
    assert np.abs(sphere.inner(chart.p, tangent)).max() < 1e-6
    scores = jax.vmap(motion3dgan_reference.critic.apply, (None, 0, 0, None, None))(critic, tangent, length, 0, 1)
    assert len({*np.asarray(scores).tolist()}) == 4
    other = motion3dgan_reference.critic.apply(critic, tangent[0], length[0], 1, 0)
    assert float(other) != float(scores[0])


@pytest.mark.slow
def test_the_game_learns_spread_amplitude_and_both_styles():
    """Half the pairs spread twice as much as the others; the untrained Gaussian gives all the average."""
    config = CONFIG._replace(noise=16, width=96, embedding=8)
    _, tangents, made, start, end, here = toy(3000)
    chart = fitted(toy(3000), labels=3, rank=8)
    scalars = made.log_length, made.log_seconds
    real = jax.vmap(tangent_pca.encode, (None, 0, 0, 0, 0, 0))(chart, tangents, *scalars, start, end)
    poses = jax.vmap(tangent_pca.encode_pose, (None, 0, 0))(chart, here, start)
    g, c = (n.init(k, chart, config=config).weights for n, k in zip(
        (motion3dgan.generator, motion3dgan.critic), jax.random.split(jax.random.key(0)), strict=True))  # fmt: skip

    def generate(weights, chart, key, pair):
        return motion3dgan.generator.apply_coordinates(
            motion3dgan.Motion3DGAN(chart, weights), jax.random.normal(key, (16,)), *pair
        )

    def score(weights, chart, values, pair):
        return motion3dgan.critic.apply_coordinates(motion3dgan.Motion3DGAN(chart, weights), values, *pair)

    adam = optax.adam(optax.cosine_decay_schedule(1e-3, 2000), b1=0.5, b2=0.9)
    players = steps.Players(adam, optax.adam(1e-3, b1=0.5, b2=0.9))
    step = loop.gather_batches(steps.adversarial(generate, score, players, decay=0.99))
    state = steps.init_adversarial(steps.Players(g, c), players, jax.random.key(1))
    indices = loop.epoch_indices(0, len(real), 5 * 64)(0, 2000)
    held = ((real, (start, end, poses)), chart)
    state, _ = jax.jit(lambda s, i, h: jax.lax.scan(lambda s, b: step(s, b, h), s, i))(state, indices, held)
    keys = jax.random.split(jax.random.key(2), 500)
    for a, b in {*zip(start.tolist(), end.tolist(), strict=True)}:
        fake = np.asarray(jax.vmap(generate, (None, None, 0, None))(state.extra, chart, keys, (a, b, jnp.zeros(4))))
        true = np.asarray(real[(start == a) & (end == b)])
        assert np.linalg.norm((fake - true).mean(0)[2:]) < 0.35 * np.linalg.norm(true.std(0)[2:])
        assert 0.75 < np.linalg.norm(fake.std(0)[2:]) / np.linalg.norm(true.std(0)[2:]) < 1.25
        assert 0.7 < fake[:, 0].std() / true[:, 0].std() < 1.3
        assert abs(fake[:, 0].mean() - true[:, 0].mean()) < 0.35 * true[:, 0].std()


def test_tangent_distance_of_the_loss_is_that_of_the_motions(chart):
    """Equation 6 in coordinates expanded through the basis equals the one on log-mapped motions."""
    a, b = np.random.default_rng(3).standard_normal((2, CONFIG.rank + 2)).astype(np.float32) * 0.1
    v, w = tangent_pca.decode(chart, a, 0, 1)[0], tangent_pca.decode(chart, b, 0, 1)[0]
    mapped = [sphere.log(chart.p, sphere.exp(chart.p, x)) for x in (v, w)]
    np.testing.assert_allclose(losses.tangent_l1(v, w), losses.tangent_l1(*mapped), rtol=1e-4)
