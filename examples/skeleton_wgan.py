"""Train a Wasserstein GAN with gradient penalty on the motion of your own skeleton.

    python examples/skeleton_wgan.py --out runs/skeleton --steps 300

A sample is a point on the SRVF sphere, as in Motion3DGAN (Otberdout et al. 2023): the generator maps noise and a label
to a tangent vector at the mean motion, and the exponential map takes it to the sphere. Generator and critic are pure
functions of one sample, written here; the adversarial step, the losses and the loop with its checkpoints are facejax's.
Called again with more `--steps`, the run continues from its last checkpoint.
"""

import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax
import tyro

from facejax import losses
from facejax.geometry import sphere, srvf
from facejax.training import loop, metric_logger
from facejax.training.steps import Players, adversarial, init_adversarial

LABELS = ("wave", "raise")
NOISE, WIDTH, BATCH, CRITIC_STEPS = 8, 64, 32, 3


def recordings(seed: int, count: int, frames: int = 24) -> tuple[jax.Array, jax.Array]:
    """Return curves (count, frames, 3, 3) of shoulder, elbow and wrist, and labels (count,), indices into LABELS."""
    rng = np.random.default_rng(seed)
    label, time = rng.integers(0, 2, count), np.linspace(0, 1, frames)
    size, phase = rng.uniform(0.6, 1.2, (2, count, 1))
    angle = np.where(label[:, None] == 0, size * np.sin(4 * np.pi * time + phase), 2 * size * time**phase)
    joint = np.arange(3) * 0.3
    x, y = joint * np.cos(angle)[..., None], joint * np.sin(angle)[..., None]
    return jnp.asarray(np.stack([x, y, 0 * x], axis=-1), jnp.float32), jnp.asarray(label, jnp.int32)


def init_mlp(key: jax.Array, *sizes: int) -> list:
    glorot = jax.nn.initializers.glorot_normal()
    pairs = zip(jax.random.split(key, len(sizes) - 1), sizes[:-1], sizes[1:], strict=True)
    return [{"kernel": glorot(k, (a, b)), "bias": jnp.zeros(b)} for k, a, b in pairs]


def mlp(weights: list, *inputs: jax.Array) -> jax.Array:
    x = jnp.concatenate([jnp.ravel(value) for value in inputs])
    for layer in weights[:-1]:
        x = jax.nn.silu(x @ layer["kernel"] + layer["bias"])
    return x @ weights[-1]["kernel"] + weights[-1]["bias"]


def generate(weights: list, mean: jax.Array, key: jax.Array, label: jax.Array) -> jax.Array:
    """Return one motion (T-1, L, 3) on the sphere."""
    tangent = mlp(weights, jax.random.normal(key, (NOISE,)), jax.nn.one_hot(label, len(LABELS)))
    return sphere.exp(mean, sphere.project(mean, tangent.reshape(mean.shape)))


def score(weights: list, mean: jax.Array, point: jax.Array, label: jax.Array) -> jax.Array:
    """Return how real one motion looks, from its coordinates in the tangent space at the mean."""
    return mlp(weights, sphere.log(mean, point), jax.nn.one_hot(label, len(LABELS)))[0]


def reconstruction(mean: jax.Array, fake: jax.Array, real: jax.Array, _: jax.Array) -> dict[str, jax.Array]:
    """Return the paper's second term of the generator's loss (equation 6): L1 between tangent vectors."""
    return {"reconstruction": 10 * losses.tangent_l1(sphere.log(mean, fake), sphere.log(mean, real))}


def main(out: Path | None = None, steps: int = 300, seed: int = 0) -> dict[str, float]:
    out = Path(tempfile.mkdtemp(prefix="skeleton-")) if out is None else out
    curves, labels = recordings(seed, count=256)
    points, _ = srvf.encode(curves)
    mean = sphere.karcher_mean(points)

    generator_key, critic_key, run_key, test_key = jax.random.split(jax.random.key(seed), 4)
    generator = init_mlp(generator_key, NOISE + len(LABELS), WIDTH, WIDTH, mean.size)
    players = Players(generator, init_mlp(critic_key, mean.size + len(LABELS), WIDTH, WIDTH, 1))
    optimisers = Players(optax.adam(1e-3, b1=0.5, b2=0.9), optax.adam(1e-3, b1=0.5, b2=0.9))
    options = {"critic_steps": CRITIC_STEPS, "terms": reconstruction, "decay": 0.98}
    step = loop.gather_batches(adversarial(generate, score, optimisers, **options))
    state = init_adversarial(players, optimisers, run_key)
    batches = loop.epoch_indices(seed, len(points), CRITIC_STEPS * BATCH)
    state = loop.run(step, state, batches, out, steps=steps, constants=((points, labels), mean), chunk=50)

    wanted = jnp.arange(64) % len(LABELS)
    keys = jax.random.split(test_key, len(wanted))
    made = jax.vmap(generate, (None, None, 0, 0))(state.extra, mean, keys, wanted)  # extra: the weights' moving average
    angles = sphere.distance(made[:, None], points)
    metrics = {
        "wasserstein": metric_logger.read(out)[-1]["wasserstein"],
        "nearest_recording_has_the_label": float(jnp.mean(labels[jnp.argmin(angles, axis=1)] == wanted)),
        "angle_to_nearest_recording": float(jnp.mean(jnp.min(angles, axis=1))),
        "angle_between_recordings": float(jnp.mean(sphere.distance(points[:64, None], points))),
    }
    print("\n".join(f"{name}: {value:.3f}" for name, value in metrics.items()))
    print(f"metrics and checkpoints in {out}")
    return metrics


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
