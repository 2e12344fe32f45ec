"""What the experiments on landmarks -> mesh share: who is trained on and judged, and results that are kept.

A *case* is one fold of one protocol. A method's distances on a case are kept in its folder, so that a comparison that
was stopped goes on, and one method can be added later.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from facejax import evaluation, files, fit_decoder, fit_neural3dmm, fit_residual, journal, methods
from facejax.data import cache, makehuman, makehuman4d, performance, store
from facejax.data.meshes import Meshes, of_split
from facejax.mesh import graph, topology

MOST = 20_000  # meshes of a case; more are thinned by a fixed draw
FACE_REACH = 25.0  # mm along the surface
FOLDS = 4
QUICK = {"subjects": 24, "meshes": 1_200}  # of makehuman4d
QUICK_STEPS, QUICK_COMPONENTS = 100, 60
Mode = Literal["quick", "default", "paper"]
NAMES = {
    "s2d": "S2D-Dec",
    "s2d_residual": "residual decoder",
    "gpmm": "carried GPMM (its base)",
    "ridge": "ridge",
    "pca38": "PCA-38",
    "pca220": "PCA-220",
    "pca220_mean": "PCA-220 about the mean",
    "dl3dmm": "DL-3DMM",
    "neural3dmm": "Neural3DMM",
    "rbf": "RBF",
    "still": "left still",
}


class Case(NamedTuple):
    """One fold: what to fit to, what to judge on, and what is new in it."""

    split: str
    fold: int
    train: Meshes
    test: Meshes
    by: str  # "subjects" or "labels"

    @property
    def name(self) -> str:
        """The folder's name."""
        return f"{self.split}-{self.fold}"


class Result(NamedTuple):
    """A method on a case."""

    distances: evaluation.Distances
    seconds: float  # of fitting, however often it was stopped
    about: dict[str, Any]  # what was chosen


def data_of(path: Path | None, mode: Mode, *, level: int = 3, noise: float = 0.0, seed: int = makehuman4d.SEED):
    """The user's store, or makehuman4d: a small one of 24 people for `quick`."""
    if path is not None:
        return store.open_store(path)
    size = QUICK if mode == "quick" else {}
    return makehuman4d.prepare(makehuman4d.Spec(level=level, noise=noise, seed=seed, **size))


def is_makehuman(data: store.Store) -> bool:
    """Whether the store holds the embedded dataset."""
    return data.index.get("name") == "makehuman4d"


def cases(data: store.Store, splits: Sequence[str]) -> list[Case]:
    """The folds of each protocol.

    `identity`: four folds over the sorted training and validation subjects. `expression`: four over the sorted names of
    CoMA's expressions, of the same people; other data: over all names. `test`: fitted to all those people, judged on
    the test subjects. Datasets of OT23 4.1 that have splits of their own get them (D3DFACS, Florence 4D, BU-3DFE).
    """
    known = [split for split in ("train", "validation") if len(data.subjects(split))]
    people = at_most(of_split(data, *known))
    found = []
    for split in splits:
        if split == "test":
            found.append(Case("test", 0, people, at_most(of_split(data, "test")), "subjects"))
        elif split in ("identity", "expression"):
            found += _PUBLISHED.get(data.index.get("name"), _four_folds)(people, split)
        else:
            raise ValueError(f"unknown split {split!r}, expected identity, expression or test")
    return found


def _four_folds(people: Meshes, split: str) -> list[Case]:
    by = "subjects" if split == "identity" else "labels"
    if by == "labels" and is_makehuman(people.data):
        people = people.of_labels(performance.COMA)
    return [Case(split, i, fit, held, by) for i, (fit, held) in enumerate(people.folds(FOLDS, by=by))]


def _one_fold(people: Meshes, split: str, held: np.ndarray) -> list[Case]:
    return [Case(split, 0, people.where(~held), people.where(held), "subjects" if split == "identity" else "labels")]


def _d3dfacs(people: Meshes, split: str) -> list[Case]:
    """The last seven subjects train; the first eleven expressions of each are left out."""
    if split == "identity":
        return _one_fold(people, split, ~np.isin(people.owner, people.subjects[-7:]))
    return _one_fold(people, split, _first_of_each(people, 11))


def _florence(people: Meshes, split: str) -> list[Case]:
    """The last 30 women and 10 men, or the first two expressions of each, are left out."""
    if split == "expression":
        return _one_fold(people, split, _first_of_each(people, 2))
    sex = np.array([people.data.index["subjects"][i].get("sex", "") for i in people.subjects])
    held = np.concatenate([people.subjects[sex == "female"][-30:], people.subjects[sex == "male"][-10:]])
    return _one_fold(people, split, np.isin(people.owner, held))


def _bu3dfe(people: Meshes, split: str) -> list[Case]:
    """The first ten subjects, or anger and disgust, are left out."""
    if split == "identity":
        return _one_fold(people, split, np.isin(people.owner, people.subjects[:10]))
    return _one_fold(people, split, np.isin(people.labels, ["angry", "anger", "disgust"]))


def _first_of_each(people: Meshes, count: int) -> np.ndarray:
    held = np.zeros(people.count, bool)
    for subject in people.subjects:
        mine = people.owner == subject
        held |= mine & np.isin(people.labels, np.unique(people.labels[mine])[:count])
    return held


_PUBLISHED = {"d3dfacs": _d3dfacs, "florence4d": _florence, "bu3dfe": _bu3dfe}


def at_most(meshes: Meshes) -> Meshes:
    """The meshes, or a fixed draw of 20,000 of them."""
    if meshes.count <= MOST:
        return meshes
    keep = np.sort(np.random.default_rng(0).permutation(meshes.count)[:MOST])
    return meshes.where(np.isin(np.arange(meshes.count), keep))


def regions_of(data: store.Store) -> dict[str, np.ndarray]:
    """The whole head, and the face: 25 mm along the surface about a landmark."""
    if is_makehuman(data):
        mask = makehuman.template().face_mask
    else:
        mean = np.asarray(data.neutral, np.float64).mean(axis=0)
        mask = graph.geodesic(mean, np.asarray(data.faces), np.asarray(data.landmark_index)) <= FACE_REACH
    return {"head": np.ones_like(mask), "face": mask}


def hierarchy_of(data: store.Store) -> topology.Hierarchy:
    """The levels that spiral networks climb."""
    template = (
        makehuman.template().vertices if is_makehuman(data) else np.asarray(data.neutral, np.float64).mean(axis=0)
    )
    return topology.build(template, np.asarray(data.faces), cache=cache.folder())


def options_of(case: Case, mode: Mode, seed: int, hierarchy: topology.Hierarchy, **plans) -> methods.Options:
    """Steps of training by mode: a look, two hours at most for one method and split, or the paper's 300 epochs."""
    options = methods.Options(by=case.by, seed=seed, hierarchy=hierarchy)
    if mode == "default":
        return options._replace(**plans)
    epochs = 300 * case.train.count
    steps = {
        "decoder": fit_decoder.Plan, "residual": fit_residual.Plan, "neural3dmm": fit_neural3dmm.Plan,
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
    options: methods.Options,
    regions: dict[str, np.ndarray],
    *,
    noises: Sequence[float] = (0.0,),
    trained: str | None = None,
) -> dict[float, Result]:
    """Fit a method to a case and measure it under each landmark noise (mm), or read what was measured before.

    `trained` names the folder of checkpoints, where cases with the same training meshes share one.
    """
    kept = folder / name / case.name
    folder = kept if trained is None else folder / name / trained
    key = _key(name, case, options, noises)
    known = _read(kept, key, noises)
    if known is not None:
        return known
    method = methods.METHODS[name]
    found = {}
    model, seconds = _fit(name, case, folder, options)
    for noise in noises:
        distances = evaluation.distances(
            lambda marks, rest: method.apply(model, marks, rest), case.test, regions, noise=noise
        )
        found[noise] = Result(distances, round(seconds, 1), _about(name, model, options))
    _write(kept, key, found)
    return found


def fitted(name: str, case: Case, folder: Path, options: methods.Options) -> Any:
    """A method's parameters for a case: what was trained step by step in the folder of `judge` is not trained again."""
    return _fit(name, case, folder / name / case.name, options)[0]


def _fit(name: str, case: Case, folder: Path, options: methods.Options) -> tuple[Any, float]:
    """Parameters, and the seconds that they took; of networks those of their steps, however often they were stopped."""
    begun = time.perf_counter()
    if name in ("gpmm", "s2d_residual"):
        options = options._replace(base=base(case, options))
    model = methods.METHODS[name].fit(case.train, folder, options)
    steps = [entry["seconds"] for entry in journal.read(folder)]
    return model, sum(steps) if steps else time.perf_counter() - begun


_known_bases: dict[str, Any] = {}


def base(case: Case, options: methods.Options):
    """The morphable model of a case, which two methods share: the last one is kept, so judge one after the other."""
    key = _key("gpmm", case, options, ())
    if key not in _known_bases:
        _known_bases.clear()
        _known_bases[key] = methods.METHODS["gpmm"].fit(case.train, Path(), options)
    return _known_bases[key]


def _about(name: str, model: Any, options: methods.Options) -> dict[str, Any]:
    if isinstance(model, methods.LinearFit):
        return {"alpha_mm2": model.alpha}
    if name == "gpmm":
        return model.params.prior._asdict()
    if name == "s2d_residual":
        return {**model.base.prior._asdict(), "gate": float(model.network.gate), "steps": options.residual.steps}
    return {"s2d": {"steps": options.decoder.steps}, "neural3dmm": {"steps": options.neural3dmm.steps}}.get(name, {})


def _key(name: str, case: Case, options: methods.Options, noises: Sequence[float]) -> str:
    """What a kept result depends on, as a hash."""
    plans = {
        "s2d": [options.decoder], "neural3dmm": [options.neural3dmm], "gpmm": [options.components],
        "s2d_residual": [options.residual, options.components],
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
    with files.replacing(folder / "distances.npz") as temporary, open(temporary, "wb") as file:
        np.savez_compressed(file, about=np.array(about), **arrays)


def _read(folder: Path, key: str, noises: Sequence[float]) -> dict[float, Result] | None:
    try:
        with np.load(folder / "distances.npz", allow_pickle=False) as arrays:
            about = json.loads(str(arrays["about"]))
            if about["key"] != key:
                return None
            fields = evaluation.Distances._fields
            found = {}
            for noise in noises:
                parts = {field: arrays[f"{noise:g}/{field}"] for field in fields}
                distances = evaluation.Distances(**parts | {"count": int(parts["count"])})
                found[noise] = Result(distances, about["seconds"], about["about"])
            return found
    except (OSError, KeyError, ValueError):
        return None


def pooled(results: Sequence[Result]) -> evaluation.Distances:
    """The distances of all folds together."""
    total = results[0].distances
    for result in results[1:]:
        total = total.add(result.distances)
    return total


def mode_of(config: Any) -> Mode:
    """Of a config with `quick` and `paper`."""
    if config.quick and config.paper:
        raise ValueError("--quick and --paper: name one of them")
    return "quick" if config.quick else "paper" if config.paper else "default"


def check_methods(names: Sequence[str]) -> None:
    """Raise `ValueError` for a method that there is not."""
    for name in names:
        if name not in methods.METHODS:
            raise ValueError(f"unknown method {name!r}, expected some of {', '.join(methods.METHODS)}")
