"""Error of radial basis function warps from 68 landmarks to a mesh, by kernel, width and options (SL21).

makehuman4d's true landmark displacements are interpolated over each subject's neutral mesh (SL21, "Landmark to full
mesh deformation") and compared with the subject's true meshes: over the head, the face region, and the rims of neck,
mouth and eyes. The angle between true and warped vertex normals of the face shows bumps that a mean distance does
not. Kernels, widths and the affine term are chosen on the validation subjects and evaluated on the test subjects, and
so are the additions of `facejax.mesh.rbf_weights`: a falloff towards the neck, and a lip split. Also: the paper's
system for each frame, a head with different mesh connectivity, and pictures after the paper's figures 4 and 6.
`--data STORE` takes a dataset with 68 landmarks.

    python -m experiments.rbf_warp --publish

Expected on the test subjects: 0.262 mm over the head and 0.307 mm over the face, of 0.816 and 1.314 mm of motion.
Time: one to two minutes on 2 cores of an AMD EPYC, once the dataset is prepared.
"""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

from experiments import _run
from experiments._rbf_eval import (
    Face,
    WarpVariant,
    heat_sheet,
    neutral_face,
    region_indices,
    remesh,
    sequence_sheet,
    transfer_sheet,
    warp_weights,
)
from facejax.data import dataset
from facejax.data.mesh_subset import of_split
from facejax.data.synthetic import makehuman4d
from facejax.geometry import rbf
from facejax.mesh.normals import vertex_normals
from facejax.viz import eyes_teeth, render

matplotlib.use("Agg")
import matplotlib.pyplot as plt

SIGMAS = {
    "gaussian": (0.35, 0.5, 0.75, 1.0, 1.25, 1.5, 2.0),
    "wendland_c2": (2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 12.0, 20.0),
    "multiquadric": (0.05, 0.1, 0.25, 0.5, 0.75, 1.0, 1.5, 2.0),
    "thin_plate": (1.0,),
    "triharmonic": (1.0,),
}
SMOOTHING = (0.03, 0.1, 0.3)  # tried with the chosen variant
NORMAL_STRIDE = 10  # normals are compared on every tenth mesh


@dataclasses.dataclass(frozen=True)
class Config:
    out: Path = Path("runs/rbf_warp")
    """Folder for the results."""
    seed: int = 0
    """Seed of the drawn meshes and of the remeshing."""
    data: Path | None = None
    """Prepared dataset to use in place of makehuman4d."""
    level: int = 3
    """Realism level of makehuman4d, 0 to 3."""
    subjects: int = 120
    """Number of subjects of makehuman4d."""
    meshes: int = 20_000
    """Number of meshes of makehuman4d."""
    frames: int = 2_000
    """Number of meshes of each split to evaluate on."""
    quick: bool = False
    """Evaluate each kernel at its default width only."""
    publish: bool = False
    """Also write the committed results in experiments/results."""


def run(config: Config) -> dict[str, Any]:
    """Choose on validation subjects, evaluate on test subjects, draw the figures."""
    begun = time.perf_counter()
    data = _data(config)
    regions = region_indices(data)
    validation, test = (_draw(data, split, config) for split in ("validation", "test"))
    sweep = [_row(form, validation, regions) for form in _variants(config.quick)]
    chosen = _best(sweep)
    if not config.quick:
        sweep += [_row(chosen._replace(smoothing=s), validation, regions) for s in SMOOTHING]
    odd = remesh(test[-1], config.seed)
    metrics = {
        "chosen": chosen._asdict(),
        "still": _measure(test, None, regions),
        "test": [_row(form, test, regions) for form in _tested_variants(sweep, chosen)],
        "validation": sweep,
        "per_frame": _per_frame(data, chosen, regions["face"]),
        "remeshed": {
            "vertices": len(odd.neutral),
            "head_mm": _measure([odd], chosen, {"head": np.arange(len(odd.neutral))})["head"],
            "original_head_mm": _measure(test[-1:], chosen, regions)["head"],
        },
    }
    config.out.mkdir(parents=True, exist_ok=True)
    figure = _plot(config.out / "rbf_warp.png", sweep)
    bare = chosen._replace(falloff=False, lips=False)
    shown = {"left still": None, "warped": chosen, "bare": bare}
    pictures = {
        "heat": heat_sheet(data, {name: _errors(test, form)[0] for name, form in shown.items()}),
        "sequence": sequence_sheet(data, chosen),
        "faces": transfer_sheet(data, chosen, odd),
    }
    for name, pixels in pictures.items():
        render.save(config.out / f"{name}.png", pixels)
        if config.publish:
            render.save(_run.RESULTS / f"rbf_warp_{name}.png", pixels)
    made = _run.record(config, seconds=time.perf_counter() - begun, dataset=data.index["spec"])
    _run.finish("rbf_warp", config, metrics, made=made, table=_table(metrics), figure=figure)
    return metrics


def _data(config: Config) -> dataset.Dataset:
    if config.data is None:
        return makehuman4d.prepare(makehuman4d.Spec(config.level, config.subjects, config.meshes))
    data = dataset.open_meshes(config.data)
    if len(data.landmark_index) != eyes_teeth.LANDMARKS:
        raise ValueError(f"{data.path}: expected {eyes_teeth.LANDMARKS} landmarks, got {len(data.landmark_index)}")
    return data


def _draw(data: dataset.Dataset, split: str, config: Config) -> list[Face]:
    """Draw meshes of a split with a fixed seed, grouped by subject."""
    meshes = of_split(data, split)
    rng = np.random.default_rng(config.seed)
    drawn = meshes.where(rng.permutation(meshes.count) < config.frames)
    faces = []
    for s in np.unique(drawn.owner):
        own = drawn.where(drawn.owner == s)
        neutral = data.neutral[s]
        landmarks, vertices = own.read(np.arange(own.count))
        face = neutral_face(neutral, np.asarray(data.faces), neutral[data.landmark_index])
        faces.append(face._replace(landmarks=landmarks, vertices=vertices))
    return faces


def _variants(quick: bool) -> list[WarpVariant]:
    """Return every kernel and width, without and with falloff and lip split."""
    forms = []
    for kernel, sigmas in SIGMAS.items():
        for sigma in (rbf.KERNELS[kernel].sigma,) if quick else sigmas:
            for affine in (True, False) if rbf.KERNELS[kernel].definite else (True,):
                forms += [WarpVariant(kernel, sigma, affine, whole, whole) for whole in (False, True)]
    return forms


def _tested_variants(sweep: list[dict[str, Any]], chosen: WarpVariant) -> list[WarpVariant]:
    """Return the paper's variant, each kernel at its best width, and the chosen one with either addition alone."""

    def kind(row: dict[str, Any]) -> tuple:
        return row["kernel"], row["affine"], row["lips"]

    plain = [row for row in sweep if not row["smoothing"]]
    best = [_best([row for row in plain if kind(row) == one]) for one in dict.fromkeys(map(kind, plain))]
    alone = [chosen._replace(falloff=False), chosen._replace(lips=False)]
    return list(dict.fromkeys([WarpVariant("gaussian", 1.0, True, False, False), *best, *alone]))


def _errors(faces: list[Face], form: WarpVariant | None) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean distance (N,) in mm and mean normal angle (N,) in degrees; None leaves faces still."""
    distance, angle, thin = 0.0, 0.0, 0
    for face in faces:
        unmoved = np.zeros_like(face.vertices)
        warped = unmoved if form is None else np.asarray(rbf.warp(warp_weights(form, face), face.landmarks))
        distance = distance + np.linalg.norm(warped - face.vertices, axis=-1).sum(axis=0)
        surfaces = (face.neutral + moved[::NORMAL_STRIDE] for moved in (warped, face.vertices))
        a, b = (np.asarray(vertex_normals(surface, face.faces)) for surface in surfaces)
        cosine = np.clip(np.sum(a * b, axis=-1), -1, 1)
        angle, thin = angle + np.degrees(np.arccos(cosine)).sum(axis=0), thin + len(cosine)
    return distance / sum(len(face.vertices) for face in faces), angle / thin


def _measure(faces: list[Face], form: WarpVariant | None, regions: dict[str, np.ndarray]) -> dict[str, float]:
    distance, angle = _errors(faces, form)
    found = {region: float(distance[index].mean()) for region, index in regions.items()}
    visible = regions.get("face", regions["head"])
    return found | {"worst vertex": float(distance.max()), "normals": float(angle[visible].mean())}


def _row(form: WarpVariant, faces: list[Face], regions: dict[str, np.ndarray]) -> dict[str, Any]:
    return form._asdict() | {"error_mm": _measure(faces, form, regions)}


def _best(rows: list[dict[str, Any]]) -> WarpVariant:
    """Return the variant with the least normal error among those within 1 % of the least face error."""
    least = min(row["error_mm"]["face"] for row in rows)
    close = [row for row in rows if row["error_mm"]["face"] <= 1.01 * least]
    best = min(close, key=lambda row: row["error_mm"]["normals"])
    return WarpVariant(*(best[name] for name in WarpVariant._fields))


def _per_frame(data: dataset.Dataset, form: WarpVariant, face: np.ndarray) -> dict[str, float]:
    """Compare one system per face with the paper's one per frame, on one sequence per test subject."""
    found: dict[str, list] = {"once": [], "per_frame": [], "between_them": []}
    for i, s in enumerate(data.subjects("test")):
        takes = [take for take in data.sequences if take.subject == s]
        take = takes[i % len(takes)]
        neutral = data.neutral[s]
        marks = neutral[data.landmark_index]
        moved = data.landmarks[take.start : take.start + take.frames] - marks
        first, last = np.searchsorted(data.drawn, [take.start, take.start + take.frames])
        if first == last:  # the sequence has no meshes
            continue
        true, at = data.vertices[first:last] - neutral, data.drawn[first:last] - take.start
        once = np.asarray(rbf.apply(rbf.fit(marks, **form.options), moved, neutral))[at]
        each = rbf.refit(marks, moved, neutral, **form.options)[at]
        for name, a, b in (("once", once, true), ("per_frame", each, true), ("between_them", once, each)):
            found[name].append(np.linalg.norm(a - b, axis=-1)[:, face].ravel())
    return {name: float(np.concatenate(values).mean()) for name, values in found.items()}


def _plot(path: Path, sweep: list[dict[str, Any]]) -> Path:
    """Plot error against width by kernel: solid lines with the affine term, dashed ones without."""
    figure, axes = plt.subplots(1, 3, figsize=(13, 4), constrained_layout=True)
    colours = dict(zip(SIGMAS, ("#c46b4e", "#5b8db8", "#6a9a58", "#8a3fae", "#7a7a7a"), strict=True))
    titles = {"face": "face, mm", "mouth rim": "rim of the mouth, mm", "normals": "normals of the face, degrees"}
    rows = [row for row in sweep if row["lips"] and not row["smoothing"]]
    if "mouth rim" not in rows[0]["error_mm"]:
        titles = {"head": "head, mm"} | {name: title for name, title in titles.items() if name != "mouth rim"}
    for axis, (column, title) in zip(axes, titles.items(), strict=True):
        for kernel, affine in dict.fromkeys((row["kernel"], row["affine"]) for row in rows):
            mine = [row for row in rows if (row["kernel"], row["affine"]) == (kernel, affine)]
            points = [(row["sigma"], row["error_mm"][column]) for row in mine]
            look = {"color": colours[kernel], "label": kernel + ("" if affine else ", not affine")}
            if len(SIGMAS[kernel]) == 1:
                axis.axhline(points[0][1], linewidth=1.2, linestyle=":", **look)
            else:
                axis.plot(*zip(*points, strict=True), "-" if affine else "--", marker="o", markersize=3, **look)
        least = min(row["error_mm"][column] for row in rows)
        axis.set(xscale="log", xlabel="sigma, landmark spacings", title=title, ylim=(0.9 * least, 2.5 * least))
    axes[0].legend(frameon=False, fontsize=8)
    return _run.save_figure(figure, path)


def _name(form: dict[str, Any]) -> str:
    added = [word for word in ("affine", "falloff", "lips") if form[word]]
    smooth = [f"smoothing {form['smoothing']:g}"] if form["smoothing"] else []
    return ", ".join([f"{form['kernel']} {form['sigma']:g}", *added, *smooth])


def _table(metrics: dict[str, Any]) -> str:
    columns = list(metrics["still"])
    rows = [("left still", *metrics["still"].values())]
    rows += [(_name(row), *(row["error_mm"][c] for c in columns)) for row in metrics["test"]]
    return "\n\n".join(
        (
            f"Chosen on the validation subjects: {_name(metrics['chosen'])}.",
            _run.markdown(("test subjects, mm (normals: degrees)", *columns), rows),
            "Bare, over the face in one sequence of each test subject: one system {once:.3f} mm, the paper's system "
            "for each frame {per_frame:.3f} mm, {between_them:.3f} mm apart.".format(**metrics["per_frame"]),
            "One test subject, head: {original_head_mm:.3f} mm; its surface under another mesh, of {vertices} "
            "vertices: {head_mm:.3f} mm.".format(**metrics["remeshed"]),
        )
    )


if __name__ == "__main__":
    _run.main("rbf_warp", Config, run)
