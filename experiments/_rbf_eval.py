"""Faces, warp variants, remeshing and contact sheets of `experiments.rbf_warp`.

N vertices, F triangles, L landmarks, n meshes of a face; millimetres.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from experiments import _datasets, _motion_transfer
from facejax.data import dataset
from facejax.data.synthetic import makehuman, performance, rig
from facejax.geometry import rbf
from facejax.mesh import graph, rbf_weights
from facejax.viz import eyes_teeth, render

PEOPLE = (85, 102, 104, 111)  # validation and test subjects, 27 to 75 years old
FIGURE4_LABEL, FIGURE6_LABEL = "surprise", "anger"  # expressions of the sheets after figures 4 and 6 of SL21
PICTURE = (170, 212)  # pixels


class WarpVariant(NamedTuple):
    """A warp variant: options of `rbf.fit`, and whether `rbf_weights` adds the falloff and the lip split."""

    kernel: str
    sigma: float
    affine: bool
    falloff: bool
    lips: bool
    smoothing: float = 0.0

    @property
    def options(self) -> dict:
        """Return the options of `rbf.fit`."""
        return {"kernel": self.kernel, "sigma": self.sigma, "affine": self.affine, "smoothing": self.smoothing}


class Face(NamedTuple):
    """A subject's neutral face, and its true motion where known."""

    neutral: np.ndarray  # (N, 3)
    faces: np.ndarray  # (F, 3)
    marks: np.ndarray  # (L, 3) neutral landmarks
    factor: np.ndarray  # (N,) falloff
    share: np.ndarray  # (N,) share of the upper lip
    landmarks: np.ndarray  # (n, L, 3) displacements
    vertices: np.ndarray  # (n, N, 3) displacements


def region_indices(data: dataset.Dataset) -> dict[str, np.ndarray]:
    """Return vertex indices of the head, the face and, on makehuman4d, of the boundary loops (rims)."""
    found = {name: np.flatnonzero(mask) for name, mask in _datasets.region_masks(data).items()}
    if not _datasets.is_makehuman(data):
        return found
    shape = makehuman.template()
    loops = graph.boundary_loops(shape.faces)
    neck, mouth, *eyes = sorted(loops, key=lambda loop: shape.vertices[loop, 1].mean())
    return found | {"neck rim": neck, "mouth rim": mouth, "eye rims": np.concatenate(eyes)}


def neutral_face(neutral: np.ndarray, faces: np.ndarray, marks: np.ndarray) -> Face:
    """Return a neutral face with its warp weights and no motion."""
    rbf_weights.check(marks, neutral)
    factor = rbf_weights.falloff(neutral, faces, marks)
    share = rbf_weights.upper_lip_share(neutral, faces, marks, rbf_weights.IBUG_LIPS)
    return Face(neutral, faces, marks, factor, share, np.zeros((0, *marks.shape)), np.zeros((0, *neutral.shape)))


def warp_weights(form: WarpVariant, face: Face) -> np.ndarray:
    """Return the weights (N, L) of a variant for `rbf.warp`."""
    if form.lips:
        found = rbf_weights.split_lips(face.neutral, face.marks, rbf_weights.IBUG_LIPS, face.share, **form.options)
    else:
        found = rbf.weights(rbf.fit(face.marks, **form.options), face.neutral)
    return found * face.factor[:, None] if form.falloff else found


def remesh(face: Face, seed: int) -> Face:
    """Remesh a face: a random vertex in each old triangle, connected around the old vertices."""
    # Vertices near the sides of their triangle would fold the new triangles.
    mix = np.random.default_rng(seed).dirichlet(np.full(3, 60.0), len(face.faces))
    points, moved = (np.einsum("fc,...fcx->...fx", mix, x[..., face.faces, :]) for x in (face.neutral, face.vertices))
    # Directed edge -> its triangle, counter-clockwise.
    leaving = {(a, b): t for t, (p, q, r) in enumerate(face.faces.tolist()) for a, b in ((p, q), (q, r), (r, p))}
    triangles = []
    for v, ring in enumerate(graph.rings(face.faces, len(face.neutral))):
        first, *around = [leaving[v, other] for other in ring if (v, other) in leaving]
        triangles += [(first, a, b) for a, b in zip(around, around[1:], strict=False)]
    used, faces = np.unique(triangles, return_inverse=True)
    rest = neutral_face(points[used].astype(np.float32), faces.reshape(-1, 3).astype(np.int32), face.marks)
    return rest._replace(landmarks=face.landmarks, vertices=moved[:, used])


def sequence_sheet(data: dataset.Dataset, form: WarpVariant) -> np.ndarray:
    """Render landmarks over the neutral mesh, the warped and the true meshes of a sequence (SL21, figure 4)."""
    shown, take = _performed(data) if _datasets.is_makehuman(data) else _recorded(data)
    face, moved = _resting(data, take.rest), take.landmarks[take.at]
    rest = np.broadcast_to(face.neutral, take.vertices.shape)
    warped = face.neutral + np.asarray(rbf.warp(warp_weights(form, face), moved))
    rows = [
        _pictures(face, vertices, moved, dots=dots)
        for vertices, dots in ((rest, True), (warped, True), (take.vertices, False))
    ]
    labels = [f"frame {t + 1}" for t in shown]
    return render.contact_sheet(rows, row_labels=["landmarks", "warped", "true"], column_labels=labels)


def _performed(data: dataset.Dataset) -> tuple[np.ndarray, _motion_transfer.Take]:
    """Return seven frames of a performance by the first test subject of makehuman4d, and its meshes from the rig."""
    subject, spec = int(data.subjects("test")[0]), data.index["spec"]
    person = makehuman.subject(subject, seed=spec["seed"])
    take = performance.perform(FIGURE4_LABEL, subject, seed=spec["seed"])
    onset = np.linspace(0, take.apex_start, 5).round()
    shown = np.array([*onset, (take.apex_end + take.offset) // 2, take.offset], int)
    skin = rig.pose(rig.build(person, level=spec["level"]), take.weights[shown])[:, : len(person.vertices)]
    return shown, _motion_transfer.from_meshes(skin, person, data.landmark_index)


def _recorded(data: dataset.Dataset) -> tuple[np.ndarray, _motion_transfer.Take]:
    """Return up to seven frames with meshes of a test subject's recording."""
    take = _motion_transfer.from_sequence(data, _first(data))
    some = np.unique(np.linspace(0, len(take.at) - 1, 7).round().astype(int))
    return take.at[some], take._replace(at=take.at[some], vertices=take.vertices[some])


def _first(data: dataset.Dataset) -> dataset.Sequence:
    """Return the first test subject's recording of anger, else of another expression, that has meshes."""
    mine = [s for s in data.sequences if s.subject in data.subjects("test")[:1] and ">" not in s.label]
    for sequence in sorted(mine, key=lambda s: s.label != FIGURE6_LABEL):
        if len(_motion_transfer.from_sequence(data, sequence).at):
            return sequence
    raise ValueError(f"{data.path}: expected recordings with meshes of a test subject, found none")


def transfer_sheet(data: dataset.Dataset, form: WarpVariant, odd: Face) -> np.ndarray:
    """Render the motion of one test subject on other faces, one with different mesh connectivity (SL21, figure 6)."""
    sequence = _first(data)
    take = _motion_transfer.from_sequence(data, sequence)
    shown = np.array([*np.linspace(0, sequence.apex_start, 5).round(), (sequence.apex_end + sequence.offset) // 2], int)
    source = take.rest[data.landmark_index]
    people = PEOPLE if _datasets.is_makehuman(data) else data.subjects("test")[-4:]
    people = [i for i in people if i < len(data.neutral)]
    rows = []
    for face in [*(_resting(data, data.neutral[i]) for i in people), odd]:
        moved = take.landmarks[shown] * (_size(face.marks) / _size(source))
        warped = face.neutral + np.asarray(rbf.warp(warp_weights(form, face), moved))
        rows.append(_pictures(face, warped, moved, dots=False))
    names = [data.index["subjects"][i]["name"] for i in people] + [f"{len(odd.neutral):,} vertices"]
    return render.contact_sheet(rows, row_labels=names, column_labels=[f"frame {t + 1}" for t in shown])


def heat_sheet(data: dataset.Dataset, errors: dict[str, np.ndarray], *, high: float = 2.0) -> np.ndarray:
    """Render per-vertex errors (N,) in mm, by name, on the mean face from the front and from the side."""
    mean, faces, size = _datasets.template_vertices(data), np.asarray(data.faces), (240, 300)
    rows = [
        [
            render.image(
                mean, faces, size=size, colours=render.heat_colours(values, high=high),
                camera=render.fit_camera(mean, size=size, turn=turn),
            )
            for values in errors.values()
        ]
        for turn in (0, 60)
    ]  # fmt: skip
    return render.contact_sheet(rows, column_labels=[f"{name}, 0 to {high:g} mm" for name in errors])


def _resting(data: dataset.Dataset, neutral: np.ndarray) -> Face:
    neutral = np.asarray(neutral)
    return neutral_face(neutral, np.asarray(data.faces), neutral[data.landmark_index])


def _size(marks: np.ndarray) -> float:
    return float(np.linalg.norm(marks - marks.mean(axis=0)))


def _pictures(face: Face, vertices: np.ndarray, moved: np.ndarray, *, dots: bool) -> np.ndarray:
    """Render frames (T, N, 3) with eyes and teeth that follow the landmark displacements (T, L, 3)."""
    shape = makehuman.template()
    props = eyes_teeth.Props(shape.vertices[shape.landmarks], *makehuman.template_props())
    marks = (face.marks + moved).astype(np.float32)
    return render.frames(
        vertices,
        face.faces,
        size=PICTURE,
        camera=render.fit_camera(face.neutral * 1.04, size=PICTURE, turn=18),
        landmarks=marks if dots else None,
        extras=eyes_teeth.parts(props, face.marks, marks),
    )
