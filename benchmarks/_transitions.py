"""Synthetic motions, transitions between their peaks in three implementations, and a pass over many transitions.

    python -m benchmarks._transitions '{"labels": 19, "people": 80, "count": 300000, "pace": "performed", ...}'

`benchmarks.augment` starts this process to measure the pass's peak memory. It prints one line of JSON.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import _machine
from facejax import augment
from facejax.data.motions import Motions
from facejax.geometry import sphere, srvf

CHUNK = 128


def made_up(
    count: int, *, labels: int, steps: int, landmarks: int, end: np.ndarray | None = None, seed: int = 0
) -> Motions:
    """Return smooth random motions between peaks of two labels; with `end` (count,), from neutral to those labels."""
    rng = np.random.default_rng(seed)
    start = rng.integers(labels, size=count) if end is None else np.zeros(count, int)
    end = (start + rng.integers(1, labels, size=count)) % labels if end is None else end
    peaks = rng.normal(size=(labels, landmarks, 3))
    own = 0.3 * rng.normal(size=(2, count, landmarks, 3))
    first, last = ((peaks[of] + mine) * (of > 0)[:, None, None] for of, mine in zip((start, end), own, strict=True))
    tau = np.linspace(0, 1, steps + 1)[None, :, None, None]
    ease = np.sin(np.pi / 2 * tau) ** rng.uniform(1, 3, (count, 1, 1, 1))
    detour = np.sin(np.pi * tau) * rng.normal(size=(count, 1, landmarks, 3))
    curves = 0.02 * (first[:, None] + ease * (last - first)[:, None] + 0.2 * detour)
    numbers = (array.astype(np.int32) for array in (start, end, np.arange(count)))
    sizes = (array.astype(np.float32) for array in (np.full(count, 100.0), rng.uniform(0.4, 0.8, count)))
    return Motions(curves.astype(np.float32), *numbers, *sizes)


def problem(count: int, *, labels: int, people: int, steps: int, landmarks: int) -> tuple[augment.Motions, np.ndarray]:
    """Return onsets of all labels but neutral by all people, and `count` of their index pairs, evenly spread."""
    end = np.repeat(np.arange(1, labels), people)
    curves = made_up(len(end), labels=labels, steps=steps, landmarks=landmarks, end=end).curves
    pairs = augment.balanced_pairs(end - 1, classes=labels - 1, per_pair=None)
    if len(pairs) < count:
        raise ValueError(f"{people} people and {labels} labels make {len(pairs)} transitions; {count} are wanted")
    pairs = pairs[np.linspace(0, len(pairs) - 1, count).astype(int)]
    return augment.Motions(*srvf.encode(jnp.asarray(curves)), jnp.asarray(curves[:, 0])), pairs


def forms(motions: augment.Motions, pairs: np.ndarray) -> dict[str, Callable[[], np.ndarray]]:
    """Return three implementations of all transitions at the "performed" pace, checked to agree, as functions."""
    host = augment.Motions(*map(np.asarray, motions))
    options = {"frames": motions.q.shape[1] + 1, "time_warp": "performed", "chunk": CHUNK}
    parts = [pairs[low : low + CHUNK] for low in range(0, len(pairs), CHUNK)]
    made = {
        "facejax": lambda: list(map(np.asarray, augment.transitions(motions, pairs, **options))),
        "decoded in full": lambda: [np.asarray(_in_full(motions, jnp.asarray(part))) for part in parts],
        "NumPy": lambda: [_in_numpy(host, part) for part in parts],
    }
    expected, *others = (np.concatenate(form()) for form in made.values())
    for other in others:
        np.testing.assert_allclose(other, expected, atol=1e-4 * np.abs(expected).max())
    return made


def stream(*, count: int, pace: str, **sizes: int) -> dict[str, float]:
    """Run a pass over `count` transitions without keeping them; return time and peak memory before and after."""
    motions, pairs = problem(count, **sizes)
    jax.block_until_ready(motions)
    before, options = _machine.peak_mb(), {"frames": motions.q.shape[1] + 1, "time_warp": pace, "chunk": CHUNK}

    def walk(pairs: np.ndarray) -> float:
        begun = time.perf_counter()
        done = sum(len(np.asarray(part)) for part in augment.transitions(motions, pairs, **options))
        assert done == len(pairs)
        return time.perf_counter() - begun

    first, seconds = walk(pairs[:CHUNK]), walk(pairs)
    return {"first_s": first, "seconds": seconds, "before_mb": before, "memory_mb": _machine.peak_mb()}


@jax.jit
def _in_full(motions: augment.Motions, pairs: jax.Array) -> jax.Array:
    """Plain implementation: decode every motion along the geodesic in full and keep its last frame."""

    def one(pair):
        first, second = (jax.tree.map(lambda x, row=row: x[row], motions) for row in pair)

        def frame(tau):
            q = sphere.geodesic(first.q, second.q, tau)
            log_length, start = (
                a + tau * (b - a) for a, b in ((first.log_length, second.log_length), (first.start, second.start))
            )
            return srvf.decode(q, log_length, start)[-1]

        return jax.vmap(frame)(srvf.arc_length_fraction(second.q))

    return jax.vmap(one)(pairs)


def _in_numpy(motions: augment.Motions, pairs: np.ndarray) -> np.ndarray:
    """facejax's algorithm in NumPy: three numbers per step for all frames, and one matrix product per pair."""
    first, second = (augment.Motions(*(field[rows] for field in motions)) for rows in pairs.T)
    count, steps = first.q.shape[:2]
    p, q = (side.q.reshape(count, steps, -1) for side in (first, second))
    cosine = np.einsum("ntd,ntd->n", p, q)[:, None] / steps
    u = q - cosine[..., None] * p
    sine = np.sqrt(np.einsum("ntd,ntd->n", u, u)[:, None] / steps)
    theta = np.arctan2(sine, cosine)
    w = (theta / sine)[..., None] * u
    speed = np.einsum("ntd,ntd->nt", q, q)
    tau = np.pad(np.cumsum(speed, axis=1) / speed.sum(axis=1, keepdims=True), ((0, 0), (1, 0)))
    a, b = np.cos(theta * tau)[..., None], (np.sin(theta * tau) / theta)[..., None]
    pp, pw, ww = (np.einsum("ntd,ntd->nt", x, y)[:, None] for x, y in ((p, p), (p, w), (w, w)))
    pace = np.sqrt(np.maximum(a**2 * pp + 2 * a * b * pw + b**2 * ww, 0))
    moves = np.concatenate([a * pace, b * pace], axis=2) @ np.concatenate([p, w], axis=1)
    log_length = first.log_length[:, None] * (1 - tau) + second.log_length[:, None] * tau
    starts = (side.start.reshape(count, 1, -1) for side in (first, second))
    start = sum(share[..., None] * side for share, side in zip((1 - tau, tau), starts, strict=True))
    return (start + np.exp(log_length)[..., None] / steps * moves).reshape(count, steps + 1, -1, 3)


if __name__ == "__main__":
    print(json.dumps(stream(**json.loads(sys.argv[1]))))
