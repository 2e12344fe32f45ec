"""Train the released models on makehuman4d: the motion generator and the landmark-to-mesh decoder.

    python -m experiments.pretrain --release

Each stage keeps checkpoints in its folder and resumes; the two may run side by side (`--stage motion`, `--stage
decoder`), and `--stage assemble --release` joins them into the package's `facejax/assets/makehuman4d.safetensors`,
with their provenance. Either network can come from a model file instead (`--motion FILE`, `--decoder FILE`). The
decoder is the GPMM estimate plus residual decoder (`facejax.training.recipes.fit_residual`), or OT23's S2D-Dec
(`--meshes-by s2d`).

The generator of OT23's predecessor, which is trained on neutral to peak alone, for `experiments.user_study`:

    python -m experiments.pretrain --onsets-only --decoder facejax/assets/makehuman4d.safetensors --out runs/predecessor

Expected mean vertex error on the test subjects: 0.0219 mm over the head, 0.0272 mm over the face. Time: 21 minutes
for the decoder and 5 for the generator on 2 cores of an AMD EPYC.
"""

from __future__ import annotations

import dataclasses
import json
import time
from pathlib import Path
from typing import Any, Literal

import facejax
from experiments import _run
from facejax.data import dataset, motions, transitions
from facejax.data.mesh_subset import of_split
from facejax.data.synthetic import assets, expression_recipes, makehuman, makehuman4d
from facejax.evaluation import vertex_error
from facejax.inference import pipeline
from facejax.io import cache
from facejax.mesh import hierarchy as mesh_hierarchy
from facejax.models import bundle, model_file
from facejax.models.decoders import s2d_dec
from facejax.models.motion import generators
from facejax.training.recipes import fit_gpmm, fit_motion, fit_residual, fit_s2d_dec

PACKAGED = Path(facejax.__file__).parent / "assets" / bundle.RELEASED


@dataclasses.dataclass(frozen=True)
class Config:
    out: Path = Path("runs/pretrain")
    """Folder for checkpoints, metrics and the weights."""
    seed: int = 0
    """Seed of the initial weights, the order of the data and the noise."""
    stage: Literal["all", "motion", "decoder", "assemble"] = "all"
    """Stage to run; `assemble` needs the results of the other two."""
    level: int = 3
    """Realism level of makehuman4d, 0 to 3."""
    subjects: int = 120
    """Number of subjects of makehuman4d."""
    meshes: int = 20_000
    """Number of meshes of makehuman4d."""
    generator: Literal["flow", "gan"] = "flow"
    """Kind of motion generator."""
    motion_steps: int | None = None
    """Number of training steps of the generator; by default that of its plan."""
    meshes_by: Literal["refined", "s2d"] = model_file.REFINED
    """Decoder from landmarks to meshes: GPMM estimate plus residual decoder, or S2D-Dec."""
    decoder_steps: int | None = None
    """Number of training steps of the decoder; by default that of its plan."""
    motion: Path | None = None
    """Model file to take the generator from, in place of training one."""
    decoder: Path | None = None
    """Model file to take the decoder from, in place of training one."""
    labels: Literal["all", "coma"] = "all"
    """Labels of the generator: the dataset's 19, or neutral and the 12 of OT23."""
    onsets_only: bool = False
    """Train the generator on neutral to peak alone."""
    release: bool = False
    """Write the models into the package."""
    publish: bool = False
    """Also write the committed results in experiments/results."""


def run(config: Config) -> dict[str, Any]:
    """Train the networks, assemble the model file and measure its error."""
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
        labels=bundle.Labels(_names(config, data)),
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
        about=bundle.Provenance(
            {"made": made, "plans": {"motion": _motion_about(config), "decoder": _decoder_about(config)}}
        ),
    )
    # Evaluated as saved: the file holds rounded weights.
    pipeline.save(config.out / bundle.RELEASED, models)
    models = pipeline.load(config.out / bundle.RELEASED)
    metrics = {
        "error_mm": vertex_error.model_errors(models, data, "test"),
        "seconds": {"motion": motion_seconds, "decoder": decoder_seconds},
    }
    models = models.replace(about=models.about | metrics)
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
    """Return the provenance of a network as recorded in its model file."""
    about = pipeline.load(path).about
    known = {name: about[name] for name in ("made", "variant", "seed") if name in about}
    return about.get("plans", {}).get(network) or known


def _plan(config: Config) -> fit_s2d_dec.S2DDecPlan | fit_residual.ResidualPlan:
    plan = fit_s2d_dec.S2DDecPlan() if config.meshes_by == model_file.S2D else fit_residual.ResidualPlan()
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
    """Return the generator with its start poses, and the seconds of training."""
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
    """Return the decoder and the seconds of training."""
    if config.decoder is not None:
        return pipeline.load(config.decoder).decoder, 0.0
    folder, train = config.out / config.meshes_by, of_split(data, "train")
    with _timed(folder) as seconds:
        if config.meshes_by == model_file.S2D:
            found = fit_s2d_dec.fit(train, hierarchy, folder, plan=_plan(config), seed=config.seed)
        else:
            base = fit_gpmm.fit(train, components=bundle.COMPONENTS)
            found = fit_residual.fit(train, hierarchy, folder, plan=_plan(config), seed=config.seed, base=base)
    return found, seconds()


class _timed:
    """Context manager that counts the seconds of a folder's run over all interruptions."""

    def __init__(self, folder: Path):
        self.path = folder / "seconds.json"

    def __enter__(self):
        self.before = json.loads(self.path.read_text()) if self.path.exists() else 0.0
        self.begun = time.perf_counter()
        return lambda: json.loads(self.path.read_text())

    def __exit__(self, *_: object) -> None:
        spent = time.perf_counter() - self.begun
        # Reading a finished run again takes seconds, which do not count as training.
        _run.write_text(
            self.path, json.dumps(round(self.before + (spent if spent > 30 or not self.before else 0.0), 1))
        )


if __name__ == "__main__":
    _run.main("pretrain", Config, run)
