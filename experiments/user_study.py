"""Subjective evaluation of generated animations: naturalness, and faithfulness to the label (OT23, section 4.4).

Writes one web page that works offline: two examples of the ends of the scale, then the animations in an order drawn
for each participant, to be scored from 0 to 10 for naturalness (NAT) and for faithfulness to the label (LAB). Neither
the page nor a participant's file states how an animation was made; `items.json` does: keep it.

    python -m experiments.user_study --predecessor runs/predecessor/makehuman4d.safetensors
    python -m experiments.user_study --scores runs/user_study/scores

The first command writes `page.html` and `items.json`, in about 3 minutes on 2 cores; the second, in seconds, writes
the table of the participants' CSV files. No study has been run yet. OT23 had 23 participants: NAT 7.22 and LAB 7.05;
neutral → peak alone NAT 7.39, and 5.82 for the predecessor.
"""

from __future__ import annotations

import dataclasses
import hashlib
import itertools
import json
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from experiments import _run, _study
from facejax.cli import outputs
from facejax.data.synthetic import expression_recipes, makehuman, makehuman4d, performance, rig
from facejax.geometry import align
from facejax.inference import pipeline
from facejax.viz import eyes_teeth, render, video

FACES, EXAMPLE_FACE = range(100, 119), 119  # test subjects, which no network was trained on
EXAMPLE = ("neutral", "high_smile", "neutral")
TURN = 15  # degrees
LEAD, REST = 8, 18  # still frames before and after the motion
NOISE = 5.0  # mm, landmark noise of the failed example
QUALITY = 88


@dataclasses.dataclass(frozen=True)
class Config:
    out: Path = Path("runs/user_study")
    """Folder for the page, the list of its items, and the table."""
    seed: int = 0
    """Seed of the labels, the faces and the generator's noise."""
    composed: int = 14
    """Number of animations of three transitions."""
    peaks: int = 14
    """Number of neutral → peak animations of each generator."""
    real: int = 4
    """Number of real neutral → peak sequences of test subjects, as a control."""
    model: Path | None = None
    """Model file to evaluate in place of the released models."""
    predecessor: Path | None = None
    """Model file of a generator trained on neutral → peak alone; without it the page has no items of it."""
    frames: int = 30
    """Number of frames of a transition."""
    width: int = 320
    """Width of the pictures in pixels."""
    scores: tuple[str, ...] | None = None
    """CSV files of participants, or folders of them: write the table of their scores instead of a page."""
    publish: bool = False
    """Also write the committed results in experiments/results."""


class Item(NamedTuple):
    """An item of the study; `number` seeds the noise, the same for both generators."""

    kind: str
    labels: tuple[str, ...]
    subject: int
    number: int


class Motion(NamedTuple):
    """An animated face, and the first frame of each transition."""

    vertices: np.ndarray  # (T, N, 3)
    landmarks: np.ndarray  # (T, L, 3)
    starts: tuple[int, ...]


def run(config: Config) -> dict[str, Any]:
    """Write the page, or with `--scores` the table of the participants' scores."""
    return _show(config) if config.scores is None else _judge(config)


def _judge(config: Config) -> dict[str, Any]:
    begun = time.perf_counter()
    study = _study.read_items(config.out / "items.json")
    answers = _study.read_scores([Path(path) for path in config.scores], study)
    found = _study.summary(answers) | {name: study[name] for name in ("version", "weights")} | {"page": study["made"]}
    made = _run.record(config, seconds=time.perf_counter() - begun, dataset=study["made"]["dataset"])
    _run.finish("user_study", config, found, made=made, table=_study.table(found))
    return found


def _show(config: Config) -> dict[str, Any]:
    begun = time.perf_counter()
    _check(config)
    models = {"ours": pipeline.load(config.model)}
    if config.predecessor is None:
        print("no --predecessor: the page has no neutral → peak animations of a second generator")
    else:
        models["predecessor"] = pipeline.load(config.predecessor)
    items = plan(config, models)
    example = Item("example", EXAMPLE, EXAMPLE_FACE, len(items))
    films, listed = [], {}
    with outputs.progress("user study", len(items) + 2) as advance:
        for item in items:
            films.append(_filmed(config, models["ours"], item, _moved(config, models, item)))
            listed[films[-1].name] = {"kind": item.kind, "labels": item.labels, "subject": f"S{item.subject:03d}"}
            advance()
        examples = []
        for motion in (_performed(example), _failed(config, models["ours"], example)):
            examples.append(_filmed(config, models["ours"], example, motion))
            advance()
    page = config.out / "page.html"
    version = _study.write_page(page, films, *examples)
    made = _run.record(config, seconds=time.perf_counter() - begun, dataset=makehuman4d.Spec()._asdict())
    weights = {name: found.about.get("made") for name, found in models.items()}
    document = {"version": version, "items": dict(sorted(listed.items())), "weights": weights, "made": made}
    _run.write_text(config.out / "items.json", json.dumps(document, indent=1) + "\n")
    kinds = [item.kind for item in items]
    found = {"version": version, "items": {kind: kinds.count(kind) for kind in dict.fromkeys(kinds)}}
    print(f"{page}: {len(items)} animations, {page.stat().st_size / 1e6:.1f} MB")
    return found | {"megabytes": page.stat().st_size / 1e6}


def _check(config: Config) -> None:
    """Raise `ValueError` for pictures that are too small, or where the folder holds answers to an earlier page."""
    if config.width < 16:
        raise ValueError(f"width: expected 16 pixels or more, got {config.width}")
    if any((config.out / "scores").glob("*.csv")):
        raise ValueError(f"{config.out / 'scores'} holds answers to an earlier page: name another --out")


def plan(config: Config, models: dict[str, pipeline.Models]) -> list[Item]:
    """Choose the labels and faces of all items.

    Chains are distinct, and so are peaks; every second chain ends at neutral. The predecessor's and the real peaks have
    the same labels and faces as ours.

    Raises:
        ValueError: for more items than there are labels, or labels unknown to the predecessor or the dataset.
    """
    neutral, *expressions = models["ours"].labels
    if not config.composed and not config.peaks:
        raise ValueError("composed and peaks: expected at least one animation, got none")
    if not (0 <= config.peaks <= len(expressions) and 0 <= config.real <= config.peaks):
        bounds = f"peaks in 0..{len(expressions)}, the model's expressions, and real in 0..peaks"
        raise ValueError(f"expected {bounds}, got {config.peaks} and {config.real}")
    rng = np.random.default_rng(config.seed)
    faces = itertools.cycle(rng.permutation(FACES).tolist())
    chains = _chains(rng, neutral, expressions, config.composed)
    peaks = [(neutral, expressions[i]) for i in rng.permutation(len(expressions))[: config.peaks]]
    composed = [Item("composed", labels, next(faces), number) for number, labels in enumerate(chains)]
    ours = [Item("peak", labels, next(faces), number) for number, labels in enumerate(peaks, len(chains))]
    others = [item._replace(kind="predecessor") for item in ours if "predecessor" in models]
    real = [item._replace(kind="real") for item in ours[: config.real]]
    for item in others:
        models["predecessor"].labels.encode(item.labels)
    for item in real:
        if item.labels[1] not in expression_recipes.EXPRESSIONS:
            raise ValueError(f"real: the dataset has no {item.labels[1]!r}; go without with --real 0")
    return composed + ours + others + real


def _chains(rng: np.random.Generator, neutral: str, expressions: Sequence[str], count: int) -> list[tuple[str, ...]]:
    """Draw chains, alternating neutral → A → B → C and neutral → A → B → neutral."""
    there, back = (list(itertools.permutations(expressions, length)) for length in (3, 2))
    if not 0 <= count <= 2 * len(back):
        raise ValueError(f"composed: expected 0 to {2 * len(back)} with {len(expressions)} expressions, got {count}")
    onward = [(neutral, *there[i]) for i in rng.choice(len(there), count - count // 2, replace=False)]
    home = [(neutral, *back[i], neutral) for i in rng.choice(len(back), count // 2, replace=False)]
    return [chain for pair in itertools.zip_longest(onward, home) for chain in pair if chain is not None]


def _moved(config: Config, models: dict[str, pipeline.Models], item: Item) -> Motion:
    if item.kind != "real":
        return _generated(config, models["predecessor" if item.kind == "predecessor" else "ours"], item)
    whole = _performed(item)
    take = performance.perform(item.labels[1], item.subject, seed=makehuman4d.SEED)
    # Cut and resampled like the generator's training motions, so that the tempo does not reveal it as real.
    rise = slice(take.onset, take.apex_start + 1)
    return Motion(*(np.asarray(align.resample(x[rise], frames=config.frames)) for x in whole[:2]), starts=(0,))


def _generated(config: Config, models: pipeline.Models, item: Item) -> Motion:
    key = jax.random.fold_in(jax.random.key(config.seed), item.number)
    neutral = makehuman.subject(item.subject).vertices
    marks = pipeline.landmarks(models, key, item.labels, neutral, frames=config.frames)
    starts = tuple(start for start, _ in pipeline.captions(item.labels, frames=config.frames))
    return Motion(np.asarray(pipeline.meshes(models, marks, neutral)), np.asarray(marks), starts)


def _performed(item: Item) -> Motion:
    """Return the dataset's whole sequence of a label and a subject: neutral → peak → neutral."""
    shape, person = makehuman.template(), makehuman.subject(item.subject)
    take = performance.perform(item.labels[1], item.subject, seed=makehuman4d.SEED)
    vertices = rig.pose(rig.build(person, level=makehuman4d.Spec().level), take.weights)[:, : len(shape.vertices)]
    return Motion(vertices, vertices[:, shape.landmarks], (0, take.apex_end))


def _failed(config: Config, models: pipeline.Models, item: Item) -> Motion:
    """Return a failed animation, the example of score 0: shuffled frames, shuffled landmarks, and noise."""
    rng = np.random.default_rng([config.seed, item.number])
    sound, neutral = _generated(config, models, item), makehuman.subject(item.subject).vertices
    rest = np.asarray(pipeline.neutral_landmarks(models, neutral))
    moved = rng.permutation(rng.permutation(sound.landmarks - rest, axis=0), axis=1)
    marks = (rest + moved + rng.normal(0, NOISE, moved.shape)).astype(np.float32)
    return Motion(np.asarray(pipeline.meshes(models, marks, neutral)), marks, sound.starts)


def _filmed(config: Config, models: pipeline.Models, item: Item, motion: Motion) -> _study.Film:
    """Render an animation with captions; eyes, teeth, light and camera are the same for all items."""
    rest = np.asarray(pipeline.neutral_landmarks(models, makehuman.subject(item.subject).vertices))
    size = (config.width, config.width * 5 // 4)
    pictures = render.frames(
        motion.vertices, models.face.faces, size=size, camera=render.fit_camera(motion.vertices, size=size, turn=TURN),
        extras=eyes_teeth.parts(eyes_teeth.template(), rest, motion.landmarks),
    )  # fmt: skip
    texts = [f"{a} → {b}".replace("_", " ") for a, b in itertools.pairwise(item.labels)]
    pictures = render.caption(pictures, tuple(zip(motion.starts, texts, strict=True)))
    pictures = np.concatenate([pictures[[0] * LEAD], pictures, pictures[[-1] * REST]])
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "film.webp"
        video.write(path, pictures, fps=pipeline.RATE, quality=QUALITY)
        data = path.read_bytes()
    # The hash includes the kind: two generators might produce the same pictures.
    name = hashlib.sha256(json.dumps(item).encode() + data).hexdigest()[:12]
    milliseconds = round(1000 * len(pictures) / pipeline.RATE)
    return _study.Film(name, item.labels, milliseconds, pictures.shape[2:0:-1], data)


if __name__ == "__main__":
    _run.main("user_study", Config, run)
