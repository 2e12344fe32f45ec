"""Large corpora of generated motions, written in shards; `facejax.data.corpora` reads them.

A sequence is a function of the seed and its own number: shards are generated in any order, by any number of devices and
processes, and an interrupted corpus resumes with the shards that are missing. S sequences, P transitions, T frames,
L landmarks, N vertices.
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
from jax.typing import ArrayLike

from facejax.data import corpora
from facejax.inference import checks, composition, pipeline
from facejax.io import atomic, npz
from facejax.models.motion import generators, start_poses
from facejax.training import metric_logger, sharding

SHARD_BYTES = 64_000_000  # default size of a shard
MAX_SHARDS = 100_000
BATCH = 128  # sequences generated in one call
MESH_BATCH = 16  # sequences decoded in one call


class Request(NamedTuple):
    """Number, length and kind of the sequences to generate."""

    count: int  # of sequences  # pyright: ignore[reportIncompatibleMethodOverride]
    labels: tuple[str, ...] = ()  # of every motion; none: two different ones are drawn for each
    seed: int = 7
    frames: int = pipeline.FRAMES  # of a transition
    intensity: float = 1.0
    meshes: bool = False  # vertices as well as landmarks
    shard: int | None = None  # sequences per file, by default as many as fit in 64 MB


def generate(
    models: pipeline.Models,
    request: Request,
    neutrals: dict[str, np.ndarray],
    out: str | Path,
    *,
    devices: Sequence[Any] | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> corpora.Corpus:
    """Write a corpus, or the shards that are missing of it, and return it.

    Every process of a distributed job writes its own share of the shards.

    Args:
      neutrals: names and vertices (N, 3) of the people that motions are drawn for.
      devices: of this process; default: all of them.
      progress: called with (done, total) shards of this process.

    Raises:
      ValueError: an invalid request, too little disk space, or `out` holds a corpus of another request.
    """
    out, plan = Path(out), _plan(models, request, neutrals)
    mine = range(jax.process_index(), len(plan.firsts), jax.process_count())
    missing = [number for number in mine if not _is_done(out, number)]
    _check_disk_space(out, plan, len(missing))
    if sharding.is_primary():
        metric_logger.claim_folder(out, plan.claim)
    sharding.barrier("claimed")
    for name in ("shards", "done"):
        (out / name).mkdir(exist_ok=True)
    progress(len(mine) - len(missing), len(mine))
    make = maker(models, request, neutrals, devices=devices)
    for i, number in enumerate(missing):
        _write(out, number, make(plan.firsts[number], plan.counts[number]))
        progress(len(mine) - len(missing) + i + 1, len(mine))
    sharding.barrier("made")
    if sharding.is_primary():
        _finish(out, plan)
    sharding.barrier("finished")
    return corpora.load(out)


class _Plan(NamedTuple):
    request: Request
    pairs: np.ndarray  # (K, P, 2): the sequences of transitions that motions are drawn from
    firsts: Sequence[int]
    counts: list[int]
    sequence_bytes: int
    claim: dict[str, Any]


def _plan(models: pipeline.Models, request: Request, neutrals: dict[str, np.ndarray]) -> _Plan:
    checks.check_count(request.count)
    checks.check_intensity(request.intensity)
    if not neutrals:
        raise ValueError("neutrals: expected at least one face")
    for neutral in neutrals.values():
        pipeline.neutral_landmarks(models, neutral)
    if request.labels:
        numbers = models.labels.encode(request.labels)
        pairs = np.asarray(composition.label_pairs(numbers, classes=len(models.labels)))[None]
    else:
        known = range(len(models.labels))
        pairs = np.array([[(a, b)] for a in known for b in known if a != b], np.int32)
    total = 1 + pairs.shape[1] * (pipeline.lengths(1, request.frames)[0] - 1)
    points = len(models.face.landmark_index) + (len(models.face.vertices) if request.meshes else 0)
    sequence_bytes = total * points * 12  # float32
    size = max(1, SHARD_BYTES // sequence_bytes) if request.shard is None else request.shard
    if size < 1 or size * sequence_bytes > npz.MAX_BYTES:
        raise ValueError(
            f"shard: {size} sequences of {sequence_bytes} bytes, expected 1 or more, up to {npz.MAX_BYTES} bytes"
        )
    firsts = range(0, request.count, size)
    if len(firsts) > MAX_SHARDS:
        raise ValueError(f"shard: {size} sequences make {len(firsts)} files, expected up to {MAX_SHARDS}: increase it")
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
    return _Plan(request, pairs, firsts, counts, sequence_bytes, claim)


def maker(
    models: pipeline.Models,
    request: Request,
    neutrals: dict[str, np.ndarray],
    *,
    devices: Sequence[Any] | None = None,
) -> Callable[[int, int], dict[str, np.ndarray]]:
    """Return `make(first, count)`: the arrays of sequences by number. Arguments and errors as of `generate`."""
    plan, faces = _plan(models, request, neutrals), list(neutrals.values())
    device_mesh = sharding.data_mesh(devices or jax.local_devices())
    # One batch size whatever `count` is: one compiled program, and bitwise equal results.
    batch = -(-BATCH // device_mesh.size) * device_mesh.size
    timeline = composition.timeline([request.frames] * plan.pairs.shape[1])
    rest = np.stack([np.asarray(neutral, np.float32)[models.face.landmark_index] for neutral in faces])
    constants = sharding.shard(
        (models.motion, models.starts, jax.random.key(request.seed), plan.pairs, timeline, rest),
        sharding.replicated(device_mesh),
    )

    def make(first: int, count: int) -> dict[str, np.ndarray]:
        parts = []
        for low in range(first, first + count, batch):
            # The last batch is padded; its surplus is cut off below.
            numbers = sharding.shard(np.arange(low, low + batch, dtype=np.uint32), sharding.split_along(device_mesh))
            parts.append(jax.device_get(_draw(*constants, numbers, jnp.float32(request.intensity))))
        marks, labels, person = (np.concatenate(field)[:count] for field in zip(*parts, strict=True))
        made = {"landmarks": marks, "labels": labels, "person": person}
        if request.meshes:
            made["vertices"] = _meshes(models, marks, person, faces)
        return made

    return make


@jax.jit
def _draw(
    motion: generators.Generator,
    starts: start_poses.StartPoses,
    key: jax.Array,
    pairs: jax.Array,
    timeline: jax.Array,
    rest: jax.Array,
    numbers: jax.Array,
    intensity: ArrayLike,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return landmarks (S, T, L, 3), labels (S, P + 1) and person (S,) of the sequences with these numbers (S,)."""

    def choose(key: jax.Array) -> tuple[jax.Array, jax.Array]:
        pair_key, person_key = jax.random.split(jax.random.fold_in(key, len(pairs)))
        return jax.random.randint(pair_key, (), 0, len(pairs)), jax.random.randint(person_key, (), 0, len(rest))

    keys = jax.vmap(jax.random.fold_in, (None, 0))(key, numbers)
    which, person = jax.vmap(choose)(keys)
    chosen = pairs[which]
    drawn = jax.vmap(composition.draw, (None, None, 0, 0))(motion, starts, keys[:, None], chosen)
    moved = composition.join(drawn.curves[:, 0], timeline)
    neutral = rest[person]
    size = jnp.linalg.norm(neutral - neutral.mean(axis=1, keepdims=True), axis=(1, 2))
    marks = neutral[:, None] + intensity * size[:, None, None, None] * moved
    return marks, jnp.concatenate([chosen[:, :1, 0], chosen[:, :, 1]], axis=1), person


def _meshes(models: pipeline.Models, marks: np.ndarray, person: np.ndarray, neutrals: list[np.ndarray]) -> np.ndarray:
    """Decode vertices (S, T, N, 3), person by person."""
    made = np.empty((*marks.shape[:2], *neutrals[0].shape), np.float32)
    for who in np.unique(person):
        rows, face = np.flatnonzero(person == who), pipeline.prepare(models, neutrals[who])
        for low in range(0, len(rows), MESH_BATCH):
            chosen = rows[low : low + MESH_BATCH]
            padding = np.repeat(chosen[-1:], MESH_BATCH - len(chosen))  # one compiled program for all
            found = pipeline.vertices(models, face, marks[np.append(chosen, padding)])
            made[chosen] = np.asarray(found)[: len(chosen)]
    return made


def _write(out: Path, number: int, made: dict[str, Any]) -> None:
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


def _check_disk_space(out: Path, plan: _Plan, shards: int) -> None:
    place = next(folder for folder in (out, *out.absolute().parents) if folder.exists())
    needed, free = shards * max(plan.counts) * plan.sequence_bytes, shutil.disk_usage(place).free
    if needed > free:
        raise ValueError(
            f"{out}: needs {needed / 1e6:,.1f} MB, {free / 1e6:,.1f} MB are free; name another disk with --out"
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
