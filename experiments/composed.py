"""Error along composed motions: OT23's sequences of three transitions (figure 8), and chains of 20.

Figure 8: five sequences of three transitions, 64 samples, 90 frames; the error per frame against the single held-out
sample of each transition, as in `experiments.specificity`. Beyond the paper, chains of 20 random transitions that end
at neutral: the distance to the nearest real motion of the pair (Davies) along the chain, the distance of the last
frame from neutral, and the continuity of position and speed at the joints. Held-out people as in
`experiments.specificity`.

    python -m experiments.composed --publish --models runs/generators/flow-{0,1,2}.safetensors

Expected: median distance 0.632 mm for transitions 1 to 5, 0.573 mm for 16 to 20; the last frame is neutral; no
acceleration peak at joints. Time: 5 minutes on 2 cores of an AMD EPYC.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import matplotlib
import numpy as np

from experiments import _datasets, _motion_eval, _run
from facejax import metrics
from facejax.data.synthetic import expression_recipes
from facejax.inference import composition, pipeline
from facejax.viz import contact_sheet, eyes_teeth, render

matplotlib.use("Agg")
import matplotlib.pyplot as plt

# OT23 names the first in its text and the third as its yellow curve, and does not name the others.
FIVE = (
    ("neutral", "bareteeth", "eyebrow", "lips_up"),
    ("neutral", "high_smile", "mouth_open", "cheeks_in"),
    ("mouth_down", "mouth_side", "mouth_open", "lips_back"),
    ("bareteeth", "high_smile", "mouth_up", "neutral"),
    ("cheeks_in", "mouth_extreme", "bareteeth", "lips_up"),
)
TRANSITIONS = 20
FRAMES = 30


@dataclasses.dataclass(frozen=True)
class Config(_motion_eval.Options):
    out: Path = Path("runs/composed")
    """Folder for the results."""
    chains: int = 8
    """Number of different chains of 20 transitions."""


def run(config: Config) -> dict[str, Any]:
    """Generate chains and measure them along their length."""
    begun = time.perf_counter()
    judged = _motion_eval.load_models(config)
    data = _motion_eval.load_dataset(config)
    chains = random_chains(config.chains, config.seed, data.labels)
    five = FIVE if _datasets.is_makehuman(data) else random_chains(5, config.seed + 1, data.labels, transitions=3)
    steps = {pair for labels in (*five, *chains) for pair in zip(labels[:-1], labels[1:], strict=True)}
    real = _motion_eval.held_out_motions(config, "test", sorted(steps))
    of = {name: i for i, name in enumerate(real.names)}
    rows, errors = [], []
    for models in judged:
        errors.append([_errors(models, config, labels, real, of) for labels in five])
        rows.append([_chain(models, config, i, labels, real, of) for i, labels in enumerate(chains)])
    davies = np.array([[row["davies_mm"] for row in each] for each in rows])  # models, chains, samples, transitions
    own = np.array([row["davies_real_mm"] for row in rows[0]])  # chains, transitions
    early, late = np.median(davies[..., :5]), np.median(davies[..., 15:20])
    measured = [row["joints"] for each in rows for row in each]
    joints = {name: float(np.mean([row[name] for row in measured])) for name in measured[0]}
    found = {
        "davies_1_to_5_mm": float(early),
        "davies_16_to_20_mm": float(late),
        "davies_ratio": float(late / early),
        "davies_each_mm": np.median(davies, axis=(0, 1, 2)).tolist(),
        "davies_real_mm": float(np.mean(own)),
        "davies_over_real_1_to_5": float(np.median(davies[..., :5] / own[:, None, :5])),
        "davies_over_real_16_to_20": float(np.median(davies[..., 15:20] / own[:, None, 15:20])),
        "from_neutral_at_the_end_mm": float(np.max([[row["end_mm"] for row in each] for each in rows])),
        **joints,
        "error_per_frame_mm": dict(zip(map(" > ".join, five), np.mean(errors, axis=0).tolist(), strict=True)),
        "people": real.people,
    }  # fmt: skip
    figure = _plot(config.out, found)
    _picture(config.out, judged[0], chains[0], config.seed)
    made = _run.record(config, seconds=time.perf_counter() - begun, dataset=data.index["spec"])
    _run.finish("composed", config, found, made=made, table=_table(found), figure=figure)
    if config.publish:
        _run.publish_file(config.out / "chain.png", "composed_chain.png")
    return found


def random_chains(
    count: int, seed: int, labels: Sequence[str] = expression_recipes.LABELS, *, transitions: int = TRANSITIONS
) -> list[tuple[str, ...]]:
    """Draw chains of labels that start and end with neutral, the first label, and never repeat a label in a row."""
    random = np.random.default_rng(seed)
    chains = []
    for _ in range(count):
        chain = [labels[0]]
        while len(chain) < transitions:
            label = str(random.choice(labels[1:]))
            if label != chain[-1]:
                chain.append(label)
        chains.append((*chain, labels[0]))
    return chains


def _errors(models: pipeline.Models, config: Config, labels, real: _motion_eval.HeldOut, of: dict) -> np.ndarray:
    """Return the mean distance (T,) to the held-out sample of each transition in turn."""
    key = jax.random.key(config.seed)
    drawn = real.scale * np.asarray(pipeline.displacements(models, key, labels, samples=config.samples))
    truth = [real.reference[of[pair]] for pair in zip(labels[:-1], labels[1:], strict=True)]
    # A joint is the last frame of one transition and the first of the next; it is counted once.
    line = np.concatenate([truth[0], *(curve[1:] for curve in truth[1:])])
    return np.linalg.norm(drawn - line, axis=-1).mean(axis=(0, 2))


def _chain(
    models: pipeline.Models, config: Config, number: int, labels, real: _motion_eval.HeldOut, of: dict
) -> dict[str, Any]:
    """Measure one chain: distances to the nearest real transitions, the last frame, and the joints."""
    pairs = list(zip(labels[:-1], labels[1:], strict=True))
    key = jax.random.fold_in(jax.random.key(config.seed), number)
    drawn = real.scale * np.asarray(pipeline.displacements(models, key, labels, samples=config.samples))
    cut = [drawn[:, i * (FRAMES - 1) : i * (FRAMES - 1) + FRAMES] for i in range(len(pairs))]
    known = [real.curves[of[pair]] for pair in pairs]
    nearest = [metrics.nearest_distance(mine, truth) for mine, truth in zip(cut, known, strict=True)]
    own = [np.asarray(metrics.distances(truth, truth)) for truth in known]
    return {
        "davies_mm": np.stack([np.asarray(row) for row in nearest], axis=1).tolist(),
        "davies_real_mm": [float((table + 1e9 * np.eye(len(table))).min(axis=1).mean()) for table in own],
        "end_mm": float(np.abs(drawn[:, -1]).max()),
        "joints": _joints(models, key, labels, drawn, real.scale),
    }


def _joints(models: pipeline.Models, key, labels, drawn: np.ndarray, scale: float) -> dict[str, float]:
    """Return the acceleration at joints over the mean between them, with and without matched speeds."""
    at = np.arange(1, len(labels) - 1) * (FRAMES - 1) - 1

    def relative(curves):
        bend = np.linalg.norm(np.diff(curves, n=2, axis=1), axis=-1).mean(axis=-1)
        return float(bend[:, at].mean() / np.delete(bend, at, axis=1).mean())

    pairs = composition.label_pairs(models.labels.encode(labels))
    keys = composition.sample_keys(key, len(drawn))
    curves = scale * np.asarray(composition.draw(models.motion, models.starts, keys, pairs).curves)
    gaps = np.abs(curves[:, 1:, 0] - curves[:, :-1, -1]).max()
    plain = np.concatenate([curves[:, 0], *(curves[:, i, 1:] for i in range(1, curves.shape[1]))], axis=1)
    return {
        "gap_mm": float(gaps),
        "joint_acceleration_ratio": relative(drawn),
        "joint_acceleration_ratio_unmatched": relative(plain),
    }


def _table(found: dict[str, Any]) -> str:
    rows = [
        ("distance to the nearest real motion, transitions 1 to 5, median, mm", f"{found['davies_1_to_5_mm']:.3f}", ""),
        ("the same, transitions 16 to 20", f"{found['davies_16_to_20_mm']:.3f}", ""),
        ("16 to 20 over 1 to 5", f"{found['davies_ratio']:.3f}", "≤ 1.2"),
        ("over that of real motions to the nearest other: 1 to 5", f"{found['davies_over_real_1_to_5']:.3f}", ""),
        ("the same: 16 to 20", f"{found['davies_over_real_16_to_20']:.3f}", ""),
        ("distance of the last frame from neutral, largest, mm", f"{found['from_neutral_at_the_end_mm']:.1e}", ""),
        ("jump in position at a joint, largest, mm", f"{found['gap_mm']:.1e}", "0"),
        ("acceleration at joints over that between them", f"{found['joint_acceleration_ratio']:.4f}", "≤ 1"),
        ("the same without matching speeds", f"{found['joint_acceleration_ratio_unmatched']:.3f}", ""),
    ]  # fmt: skip
    return _run.markdown(
        (f"chains of {TRANSITIONS} transitions, {found['people']} held-out people", "", "wanted"), rows
    )


def _plot(out: Path, found: dict[str, Any]) -> Path:
    figure, (left, right) = plt.subplots(1, 2, figsize=(12, 4.2), constrained_layout=True)
    for labels, curve in found["error_per_frame_mm"].items():
        left.plot(curve, label=labels.replace("_", " "))
    for joint in (29, 58):
        left.axvline(joint, color="0.8", zorder=0)
    left.set_xlabel("frame")
    left.set_ylabel("distance to the held-out sample, mm")
    left.set_ylim(0, 1.4 * max(max(curve) for curve in found["error_per_frame_mm"].values()))
    left.legend(frameon=False, fontsize=7, loc="upper left")
    right.bar(np.arange(1, TRANSITIONS + 1), found["davies_each_mm"], color="#5b8db8")
    right.set_xticks([1, *range(5, TRANSITIONS + 1, 5)])
    right.set_xlabel("transition of the chain")
    right.set_ylabel("distance to the nearest real motion, mm")
    return _run.save_figure(figure, out / "composed.png")


def _picture(out: Path, models: pipeline.Models, labels, seed: int) -> None:
    """Render the mean face at every peak of one chain."""
    face = models.face
    marks = pipeline.landmarks(models, jax.random.key(seed), labels, face.vertices)
    vertices = np.asarray(pipeline.meshes(models, marks[:: FRAMES - 1], face.vertices))
    parts = eyes_teeth.parts(eyes_teeth.template(), np.asarray(marks[0]), np.asarray(marks[:: FRAMES - 1]))
    pictures = render.frames(vertices, face.faces, size=(160, 200), extras=parts)
    pictures = contact_sheet.caption(pictures, tuple((i, name.replace("_", " ")) for i, name in enumerate(labels)))
    rows = [pictures[:7], pictures[7:14], pictures[14:]]
    contact_sheet.save(out / "chain.png", contact_sheet.contact_sheet(rows))


if __name__ == "__main__":
    _run.main("composed", Config, run)
