"""`facejax demo`: labels to meshes on three unseen faces, with timings; `make demo` runs it."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Sequence
from pathlib import Path

import jax
import numpy as np

from facejax.cli import outputs, runtime
from facejax.cli.arguments import Demo
from facejax.data.synthetic import makehuman
from facejax.inference import pipeline
from facejax.io import atomic
from facejax.viz import render
from facejax.viz.scene import Scene

LABELS = ("neutral", "high_smile", "mouth_open", "neutral")
SUBJECTS = (100, 107, 115)  # test subjects: not in the training data of any network
SHEET_FRAMES = 8
PICTURE_SIZE = (200, 250)


def run(command: Demo) -> None:
    """Write the animations, and print the summary."""
    print(animate_subjects(command.out, seed=command.seed).read_text())


def animate_subjects(out: Path, *, seed: int = 7) -> Path:
    """Animate `SUBJECTS` through `LABELS`; return the path of the summary."""
    clock = _Clock()
    runtime.configure()
    outputs.make_output_folder(out)
    people = [makehuman.subject(i) for i in SUBJECTS]
    clock.lap("MakeHuman's assets and three faces")
    models = pipeline.load()
    clock.lap("weights")
    keys = jax.random.split(jax.random.key(seed), len(people))
    rows, marks, names, shown = [], [], [person.name for person in people], np.zeros(0, int)
    with outputs.progress("demo", 3 * len(people) + 2) as advance:
        for person, key in zip(people, keys, strict=True):
            face = pipeline.prepare(models, person.vertices)
            moved = pipeline.motion(models, key, models.labels.encode(LABELS), face)
            vertices = np.asarray(pipeline.vertices(models, face, moved))
            clock.lap("labels to meshes" if marks else "labels to meshes, first (compiles, or reads the cache)")
            marks.append(np.asarray(moved))
            scene = outputs.scene_of(models, person.vertices, vertices, marks[-1], LABELS, pipeline.FRAMES)
            for suffix in ("glb", "html", "webp"):
                outputs.save(out, person.name, suffix, scene, pipeline.RATE)
                clock.lap(f"{suffix} files")
                advance()
            shown = np.linspace(0, len(vertices) - 1, SHEET_FRAMES).round().astype(int)
            rows.append(_pictures(scene, shown))
            clock.lap("contact sheet")
        labels = [f"frame {t + 1}" for t in shown]
        render.save(out / "contact_sheet.png", render.contact_sheet(rows, row_labels=names, column_labels=labels))
        advance()
        outputs.save_landmarks(out / "landmarks.npz", np.stack(marks), LABELS, pipeline.FRAMES, pipeline.RATE)
        advance()
    return _summary(out, names, clock)


def _pictures(scene: Scene, chosen: np.ndarray) -> np.ndarray:
    parts = [p._replace(vertices=p.vertices[chosen]) if p.vertices.ndim == 3 else p for p in scene.extras]
    camera = render.fit_camera(scene.vertices, size=PICTURE_SIZE, turn=15)
    return render.frames(scene.vertices[chosen], scene.faces, size=PICTURE_SIZE, camera=camera, extras=parts)


class _Clock:
    """Seconds spent on each named step, summed."""

    def __init__(self) -> None:
        self.begun = self.last = time.perf_counter()
        self.laps: dict[str, float] = {}

    def lap(self, name: str) -> None:
        now = time.perf_counter()
        self.laps[name] = self.laps.get(name, 0.0) + now - self.last
        self.last = now


def _summary(out: Path, names: Sequence[str], clock: _Clock) -> Path:
    rows = "\n".join(f"| {name} | {seconds:.2f} |" for name, seconds in clock.laps.items())
    lines = [
        "# facejax demo",
        "",
        f"{' → '.join(LABELS)} on {len(names)} unseen faces ({', '.join(names)}), 88 frames each.",
        "",
        "* `NAME.glb` animated glTF, `NAME.html` viewer in one page, `NAME.webp` video",
        "* `contact_sheet.png` three faces by eight frames, `landmarks.npz` the generated landmarks",
        "",
        "| step | seconds |",
        "| --- | --- |",
        rows,
        f"| **all** | **{time.perf_counter() - clock.begun:.2f}** |",
        "",
        f"{os.cpu_count()} cores, {platform.machine()}, Python {platform.python_version()}, jax {jax.__version__}.",
        "",
    ]
    path = out / "summary.md"
    with atomic.replace_file(path) as temporary:
        temporary.write_text("\n".join(lines))
    return path
