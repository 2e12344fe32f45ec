"""Error of registering the template to a head scan, and of transferring a motion back to the scan's own vertices.

    python -m experiments.registration --publish

Ten MakeHuman test people that the morphable model was not fitted to, remeshed to 2,000, 10,000 and 50,000 vertices
and placed at random, with 68 landmarks or the seven that are easy to pick manually. `whole` is the bare surface;
`damaged` has eight holes of 12 mm radius, noise of 0.3 mm on its vertices and of 1 mm on its landmarks; `unlike` is
deformed by a smooth field of 3 mm, which takes it outside of the morphable model. The ground truth is known: the
surface that the scan was sampled from, and the position of each template vertex on it. `carried` is the error of a
motion of the true head (`mouth_open`) that is applied to the template and transferred to the scan's vertices.

Expected distance to the true surface, face, 10,000 vertices, 68 landmarks: 0.102 mm whole, 0.136 damaged, 0.285
unlike. Time: 9 minutes on 2 cores of an AMD EPYC; `--quick` evaluates one head in one size.
"""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path
from typing import Any, NamedTuple

import fast_simplification
import matplotlib
import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from experiments import _run
from facejax.data.synthetic import makehuman, makehuman4d, noise, performance, rig
from facejax.inference import registration, scans
from facejax.mesh import closest_point
from facejax.viz import render

matplotlib.use("Agg")
import matplotlib.pyplot as plt

FIRST = 100  # index of the first test person
EXPRESSION = "mouth_open"
HOLE_COUNT, HOLE_RADIUS = 8, 12.0  # mm
VERTEX_NOISE, LANDMARK_NOISE, WARP = 0.3, 1.0, 3.0  # mm
KINDS = ("whole", "damaged", "unlike")
SEVEN = (36, 39, 42, 45, 30, 48, 54)


@dataclasses.dataclass(frozen=True)
class Config:
    out: Path = Path("runs/registration")
    """Folder for the results."""
    heads: int = 10
    """Number of test people, 1 to 20."""
    sizes: tuple[int, ...] = (2_000, 10_000, 50_000)
    """Numbers of vertices of the scans."""
    kinds: tuple[str, ...] = KINDS
    """Kinds of scan: whole, damaged, unlike."""
    seed: int = 0
    """Seed of the scans."""
    quick: bool = False
    """Evaluate one head in one size."""
    publish: bool = False
    """Also write the committed results in experiments/results."""


class Head(NamedTuple):
    """The ground truth."""

    neutral: np.ndarray  # (N, 3)
    moved: np.ndarray  # (N, 3) displacements of an expression


def run(config: Config) -> dict[str, Any]:
    """Register all scans; one row per kind, size and number of landmarks, over all heads."""
    if wrong := [kind for kind in config.kinds if kind not in KINDS]:
        raise ValueError(f"unknown kind {wrong[0]!r}, expected {', '.join(KINDS)}")
    heads, sizes = (1, config.sizes[:1]) if config.quick else (config.heads, config.sizes)
    if not 1 <= heads <= 20:
        raise ValueError(f"heads: expected 1 to 20 test people, got {heads}")
    begun, rows, shots = time.perf_counter(), [], []
    scans.head_model()
    for kind in config.kinds:
        for size in sizes:
            for marks in (68, 7):
                found = [_trial(index, kind, size, marks, config.seed) for index in range(heads)]
                row = {"kind": kind, "vertices": size, "landmarks": marks}
                row |= {name: float(np.mean([one[name] for one, _ in found])) for name in found[0][0]}
                row["worst_surface_mm"] = max(one["surface_mm"] for one, _ in found)
                row["slowest_s"] = max(one["seconds"] for one, _ in found)
                rows.append(row)
                print(_progress_line(row), flush=True)
                if marks == 7 and size == sizes[len(sizes) // 2]:
                    shots.append((f"{kind}, {size:,}", found[0][1]))
    config.out.mkdir(parents=True, exist_ok=True)
    sheet = config.out / "registration.png"
    titles, rows_shown = zip(*shots, strict=True)
    render.save(sheet, render.contact_sheet(rows_shown, row_labels=titles, column_labels=scans.PICTURE_LABELS))
    plot = _plot(config.out / "registration_by_size.png", rows)
    made = _run.record(config, seconds=time.perf_counter() - begun)
    metrics = {"mode": "quick" if config.quick else "default", "heads": heads, "rows": rows}
    _run.finish("registration", config, metrics, made=made, table=_table(rows), figure=sheet)
    if config.publish:
        _run.publish_file(plot, plot.name)
    return metrics


def _trial(index: int, kind: str, size: int, marks: int, seed: int) -> tuple[dict[str, float], list[np.ndarray]]:
    """Return the errors of one head in mm, and pictures of it."""
    head, rng = _head(FIRST + index, kind, seed), np.random.default_rng([seed, index, size, marks, KINDS.index(kind)])
    template = makehuman.template()
    vertices, faces = cut(head.neutral, template.faces, size)
    which = np.arange(68) if marks == 68 else np.array(SEVEN)
    points = head.neutral[template.landmarks[which]]
    if kind == "damaged":
        vertices, faces = damage(vertices, faces, rng)
        points = points + LANDMARK_NOISE / np.sqrt(3) * rng.normal(size=points.shape)
    turn, move = Rotation.random(rng=rng).as_matrix(), rng.normal(size=3) * 300
    scan = scans.Scan(
        f"S{FIRST + index}", vertices @ turn.T + move, faces, points @ turn.T + move, which, 1.0, ()
    )  # fmt: skip
    begun = time.perf_counter()
    found = scans.fit(scan)
    seconds = time.perf_counter() - begun
    placed = (found.vertices - move) @ turn
    true = closest_point.surface(head.neutral, template.faces)
    off = closest_point.closest_points(true, placed).distance
    apart = np.linalg.norm(placed - head.neutral, axis=1)
    hung = registration.bind(placed, template.faces, vertices, faces)
    hits = closest_point.closest_points(true, vertices)
    there = closest_point.at(true, hits, head.moved)
    shown = closest_point.at(true, hits, template.face_mask.astype(np.float64)) > 0.5
    lost = np.linalg.norm(registration.transfer_displacements(hung, head.moved) - there, axis=1)
    face = template.face_mask
    errors = {
        "surface_mm": off[face].mean(),
        "correspondence_mm": apart[face].mean(),
        "head_surface_mm": off.mean(),
        "head_correspondence_mm": apart.mean(),
        "carried_mm": lost[shown].mean(),
        "motion_mm": np.linalg.norm(there[shown], axis=1).mean(),
        "seconds": seconds,
    }
    return {name: float(value) for name, value in errors.items()}, scans.fit_pictures(scan, found)


def _head(index: int, kind: str, seed: int) -> Head:
    """Return a test person's neutral head and the displacements of an expression at its apex."""
    person = makehuman.subject(index, seed=makehuman4d.SEED)
    take = performance.perform(EXPRESSION, index, seed=makehuman4d.SEED)
    count = len(person.vertices)
    posed = rig.pose(rig.build(person, level=2), take.weights[take.apex_start][None])[0, :count]
    neutral = person.vertices.astype(np.float64)
    moved = posed - neutral
    if kind == "unlike":
        neutral = neutral + noise.field(1, np.random.default_rng([seed, index]), sigma=1.0)[0] * WARP
    return Head(neutral, moved)


def cut(vertices: np.ndarray, faces: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Remesh a surface to about `size` vertices: subdivide, then simplify by quadric decimation."""
    while len(vertices) < 2.2 * size:
        vertices, faces = trimesh.remesh.subdivide(vertices, faces)
    share = 1 - 2 * size / len(faces)
    found = fast_simplification.simplify(vertices.astype(np.float32), faces.astype(np.int32), target_reduction=share)
    return np.asarray(found[0], np.float64), np.asarray(found[1])


def damage(vertices: np.ndarray, faces: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Add noise to every vertex, and cut holes."""
    vertices = vertices + VERTEX_NOISE / np.sqrt(3) * rng.normal(size=vertices.shape)
    for _ in range(HOLE_COUNT):
        centre = vertices[rng.integers(len(vertices))]
        faces = faces[np.linalg.norm(vertices[faces].mean(axis=1) - centre, axis=1) > HOLE_RADIUS]
    used, faces = np.unique(faces, return_inverse=True)
    return vertices[used], faces.reshape(-1, 3)


def _progress_line(row: dict[str, Any]) -> str:
    return (
        f"{row['kind']}, {row['vertices']} vertices, {row['landmarks']} landmarks: surface {row['surface_mm']:.3f}, "
        f"correspondence {row['correspondence_mm']:.3f}, carried {row['carried_mm']:.3f} of {row['motion_mm']:.2f} mm, "
        f"{row['seconds']:.1f} s"
    )


def _table(rows: list[dict[str, Any]]) -> str:
    header = ["scan", "vertices", "landmarks", "to the surface, face / head, mm", "worst head, mm"]
    header += ["correspondence, face / head, mm", "motion carried, off / of, mm", "seconds, mean / most"]
    body = [
        [
            row["kind"], f"{row['vertices']:,}", row["landmarks"],
            f"{row['surface_mm']:.3f} / {row['head_surface_mm']:.3f}", f"{row['worst_surface_mm']:.3f}",
            f"{row['correspondence_mm']:.2f} / {row['head_correspondence_mm']:.2f}",
            f"{row['carried_mm']:.3f} / {row['motion_mm']:.2f}", f"{row['seconds']:.1f} / {row['slowest_s']:.1f}",
        ]
        for row in rows
    ]  # fmt: skip
    return _run.markdown(header, body)


def _plot(path: Path, rows: list[dict[str, Any]]) -> Path:
    figure, axes = plt.subplots(1, 2, figsize=(10, 3.4), constrained_layout=True)
    sizes = sorted({row["vertices"] for row in rows})
    for axis, name, title in zip(
        axes, ("surface_mm", "correspondence_mm"), ("to the true surface", "to the true place"), strict=True
    ):
        for kind, colour in zip(KINDS, ("#5b8db8", "#c46b4e", "#6a9a58"), strict=True):
            for marks, style in ((68, "-"), (7, ":")):
                mine = [row for row in rows if (row["kind"], row["landmarks"]) == (kind, marks)]
                if mine:
                    axis.plot(
                        [row["vertices"] for row in mine], [row[name] for row in mine], style, color=colour,
                        marker="o", ms=3, label=f"{kind}, {marks} landmarks",
                    )  # fmt: skip
        axis.set(title=title, xscale="log", xlabel="vertices of the scan", ylabel="mm, mean over the face")
        axis.set_ylim(0)
        axis.minorticks_off()
        axis.set_xticks(sizes, [f"{size:,}" for size in sizes])
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, frameon=False, fontsize=8, loc="outside right center")
    return _run.save_figure(figure, path)


if __name__ == "__main__":
    _run.main("registration", Config, run)
