"""What `experiments.rbf_warp` judges and draws: faces, ways to warp them, a head of another connectivity, pictures."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from facejax.data import makehuman, performance, rig, store
from facejax.geometry import rbf
from facejax.io import dress, render
from facejax.mesh import attachment, graph

PEOPLE = (85, 102, 104, 111)  # of the validation and test subjects: 27 to 75 years old
SEQUENCE = "surprise"  # of the picture after figure 4; the one after figure 6 shows the paper's, anger
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


def still(neutral: np.ndarray, faces: np.ndarray, marks: np.ndarray) -> Face:
    """A face at rest, with no motion."""
    attachment.check(marks, neutral)
    factor = attachment.falloff(neutral, faces, marks)
    share = attachment.side(neutral, faces, marks, attachment.IBUG_LIPS)
    return Face(neutral, faces, marks, factor, share, np.zeros((0, *marks.shape)), np.zeros((0, *neutral.shape)))


def weights(form: Form, face: Face) -> np.ndarray:
    """(N, L) for `rbf.warp`: those of `attachment.weights`, or with less of what it adds."""
    if form.lips:
        found = attachment.parted(face.neutral, face.marks, attachment.IBUG_LIPS, face.share, **form.options)
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


def sequence(data: store.Store, form: Form) -> np.ndarray:
    """After SL21's figure 4: landmarks over a mesh at rest, the meshes that they make of it, and the true ones."""
    subject, spec = int(data.subjects("test")[0]), data.index["spec"]
    person = makehuman.subject(subject, seed=spec["seed"])
    face = _person(person)
    take = performance.perform(SEQUENCE, subject, seed=spec["seed"])
    onset = np.linspace(0, take.apex_start, 5).round()
    shown = np.array([*onset, (take.apex_end + take.offset) // 2, take.offset], int)
    true = rig.pose(rig.build(person, level=spec["level"]), take.weights[shown])[:, : len(face.neutral)]
    moved = true[:, data.landmark_index] - face.marks
    rest = np.broadcast_to(face.neutral, true.shape)
    warped = face.neutral + np.asarray(rbf.warp(weights(form, face), moved))
    rows = [
        _pictures(face, vertices, moved, dots=dots) for vertices, dots in ((rest, True), (warped, True), (true, False))
    ]
    labels = [f"frame {t + 1}" for t in shown]
    return render.contact_sheet(rows, row_labels=["landmarks", "warped", "true"], column_labels=labels)


def others(data: store.Store, form: Form, odd: Face) -> np.ndarray:
    """After SL21's figure 6: the anger of one test subject on five other faces, one of another connectivity."""
    take = next(s for s in data.sequences if s.label == "anger" and s.subject == data.subjects("test")[0])
    source = data.neutral[take.subject][data.landmark_index]
    shown = np.array([*np.linspace(0, take.apex_start, 5).round(), (take.apex_end + take.offset) // 2], int)
    motion = data.landmarks[take.start + shown] - source
    people = [makehuman.subject(i, seed=data.index["spec"]["seed"]) for i in PEOPLE]
    rows = []
    for face in [*map(_person, people), odd]:
        moved = motion * (_size(face.marks) / _size(source))
        warped = face.neutral + np.asarray(rbf.warp(weights(form, face), moved))
        rows.append(_pictures(face, warped, moved, dots=False))
    names = [person.name for person in people] + [f"{len(odd.neutral):,} vertices"]
    return render.contact_sheet(rows, row_labels=names, column_labels=[f"frame {t + 1}" for t in shown])


def heat(errors: dict[str, np.ndarray], *, high: float = 2.0) -> np.ndarray:
    """Errors (N,) by name on the average face, from the front and from the side; mm."""
    shape, size = makehuman.template(), (240, 300)
    rows = [
        [
            render.image(
                shape.vertices, shape.faces, size=size, colours=render.heat(values, high=high),
                camera=render.aim(shape.vertices, size=size, turn=turn),
            )
            for values in errors.values()
        ]
        for turn in (0, 60)
    ]  # fmt: skip
    return render.contact_sheet(rows, column_labels=[f"{name}, 0 to {high:g} mm" for name in errors])


def _person(person: makehuman.Subject) -> Face:
    shape = makehuman.template()
    return still(person.vertices, shape.faces, person.vertices[shape.landmarks])


def _size(marks: np.ndarray) -> float:
    return float(np.linalg.norm(marks - marks.mean(axis=0)))


def _pictures(face: Face, vertices: np.ndarray, moved: np.ndarray, *, dots: bool) -> np.ndarray:
    """Frames (T, N, 3) with eyes and teeth that follow the landmarks' displacements (T, L, 3)."""
    shape = makehuman.template()
    props = dress.Props(shape.vertices[shape.landmarks], *makehuman.template_props())
    marks = (face.marks + moved).astype(np.float32)
    return render.frames(
        vertices,
        face.faces,
        size=PICTURE,
        camera=render.aim(face.neutral * 1.04, size=PICTURE, turn=18),
        landmarks=marks if dots else None,
        extras=dress.parts(props, face.marks, marks),
    )
