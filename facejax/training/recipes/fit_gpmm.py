"""Fit the GPMM with its prior chosen by cross-validation, and predict held-out faces.

    found = fit_gpmm.fit(train, by="subjects")
    found.params           # fitted to all of `train` under the best prior
    found.held_out(train)  # for every mesh, the prediction of a model fitted without its person (or its label)

Hold out what will be new at test time: people, or expressions. The choice includes whether statistics are transferred
from face to face, and the strength of the smooth prior; without both the model is ridge regression.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from facejax.data.mesh_subset import MeshSubset
from facejax.models.decoders import gpmm, gpmm_fit, linear

SMOOTHNESS_GRID = (0.0, 0.003, 0.01, 0.03, 0.06, 0.12, 0.25)
NOISE_GRID = (1e-8, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2)
FOLDS = 4
EVALUATED_PEOPLE = 12  # held-out people per fold; errors are measured at a quarter of the vertices
EVALUATED_FRAMES = 24
MIN_RELATIVE_GAIN = 0.99  # a more complex prior must lower the error by 1 %


class FittedGPMM(NamedTuple):
    """The model, the cross-validation errors, and the models of the folds."""

    params: gpmm.GPMM
    errors_mm: dict[gpmm.Prior, float]  # held-out error of every prior
    folds: tuple[tuple[gpmm.GPMM, np.ndarray], ...]  # models of part of the data, and the meshes (n,) held out

    def held_out(self, train: MeshSubset) -> np.ndarray:
        """Return displacements (G, N, 3) float32 of all meshes, each predicted by the model that held it out."""
        found = np.empty((train.count, *self.params.face.shape), np.float32)
        for params, rows in self.folds:
            for subject in np.unique(train.owner[rows]):
                mine = rows[train.owner[rows] == subject]
                found[mine] = _predict(gpmm.linear_map(params, train.data.neutral[subject]), train.read(mine)[0])
        return found


@dataclasses.dataclass(frozen=True)
class _People:
    """Meshes by person; can be iterated repeatedly."""

    meshes: MeshSubset

    def __iter__(self) -> Iterator[gpmm_fit.Person]:
        return (gpmm_fit.Person(*self.meshes.person(subject)) for subject in self.meshes.subjects)


def fit(
    train: MeshSubset,
    *,
    by: str = "subjects",
    carried: Sequence[bool] = (False, True),
    components: int = gpmm_fit.COMPONENTS,
) -> FittedGPMM:
    """Choose the prior and fit the model.

    The models of the folds are fitted to every second mesh, with fewer components: they serve for the choice, and for
    training the residual decoder.

    Args:
      by: what is held out, "subjects" or "labels".
      carried: values of `Prior.carried` to try; `(False,)` excludes deformation transfer.
      components: of the GPMM.

    Raises:
      ValueError: fewer than two groups to hold out.
    """
    of = train.groups(by)
    names = np.unique(of)
    if len(names) < 2:
        raise ValueError(f"expected meshes of two or more {by}, got {len(names)}")
    held = [np.flatnonzero(np.isin(of, part)) for part in np.array_split(names, min(FOLDS, len(names)))]
    faces, at = np.asarray(train.data.faces), np.asarray(train.data.landmark_index)
    face, overall_motion = gpmm_fit.mean_face_and_motion(_People(train))
    errors, models, learnt = {}, {}, {}
    for kind in carried:
        learnt[kind] = _Displacements(train, _transfer(train, faces, face, overall_motion) if kind else None)
        total, models[kind] = np.zeros(()), []
        for rows in held:
            fit_on = np.setdiff1d(np.arange(train.count), rows)[::2]
            _, motion = gpmm_fit.mean_face_and_motion(_People(train.rows(fit_on)))
            known = gpmm_fit.fit_statistics(
                learnt[kind].only(fit_on), carried=kind, components=max(1, 3 * components // 4), passes=2
            )
            params = gpmm_fit.assemble(
                known, gpmm.Prior(kind), faces, at, face=face, motion=motion, hold=overall_motion
            )
            models[kind].append((params, rows))
            total = total + _errors(params, train, rows)
        errors |= dict(zip(_priors(kind), (total / len(held)).tolist(), strict=True))
    prior = _best(errors)
    folded = tuple((gpmm_fit.with_prior(params, prior), rows) for params, rows in models[prior.carried])
    known = gpmm_fit.fit_statistics(learnt[prior.carried], carried=prior.carried, components=components)
    params = gpmm_fit.assemble(known, prior, faces, at, face=face, motion=overall_motion, hold=overall_motion)
    return FittedGPMM(params, errors, folded)


@dataclasses.dataclass(frozen=True)
class _Displacements:
    """Meshes, optionally with their displacements replaced; can be iterated repeatedly."""

    meshes: MeshSubset
    moved: np.ndarray | None  # (G, N, 3); None: their own

    def __iter__(self) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        first = 0
        for landmarks, vertices in self.meshes:
            yield landmarks, vertices if self.moved is None else self.moved[first : first + len(vertices)]
            first += len(vertices)

    def only(self, rows: np.ndarray) -> _Displacements:
        return _Displacements(self.meshes.rows(rows), None if self.moved is None else self.moved[rows])


def _transfer(train: MeshSubset, faces: np.ndarray, face: np.ndarray, overall_motion: np.ndarray) -> np.ndarray:
    """Return all displacements (G, N, 3) on the mean face in float32: 40 KB per mesh of 3,260 vertices."""
    found = np.empty((train.count, *face.shape), np.float32)
    for subject, person in zip(train.subjects, _People(train), strict=True):
        found[train.owner == subject] = gpmm_fit.transfer_to(person, faces, face, overall_motion)
    return found


def _priors(carried: bool) -> list[gpmm.Prior]:
    return [gpmm.Prior(carried, smooth, noise) for smooth in SMOOTHNESS_GRID for noise in NOISE_GRID]


def _errors(params: gpmm.GPMM, train: MeshSubset, rows: np.ndarray) -> np.ndarray:
    """Return the mean vertex distance in mm of some held-out people's frames, under each prior."""
    rng = np.random.default_rng(0)
    everybody = np.unique(train.owner[rows])
    chosen = np.sort(rng.permutation(everybody)[:EVALUATED_PEOPLE])
    only = np.union1d(rng.permutation(len(params.face))[: len(params.face) // 4], params.landmark_index)
    total, count = np.zeros(()), 0
    for subject in chosen:
        mine = rows[train.owner[rows] == subject]
        landmarks, vertices = train.read(np.sort(rng.permutation(mine)[:EVALUATED_FRAMES]))
        known = gpmm_fit.covariances(params, train.data.neutral[subject], vertex_index=only)
        off = [gpmm_fit.predict(known, prior, landmarks) - vertices[:, only] for prior in _priors(params.prior.carried)]
        total = total + np.array([np.linalg.norm(one, axis=-1).mean(axis=-1).sum() for one in off])
        count += len(vertices)
    return total / count


def _predict(face_map: linear.LinearMap, landmarks: np.ndarray) -> np.ndarray:
    return np.asarray(linear.apply(face_map, landmarks))


def _best(errors: dict[gpmm.Prior, float]) -> gpmm.Prior:
    """Return the prior with the least error; of nearly equal ones the simpler (not carried, no smooth prior)."""
    best = min(errors, key=lambda prior: errors[prior])
    for simpler in (lambda p: not p.carried and p.smooth == 0, lambda p: not p.carried, lambda p: p.smooth == 0):
        some = {prior: error for prior, error in errors.items() if simpler(prior)}
        if some:
            least = min(some, key=lambda prior: some[prior])
            if some[least] * MIN_RELATIVE_GAIN <= errors[best]:
                return least
    return best
