"""Raw scans of heads: read, register, and animate them in their own vertices.

V vertices of the scan, N of the template, L landmarks; millimetres.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from facejax import io
from facejax.data.synthetic import makehuman
from facejax.inference import pipeline, registration
from facejax.io import atomic
from facejax.io.meshes import MeshError
from facejax.landmarks import canonical_frame, schemes
from facejax.mesh import closest_point, graph
from facejax.viz import eyes_teeth, render, scene

# The order of a file of seven landmarks without names: points that are easy to place by hand.
SEVEN_LANDMARKS = (
    "right eye outer corner", "right eye inner corner", "left eye inner corner", "left eye outer corner",
    "nose tip", "right lip corner", "left lip corner",
)  # fmt: skip
PEOPLE, PEOPLE_SEED = 400, 2**16  # of the head model; no experiment uses this seed
MIN_LANDMARKS = 4
# A fit is reported as doubtful beyond these values.
MAX_COEFFICIENT = 4.0  # standard deviations
MIN_MATCHED = 0.7  # of the template's vertices
MAX_MEAN_MM = 0.5  # from the scan
MAX_LANDMARK_MM = 3.0
PICTURE_SIZE = (360, 440)
MAX_SHOWN_MM = 2.0  # the darkest colour of the picture of distances
PICTURE_LABELS = ("scan", "template", f"distance, dark at {MAX_SHOWN_MM:g} mm")


class Scan(NamedTuple):
    """A scan of a head in any topology, and its landmarks."""

    name: str
    vertices: np.ndarray  # (V, 3) float64 mm, in the file's frame
    faces: np.ndarray  # (F, 3)
    landmarks: np.ndarray  # (L, 3) mm
    scheme_index: np.ndarray  # (L,) which of the 68 landmarks each is
    unit: float  # of the file, in millimetres
    notes: tuple[str, ...]


class BoundScan(NamedTuple):
    """A scan whose vertices follow the template; millimetres, y up, z forward."""

    name: str
    neutral: np.ndarray  # (N, 3) float32, the registered template
    rest: np.ndarray  # (V, 3) float32, the scan at rest
    faces: np.ndarray  # (F, 3)
    binding: registration.Binding


@functools.cache
def head_model() -> registration.HeadModel:
    """Return the PCA model of MakeHuman heads at rest; takes some seconds."""
    template = makehuman.template()
    drawn = [makehuman.subject(i, seed=PEOPLE_SEED).vertices for i in range(PEOPLE)]
    return registration.fit_head_model(np.stack(drawn), template.faces, template.landmarks)


def read(path: Path, landmarks: Path) -> Scan:
    """Read a scan and its landmarks: 68, 66, 51 or 83 of a scheme, `SEVEN_LANDMARKS`, or any with names of the 68.

    Raises:
      MeshError: the mesh is damaged, has no triangles, an unknown unit, or landmarks that do not form a face.
      LandmarkError: the landmarks are damaged or unknown.
    """
    mesh = io.load_mesh(path)
    if mesh.faces is None:
        raise MeshError(f"{path}: has no triangles; expected a mesh with faces")
    found = io.landmarks.read(landmarks, mesh.vertices, mesh.faces)
    scheme_index, kept, ignored = _known(found, landmarks)
    points = found.points[kept]
    template = makehuman.template()
    wanted = template.vertices[template.landmarks[scheme_index]]
    try:
        _, size = canonical_frame.align_to_template(points, wanted)
        unit, name = canonical_frame.infer_unit(size, str(path))
    except canonical_frame.FaceError as error:  # names the file
        raise MeshError(str(error)) from error
    except ValueError as error:
        raise MeshError(f"{path}: {error}") from error
    notes = [f"read as {name}"]
    if len(scheme_index) < 68:
        notes.append(f"{len(scheme_index)} of 68 landmarks are given, the others are estimated")
    if ignored:
        notes.append(f"ignored landmarks with unknown names: {', '.join(ignored)}")
    return Scan(path.stem, mesh.vertices * unit, mesh.faces, points * unit, scheme_index, unit, tuple(notes))


def fit(scan: Scan) -> registration.Registration:
    """Register the template to a scan. Raises `MeshError` where landmarks and surface do not belong together."""
    try:
        used, _, triangles = graph.weld(scan.vertices, scan.faces)
        found = registration.fit(head_model(), scan.vertices[used], triangles, scan.landmarks, scan.scheme_index)
    except ValueError as error:
        raise MeshError(f"{scan.name}: {error}") from error
    if found.matched.mean() < 0.2:
        raise MeshError(
            f"{scan.name}: only {found.matched.mean():.0%} of the template matches: do the landmarks belong to it?"
        )
    return found


def save(scan: Scan, found: registration.Registration, out: Path) -> tuple[list[Path], tuple[str, ...]]:
    """Write the registered template, its 68 landmarks, a record of distances, and a picture.

    Mesh and landmarks are in the scan's frame and unit. Return the files, and notes on what was assumed.
    """
    model = head_model()
    marks = found.vertices[model.landmark_index]
    hits = closest_point.closest_points(closest_point.surface(scan.vertices, scan.faces), marks)
    paths = [out / f"{scan.name}-{what}" for what in ("template.ply", "landmarks.json", "fit.json", "fit.png")]
    io.save(paths[0], found.vertices / scan.unit, model.faces)
    io.landmarks.write(paths[1], points=hits.points / scan.unit, names=schemes.by_count(68).points)
    record = measure(scan, found)
    with atomic.replace_file(paths[2]) as temporary:
        temporary.write_text(json.dumps(record, indent=1) + "\n")
    render.save(paths[3], render.contact_sheet([fit_pictures(scan, found)], column_labels=PICTURE_LABELS))
    return paths, scan.notes + describe(record)


def measure(scan: Scan, found: registration.Registration) -> dict[str, float]:
    """Return how well the template fits a scan: distances in mm, fraction matched, largest coefficient."""
    distance = found.distance[found.matched]
    off = np.linalg.norm(found.vertices[head_model().landmark_index[scan.scheme_index]] - scan.landmarks, axis=1)
    return {
        "mean_mm": float(distance.mean()),
        "percentile95_mm": float(np.percentile(distance, 95)),
        "matched": float(found.matched.mean()),
        "largest_coefficient": float(np.abs(found.coefficients).max()),
        "landmarks_given": len(scan.scheme_index),
        "landmarks_mm": float(off.mean()),
    }


def describe(record: dict[str, float]) -> tuple[str, ...]:
    """Return notes on the quality of a registration."""
    notes = [f"mean distance to the scan {record['mean_mm']:.2f} mm, over the {record['matched']:.0%} that it covers"]
    if record["matched"] < MIN_MATCHED:
        notes.append("the rest of the head is extrapolated: the scan has no surface there")
    if record["largest_coefficient"] > MAX_COEFFICIENT or record["mean_mm"] > MAX_MEAN_MM:
        notes.append("unusual for the head model: check the picture that `facejax register` writes")
    if record["landmarks_mm"] > MAX_LANDMARK_MM:
        notes.append(f"mean landmark distance {record['landmarks_mm']:.1f} mm: are the landmarks of this face?")
    return tuple(notes)


def fit_pictures(scan: Scan, found: registration.Registration) -> list[np.ndarray]:
    """Return pictures (`PICTURE_LABELS`) of the scan, the template, and their distance, (height, width, 3) uint8."""
    model = head_model()
    scanned, placed = (x @ found.rotation.T + found.translation for x in (scan.vertices, found.vertices))
    camera = render.fit_camera(placed, size=PICTURE_SIZE, turn=18)
    colours = render.heat_colours(np.where(found.matched, found.distance, 0.0), high=MAX_SHOWN_MM)
    return [
        render.image(scanned, scan.faces, size=PICTURE_SIZE, camera=camera),
        render.image(placed, model.faces, size=PICTURE_SIZE, camera=camera),
        render.image(placed, model.faces, size=PICTURE_SIZE, camera=camera, colours=colours),
    ]


def bind_scan(scan: Scan) -> tuple[BoundScan, tuple[str, ...]]:
    """Register a scan and bind it to the template, y up and z forward; return notes as well."""
    found, faces = fit(scan), head_model().faces
    neutral, rest = (
        (x @ found.rotation.T + found.translation).astype(np.float32) for x in (found.vertices, scan.vertices)
    )
    binding = registration.bind(neutral, faces, rest, scan.faces)
    return BoundScan(scan.name, neutral, rest, scan.faces, binding), scan.notes + describe(measure(scan, found))


def scene_of(
    models: pipeline.Models,
    bound: BoundScan,
    vertices: np.ndarray,
    marks: np.ndarray,
    labels: Sequence[str],
    frames: int | Sequence[int],
) -> scene.Scene:
    """Return an animation of a bound scan that follows the template's vertices (T, N, 3) and landmarks (T, L, 3)."""
    rest = np.asarray(pipeline.neutral_landmarks(models, bound.neutral))
    moved = bound.rest + registration.transfer_displacements(bound.binding, vertices - bound.neutral)
    extras = (
        eyes_teeth.parts(eyes_teeth.template(), rest, marks)
        if eyes_teeth.has_eye_holes(bound.rest, bound.faces, rest)
        else ()
    )
    captions = pipeline.captions(labels, frames=frames)
    return scene.make(moved, bound.faces, captions=captions, landmarks=marks, extras=extras)


def _known(found: io.landmarks.Landmarks, path: Path) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Return which of the 68 are known (K,), their rows in the file (K,), and the file's unknown names."""
    names, count = schemes.by_count(68).points, len(found.points)
    given = found.names if found.names is not None and set(found.names) & set(names) else None
    if given is None and count == len(SEVEN_LANDMARKS):
        given = SEVEN_LANDMARKS
    if given is not None:
        pairs = [(names.index(name), i) for i, name in enumerate(given) if name in names]
        if len({a for a, _ in pairs}) < len(pairs):
            raise io.landmarks.LandmarkError(f"{path}: duplicate landmark name")
        scheme_index, kept = np.array(pairs, np.int64).reshape(-1, 2).T
    else:
        try:
            scheme_index, kept = schemes.common(68, count)
        except ValueError as error:
            raise io.landmarks.LandmarkError(
                f"{path}: {error}; or {len(SEVEN_LANDMARKS)}: {', '.join(SEVEN_LANDMARKS)}; or any with names of the 68"
            ) from error
    if len(scheme_index) < MIN_LANDMARKS:
        raise io.landmarks.LandmarkError(
            f"{path}: {len(scheme_index)} landmarks with known names, expected {MIN_LANDMARKS} or more"
        )
    ignored = [name for name in found.names or () if name not in names] if given is found.names else []
    return scheme_index, kept, ignored
