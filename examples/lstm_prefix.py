"""Complete a motion from its first frames with an LSTM: train on curves of your own, generate from a prefix.

    python examples/lstm_prefix.py --out runs/completion --steps 200

One network per kind of motion (Seo and Luo 2021) predicts the next step of all points from the steps before. Here a
chain of four points swings out and back, each recording by an amount and in a direction of its own, which the network
cannot know without a prefix. Curves are displacements from the first frame, (K, T, L, 3).
"""

import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax
import tyro

from facejax import losses
from facejax.models import expression_lstm

POINTS, FRAMES, PREFIX = 4, 30, 8


def swings(seed: int, count: int) -> np.ndarray:
    """Return curves (count, FRAMES, POINTS, 3) that start at 0, unitless."""
    rng = np.random.default_rng(seed)
    direction = rng.normal(size=(count, 1, 1, 3)) * [1.0, 0.5, 0.1]
    time = np.linspace(0, 1, FRAMES)[None, :] ** rng.uniform(0.8, 1.25, (count, 1))
    weight = np.linspace(0.4, 1, POINTS)[:, None]
    return (np.sin(np.pi * time) ** 2)[..., None, None] * weight * direction * 0.1


def main(out: Path | None = None, steps: int = 200, seed: int = 0) -> dict[str, float]:
    out = Path(tempfile.mkdtemp(prefix="completion-")) if out is None else out
    out.mkdir(parents=True, exist_ok=True)
    curves = jnp.asarray(swings(seed, 96), jnp.float32)
    train, test = curves[:80], curves[80:]

    # Entry t of a block is the step that led to frame t; the first is zero, and the target is the step that follows.
    motion = jnp.diff(train, axis=1)
    inputs = jnp.concatenate([jnp.zeros_like(motion[:, :1]), motion[:, :-1]], axis=1)
    mask = jnp.ones(motion.shape[:2], bool)
    config = expression_lstm.Config(landmarks=POINTS, hidden=32, layers=1)
    neutral = np.zeros((len(train), POINTS, 3), np.float32)
    scale = expression_lstm.measure(np.asarray(motion), np.asarray(mask), neutral, config=config)
    params = expression_lstm.init(jax.random.key(seed), scale, config=config)
    optimiser = optax.adam(optax.cosine_decay_schedule(1e-2, steps))

    def loss(weights):
        found = expression_lstm.predict(params._replace(weights=weights), inputs)
        return losses.next_step(found, motion, mask) / scale.step**2

    @jax.jit
    def train_all(weights):
        def step(carry, _):
            value, slope = jax.value_and_grad(loss)(carry[0])
            updates, opt_state = optimiser.update(slope, carry[1])
            return (optax.apply_updates(carry[0], updates), opt_state), value

        (weights, _), values = jax.lax.scan(step, (weights, optimiser.init(weights)), length=steps)
        return weights, values

    weights, values = train_all(params.weights)
    print(f"loss, in units of the mean square step: {values[0]:.3f} at first, {values[-1]:.5f} after {steps} steps")
    params = params._replace(weights=weights)

    completed = expression_lstm.generate(params, prefix=test[:, :PREFIX], frames=FRAMES)
    alone = expression_lstm.generate(params, frames=FRAMES)
    held = jnp.broadcast_to(test[:, PREFIX - 1 : PREFIX], test.shape)
    guesses = {"completed": completed, "without prefix": alone, "last frame held": held}
    metrics = {
        name: float(jnp.mean(jnp.linalg.norm((guess - test)[:, PREFIX:], axis=-1))) for name, guess in guesses.items()
    }
    for name, error in metrics.items():
        print(f"mean error after frame {PREFIX}, {name}: {error:.4f}")
    np.savez(out / "completed.npz", true=test, completed=completed)
    print(f"true and completed curves in {out / 'completed.npz'}")
    return metrics


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
