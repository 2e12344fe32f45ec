"""Use the pipeline inside a training loop of your own, on four devices.

    python examples/pipeline_on_devices.py --out runs/recogniser --steps 60

A network learns to tell expressions apart from 50 noisy vertices of a face. Its data are never stored: each step of the
loop draws motions from the released generator, maps landmarks to vertices and trains on them, in one jitted function of
pytrees. `sharding.data_parallel` splits every batch among the devices, here four of the host; on GPUs it takes all that
there are. The numbers are those of one device, except for the order of sums.
"""

import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax
import tyro

import facejax
from facejax.inference import composition, pipeline
from facejax.models.decoders import linear
from facejax.training import sharding

LABELS = ("neutral", "high_smile", "mouth_open", "anger", "surprise")  # every motion starts at the first of them
BATCH, SEEN, NOISE_MM = 32, 50, 1.0


def peaks(models: tuple, keys: jax.Array, labels: jax.Array) -> jax.Array:
    """Return vertex displacements (B, SEEN, 3) in mm at the end of motions from neutral to `labels` (B,)."""
    motion, starts, size, seen = models

    def one(key, label):
        pairs = jnp.stack([jnp.zeros_like(label), label])[None]
        return composition.draw(motion, starts, key[None], pairs).curves[0, 0, -1]

    return linear.apply(seen, size * jax.vmap(one)(keys, labels))


def loss(params: dict, vertices: jax.Array, classes: jax.Array) -> tuple[jax.Array, jax.Array]:
    hidden = jax.nn.silu(vertices.reshape(len(vertices), -1) @ params["in"])
    logits = hidden @ params["out"]
    value = optax.losses.softmax_cross_entropy_with_integer_labels(logits, classes).mean()
    return value, jnp.mean(jnp.argmax(logits, axis=1) == classes)


def main(out: Path | None = None, steps: int = 60, seed: int = 0) -> dict[str, float]:
    jax.config.update("jax_num_cpu_devices", 4)  # before any computation: JAX opens its devices once
    out = Path(tempfile.mkdtemp(prefix="recogniser-")) if out is None else out
    released = facejax.load()
    numbers = jnp.asarray(released.labels.encode(LABELS))
    rest = released.face.vertices[released.face.landmark_index]
    # Computed once for a face: its linear map from landmarks to vertices, of which 50 are used.
    whole = pipeline.prepare(released, released.face.vertices).decoder.map
    chosen = np.random.default_rng(seed).choice(np.flatnonzero(released.face.mask), SEEN, replace=False)
    factor = np.asarray(whole.factors[0]).reshape(3 * len(rest), -1, 3)[:, chosen].reshape(3 * len(rest), -1)
    seen = linear.LinearMap(whole.landmark_mean, whole.vertex_mean[chosen], (jnp.asarray(factor),))
    models = (released.motion, released.starts, np.float32(np.linalg.norm(rest - rest.mean(axis=0))), seen)

    optimiser = optax.adam(3e-3)
    in_key, out_key, data_key = jax.random.split(jax.random.key(seed), 3)
    glorot = jax.nn.initializers.glorot_normal()
    params = {"in": 0.1 * glorot(in_key, (3 * SEEN, 64)), "out": glorot(out_key, (64, len(LABELS) - 1))}

    def step(state, classes, models):
        params, opt_state, key = state
        key, motion_key, noise_key = jax.random.split(key, 3)
        vertices = peaks(models, jax.random.split(motion_key, len(classes)), numbers[1 + classes])
        vertices += NOISE_MM * jax.random.normal(noise_key, vertices.shape)
        (value, accuracy), slope = jax.value_and_grad(loss, has_aux=True)(params, vertices, classes)
        updates, opt_state = optimiser.update(slope, opt_state)
        return (optax.apply_updates(params, updates), opt_state, key), {"loss": value, "accuracy": accuracy}

    devices = sharding.data_mesh()
    advance = jax.jit(sharding.data_parallel(step, device_mesh=devices), donate_argnums=0)
    state = (params, optimiser.init(params), data_key)
    classes = jnp.arange(BATCH) % (len(LABELS) - 1)
    rows = []
    for _ in range(steps):
        state, metrics = advance(state, classes, models)
        rows.append({name: float(value) for name, value in metrics.items()})
    print(f"{devices.size} devices, {BATCH // devices.size} motions on each per step")
    found = {"devices": devices.size, "loss_first": rows[0]["loss"]}
    # Every batch is new, so that the last ones are a test set.
    found |= {f"{name}_last": float(np.mean([row[name] for row in rows[-5:]])) for name in ("loss", "accuracy")}
    print(", ".join(f"{name} {value:.3f}" for name, value in found.items()))
    out.mkdir(parents=True, exist_ok=True)
    np.savez(out / "recogniser.npz", vertices=chosen, **jax.device_get(state[0]))
    print(f"the network in {out / 'recogniser.npz'}")
    return found


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
