"""Raw scans of heads: read, registered, animated in their own vertices. Files in, files out.

V vertices of the scan, N of the template, L landmarks.
"""

from __future__ import annotations

import functools
import json
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

# The few landmarks that anybody can place, in this order where a file has seven and no names.
SEVEN = (
    "right eye outer corner", "right eye inner corner", "left eye inner corner", "left eye outer corner",
    "nose tip", "right lip corner", "left lip corner",
)  # fmt: skip
PEOPLE, PEOPLE_SEED = 400, 2**16  # of a population that no experiment uses
LEAST = 4
UNLIKE, COVERED, APART, OFF = 4.0, 0.7, 0.5, 3.0  # beyond which there is something to say of a fit
PICTURE = (360, 440)
RED = 2.0  # mm, where a picture of distances is darkest
SHOWN = ("scan", "template", f"distance, dark at {RED:g} mm")


class Scan(NamedTuple):
    """A head in no topology."""

    name: str
    vertices: np.ndarray  # (V, 3) float64 mm, in its own place
    faces: np.ndarray  # (F, 3)
    landmarks: np.ndarray  # (L, 3) mm
    which: np.ndarray  # (L,) of the 68
    unit: float  # millimetres of the file's unit
    notes: tuple[str, ...]


class BoundScan(NamedTuple):
    """A scan that moves with the template; millimetres, y up, z forward."""

    name: str
    neutral: np.ndarray  # (N, 3) float32, the template on the scan
    still: np.ndarray  # (V, 3) float32
    faces: np.ndarray  # (F, 3)
    hung: registration.Binding


@functools.cache
def people() -> registration.HeadModel:
    """The morphable model of MakeHuman's people at rest; some seconds."""
    template = makehuman.template()
    drawn = [makehuman.subject(i, seed=PEOPLE_SEED).vertices for i in range(PEOPLE)]
    return registration.fit_head_model(np.stack(drawn), template.faces, template.landmarks)


def read(path: Path, landmarks: Path) -> Scan:
    """A scan and its landmarks: 68, 66, 51 or 83 of a scheme, the `SEVEN`, or any that bear names of the 68.

    Raises `MeshError` or `LandmarkError`, naming the file.
    """
    mesh = io.load_mesh(path)
    if mesh.faces is None:
        raise MeshError(f"{path}: has no triangles, nothing to register")
    found = io.landmarks.read(landmarks, mesh.vertices, mesh.faces)
    which, kept, passed = _known(found, landmarks)
    points = found.points[kept]
    template = makehuman.template()
    wanted = template.vertices[template.landmarks[which]]
    try:
        _, size = canonical_frame.place(points, wanted)
        unit, name = canonical_frame.unit_of(size, str(path))
    except canonical_frame.FaceError as error:  # names the file
        raise MeshError(str(error)) from error
    except ValueError as error:
        raise MeshError(f"{path}: {error}") from error
    notes = [f"read as {name}"]
    if len(which) < 68:
        notes.append(f"{len(which)} of 68 landmarks are given, the others are estimated")
    if passed:
        notes.append(f"no landmarks' names, passed over: {', '.join(passed)}")
    return Scan(path.stem, mesh.vertices * unit, mesh.faces, points * unit, which, unit, tuple(notes))


def fit(scan: Scan) -> registration.Registration:
    """The template on the scan. Raises `MeshError` where landmarks and surface do not fit one another."""
    try:
        used, _, triangles = graph.weld(scan.vertices, scan.faces)
        found = registration.fit(people(), scan.vertices[used], triangles, scan.landmarks, scan.which)
    except ValueError as error:
        raise MeshError(f"{scan.name}: {error}") from error
    if found.matched.mean() < 0.2:
        raise MeshError(
            f"{scan.name}: only {found.matched.mean():.0%} of a head lies on it: are the landmarks of this mesh?"
        )
    return found


def save(scan: Scan, found: registration.Registration, out: Path) -> tuple[list[Path], tuple[str, ...]]:
    """What registration gives: the template on the scan, its 68 landmarks, how far it lies off, and a picture.

    The mesh and the landmarks are in the scan's own place and unit. The files, and what was assumed.
    """
    model = people()
    marks = found.vertices[model.landmark_index]
    hits = closest_point.closest_points(closest_point.surface(scan.vertices, scan.faces), marks)
    paths = [out / f"{scan.name}-{what}" for what in ("template.ply", "landmarks.json", "fit.json", "fit.png")]
    io.save(paths[0], found.vertices / scan.unit, model.faces)
    io.landmarks.write(paths[1], points=hits.points / scan.unit, names=schemes.by_count(68).points)
    record = measure(scan, found)
    with atomic.replace_file(paths[2]) as temporary:
        temporary.write_text(json.dumps(record, indent=1) + "\n")
    render.save(paths[3], render.contact_sheet([pictures(scan, found)], column_labels=SHOWN))
    return paths, scan.notes + describe(record)


def measure(scan: Scan, found: registration.Registration) -> dict[str, float]:
    """How well the template lies on a scan: distances in mm, the share of it that is matched, how unusual the face."""
    distance = found.distance[found.matched]
    off = np.linalg.norm(found.vertices[people().landmark_index[scan.which]] - scan.landmarks, axis=1)
    return {
        "mean_mm": float(distance.mean()),
        "percentile95_mm": float(np.percentile(distance, 95)),
        "matched": float(found.matched.mean()),
        "largest_coefficient": float(np.abs(found.coefficients).max()),
        "landmarks_given": len(scan.which),
        "landmarks_mm": float(off.mean()),
    }


def describe(record: dict[str, float]) -> tuple[str, ...]:
    """What to say of a registration."""
    notes = [f"{record['mean_mm']:.2f} mm from the scan in the mean, over the {record['matched']:.0%} that it covers"]
    if record["matched"] < COVERED:
        notes.append("the rest of the head is a guess: the scan has no surface there")
    if record["largest_coefficient"] > UNLIKE or record["mean_mm"] > APART:
        notes.append("this is unlike any head that the template knows: look at the picture of `facejax register`")
    if record["landmarks_mm"] > OFF:
        notes.append(f"the landmarks lie {record['landmarks_mm']:.1f} mm off in the mean: are they of this face?")
    return tuple(notes)


def pictures(scan: Scan, found: registration.Registration) -> list[np.ndarray]:
    """The scan, the template on it, and how far the two are apart (`SHOWN`), (height, width, 3) uint8 each."""
    model = people()
    there, placed = (x @ found.turn.T + found.move for x in (scan.vertices, found.vertices))
    camera = render.fit_camera(placed, size=PICTURE, turn=18)
    colours = render.heat_colours(np.where(found.matched, found.distance, 0.0), high=RED)
    return [
        render.image(there, scan.faces, size=PICTURE, camera=camera),
        render.image(placed, model.faces, size=PICTURE, camera=camera),
        render.image(placed, model.faces, size=PICTURE, camera=camera, colours=colours),
    ]


def bind_scan(scan: Scan) -> tuple[BoundScan, tuple[str, ...]]:
    """Register a scan, and hang it on the template, y up and z forward; and what there is to say of it."""
    found, faces_ = fit(scan), people().faces
    neutral, still = ((x @ found.turn.T + found.move).astype(np.float32) for x in (found.vertices, scan.vertices))
    hung = registration.bind(neutral, faces_, still, scan.faces)
    return BoundScan(scan.name, neutral, still, scan.faces, hung), scan.notes + describe(measure(scan, found))


def scene_of(models: pipeline.Models, worn: BoundScan, vertices: np.ndarray, marks: np.ndarray, labels, frames):
    """`results.scene_of` in the scan's own vertices: of the template's (T, N, 3) and landmarks (T, L, 3)."""
    rest = np.asarray(pipeline.neutral_landmarks(models, worn.neutral))
    moved = worn.still + registration.transfer_displacements(worn.hung, vertices - worn.neutral)
    extras = (
        eyes_teeth.parts(eyes_teeth.template(), rest, marks)
        if eyes_teeth.has_eye_holes(worn.still, worn.faces, rest)
        else ()
    )
    captions = pipeline.captions(labels, frames=frames)
    return scene.make(moved, worn.faces, captions=captions, landmarks=marks, extras=extras)


def _known(found: io.landmarks.Landmarks, path: Path) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """(K,) of the 68 that are known, (K,) which of the file's each is, and names that are unknown."""
    names, count = schemes.by_count(68).points, len(found.points)
    given = found.names if found.names is not None and set(found.names) & set(names) else None
    if given is None and count == len(SEVEN):
        given = SEVEN
    if given is not None:
        pairs = [(names.index(name), i) for i, name in enumerate(given) if name in names]
        if len({a for a, _ in pairs}) < len(pairs):
            raise io.landmarks.LandmarkError(f"{path}: a landmark's name comes twice")
        which, kept = np.array(pairs, np.int64).reshape(-1, 2).T
    else:
        try:
            which, kept = schemes.common(68, count)
        except ValueError as error:
            raise io.landmarks.LandmarkError(
                f"{path}: {error}; or {len(SEVEN)} ({', '.join(SEVEN)}), or any with names of the 68"
            ) from error
    if len(which) < LEAST:
        raise io.landmarks.LandmarkError(f"{path}: {len(which)} landmarks are known, expected {LEAST} or more")
    passed = [name for name in found.names or () if name not in names] if given is found.names else []
    return which, kept, passed
