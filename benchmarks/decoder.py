"""The mesh decoder, forward and gradient, against the obvious form: `python -m benchmarks.decoder`.

The obvious form upsamples, gathers whole spirals into (B, V, S * C) and multiplies. Both are timed in one
process, in turns, so that a busy machine slows both. Compile time stands apart; steady time is the
minimum and the median.
"""

from __future__ import annotations

import json
import os
import platform
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from facejax.data import makehuman
from facejax.mesh import topology
from facejax.mesh.topology import Hierarchy
from facejax.models import decoder


@dataclass(frozen=True)
class Config:
    """What to measure."""

    batches: tuple[int, ...] = (16, 1)
    grid: int | None = None  # side of a square grid instead of MakeHuman's head; 71 has CoMA's size
    repeats: int = 15
    out: Path | None = None  # a JSON file for the figures


def run(config: Config) -> list[dict]:
    """One row per batch size and pass."""
    mesh = _grid(config.grid) if config.grid else makehuman.template()[:2]
    hierarchy = jax.device_put(topology.build(*mesh))
    params = decoder.init(jax.random.key(0), hierarchy)
    rows = []
    for batch in config.batches:
        d = jax.random.normal(jax.random.key(1), (batch, 68, 3))
        target = jnp.ones((batch, hierarchy.sizes[0], 3))
        for task, make in (("forward", _forward), ("gradient", _gradient)):
            forms = {"plain": make(plain), "fast": make(decoder.apply)}
            arguments = (params.weights, params, hierarchy, d, target)
            measured = _compare(forms, arguments, config.repeats)
            ratio = measured["plain"]["median_ms"] / measured["fast"]["median_ms"]
            row = {"vertices": hierarchy.sizes[0], "batch": batch, "task": task, "ratio": ratio, **measured}
            rows.append(row)
            print(_line(row), flush=True)
    if config.out:
        record = {"machine": _machine(), "rows": rows}
        config.out.write_text(json.dumps(record, indent=2) + "\n")
    return rows


def plain(params: decoder.Params, hierarchy: Hierarchy, displacements: jax.Array) -> jax.Array:
    """`decoder.apply` as one would write it first: (B, L, 3) -> (B, N, 3)."""
    scale, weights = params
    x = ((displacements - scale.landmark_mean) / scale.landmark_std).reshape(len(displacements), -1)
    x = x @ weights["dense"]["kernel"] + weights["dense"]["bias"]
    x = x.reshape(len(x), hierarchy.sizes[-1], -1)
    *climbs, last = weights["convs"]
    for level, conv in zip(range(len(climbs) - 1, -1, -1), climbs, strict=True):
        x = jnp.einsum("bvkc,vk->bvc", x[:, hierarchy.corners[level]], hierarchy.weights[level])
        x = jax.nn.elu(_plain_conv(x, hierarchy.spirals[level], conv))
    return scale.vertex_mean + scale.vertex_std * _plain_conv(x, hierarchy.spirals[0], last)


def _plain_conv(x: jax.Array, spirals: jax.Array, conv: dict[str, jax.Array]) -> jax.Array:
    x = jnp.concatenate([x, jnp.zeros_like(x[:, :1])], axis=1)
    kernel = conv["kernel"]
    return x[:, spirals].reshape(*x.shape[:1], len(spirals), -1) @ kernel.reshape(-1, kernel.shape[2]) + conv["bias"]


def _forward(apply: Callable) -> Callable:
    return jax.jit(lambda weights, params, hierarchy, d, target: apply(params, hierarchy, d))


def _gradient(apply: Callable) -> Callable:
    def loss(weights, params, hierarchy, d, target):
        return jnp.mean(jnp.abs(apply(params._replace(weights=weights), hierarchy, d) - target))

    return jax.jit(jax.grad(loss))


def _compare(forms: dict[str, Callable], arguments: tuple, repeats: int) -> dict[str, dict[str, float]]:
    compiled, seconds, outputs = {}, {name: [] for name in forms}, {}
    for name, form in forms.items():
        start = time.perf_counter()
        outputs[name] = jax.block_until_ready(form(*arguments))
        compiled[name] = time.perf_counter() - start
    for a, b in zip(*map(jax.tree.leaves, outputs.values()), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-2, atol=1e-5)  # a fast wrong answer is no answer
    for _ in range(repeats):
        for name, form in forms.items():
            start = time.perf_counter()
            jax.block_until_ready(form(*arguments))
            seconds[name].append(time.perf_counter() - start)
    return {
        name: {
            "first_call_s": compiled[name],
            "min_ms": 1e3 * min(seconds[name]),
            "median_ms": 1e3 * float(np.median(seconds[name])),
        }
        for name in forms
    }


def _line(row: dict) -> str:
    cells = []
    for name in ("plain", "fast"):
        low, middle, first = (row[name][key] for key in ("min_ms", "median_ms", "first_call_s"))
        cells.append(f"{name} {low:.1f} / {middle:.1f} ms (first call {first:.1f} s)")
    rate = 1e3 * row["batch"] / row["fast"]["median_ms"]
    return (
        f"{row['vertices']} vertices, batch {row['batch']}, {row['task']}: {row['ratio']:.1f}x faster | "
        f"{' | '.join(cells)} | {rate:.0f} meshes/s"
    )


def _machine() -> dict[str, str | int | None]:
    return {
        "platform": platform.platform(),
        "cores": os.cpu_count(),
        "load": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
        "device": jax.devices()[0].device_kind,
        "jax": jax.__version__,
    }


def _grid(side: int) -> tuple[np.ndarray, np.ndarray]:
    """A bent square sheet of side^2 vertices."""
    y, x = np.divmod(np.arange(side * side), side)
    vertices = np.stack([x, y, 5 * np.sin(x / 9) * np.cos(y / 7)], axis=1)
    i = np.arange(side * side).reshape(side, side)
    a, b, c, d = i[:-1, :-1].ravel(), i[:-1, 1:].ravel(), i[1:, 1:].ravel(), i[1:, :-1].ravel()
    return vertices, np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])


if __name__ == "__main__":
    run(tyro.cli(Config, prog="python -m benchmarks.decoder", description=__doc__))
