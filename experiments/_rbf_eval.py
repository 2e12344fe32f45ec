"""What `experiments.rbf_warp` judges and draws: faces, ways to warp them, a head of another connectivity, pictures."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from experiments import _datasets, _motion_transfer
from facejax.data import dataset
from facejax.data.synthetic import makehuman, performance, rig
from facejax.geometry import rbf
from facejax.mesh import graph, rbf_weights
from facejax.viz import eyes_teeth, render

PEOPLE = (85, 102, 104, 111)  # of the validation and test subjects: 27 to 75 years old
SEQUENCE, PAPERS = "surprise", "anger"  # of the picture after figure 4, and of the one after figure 6
PICTURE = (170, 212)


class Form(NamedTuple):
    """A way to warp: options of `rbf.fit`, and what `attachment.weights` adds."""

    kernel: str
    sigma: float
    affine: bool
    falloff: bool
    lips: bool
    smoothing: float = 0.0

    @property
    def options(self) -> dict:
        """Those of `rbf.fit`."""
        return {"kernel": self.kernel, "sigma": self.sigma, "affine": self.affine, "smoothing": self.smoothing}


class Face(NamedTuple):
    """A subject at rest, and its true motion if that is known."""

    neutral: np.ndarray  # (N, 3)
    faces: np.ndarray  # (F, 3)
    marks: np.ndarray  # (L, 3) landmarks at rest
    factor: np.ndarray  # (N,) falloff
    share: np.ndarray  # (N,) of the upper lip
    landmarks: np.ndarray  # (n, L, 3) displacements
    vertices: np.ndarray  # (n, N, 3) displacements


def regions_of(data: dataset.Dataset) -> dict[str, np.ndarray]:
    """Vertices of the head, of the face region, and on makehuman4d of the boundary's loops."""
    found = {name: np.flatnonzero(mask) for name, mask in _datasets.regions_of(data).items()}
    if not _datasets.is_makehuman(data):
        return found
    shape = makehuman.template()
    loops = graph.boundary_loops(shape.faces)
    neck, mouth, *eyes = sorted(loops, key=lambda loop: shape.vertices[loop, 1].mean())
    return found | {"neck rim": neck, "mouth rim": mouth, "eye rims": np.concatenate(eyes)}


def still(neutral: np.ndarray, faces: np.ndarray, marks: np.ndarray) -> Face:
    """A face at rest, with no motion."""
    rbf_weights.check(marks, neutral)
    factor = rbf_weights.falloff(neutral, faces, marks)
    share = rbf_weights.upper_lip_share(neutral, faces, marks, rbf_weights.IBUG_LIPS)
    return Face(neutral, faces, marks, factor, share, np.zeros((0, *marks.shape)), np.zeros((0, *neutral.shape)))


def weights(form: Form, face: Face) -> np.ndarray:
    """(N, L) for `rbf.warp`: those of `attachment.weights`, or with less of what it adds."""
    if form.lips:
        found = rbf_weights.split_lips(face.neutral, face.marks, rbf_weights.IBUG_LIPS, face.share, **form.options)
    else:
        found = rbf.weights(rbf.fit(face.marks, **form.options), face.neutral)
    return found * face.factor[:, None] if form.falloff else found


def remeshed(face: Face, seed: int) -> Face:
    """The same surface under another mesh: a point somewhere in each old triangle, joined around the old vertices."""
    # Not too near its sides: the new triangles would fold.
    mix = np.random.default_rng(seed).dirichlet(np.full(3, 60.0), len(face.faces))
    points, moved = (np.einsum("fc,...fcx->...fx", mix, x[..., face.faces, :]) for x in (face.neutral, face.vertices))
    # The triangle that leaves a vertex towards another, counter-clockwise.
    leaving = {(a, b): t for t, (p, q, r) in enumerate(face.faces.tolist()) for a, b in ((p, q), (q, r), (r, p))}
    triangles = []
    for v, ring in enumerate(graph.rings(face.faces, len(face.neutral))):
        first, *around = [leaving[v, other] for other in ring if (v, other) in leaving]
        triangles += [(first, a, b) for a, b in zip(around, around[1:], strict=False)]
    used, faces = np.unique(triangles, return_inverse=True)
    rest = still(points[used].astype(np.float32), faces.reshape(-1, 3).astype(np.int32), face.marks)
    return rest._replace(landmarks=face.landmarks, vertices=moved[:, used])


def sequence(data: dataset.Dataset, form: Form) -> np.ndarray:
    """After SL21's figure 4: landmarks over a mesh at rest, the meshes that they make of it, and the true ones."""
    shown, take = _performed(data) if _datasets.is_makehuman(data) else _recorded(data)
    face, moved = _resting(data, take.rest), take.landmarks[take.at]
    rest = np.broadcast_to(face.neutral, take.vertices.shape)
    warped = face.neutral + np.asarray(rbf.warp(weights(form, face), moved))
    rows = [
        _pictures(face, vertices, moved, dots=dots)
        for vertices, dots in ((rest, True), (warped, True), (take.vertices, False))
    ]
    labels = [f"frame {t + 1}" for t in shown]
    return render.contact_sheet(rows, row_labels=["landmarks", "warped", "true"], column_labels=labels)


def _performed(data: dataset.Dataset) -> tuple[np.ndarray, _motion_transfer.Take]:
    """Seven frames of the first test subject's surprise, on makehuman4d; its rig makes their meshes."""
    subject, spec = int(data.subjects("test")[0]), data.index["spec"]
    person = makehuman.subject(subject, seed=spec["seed"])
    take = performance.perform(SEQUENCE, subject, seed=spec["seed"])
    onset = np.linspace(0, take.apex_start, 5).round()
    shown = np.array([*onset, (take.apex_end + take.offset) // 2, take.offset], int)
    skin = rig.pose(rig.build(person, level=spec["level"]), take.weights[shown])[:, : len(person.vertices)]
    return shown, _motion_transfer.of_skin(skin, person, data.landmark_index)


def _recorded(data: dataset.Dataset) -> tuple[np.ndarray, _motion_transfer.Take]:
    """Up to seven frames that have meshes, of a test subject's first recording."""
    take = _motion_transfer.of_sequence(data, _first(data))
    some = np.unique(np.linspace(0, len(take.at) - 1, 7).round().astype(int))
    return take.at[some], take._replace(at=take.at[some], vertices=take.vertices[some])


def _first(data: dataset.Dataset) -> dataset.Sequence:
    """The first test subject's anger, or another expression of which there are meshes."""
    mine = [s for s in data.sequences if s.subject in data.subjects("test")[:1] and ">" not in s.label]
    for sequence in sorted(mine, key=lambda s: s.label != PAPERS):
        if len(_motion_transfer.of_sequence(data, sequence).at):
            return sequence
    raise ValueError(f"{data.path}: expected recordings of a test subject with meshes")


def others(data: dataset.Dataset, form: Form, odd: Face) -> np.ndarray:
    """After SL21's figure 6: the anger of one test subject on other faces, one of another connectivity."""
    sequence = _first(data)
    take = _motion_transfer.of_sequence(data, sequence)
    shown = np.array([*np.linspace(0, sequence.apex_start, 5).round(), (sequence.apex_end + sequence.offset) // 2], int)
    source = take.rest[data.landmark_index]
    people = PEOPLE if _datasets.is_makehuman(data) else data.subjects("test")[-4:]
    people = [i for i in people if i < len(data.neutral)]
    rows = []
    for face in [*(_resting(data, data.neutral[i]) for i in people), odd]:
        moved = take.landmarks[shown] * (_size(face.marks) / _size(source))
        warped = face.neutral + np.asarray(rbf.warp(weights(form, face), moved))
        rows.append(_pictures(face, warped, moved, dots=False))
    names = [data.index["subjects"][i]["name"] for i in people] + [f"{len(odd.neutral):,} vertices"]
    return render.contact_sheet(rows, row_labels=names, column_labels=[f"frame {t + 1}" for t in shown])


def heat(data: dataset.Dataset, errors: dict[str, np.ndarray], *, high: float = 2.0) -> np.ndarray:
    """Errors (N,) by name on the average face, from the front and from the side; mm."""
    mean, faces, size = _datasets.template_of(data), np.asarray(data.faces), (240, 300)
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
    return still(neutral, np.asarray(data.faces), neutral[data.landmark_index])


def _size(marks: np.ndarray) -> float:
    return float(np.linalg.norm(marks - marks.mean(axis=0)))


def _pictures(face: Face, vertices: np.ndarray, moved: np.ndarray, *, dots: bool) -> np.ndarray:
    """Frames (T, N, 3) with eyes and teeth that follow the landmarks' displacements (T, L, 3)."""
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
