"""Find the motion whose last frame meets three target points: gradient descent through the whole pipeline.

    python examples/fit_targets.py --out runs/targets --steps 150

A face is to open its mouth in a given way: the lower lip in a given place, both mouth corners in given places. The
noise of the generator and the intensity are optimised. The gradient passes through decoder, composition, SRVF decoding
and the generator's ordinary differential equation, all of it one jitted function. A penalty keeps the noise likely.
"""

import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax
import trimesh
import tyro

import facejax
from facejax import io, pipeline
from facejax.viz import render, scene

LABELS = ("neutral", "mouth_open")
LANDMARKS = (57, 48, 54)  # of 68: lower lip, right and left corner of the mouth
TARGETS_MM = np.array([[0.0, -9.0, 1.0], [3.0, -4.0, 0.0], [-2.0, -6.0, 0.0]])  # displacements from neutral
PENALTY = 0.01  # mm^2 per unit of squared noise


def main(out: Path | None = None, steps: int = 150, seed: int = 0, frames: int = 30) -> dict[str, float]:
    out = Path(tempfile.mkdtemp(prefix="targets-")) if out is None else out
    models = facejax.load()
    face = pipeline.prepare(models, models.face.vertices)
    labels = models.labels.encode(LABELS)
    points = models.face.landmark_index[list(LANDMARKS)]
    targets = face.neutral[points] + TARGETS_MM

    def mesh(models, face, x):
        """Return all landmarks (T, L, 3) and the vertices (N, 3) of the last frame."""
        intensity = 2 * jax.nn.sigmoid(x["intensity"])
        moved = pipeline.motion_from_noise(models, x["noise"], labels, face, frames=frames, intensity=intensity)
        return moved, pipeline.vertices(models, face, moved[-1])

    def loss(x, models, face):
        misses = jnp.sum((mesh(models, face, x)[1][points] - targets) ** 2, axis=-1)
        return jnp.mean(misses) + PENALTY * jnp.sum(x["noise"].transitions ** 2), jnp.sqrt(misses)

    optimiser = optax.adam(0.1)

    @jax.jit
    def step(x, state, models, face):
        (_, misses), slope = jax.value_and_grad(loss, has_aux=True)(x, models, face)
        updates, state = optimiser.update(slope, state)
        return optax.apply_updates(x, updates), state, misses

    x = {"noise": pipeline.sample_noise(models, jax.random.key(seed), labels), "intensity": jnp.zeros(())}
    first = mesh(models, face, x)[1]
    state, curve = optimiser.init(x), []
    for _ in range(steps):
        x, state, misses = step(x, state, models, face)
        curve.append(np.asarray(misses))
    moved, last = mesh(models, face, x)
    found = {
        "before_mm": float(curve[0].mean()),
        "after_mm": float(jnp.linalg.norm(last[points] - targets, axis=-1).mean()),
        "intensity": float(2 * jax.nn.sigmoid(x["intensity"])),
        "noise_rms": float(jnp.sqrt(jnp.mean(x["noise"].transitions ** 2))),
    }
    print(", ".join(f"{name} {value:.3f}" for name, value in found.items()))

    out.mkdir(parents=True, exist_ok=True)
    np.savez(out / "found.npz", misses_mm=np.stack(curve), landmarks=moved, vertices=last)
    io.save(out / "found.glb", pipeline.vertices(models, face, moved), models.face.faces)
    _draw(out / "targets.png", [face.neutral, first, last], models.face.faces, np.asarray(targets))
    print(f"before and after, with the targets, in {out / 'targets.png'}; the motion in {out / 'found.glb'}")
    return found


def _draw(path: Path, meshes: list, faces: np.ndarray, targets: np.ndarray) -> None:
    """Draw meshes with a red ball of 2 mm at each target."""
    ball = trimesh.creation.icosphere(subdivisions=2, radius=2.0)
    balls = [scene.Part(ball.vertices + target, ball.faces, (0.8, 0.1, 0.1)) for target in targets]
    camera = render.fit_camera(meshes[0])
    pictures = [render.image(mesh, faces, extras=balls, camera=camera) for mesh in meshes]
    render.save(path, render.contact_sheet([pictures], column_labels=["neutral", "before", "after"]))


if __name__ == "__main__":
    tyro.cli(main)
