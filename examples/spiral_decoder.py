"""Train a spiral-convolution decoder, from sparse landmarks to all vertices, on a mesh of your own.

    python examples/spiral_decoder.py --out runs/torus --steps 150

The mesh is a torus with 12 landmarks, which bulges around them: displacements (K, L, 3) of the landmarks in, (K, N, 3)
of the vertices out. `hierarchy.build` makes the mesh coarser twice and lays spirals on every level; S2D-Dec
(Otberdout et al. 2023, 3.3) is a pair of pure functions, `init` and `apply`, trained here with optax alone.
"""

import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax
import trimesh
import tyro

import facejax.io
from facejax import losses
from facejax.mesh import hierarchy
from facejax.models.decoders import s2d_dec

LANDMARKS, BATCH = 12, 16


def bulges(seed: int, vertices: np.ndarray, landmarks: np.ndarray, count: int) -> np.ndarray:
    """Return displacements (count, N, 3) in mm: along the radius, by the square of a sum of Gaussians."""
    rng = np.random.default_rng(seed)
    distance = np.linalg.norm(vertices[:, None] - vertices[landmarks], axis=-1)
    strength = rng.normal(size=(count, LANDMARKS)) @ np.exp(-((distance / 20) ** 2)).T
    outward = vertices / np.linalg.norm(vertices, axis=1, keepdims=True)
    return (2 * strength**2)[..., None] * outward


def main(out: Path | None = None, steps: int = 150, seed: int = 0) -> dict[str, float]:
    out = Path(tempfile.mkdtemp(prefix="torus-")) if out is None else out
    torus = trimesh.creation.torus(major_radius=60, minor_radius=20, major_sections=40, minor_sections=16)
    vertices, faces = np.asarray(torus.vertices), np.asarray(torus.faces)
    landmarks = np.linspace(0, len(vertices), LANDMARKS, endpoint=False).astype(int)
    moved = jnp.asarray(bulges(seed, vertices, landmarks, count=320), jnp.float32)
    train, test = moved[:256], moved[256:]

    levels = jax.device_put(hierarchy.build(vertices, faces, factors=(4, 4), lengths=9))
    print(f"levels of {', '.join(map(str, levels.sizes))} vertices")
    scale = s2d_dec.measure([(np.asarray(train[:, landmarks]), np.asarray(train))])
    init_key, batch_key = jax.random.split(jax.random.key(seed))
    params = s2d_dec.init(init_key, levels, landmarks=LANDMARKS, channels=(32, 16, 16), scale=scale)
    optimiser = optax.adam(optax.cosine_decay_schedule(3e-3, steps))
    opt_state = optimiser.init(params.weights)

    def loss(weights, levels, targets):
        found = s2d_dec.apply(params._replace(weights=weights), levels, targets[:, landmarks])
        return losses.displacement_l1(found, targets)

    # The hierarchy is an argument: tables that are closed over become constants, which take long to compile.
    @jax.jit
    def step(weights, opt_state, levels, batch):
        value, slope = jax.value_and_grad(loss)(weights, levels, batch)
        updates, opt_state = optimiser.update(slope, opt_state)
        return optax.apply_updates(weights, updates), opt_state, value

    weights = params.weights
    order = jax.random.randint(batch_key, (steps, BATCH), 0, len(train))
    for number, chosen in enumerate(order):
        weights, opt_state, value = step(weights, opt_state, levels, train[chosen])
        if number % 50 == 0 or number == steps - 1:
            print(f"step {number + 1}: loss {value:.3f} mm")

    found = s2d_dec.apply(params._replace(weights=weights), levels, test[:, landmarks])
    mean = jnp.broadcast_to(scale.vertex_mean, test.shape)
    errors = {"decoder": found, "training mean": mean, "no motion": jnp.zeros_like(test)}
    metrics = {name: float(jnp.mean(jnp.linalg.norm(guess - test, axis=-1))) for name, guess in errors.items()}
    for name, error in metrics.items():
        print(f"mean vertex error of the {name}: {error:.3f} mm")
    out.mkdir(parents=True, exist_ok=True)
    facejax.io.save(out / "predicted.ply", vertices + np.asarray(found[0]), faces)
    facejax.io.save(out / "true.ply", vertices + np.asarray(test[0]), faces)
    print(f"one unseen shape, predicted and true, in {out}")
    return metrics


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
