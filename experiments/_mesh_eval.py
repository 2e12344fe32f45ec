"""Fitting and evaluation of the landmark-to-mesh methods on cases, with results cached on disk.

A *case* is one fold of one protocol (`experiments._datasets`). The vertex distances of a method on a case are cached
in its folder, so that an interrupted comparison can be resumed and methods can be added later.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from experiments._datasets import Case, Mode
from facejax.evaluation import baselines, vertex_error
from facejax.io import atomic
from facejax.mesh import hierarchy
from facejax.training import metric_logger
from facejax.training.recipes import fit_neural3dmm, fit_residual, fit_s2d_dec

QUICK_STEPS, QUICK_COMPONENTS = 100, 60
METHOD_NAMES = {
    "s2d": "S2D-Dec",
    "s2d_residual": "residual decoder",
    "gpmm": "carried GPMM (its base)",
    "gpmm_found": "GPMM, noise found",
    "ridge": "ridge",
    "pca38": "PCA-38",
    "pca220": "PCA-220",
    "pca220_mean": "PCA-220 about the mean",
    "dl3dmm": "DL-3DMM",
    "neural3dmm": "Neural3DMM",
    "rbf": "RBF",
    "still": "left still",
}


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of every experiment on landmarks to mesh."""

    out: Path = Path("runs")
    """Folder for checkpoints and results."""
    seed: int = 0
    """Seed of the networks."""
    quick: bool = False
    """Use small datasets and few training steps, to try the experiment out."""
    paper: bool = False
    """Train for the 300 epochs of OT23."""
    publish: bool = False
    """Also write the committed results in experiments/results."""
    trained_on: str = ""
    """Name of the machine that trained the checkpoints in the folder, recorded where it is not this one."""

    @property
    def mode(self) -> Mode:
        """Return the training length. Raises `ValueError` where both --quick and --paper are given."""
        if self.quick and self.paper:
            raise ValueError("--quick and --paper cannot be combined")
        return "quick" if self.quick else "paper" if self.paper else "default"

    def folder(self, out: Path | None = None) -> Path:
        """Return the folder for checkpoints, one per mode and per dataset, so that runs do not mix."""
        out = self.out if out is None else out
        if (data := getattr(self, "data", None)) is not None:
            out = out / f"{data.name}-{hashlib.sha256(str(data.resolve()).encode()).hexdigest()[:8]}"
        return out if self.mode == "default" else out / self.mode


class Result(NamedTuple):
    """The result of a method on a case."""

    distances: vertex_error.Distances
    seconds: float  # of fitting, over all interrupted runs
    about: dict[str, Any]  # hyperparameters that were chosen, training steps


def training_options(case: Case, mode: Mode, seed: int, hierarchy: hierarchy.Hierarchy, **plans) -> baselines.Options:
    """Return the fitting options of a case: default training lengths, `QUICK_STEPS`, or the 300 epochs of OT23.

    `plans` replaces fields of the options.
    """
    options = baselines.Options(by=case.by, seed=seed, hierarchy=hierarchy)
    if mode == "default":
        return options._replace(**plans)
    epochs = 300 * case.train.count
    plans_by_name = {
        "decoder": fit_s2d_dec.S2DDecPlan,
        "residual": fit_residual.ResidualPlan,
        "neural3dmm": fit_neural3dmm.Neural3DMMPlan,
    }
    for name, plan in plans_by_name.items():
        chosen = plan()
        count = QUICK_STEPS if mode == "quick" else -(-epochs // chosen.batch)
        options = options._replace(**{name: chosen._replace(steps=count)})
    return (options._replace(components=QUICK_COMPONENTS) if mode == "quick" else options)._replace(**plans)


def evaluate(
    name: str,
    case: Case,
    folder: Path,
    options: baselines.Options,
    regions: dict[str, np.ndarray],
    *,
    noises: Sequence[float] = (0.0,),
    trained: str | None = None,
) -> dict[float, Result]:
    """Fit a method to a case and evaluate it under each landmark noise sigma (mm), or read the cached result.

    `trained` names the folder of checkpoints where cases with the same training meshes share one.
    """
    kept = folder / name / case.name
    return cached(
        kept,
        cache_key(name, case, options, noises),
        noises,
        lambda: _measured(name, case, kept if trained is None else folder / name / trained, options, regions, noises),
    )


def cached(
    folder: Path, key: str, noises: Sequence[float], measure: Callable[[], dict[float, Result]]
) -> dict[float, Result]:
    """Return the result cached in the folder under this key, else measure and cache it."""
    known = _read(folder, key, noises)
    if known is None:
        known = measure()
        _write(folder, key, known)
    return known


def _measured(name, case, folder, options, regions, noises) -> dict[float, Result]:
    model, seconds = _fit(name, case, folder, options)
    method, found = baselines.METHODS[name], {}
    for noise in noises:
        distances = vertex_error.distances(
            lambda marks, rest: method.apply(model, marks, rest), case.test, regions, noise=noise
        )
        found[noise] = Result(distances, round(seconds, 1), _about(name, model, options))
    return found


def fit_method(name: str, case: Case, folder: Path, options: baselines.Options) -> Any:
    """Return a method's parameters for a case; networks resume from the checkpoints of `evaluate`."""
    return _fit(name, case, folder / name / case.name, options)[0]


def _fit(name: str, case: Case, folder: Path, options: baselines.Options) -> tuple[Any, float]:
    """Return the parameters and the seconds of fitting; for networks, of the training steps over all runs."""
    begun = time.perf_counter()
    if name in ("gpmm", "gpmm_found", "s2d_residual"):
        options = options._replace(base=fit_base(case, options))
    model = baselines.METHODS[name].fit(case.train, folder, options)
    steps = [entry["seconds"] for entry in metric_logger.read(folder)]
    return model, sum(steps) if steps else time.perf_counter() - begun


_known_bases: dict[str, Any] = {}


def fit_base(case: Case, options: baselines.Options):
    """Return the GPMM of a case, which several methods share; the last one is cached in memory."""
    facts = cache_key("gpmm", case, options, ())
    if facts not in _known_bases:
        _known_bases.clear()
        _known_bases[facts] = baselines.METHODS["gpmm"].fit(case.train, Path(), options)
    return _known_bases[facts]


def _about(name: str, model: Any, options: baselines.Options) -> dict[str, Any]:
    if isinstance(model, baselines.LinearFit):
        return {"alpha_mm2": model.alpha}
    if name in ("gpmm", "gpmm_found"):
        return dataclasses.asdict(model.params.prior)
    if name == "s2d_residual":
        return {
            **dataclasses.asdict(model.base.prior),
            "gate": float(model.network.gate),
            "steps": options.residual.steps,
        }
    return {"s2d": {"steps": options.decoder.steps}, "neural3dmm": {"steps": options.neural3dmm.steps}}.get(name, {})


def cache_key(name: str, case: Case, options: baselines.Options, noises: Sequence[float]) -> str:
    """Return a hash of everything that a cached result depends on."""
    plans = {
        "s2d": [options.decoder], "neural3dmm": [options.neural3dmm], "gpmm": [options.components],
        "gpmm_found": [options.components], "s2d_residual": [options.residual, options.components],
    }.get(name, [])  # fmt: skip
    facts = [name, plans, options.by, options.seed, dict(case.train.data.index["spec"]), sorted(noises)]
    digest = hashlib.sha256(repr(facts).encode())
    for meshes in (case.train, case.test):
        digest.update(repr(dict(meshes.data.index["spec"])).encode() + meshes.indices.tobytes())
    return digest.hexdigest()


def _write(folder: Path, key: str, found: dict[float, Result]) -> None:
    arrays = {f"{noise:g}/{field}": value for noise, result in found.items()
              for field, value in result.distances._asdict().items()}  # fmt: skip
    first = next(iter(found.values()))
    about = json.dumps({"key": key, "seconds": first.seconds, "about": first.about})
    with atomic.replace_file(folder / "distances.npz") as temporary, open(temporary, "wb") as file:
        np.savez_compressed(file, about=np.array(about), **arrays)


def _read(folder: Path, key: str, noises: Sequence[float]) -> dict[float, Result] | None:
    try:
        with np.load(folder / "distances.npz", allow_pickle=False) as arrays:
            about = json.loads(str(arrays["about"]))
            if about["key"] != key:
                return None
            fields = vertex_error.Distances._fields
            found = {}
            for noise in noises:
                parts = {field: arrays[f"{noise:g}/{field}"] for field in fields}
                distances = vertex_error.Distances(**parts | {"count": int(parts["count"])})
                found[noise] = Result(distances, about["seconds"], about["about"])
            return found
    except (OSError, KeyError, ValueError):
        return None


def pool(results: Sequence[Result]) -> vertex_error.Distances:
    """Pool the distances of all folds."""
    total = results[0].distances
    for result in results[1:]:
        total = total.add(result.distances)
    return total


def check_methods(names: Sequence[str]) -> None:
    """Raise `ValueError` for the name of an unknown method."""
    for name in names:
        if name not in baselines.METHODS:
            raise ValueError(f"unknown method {name!r}, expected some of {', '.join(baselines.METHODS)}")
