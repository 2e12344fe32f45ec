"""How well is the template brought onto a head in no topology, and a motion back to the head's own vertices?

    python -m experiments.registration --publish

Ten MakeHuman test people that the morphable model has not seen, cut anew into 2,000, 10,000 and 50,000 vertices and put
in any place, with 68 landmarks or the seven that anybody can set. `whole` is the bare surface; `damaged` has eight
holes of 12 mm radius, noise of 0.3 mm on its vertices and landmarks that are 1 mm off; `unlike` is warped by a smooth
field of 3 mm, so that it lies in no morphable model. The truth is known: the surface that the scan was cut from, and
where each of the template's vertices is on it. `carried` is a motion of the true head (a mouth that opens), put on the
template and carried to the scan's vertices, against the same motion there. Some ten minutes on 2 cores; `--quick` one
head in one size.
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

FIRST = 100  # test people
EXPRESSION = "mouth_open"
HOLES, HOLE = 8, 12.0  # mm radius
VERTEX_NOISE, LANDMARK_NOISE, WARP = 0.3, 1.0, 3.0  # mm
KINDS = ("whole", "damaged", "unlike")
SEVEN = (36, 39, 42, 45, 30, 48, 54)


@dataclasses.dataclass(frozen=True)
class Config:
    out: Path = Path("runs/registration")
    """Folder for the results."""
    heads: int = 10
    """How many of the test people."""
    sizes: tuple[int, ...] = (2_000, 10_000, 50_000)
    """Vertices of the scans."""
    kinds: tuple[str, ...] = KINDS
    """Which of whole, damaged and unlike."""
    seed: int = 0
    """Of the scans."""
    quick: bool = False
    """One head in one size."""
    publish: bool = False
    """Also write the figures that the README quotes."""


class Head(NamedTuple):
    """The truth."""

    neutral: np.ndarray  # (N, 3)
    moved: np.ndarray  # (N, 3) displacements of an expression


def run(config: Config) -> dict[str, Any]:
    """One row for each kind, size and number of landmarks, over all heads."""
    if wrong := [kind for kind in config.kinds if kind not in KINDS]:
        raise ValueError(f"unknown kind {wrong[0]!r}, expected {', '.join(KINDS)}")
    heads, sizes = (1, config.sizes[:1]) if config.quick else (config.heads, config.sizes)
    if not 1 <= heads <= 20:
        raise ValueError(f"heads: expected 1 to 20 test people, got {heads}")
    begun, rows, shots = time.perf_counter(), [], []
    scans.people()
    for kind in config.kinds:
        for size in sizes:
            for marks in (68, 7):
                found = [_trial(index, kind, size, marks, config.seed) for index in range(heads)]
                row = {"kind": kind, "vertices": size, "landmarks": marks}
                row |= {name: float(np.mean([one[name] for one, _ in found])) for name in found[0][0]}
                row["worst_surface_mm"] = max(one["surface_mm"] for one, _ in found)
                row["slowest_s"] = max(one["seconds"] for one, _ in found)
                rows.append(row)
                print(_said(row), flush=True)
                if marks == 7 and size == sizes[len(sizes) // 2]:
                    shots.append((f"{kind}, {size:,}", found[0][1]))
    config.out.mkdir(parents=True, exist_ok=True)
    sheet = config.out / "registration.png"
    titles, rows_shown = zip(*shots, strict=True)
    render.save(sheet, render.contact_sheet(rows_shown, row_labels=titles, column_labels=scans.SHOWN))
    plot = _plot(config.out / "registration_by_size.png", rows)
    made = _run.record(config, seconds=time.perf_counter() - begun)
    metrics = {"mode": "quick" if config.quick else "default", "heads": heads, "rows": rows}
    _run.finish("registration", config, metrics, made=made, table=_table(rows), figure=sheet)
    if config.publish:
        (_run.RESULTS / plot.name).write_bytes(plot.read_bytes())
    return metrics


def _trial(index: int, kind: str, size: int, marks: int, seed: int) -> tuple[dict[str, float], list[np.ndarray]]:
    """The errors of one head, in mm, and pictures of it."""
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
    return {name: float(value) for name, value in errors.items()}, scans.pictures(scan, found)


def _head(index: int, kind: str, seed: int) -> Head:
    """A test person, and its face in an expression at its height."""
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
    """The same surface in about `size` vertices of its own: cut fine, then simplified by quadrics."""
    while len(vertices) < 2.2 * size:
        vertices, faces = trimesh.remesh.subdivide(vertices, faces)
    share = 1 - 2 * size / len(faces)
    found = fast_simplification.simplify(vertices.astype(np.float32), faces.astype(np.int32), target_reduction=share)
    return np.asarray(found[0], np.float64), np.asarray(found[1])


def damage(vertices: np.ndarray, faces: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Noise on every vertex, and holes."""
    vertices = vertices + VERTEX_NOISE / np.sqrt(3) * rng.normal(size=vertices.shape)
    for _ in range(HOLES):
        centre = vertices[rng.integers(len(vertices))]
        faces = faces[np.linalg.norm(vertices[faces].mean(axis=1) - centre, axis=1) > HOLE]
    used, faces = np.unique(faces, return_inverse=True)
    return vertices[used], faces.reshape(-1, 3)


def _said(row: dict[str, Any]) -> str:
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
    figure.savefig(path, dpi=110)
    plt.close(figure)
    return path


if __name__ == "__main__":
    _run.main("registration", Config, run)
