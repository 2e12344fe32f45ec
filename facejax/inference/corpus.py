"""Large corpora of generated motions, written shard by shard; `facejax.data.corpora` reads them.

A sequence is a function of the seed and its own number, so that shards can be made in any order, by any number of
devices and processes, and again after a stop: one that is there is whole. S sequences, P transitions, T frames.
"""

from __future__ import annotations

import hashlib
import io as streams
import json
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from facejax.data import corpora
from facejax.inference import composition, pipeline
from facejax.io import atomic, npz
from facejax.models.motion import generators, start_poses
from facejax.training import metric_logger, sharding

SHARD_BYTES = 64_000_000  # of a shard whose size is not told
MOST, MOST_SHARDS = 100_000_000, 100_000
AT_ONCE = 128  # sequences in one call
MESHES_AT_ONCE = 16


class Request(NamedTuple):
    """What to generate."""

    count: int
    labels: tuple[str, ...] = ()  # that every motion goes through; none: two different ones are drawn for each
    seed: int = 7
    frames: int = pipeline.FRAMES  # of a transition
    intensity: float = 1.0
    meshes: bool = False  # vertices as well as landmarks
    shard: int | None = None  # sequences in a file, by default as many as make 64 MB


def generate(
    models: pipeline.Models,
    request: Request,
    neutrals: dict[str, np.ndarray],
    out: str | Path,
    *,
    devices: Sequence[jax.Device] | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> corpora.Corpus:
    """Write a corpus, or what is missing of it. `neutrals`: names and vertices (N, 3) of the people it is drawn from.

    Every process that JAX knows makes its own share of the shards, on `devices`, by default all of its own. `progress`
    hears how many of them are done, and of how many. Raises `ValueError` for a request that cannot be met, and where
    `out` holds another one's.
    """
    out, plan = Path(out), _plan(models, request, neutrals)
    mine = range(jax.process_index(), len(plan.firsts), jax.process_count())
    wanting = [number for number in mine if not _is_done(out, number)]
    _room(out, plan, len(wanting))
    if sharding.is_primary():
        metric_logger.claim_folder(out, plan.claim)
    sharding.barrier("claimed")
    for name in ("shards", "done"):
        (out / name).mkdir(exist_ok=True)
    progress(len(mine) - len(wanting), len(mine))
    make = maker(models, request, neutrals, devices=devices)
    for i, number in enumerate(wanting):
        _write(out, number, make(plan.firsts[number], plan.counts[number]))
        progress(len(mine) - len(wanting) + i + 1, len(mine))
    sharding.barrier("made")
    if sharding.is_primary():
        _finish(out, plan)
    sharding.barrier("finished")
    return corpora.load(out)


class _Plan(NamedTuple):
    request: Request
    pairs: np.ndarray  # (S or 1, P, 2): what each motion, or all of them, may go through
    firsts: Sequence[int]
    counts: list[int]
    each: int  # bytes of a sequence
    claim: dict[str, Any]


def _plan(models: pipeline.Models, request: Request, neutrals: dict[str, np.ndarray]) -> _Plan:
    if not 1 <= request.count <= MOST:
        raise ValueError(f"count: expected 1 to {MOST:,} sequences, got {request.count}")
    if not 0 <= request.intensity <= 2:
        raise ValueError(f"intensity must lie in 0..2, got {request.intensity}")
    if not neutrals:
        raise ValueError("neutrals: expected one face or more")
    for neutral in neutrals.values():
        pipeline.neutral_landmarks(models, neutral)
    if request.labels:
        numbers = pipeline.label_indices(models, request.labels)
        pairs = np.asarray(composition.label_pairs(numbers, classes=len(models.labels)))[None]
    else:
        known = range(len(models.labels))
        pairs = np.array([[(a, b)] for a in known for b in known if a != b], np.int32)
    total = 1 + pairs.shape[1] * (pipeline.lengths(("", ""), request.frames)[0] - 1)
    points = len(models.face.landmark_index) + (len(models.face.vertices) if request.meshes else 0)
    each = total * points * 12
    size = max(1, SHARD_BYTES // each) if request.shard is None else request.shard
    if size < 1 or size * each > npz.MAX_BYTES:
        raise ValueError(f"shard: {size} sequences of {each} bytes, expected 1 or more, up to {npz.MAX_BYTES} bytes")
    firsts = range(0, request.count, size)
    if len(firsts) > MOST_SHARDS:
        raise ValueError(f"shard: {size} sequences make {len(firsts)} files, expected up to {MOST_SHARDS}: take more")
    counts = [min(size, request.count - first) for first in firsts]
    claim = {
        "kind": "corpus",
        **request._asdict(),
        "shard": size,
        "models": _digest((models.motion, models.starts, models.decoder if request.meshes else ())),
        "people": {name: _digest(np.asarray(neutral, np.float32)) for name, neutral in neutrals.items()},
        "known": list(models.labels),
        "length": total,
    }
    return _Plan(request, pairs, firsts, counts, each, claim)


def maker(
    models: pipeline.Models,
    request: Request,
    neutrals: dict[str, np.ndarray],
    *,
    devices: Sequence[jax.Device] | None = None,
) -> Callable[[int, int], dict[str, np.ndarray]]:
    """`make(first, count)`: the arrays of so many sequences. Arguments and errors as of `generate`."""
    plan, mesh, faces = (
        _plan(models, request, neutrals),
        sharding.data_mesh(devices or jax.local_devices()),
        list(neutrals.values()),
    )
    count = -(-AT_ONCE // mesh.size) * mesh.size  # whatever is wanted, so that one program does it, with the same bits
    line = composition.timeline([request.frames] * plan.pairs.shape[1])
    at = models.face.landmark_index
    rest = np.stack([np.asarray(neutral, np.float32)[at] for neutral in faces])
    held = sharding.shard(
        (models.motion, models.starts, jax.random.key(request.seed), plan.pairs, line, rest), sharding.replicated(mesh)
    )

    def make(first: int, wanted: int) -> dict[str, np.ndarray]:
        parts = []
        for low in range(first, first + wanted, count):
            # Those past the end are left out.
            numbers = sharding.shard(np.arange(low, low + count, dtype=np.uint32), sharding.split_along(mesh))
            parts.append(jax.device_get(_draw(*held, numbers, jnp.float32(request.intensity))))
        marks, labels, person = (np.concatenate(field)[:wanted] for field in zip(*parts, strict=True))
        made = {"landmarks": marks, "labels": labels, "person": person}
        if request.meshes:
            made["vertices"] = _meshes(models, marks, person, faces)
        return made

    return make


@jax.jit
def _draw(motion: generators.Generator, beginnings: start_poses.StartPoses, key, pairs, line, rest, numbers, intensity):
    """Landmarks (S, T, L, 3), labels (S, P + 1) and person (S,) of the sequences of these numbers (S,)."""

    def choose(key):
        pair_key, person_key = jax.random.split(jax.random.fold_in(key, len(pairs)))
        return jax.random.randint(pair_key, (), 0, len(pairs)), jax.random.randint(person_key, (), 0, len(rest))

    keys = jax.vmap(jax.random.fold_in, (None, 0))(key, numbers)
    which, person = jax.vmap(choose)(keys)
    chosen = pairs[which]
    drawn = jax.vmap(composition.draw, (None, None, 0, 0))(motion, beginnings, keys[:, None], chosen)
    moved = composition.join(drawn.curves[:, 0], line)
    here = rest[person]
    size = jnp.linalg.norm(here - here.mean(axis=1, keepdims=True), axis=(1, 2))
    marks = here[:, None] + intensity * size[:, None, None, None] * moved
    return marks, jnp.concatenate([chosen[:, :1, 0], chosen[:, :, 1]], axis=1), person


def _meshes(models: pipeline.Models, marks: np.ndarray, person: np.ndarray, neutrals: list[np.ndarray]) -> np.ndarray:
    """Vertices (S, T, N, 3), person by person."""
    made = np.empty((*marks.shape[:2], *neutrals[0].shape), np.float32)
    for who in np.unique(person):
        rows = np.flatnonzero(person == who)
        for low in range(0, len(rows), MESHES_AT_ONCE):
            chosen = rows[low : low + MESHES_AT_ONCE]
            spare = np.repeat(chosen[-1:], MESHES_AT_ONCE - len(chosen))  # one program for all
            found = pipeline.meshes(models, jnp.asarray(marks[np.append(chosen, spare)]), neutrals[who])
            made[chosen] = np.asarray(found)[: len(chosen)]
    return made


def _write(out: Path, number: int, made: dict[str, np.ndarray]) -> None:
    buffer = streams.BytesIO()
    np.savez(buffer, **made)
    data = buffer.getvalue()
    with atomic.replace_file(out / "shards" / f"{number:06d}.npz") as temporary:
        temporary.write_bytes(data)
    record = {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
    with atomic.replace_file(out / "done" / f"{number:06d}.json") as temporary:
        temporary.write_text(json.dumps(record))


def _is_done(out: Path, number: int) -> bool:
    try:
        record = json.loads((out / "done" / f"{number:06d}.json").read_text())
        return atomic.sha256(out / "shards" / f"{number:06d}.npz") == record["sha256"]
    except (OSError, ValueError, KeyError):
        return False


def _room(out: Path, plan: _Plan, shards: int) -> None:
    place = next(folder for folder in (out, *out.absolute().parents) if folder.exists())
    need, there = shards * max(plan.counts) * plan.each, shutil.disk_usage(place).free
    if need > there:
        raise ValueError(
            f"{out}: needs {need / 1e6:,.1f} MB, {there / 1e6:,.1f} MB are free; name another disk with --out"
        )


def _finish(out: Path, plan: _Plan) -> None:
    shards = []
    for number, (first, count) in enumerate(zip(plan.firsts, plan.counts, strict=True)):
        record = json.loads((out / "done" / f"{number:06d}.json").read_text())
        shards.append(
            corpora.Shard(f"shards/{number:06d}.npz", first, count, record["bytes"], record["sha256"])._asdict()
        )
    claim = dict(plan.claim)
    index = {"schema": corpora.SCHEMA, "unit": "mm", "rate": pipeline.RATE, "labels": claim.pop("known")}
    index |= {"people": list(claim["people"]), "length": claim.pop("length"), "request": claim, "shards": shards}
    with atomic.replace_file(out / "index.json") as temporary:
        temporary.write_text(json.dumps(index))


def _digest(tree: Any) -> str:
    found = hashlib.sha256()
    for leaf in jax.tree.leaves(tree):
        found.update(np.ascontiguousarray(leaf).tobytes())
    return found.hexdigest()
