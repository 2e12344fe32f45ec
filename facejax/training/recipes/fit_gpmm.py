"""Choosing the prior of the morphable model by cross-validation, and its answers on faces that it was not fitted to.

    found = fit_gpmm.fit(train, by="subjects")
    found.params           # fitted to all of `train` under the best prior
    found.held_out(train)  # for every mesh, what a model answers that never saw its person (or its label)

Hold out what will be new at test time: people, or expressions. Part of the choice is whether displacements are carried
from face to face, and how strong the smooth prior is; both can come out as none, which is ridge regression.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from facejax.data.mesh_subset import MeshSubset
from facejax.models.decoders import gpmm, linear

SMOOTHNESS_GRID = (0.0, 0.003, 0.01, 0.03, 0.06, 0.12, 0.25)
NOISE_GRID = (1e-8, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2)
FOLDS = 4
EVALUATED_PEOPLE = 12  # held-out people per fold, as many of their frames, and a quarter of the vertices: enough to choose by
EVALUATED_FRAMES = 24
MIN_RELATIVE_GAIN = 0.99  # a prior that is not plain has to be better by a hundredth


class FittedGPMM(NamedTuple):
    """The model, how it was chosen, and what it answers out of sample."""

    params: gpmm.GPMM
    errors_mm: dict[gpmm.Prior, float]  # held out, of every prior
    folds: tuple[tuple[gpmm.GPMM, np.ndarray], ...]  # models of part of the data, and the meshes (n,) held out

    def held_out(self, train: MeshSubset) -> np.ndarray:
        """Displacements (G, N, 3) float32 of all meshes of `train`, each by the model that did not see it."""
        found = np.empty((train.count, *self.params.face.shape), np.float32)
        for params, rows in self.folds:
            for subject in np.unique(train.owner[rows]):
                mine = rows[train.owner[rows] == subject]
                found[mine] = _answer(gpmm.linear_map(params, train.data.neutral[subject]), train.read(mine)[0])
        return found


class _People(NamedTuple):
    """Meshes by person, again and again."""

    meshes: MeshSubset

    def __iter__(self) -> Iterator[gpmm.Person]:
        return (gpmm.Person(*self.meshes.person(subject)) for subject in self.meshes.subjects)


def fit(
    train: MeshSubset,
    *,
    by: str = "subjects",
    carried: Sequence[bool] = (False, True),
    components: int = gpmm.COMPONENTS,
) -> FittedGPMM:
    """Choose and fit. `carried` narrows the choice: `(False,)` where faces are not to be compared.

    The folds are fitted to every second mesh, with fewer components: they decide, and serve the training of what comes
    after.
    """
    of = train.groups(by)
    names = np.unique(of)
    if len(names) < 2:
        raise ValueError(f"expected meshes of two or more {by}, got {len(names)}")
    held = [np.flatnonzero(np.isin(of, part)) for part in np.array_split(names, min(FOLDS, len(names)))]
    faces, at = np.asarray(train.data.faces), np.asarray(train.data.landmark_index)
    face, hold = gpmm.mean_face_and_motion(_People(train))
    errors, models, learnt = {}, {}, {}
    for kind in carried:
        learnt[kind] = _Carried(train, _carried(train, faces, face, hold) if kind else None)
        total, models[kind] = 0.0, []
        for rows in held:
            fit_on = np.setdiff1d(np.arange(train.count), rows)[::2]
            _, motion = gpmm.mean_face_and_motion(_People(train.rows(fit_on)))
            known = gpmm.fit_statistics(
                learnt[kind].only(fit_on), carried=kind, components=max(1, 3 * components // 4), passes=2
            )
            params = gpmm.GPMM(faces, at, face, motion, hold, known, gpmm.Prior(kind))
            models[kind].append((params, rows))
            total = total + _errors(params, train, rows)
        errors |= dict(zip(_priors(kind), (total / len(held)).tolist(), strict=True))
    prior = _best(errors)
    folded = tuple((params._replace(prior=prior), rows) for params, rows in models[prior.carried])
    known = gpmm.fit_statistics(learnt[prior.carried], carried=prior.carried, components=components)
    return FittedGPMM(gpmm.GPMM(faces, at, face, hold, hold, known, prior), errors, folded)


class _Carried(NamedTuple):
    """Meshes with other displacements in their place: iterated again and again."""

    meshes: MeshSubset
    moved: np.ndarray | None  # (G, N, 3); None: their own

    def __iter__(self):
        first = 0
        for landmarks, vertices in self.meshes:
            yield landmarks, vertices if self.moved is None else self.moved[first : first + len(vertices)]
            first += len(vertices)

    def only(self, rows: np.ndarray) -> _Carried:
        return _Carried(self.meshes.rows(rows), None if self.moved is None else self.moved[rows])


def _carried(train: MeshSubset, faces: np.ndarray, face: np.ndarray, hold: np.ndarray) -> np.ndarray:
    """All displacements (G, N, 3) on the mean face, in float32: 40 KB a mesh of 3,260 vertices."""
    found = np.empty((train.count, *face.shape), np.float32)
    for subject, person in zip(train.subjects, _People(train), strict=True):
        found[train.owner == subject] = gpmm.transfer_to(person, faces, face, hold)
    return found


def _priors(carried: bool) -> list[gpmm.Prior]:
    return [gpmm.Prior(carried, smooth, noise) for smooth in SMOOTHNESS_GRID for noise in NOISE_GRID]


def _errors(params: gpmm.GPMM, train: MeshSubset, rows: np.ndarray) -> np.ndarray:
    """Mean vertex distance in mm of some held-out people's frames, under each prior."""
    rng = np.random.default_rng(0)
    everybody = np.unique(train.owner[rows])
    chosen = np.sort(rng.permutation(everybody)[:EVALUATED_PEOPLE])
    only = np.union1d(rng.permutation(len(params.face))[: len(params.face) // 4], params.landmark_index)
    total, count = 0.0, 0
    for subject in chosen:
        mine = rows[train.owner[rows] == subject]
        landmarks, vertices = train.read(np.sort(rng.permutation(mine)[:EVALUATED_FRAMES]))
        known = gpmm.covariances(params, train.data.neutral[subject], vertex_index=only)
        off = [gpmm.predict(known, prior, landmarks) - vertices[:, only] for prior in _priors(params.prior.carried)]
        total = total + np.array([np.linalg.norm(one, axis=-1).mean(axis=-1).sum() for one in off])
        count += len(vertices)
    return total / count


def _answer(map_: linear.LinearMap, landmarks: np.ndarray) -> np.ndarray:
    return np.asarray(linear.apply(map_, landmarks))


def _best(errors: dict[gpmm.Prior, float]) -> gpmm.Prior:
    """The least error, but the simpler of two nearly alike: plain before carried, no smooth prior before one."""
    best = min(errors, key=errors.get)
    for simpler in (lambda p: not p.carried and p.smooth == 0, lambda p: not p.carried, lambda p: p.smooth == 0):
        some = {prior: error for prior, error in errors.items() if simpler(prior)}
        if some:
            least = min(some, key=some.get)
            if some[least] * MIN_RELATIVE_GAIN <= errors[best]:
                return least
    return best
