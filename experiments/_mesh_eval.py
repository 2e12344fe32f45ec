"""What the experiments on landmarks -> mesh share: methods fitted to cases, and results that are kept.

A *case* is one fold of one protocol (`experiments._cases`). A method's distances on a case are kept in its folder, so
that a comparison that was stopped goes on, and one method can be added later.
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
NAMES = {
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
    """Of every experiment on landmarks -> mesh."""

    out: Path = Path("runs")
    """Folder for checkpoints and results."""
    seed: int = 0
    """Of the networks."""
    quick: bool = False
    """A look: small datasets and few steps."""
    paper: bool = False
    """Train for the paper's 300 epochs."""
    publish: bool = False
    """Also write the figures that the README quotes."""
    trained_on: str = ""
    """For the record: the machine that trained the checkpoints in the folder, where it is not this one."""

    @property
    def mode(self) -> Mode:
        """How thorough. Raises `ValueError` where two are asked for."""
        if self.quick and self.paper:
            raise ValueError("--quick and --paper: name one of them")
        return "quick" if self.quick else "paper" if self.paper else "default"

    def folder(self, out: Path | None = None) -> Path:
        """Where checkpoints lie: a look and the real thing, or two datasets, do not go on from one another."""
        out = self.out if out is None else out
        if (data := getattr(self, "data", None)) is not None:
            out = out / f"{data.name}-{hashlib.sha256(str(data.resolve()).encode()).hexdigest()[:8]}"
        return out if self.mode == "default" else out / self.mode


class Result(NamedTuple):
    """A method on a case."""

    distances: vertex_error.Distances
    seconds: float  # of fitting, however often it was stopped
    about: dict[str, Any]  # what was chosen


def options_of(case: Case, mode: Mode, seed: int, hierarchy: hierarchy.Hierarchy, **plans) -> baselines.Options:
    """Steps of training by mode: a look, two hours at most for one method and split, or the paper's 300 epochs."""
    options = baselines.Options(by=case.by, seed=seed, hierarchy=hierarchy)
    if mode == "default":
        return options._replace(**plans)
    epochs = 300 * case.train.count
    steps = {
        "decoder": fit_s2d_dec.S2DDecPlan, "residual": fit_residual.ResidualPlan, "neural3dmm": fit_neural3dmm.Neural3DMMPlan,
    }  # fmt: skip
    for name, plan in steps.items():
        chosen = plan()
        count = QUICK_STEPS if mode == "quick" else -(-epochs // chosen.batch)
        options = options._replace(**{name: chosen._replace(steps=count)})
    return (options._replace(components=QUICK_COMPONENTS) if mode == "quick" else options)._replace(**plans)


def judge(
    name: str,
    case: Case,
    folder: Path,
    options: baselines.Options,
    regions: dict[str, np.ndarray],
    *,
    noises: Sequence[float] = (0.0,),
    trained: str | None = None,
) -> dict[float, Result]:
    """Fit a method to a case and measure it under each landmark noise (mm), or read what was measured before.

    `trained` names the folder of checkpoints, where cases with the same training meshes share one.
    """
    kept = folder / name / case.name
    return remembered(
        kept,
        key(name, case, options, noises),
        noises,
        lambda: _measured(name, case, kept if trained is None else folder / name / trained, options, regions, noises),
    )


def remembered(
    folder: Path, key: str, noises: Sequence[float], measure: Callable[[], dict[float, Result]]
) -> dict[float, Result]:
    """What was measured before under this key, else measured now and kept in the folder."""
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


def fitted(name: str, case: Case, folder: Path, options: baselines.Options) -> Any:
    """A method's parameters for a case: what was trained step by step in the folder of `judge` is not trained again."""
    return _fit(name, case, folder / name / case.name, options)[0]


def _fit(name: str, case: Case, folder: Path, options: baselines.Options) -> tuple[Any, float]:
    """Parameters, and the seconds that they took; of networks those of their steps, however often they were stopped."""
    begun = time.perf_counter()
    if name in ("gpmm", "gpmm_found", "s2d_residual"):
        options = options._replace(base=base(case, options))
    model = baselines.METHODS[name].fit(case.train, folder, options)
    steps = [entry["seconds"] for entry in metric_logger.read(folder)]
    return model, sum(steps) if steps else time.perf_counter() - begun


_known_bases: dict[str, Any] = {}


def base(case: Case, options: baselines.Options):
    """The morphable model of a case, which two methods share: the last one is kept, so judge one after the other."""
    facts = key("gpmm", case, options, ())
    if facts not in _known_bases:
        _known_bases.clear()
        _known_bases[facts] = baselines.METHODS["gpmm"].fit(case.train, Path(), options)
    return _known_bases[facts]


def _about(name: str, model: Any, options: baselines.Options) -> dict[str, Any]:
    if isinstance(model, baselines.LinearFit):
        return {"alpha_mm2": model.alpha}
    if name in ("gpmm", "gpmm_found"):
        return model.params.prior._asdict()
    if name == "s2d_residual":
        return {**model.base.prior._asdict(), "gate": float(model.network.gate), "steps": options.residual.steps}
    return {"s2d": {"steps": options.decoder.steps}, "neural3dmm": {"steps": options.neural3dmm.steps}}.get(name, {})


def key(name: str, case: Case, options: baselines.Options, noises: Sequence[float]) -> str:
    """What a kept result depends on, as a hash."""
    plans = {
        "s2d": [options.decoder], "neural3dmm": [options.neural3dmm], "gpmm": [options.components],
        "gpmm_found": [options.components], "s2d_residual": [options.residual, options.components],
    }.get(name, [])  # fmt: skip
    facts = [name, plans, options.by, options.seed, dict(case.train.data.index["spec"]), sorted(noises)]
    digest = hashlib.sha256(repr(facts).encode())
    for meshes in (case.train, case.test):
        digest.update(repr(dict(meshes.data.index["spec"])).encode() + meshes.at.tobytes())
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


def pooled(results: Sequence[Result]) -> vertex_error.Distances:
    """The distances of all folds together."""
    total = results[0].distances
    for result in results[1:]:
        total = total.add(result.distances)
    return total


def drawn(figure: Any, path: Path) -> Path:
    """Write a matplotlib figure and let go of it."""
    from matplotlib import pyplot

    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic.replace_file(path) as temporary:
        figure.savefig(temporary, dpi=110, format="png")
    pyplot.close(figure)
    return path


def check_methods(names: Sequence[str]) -> None:
    """Raise `ValueError` for a method that there is not."""
    for name in names:
        if name not in baselines.METHODS:
            raise ValueError(f"unknown method {name!r}, expected some of {', '.join(baselines.METHODS)}")
