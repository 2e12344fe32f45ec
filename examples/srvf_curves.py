"""Statistics of motion curves on the SRVF sphere: encode, Karcher mean, log and exp, geodesic, decode.

    python examples/srvf_curves.py --out runs/curves

The curves are landmark motions of your own, (K, T, L, 3); here K recordings of an arm of L joints that is raised, each
with its own speed profile and height. Nothing in this script depends on faces.
"""

import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from facejax.geometry import align, sphere, srvf


def arm_raises(seed: int, count: int, frames: int) -> np.ndarray:
    """Return curves (count, frames, 4, 3): an arm of four joints whose angle rises from 0 to a random height."""
    rng = np.random.default_rng(seed)
    time = np.linspace(0, 1, frames) ** rng.uniform(0.6, 1.6, (count, 1))
    angle = rng.uniform(0.6, 1.4, (count, 1)) * np.sin(np.pi / 2 * time)
    reach = np.arange(4)[:, None] * [0.0, 0.3, 0.3]
    turned = [reach[:, 0] + 0 * angle[..., None], reach[:, 1] * np.cos(angle)[..., None]]
    turned.append(reach[:, 2] * np.sin(angle)[..., None])
    return np.stack(turned, axis=-1).astype(np.float32)


def main(out: Path | None = None, seed: int = 0, count: int = 8, frames: int = 40) -> dict[str, float]:
    """Run the example.

    Args:
      out: folder for the results; a temporary one if not given.
      seed: seed of the curves.
      count: number of curves.
      frames: frames per curve.
    """
    out = Path(tempfile.mkdtemp(prefix="srvf-")) if out is None else out
    out.mkdir(parents=True, exist_ok=True)
    curves = align.resample(jnp.asarray(arm_raises(seed, count, 2 * frames)), frames=frames)

    # A curve is a point on the unit sphere, the logarithm of its length, and where it starts.
    points, log_length = srvf.encode(curves)
    mean = sphere.karcher_mean(points)
    tangents = sphere.log(mean, points)
    restored = srvf.decode(sphere.exp(mean, tangents), log_length, curves[:, 0])
    error = jnp.max(jnp.abs(restored - curves))

    # Principal geodesic analysis: PCA of the tangent vectors at the mean.
    _, spread, directions = jnp.linalg.svd(tangents.reshape(count, -1), full_matrices=False)
    explained = jnp.cumsum(spread**2) / jnp.sum(spread**2)
    first = directions[0].reshape(mean.shape) * spread[0] / np.sqrt(count)
    extremes = sphere.exp(mean, jnp.stack([-2 * first, 2 * first]))

    # The geodesic between two motions has constant speed: its steps have the same length.
    way = sphere.geodesic(points[0], points[1], jnp.linspace(0, 1, 6))
    steps = sphere.distance(way[:-1], way[1:])
    # All of it can be differentiated, here with respect to the curve itself.
    slope = jax.grad(lambda curve: sphere.distance(srvf.encode(curve)[0], mean))(curves[0])

    names = {"mean": mean[None], "extremes": extremes, "geodesic": way}
    size, start = jnp.mean(log_length), jnp.mean(curves[:, 0], axis=0)
    np.savez(out / "curves.npz", **{name: srvf.decode(q, jnp.full(len(q), size), start) for name, q in names.items()})
    metrics = {
        "reconstruction_error": float(error),
        "angle_to_mean": float(jnp.mean(sphere.distance(mean, points))),
        "explained_by_two": float(explained[1]),
        "geodesic_step_spread": float(jnp.ptp(steps)),
        "gradient_norm": float(jnp.linalg.norm(slope)),
    }
    for name, value in metrics.items():
        print(f"{name}: {value:.3g}")
    print(f"decoded mean, extremes and geodesic in {out / 'curves.npz'}")
    return metrics


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
