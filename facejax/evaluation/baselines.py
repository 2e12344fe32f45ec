"""Decoders from landmarks to a mesh behind one interface, to be compared or exchanged.

    method = baselines.METHODS["ridge"]
    params = method.fit(train, folder, options)
    vertices = method.apply(params, landmark_displacements, neutral)

`train` is a selection of meshes (`facejax.data.mesh_subset`); `folder` keeps checkpoints of iterative training, which
resumes from them. `apply` maps displacements (T, L, 3) of one face and that face at rest (N, 3), in mm, to vertices
(T, N, 3).

s2d            S2D-Dec (OT23)
s2d_residual   GPMM estimate plus residual decoder (spiral convolutions on the face); `gpmm` is the estimate alone
gpmm_found     GPMM estimate with landmark noise sigma (mm) estimated from the landmarks
ridge          ridge regression, a baseline that published tables lack
pca38, pca220  3DMM with 38 or 220 principal components of displacements: OT23's expression-specific one
pca220_mean    OT23's common 3DMM: principal components of whole meshes about their overall mean
dl3dmm         dictionary-learning 3DMM, 220 atoms
neural3dmm     spiral autoencoder of the neutral face, with the landmarks beside its code
rbf            radial basis functions, without training
still          the neutral face
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from facejax.data.mesh_subset import MeshSubset
from facejax.geometry import rbf
from facejax.mesh import hierarchy as mesh_hierarchy
from facejax.mesh import rbf_weights
from facejax.models.decoders import dictionary, gpmm, gpmm_fit, gpmm_residual, linear, s2d_dec
from facejax.training.recipes import fit_gpmm, fit_linear, fit_neural3dmm, fit_residual, fit_s2d_dec


class Options(NamedTuple):
    """Settings that a comparison holds fixed."""

    by: str = "subjects"  # or "labels": what is unseen at test time; cross-validation holds it out
    seed: int = 0
    decoder: fit_s2d_dec.S2DDecPlan = fit_s2d_dec.S2DDecPlan()
    residual: fit_residual.ResidualPlan = fit_residual.ResidualPlan()
    neural3dmm: fit_neural3dmm.Neural3DMMPlan = fit_neural3dmm.Neural3DMMPlan()
    components: int = gpmm_fit.COMPONENTS
    base: fit_gpmm.FittedGPMM | None = None  # of the residual decoder, if it has been fitted already
    hierarchy: mesh_hierarchy.Hierarchy | None = None  # of the spiral networks; default: built from the mean face


class Method(NamedTuple):
    """A decoder: how it is fitted, and how it is applied."""

    fit: Callable[[MeshSubset, Path, Options], Any]
    apply: Callable[[Any, np.ndarray, np.ndarray], np.ndarray]  # displacements (T, L, 3), neutral (N, 3) -> (T, N, 3)


class LinearFit(NamedTuple):
    """A linear map, and the ridge weight that cross-validation selected."""

    params: linear.LinearMap
    alpha: float  # mm^2


class StaticTopology(NamedTuple):
    """Topology and landmarks, all that methods without training need."""

    faces: np.ndarray
    landmark_index: np.ndarray


def _hierarchy(train: MeshSubset, options: Options) -> mesh_hierarchy.Hierarchy:
    if options.hierarchy is not None:
        return options.hierarchy
    template = np.asarray(train.data.neutral[train.subjects], np.float64).mean(axis=0)
    return mesh_hierarchy.build(template, np.asarray(train.data.faces))


def _linear(model: linear.Model, **fixed: Any) -> Method:
    def fit(train: MeshSubset, folder: Path, options: Options) -> LinearFit:
        return LinearFit(*fit_linear.fit_linear(model, train, by=options.by, **fixed))

    return Method(fit, _apply_linear)


def _apply_linear(fitted: LinearFit, displacements: np.ndarray, neutral: np.ndarray) -> np.ndarray:
    return neutral + np.asarray(linear.apply(fitted.params, displacements))


def _fit_dictionary(train: MeshSubset, folder: Path, options: Options) -> LinearFit:
    index = np.asarray(train.data.landmark_index)
    found = fit_linear.fit_linear(
        dictionary.model, train, by=options.by, landmark_index=index, atoms=dictionary.ATOMS, seed=options.seed
    )
    return LinearFit(*found)


@dataclasses.dataclass(frozen=True)
class _WholeMeshes:
    """Meshes that include the identity, as displacements from the mean of all faces."""

    meshes: MeshSubset

    def __iter__(self):
        rest, at = self.meshes.data.neutral, self.meshes.data.landmark_index
        mean = np.asarray(rest[self.meshes.subjects]).mean(axis=0)
        for low in range(0, self.meshes.count, self.meshes.size):
            rows = np.arange(low, min(low + self.meshes.size, self.meshes.count))
            displacements = self.meshes.read(rows)[1] + rest[self.meshes.owner[rows]] - mean
            yield displacements[:, at], displacements


def _fit_common_pca(train: MeshSubset, folder: Path, options: Options) -> LinearFit:
    def prepare(batches: MeshSubset, **_: Any) -> linear.Basis:
        return linear.pca.prepare(_WholeMeshes(batches), components=220)

    def solve(basis: linear.Basis, *, alpha: float) -> linear.LinearMap:
        # The components are applied to displacements from the neutral face, which have no mean here.
        at_rest = basis._replace(
            landmark_mean=np.zeros_like(basis.landmark_mean), vertex_mean=np.zeros_like(basis.vertex_mean)
        )
        return linear.pca.solve(at_rest, alpha=alpha)

    return LinearFit(*fit_linear.fit_linear(linear.model(prepare, solve), train, by=options.by))


def _fit_s2d(train: MeshSubset, folder: Path, options: Options) -> tuple[s2d_dec.S2DDec, mesh_hierarchy.Hierarchy]:
    hierarchy = jax.device_put(_hierarchy(train, options))
    return fit_s2d_dec.fit(train, hierarchy, folder, plan=options.decoder, seed=options.seed), hierarchy


def _apply_s2d(
    fitted: tuple[s2d_dec.S2DDec, mesh_hierarchy.Hierarchy], displacements: np.ndarray, neutral: np.ndarray
) -> np.ndarray:
    params, hierarchy = fitted
    return neutral + np.asarray(s2d_dec.apply(params, hierarchy, np.asarray(displacements, np.float32)))


def _fit_gpmm(train: MeshSubset, folder: Path, options: Options) -> fit_gpmm.FittedGPMM:
    return options.base or fit_gpmm.fit(train, by=options.by, components=options.components)


def _apply_gpmm(fitted: fit_gpmm.FittedGPMM, displacements: np.ndarray, neutral: np.ndarray) -> np.ndarray:
    return neutral + np.asarray(linear.apply(gpmm.linear_map(fitted.params, neutral), displacements))


def _apply_gpmm_with_noise(fitted: fit_gpmm.FittedGPMM, displacements: np.ndarray, neutral: np.ndarray) -> np.ndarray:
    known = gpmm.on_face(fitted.params, neutral)
    params = gpmm.with_landmark_noise(fitted.params, gpmm.estimate_landmark_noise(fitted.params, known, displacements))
    return neutral + np.asarray(linear.apply(gpmm.linear_map(params, neutral), displacements))


def _fit_residual(train: MeshSubset, folder: Path, options: Options) -> gpmm_residual.GPMMResidual:
    return fit_residual.fit(
        train, _hierarchy(train, options), folder, plan=options.residual, by=options.by, seed=options.seed,
        base=_fit_gpmm(train, folder, options),
    )  # fmt: skip


def _apply_residual(fitted: gpmm_residual.GPMMResidual, displacements: np.ndarray, neutral: np.ndarray) -> np.ndarray:
    return neutral + np.asarray(gpmm_residual.apply(fitted, gpmm_residual.prepare(fitted, neutral), displacements))


def _fit_neural(train: MeshSubset, folder: Path, options: Options) -> fit_neural3dmm.FittedNeural3DMM:
    return fit_neural3dmm.fit(train, _hierarchy(train, options), folder, plan=options.neural3dmm, seed=options.seed)


def _apply_neural(
    fitted: fit_neural3dmm.FittedNeural3DMM, displacements: np.ndarray, neutral: np.ndarray
) -> np.ndarray:
    return neutral + fit_neural3dmm.apply(fitted, displacements, neutral)


def _fit_static(train: MeshSubset, folder: Path, options: Options) -> StaticTopology:
    return StaticTopology(np.asarray(train.data.faces), np.asarray(train.data.landmark_index))


def _apply_rbf(fitted: StaticTopology, displacements: np.ndarray, neutral: np.ndarray) -> np.ndarray:
    points = np.asarray(neutral, np.float64)[fitted.landmark_index]
    lips = rbf_weights.IBUG_LIPS if len(points) == 68 else None
    weights = rbf_weights.weights(np.asarray(neutral, np.float64), fitted.faces, points, lips=lips)
    return neutral + np.asarray(rbf.warp(weights, displacements))


def _apply_neutral(fitted: StaticTopology, displacements: np.ndarray, neutral: np.ndarray) -> np.ndarray:
    return np.broadcast_to(neutral, (len(displacements), *np.shape(neutral)))


METHODS = {
    "s2d": Method(_fit_s2d, _apply_s2d),
    "s2d_residual": Method(_fit_residual, _apply_residual),
    "gpmm": Method(_fit_gpmm, _apply_gpmm),
    "gpmm_found": Method(_fit_gpmm, _apply_gpmm_with_noise),
    "ridge": _linear(linear.ridge),
    "pca38": _linear(linear.pca, components=38),
    "pca220": _linear(linear.pca, components=220),
    "pca220_mean": Method(_fit_common_pca, _apply_linear),
    "dl3dmm": Method(_fit_dictionary, _apply_linear),
    "neural3dmm": Method(_fit_neural, _apply_neural),
    "rbf": Method(_fit_static, _apply_rbf),
    "still": Method(_fit_static, _apply_neutral),
}
