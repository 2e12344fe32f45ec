"""Train the released models on makehuman4d: the generator of motion and the way from landmarks to meshes.

    python -m experiments.pretrain --release

Each stage keeps checkpoints in its folder and goes on from there when it was stopped; the two may run side by side
(`--stage motion`, `--stage decoder`), and `--stage assemble --release` joins them into the package's
`facejax/assets/makehuman4d.safetensors`, with the record of how it was made inside. Either network can come from a
file of weights instead (`--motion FILE`, `--decoder FILE`). The way to meshes is the best linear answer, refined by a
spiral decoder (`facejax.fit_residual`), or OT23's S2D-Dec (`--meshes-by s2d`).

The generator of OT23's predecessor, which knows neutral -> peak alone, for `experiments.user_study`:

    python -m experiments.pretrain --onsets-only --decoder facejax/assets/makehuman4d.safetensors --out runs/predecessor
"""

from __future__ import annotations

import dataclasses
import json
import time
from pathlib import Path
from typing import Any, Literal

from experiments import _run
from facejax.data import dataset, motions, transitions
from facejax.data.mesh_subset import of_split
from facejax.data.synthetic import assets, expression_recipes, makehuman, makehuman4d
from facejax.evaluation import vertex_error
from facejax.inference import pipeline
from facejax.io import cache
from facejax.mesh import hierarchy as mesh_hierarchy
from facejax.models import bundle
from facejax.models.decoders import s2d_dec
from facejax.models.motion import generators
from facejax.training.recipes import fit_gpmm, fit_motion, fit_residual, fit_s2d_dec

PACKAGED = Path(pipeline.__file__).parent / "assets" / bundle.RELEASED


@dataclasses.dataclass(frozen=True)
class Config:
    out: Path = Path("runs/pretrain")
    """Folder for checkpoints, metrics and the weights."""
    seed: int = 0
    """Of the initial weights, the order of the data and the noise."""
    stage: Literal["all", "motion", "decoder", "assemble"] = "all"
    """What to do; `assemble` needs the other two."""
    level: int = 3
    """Realism of the dataset."""
    subjects: int = 120
    """Of the dataset."""
    meshes: int = 20_000
    """Of the dataset."""
    generator: Literal["flow", "gan"] = "flow"
    """Which generator of motion."""
    motion_steps: int | None = None
    """Generator steps; by default those of its plan."""
    meshes_by: Literal["refined", "s2d"] = bundle.REFINED
    """Way from landmarks to meshes: the best linear answer refined, or S2D-Dec."""
    decoder_steps: int | None = None
    """Steps of its network; by default those of its plan."""
    motion: Path | None = None
    """Weights whose generator to take, in place of training one."""
    decoder: Path | None = None
    """Weights whose decoder to take, in place of training one."""
    labels: Literal["all", "coma"] = "all"
    """Of the generator: the dataset's 19, or neutral and the 12 of OT23."""
    onsets_only: bool = False
    """Train the generator on neutral -> peak alone."""
    release: bool = False
    """Put the weights into the package."""
    publish: bool = False
    """Also write the record that the README quotes."""


def run(config: Config) -> dict[str, Any]:
    """Train, assemble, measure."""
    data = makehuman4d.prepare(makehuman4d.Spec(config.level, config.subjects, config.meshes))
    shape = makehuman.template()
    hierarchy = mesh_hierarchy.build(shape.vertices, shape.faces, cache=cache.folder())
    parts = {}
    if config.stage in ("all", "motion", "assemble"):
        parts["motion"] = _motion(config, data)
    if config.stage in ("all", "decoder", "assemble"):
        parts["decoder"] = _decoder(config, data, hierarchy)
    if config.stage in ("motion", "decoder"):
        return {}
    (generator, beginnings), motion_seconds = parts["motion"]
    decode, decoder_seconds = parts["decoder"]
    seconds = motion_seconds + decoder_seconds
    made = _run.record(config, seconds=seconds, dataset=data.index["spec"])
    models = pipeline.Models(
        labels=_names(config, data),
        face=pipeline.Face(
            shape.vertices,
            shape.faces,
            shape.landmarks,
            assets.load().source_index[: len(shape.vertices)],
            shape.face_mask,
        ),
        motion=generator,
        starts=beginnings,
        hierarchy=hierarchy,
        decoder=decode,
        about={"made": made, "plans": {"motion": _motion_about(config), "decoder": _decoder_about(config)}},
    )
    # Judged as the file holds them: rounded.
    pipeline.save(config.out / bundle.RELEASED, models)
    models = pipeline.load(config.out / bundle.RELEASED)
    metrics = {
        "error_mm": vertex_error.of_models(models, data, "test"),
        "seconds": {"motion": motion_seconds, "decoder": decoder_seconds},
    }
    models = models._replace(about=models.about | metrics)
    pipeline.save(config.out / bundle.RELEASED, models)
    if config.release:
        pipeline.save(PACKAGED, models)
    size = (config.out / bundle.RELEASED).stat().st_size / 1e6
    rows = [
        ("landmarks to mesh", "S2D-Dec" if isinstance(decode, s2d_dec.S2DDec) else "carried GPMM, refined"),
        ("mean vertex error on test subjects, whole head", f"{metrics['error_mm']['head']:.4f} mm"),
        ("the same, face region", f"{metrics['error_mm']['face']:.4f} mm"),
        ("generator of motion", generators.kind(models.motion)),
        ("weights", f"{size:.1f} MB"),
    ]
    _run.finish("pretrain", config, metrics, made=made, table=_run.markdown(("released models", ""), rows))
    return metrics


def _motion_plan(config: Config) -> fit_motion.FlowPlan | fit_motion.GanPlan:
    plan = fit_motion.FlowPlan() if config.generator == "flow" else fit_motion.GanPlan()
    return plan if config.motion_steps is None else plan._replace(steps=config.motion_steps)


def _motion_about(config: Config) -> dict[str, Any]:
    if config.motion is not None:
        return _taken(config.motion, "motion")
    return _motion_plan(config)._asdict() | {"labels": config.labels, "onsets_only": config.onsets_only}


def _taken(path: Path, network: str) -> dict[str, Any]:
    """How a network that comes from a file was made, as far as the file tells."""
    about = pipeline.load(path).about
    known = {name: about[name] for name in ("made", "variant", "seed") if name in about}
    return about.get("plans", {}).get(network) or known


def _plan(config: Config) -> fit_s2d_dec.S2DDecPlan | fit_residual.ResidualPlan:
    plan = fit_s2d_dec.S2DDecPlan() if config.meshes_by == bundle.S2D else fit_residual.ResidualPlan()
    return plan if config.decoder_steps is None else plan._replace(steps=config.decoder_steps)


def _decoder_about(config: Config) -> dict[str, Any]:
    if config.decoder is not None:
        return _taken(config.decoder, "decoder")
    return {"kind": config.meshes_by} | _plan(config)._asdict()


def _names(config: Config, data: dataset.Dataset) -> tuple[str, ...]:
    if config.motion is not None:
        return pipeline.load(config.motion).labels
    return data.labels if config.labels == "all" else (expression_recipes.NEUTRAL, *expression_recipes.COMA)


def _motion(config: Config, data: dataset.Dataset):
    """The generator, the peaks that motions start from, and the seconds it took."""
    if config.motion is not None:
        found = pipeline.load(config.motion)
        return (found.motion, found.starts), 0.0
    names = _names(config, data)

    def parts(per_pair):
        if config.onsets_only:
            halves = motions.halves(data, "train", label_names=names)
            return [halves.take(halves.start == 0)]
        return transitions.all_pairs(data, "train", label_names=names, per_pair=per_pair)

    folder = config.out / "motion"
    fit = fit_motion.fit_flow if config.generator == "flow" else fit_motion.fit_gan
    with _timed(folder) as seconds:
        known = motions.join(*parts(transitions.CHART_PER_PAIR))
        chart = transitions.fit_chart(known, labels=len(names))
        examples = transitions.encode_examples(chart, parts(transitions.SPREAD_PER_PAIR))
        generator = fit(examples, chart, folder, plan=_motion_plan(config), seed=config.seed)
    beginnings = transitions.fit_start_poses(chart, motions.halves(data, "train", label_names=names))
    return (generator, beginnings), seconds()


def _decoder(config: Config, data: dataset.Dataset, hierarchy):
    """The way from landmarks to meshes, and the seconds it took."""
    if config.decoder is not None:
        return pipeline.load(config.decoder).decoder, 0.0
    folder, train = config.out / config.meshes_by, of_split(data, "train")
    with _timed(folder) as seconds:
        if config.meshes_by == bundle.S2D:
            found = fit_s2d_dec.fit(train, hierarchy, folder, plan=_plan(config), seed=config.seed)
        else:
            base = fit_gpmm.fit(train, components=bundle.COMPONENTS)
            found = fit_residual.fit(train, hierarchy, folder, plan=_plan(config), seed=config.seed, base=base)
    return found, seconds()


class _timed:
    """Seconds spent in a folder's run, however often it was stopped."""

    def __init__(self, folder: Path):
        self.path = folder / "seconds.json"

    def __enter__(self):
        self.before = json.loads(self.path.read_text()) if self.path.exists() else 0.0
        self.begun = time.perf_counter()
        return lambda: json.loads(self.path.read_text())

    def __exit__(self, *_: object) -> None:
        spent = time.perf_counter() - self.begun
        # A finished run that is only read again has added nothing worth counting.
        _run.write_text(
            self.path, json.dumps(round(self.before + (spent if spent > 30 or not self.before else 0.0), 1))
        )


if __name__ == "__main__":
    _run.main("pretrain", Config, run)
