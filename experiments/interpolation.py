"""Is it better to interpolate motions on the sphere of square-root velocities than in 3D, and how near is it to life?

OT23, 4.1: interpolation on the sphere "leads to cleaner results than interpolating directly in the 3D space". Measured
in three ways, nothing is trained but forests:

Between two performed onsets of two people, at 0.25, 0.5 and 0.75 of the way: how long, strong and jerky is the motion
beside its two parents, how far from the nearest real one, and what does noise in the parents do to it? From peak to
peak: how near are the paper's transitions (on the sphere, at an even pace), straight ones, and both at other paces, to
transitions that the same person performed directly, which no capture set has? And a forest that has seen one
construction, how well does it recognise directly performed transitions of other people?

Direct transitions here are a rig's: the muscles of one expression let go while those of the other pull, each with its
own timing. That is nearer to a straight line than people may be.

    python -m experiments.interpolation --publish

Less than 4 minutes on 2 cores.
"""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path
from typing import Any

import numpy as np
from sklearn.ensemble import RandomForestClassifier

from experiments import _datasets, _run, _transition_classifier
from experiments import _interpolation_eval as made_of
from experiments import _interpolation_plots as drawn
from experiments._interpolation_eval import PACES, PATHS, WAYS
from facejax import augment
from facejax.data import dataset, motions, transitions
from facejax.data.synthetic import makehuman4d
from facejax.io import atomic

HELD_OUT = ("validation", "test")
KINDS = ("same expression", "two expressions")


@dataclasses.dataclass(frozen=True)
class Config:
    out: Path = Path("runs/interpolation")
    """Folder for the results."""
    seed: int = 0
    """Of the pairs of people, and of the forests."""
    data: Path | None = None
    """A makehuman4d of your own making, with noise or heads that move, in place of the default one."""
    level: int = 3
    """Realism of the dataset."""
    subjects: int = 120
    """Of the dataset."""
    meshes: int = 20_000
    """Of the dataset."""
    per_expression: int = 30
    """Pairs of onsets to interpolate between, for each first expression."""
    noise: float = 0.2
    """Of the tracking, mm in every coordinate, to see what it does to an interpolated onset."""
    people: int = 4
    """How many perform their direct transitions a second time: how far one take is from the next."""
    trees: int = 300
    """Size of a forest."""
    publish: bool = False
    """Also write the figures that the README quotes."""


def run(config: Config) -> dict[str, Any]:
    """Measure the three, and draw."""
    begun = time.perf_counter()
    data = _data(config)
    onsets = made_of.onsets_of(made_of.joined(data, HELD_OUT))
    direct = made_of.joined(data, HELD_OUT, motions.direct_transitions)
    walks = _walks(onsets, direct)
    metrics = {
        "onsets": _onsets(config, data, onsets),
        "peaks": _peaks(config, data, walks, direct),
        "recognition": _recognition(config, data, direct),
        "transitions": len(direct.curves),
        "people": len(np.unique(direct.subject)),
    }
    config.out.mkdir(parents=True, exist_ok=True)
    figure = drawn.plot(config.out / "interpolation.png", metrics, direct)
    drawn.sheet(config.out / "sheet.png", data, walks, direct)
    made = _run.record(config, seconds=time.perf_counter() - begun, dataset=data.index["spec"])
    _run.finish("interpolation", config, metrics, made=made, table=_table(metrics, config.noise), figure=figure)
    if config.publish:
        with atomic.replace_file(_run.RESULTS / "interpolation_sheet.png") as temporary:
            temporary.write_bytes((config.out / "sheet.png").read_bytes())
    return metrics


def _data(config: Config) -> dataset.Dataset:
    if config.data is None:
        return makehuman4d.prepare(makehuman4d.Spec(config.level, config.subjects, config.meshes))
    data = dataset.open_dataset(config.data)
    if not _datasets.is_makehuman(data):
        raise ValueError(f"{data.path}: only makehuman4d has transitions that were performed from peak to peak")
    return data


def _onsets(config: Config, data: dataset.Dataset, onsets: motions.Motions) -> dict[str, Any]:
    """Between the onsets of two people; real ones are sought among the training subjects'."""
    scale = float(onsets.scale.mean())
    pool = made_of.onsets_of(motions.halves(data, "train"))
    noise = np.random.default_rng(config.seed).standard_normal(onsets.curves.shape, np.float32)
    noisy = onsets.curves + config.noise / scale * noise
    real = made_of.nearest(onsets.curves, onsets.end, pool, scale)
    drawn_pairs = made_of.pairs_between(onsets, config.per_expression, config.seed)
    parents = drawn_pairs["same expression"]
    found: dict[str, Any] = {"parents": {name: float(values[parents].mean()) for name, values in real.items()}}
    for kind, pairs in drawn_pairs.items():
        # What lies between anger and an open mouth has no real counterpart.
        known = pool if kind == "same expression" else None
        each = {path: made_of.cleanness(onsets, noisy, pairs, path, known, scale) for path in PATHS}
        found[kind] = {
            path: {name: float(values.mean()) for name, values in rows.items()}
            | {f"{name}_by_tau": values.mean(axis=1) for name, values in rows.items()}
            for path, rows in each.items()
        }
        found[kind]["sphere_less"] = {
            name: float(np.mean(values < each["linear"][name])) for name, values in each["sphere"].items()
        }
    return found


def _walks(onsets: motions.Motions, direct: motions.Motions) -> dict[tuple[str, str], made_of.Walk]:
    """Each direct transition's own person's, in every way."""
    row = {who: k for k, who in enumerate(zip(onsets.subject.tolist(), onsets.end.tolist(), strict=True))}
    first, second = (
        onsets.curves[[row[who] for who in zip(direct.subject.tolist(), labels.tolist(), strict=True)]]
        for labels in (direct.start, direct.end)
    )
    return {(path, pace): made_of.walk(first, second, path=path, pace=pace) for path, pace in WAYS}


def _peaks(config: Config, data: dataset.Dataset, walks, direct: motions.Motions) -> dict[str, Any]:
    """Every way from peak to peak against the direct one; and another take of it."""
    scale = float(direct.scale.mean())
    found = {made_of.name(way): made_of.against(walk, direct, scale) for way, walk in walks.items()}
    each = {name: row.pop("each_aligned_mm") for name, row in found.items()}
    people = np.unique(direct.subject)
    some = people[np.linspace(0, len(people) - 1, min(config.people, len(people))).astype(int)]
    once = direct.take(np.isin(direct.subject, some))
    even = next(iter(walks.values())).tau[: len(once.curves)]
    twice = made_of.against(made_of.Walk(made_of.again(data, once).curves, even), once, scale)
    del twice["each_aligned_mm"]
    nearer = {}
    for pace in PACES:
        gain = each[made_of.name(("sphere", pace))] - each[made_of.name(("linear", pace))]
        by_person = np.array([gain[direct.subject == person].mean() for person in people])
        nearer[pace] = {
            "sphere_nearer": float(np.mean(gain < 0)),
            "difference_mm": float(by_person.mean()),
            "standard_error_mm": float(by_person.std(ddof=1) / np.sqrt(len(people))),
        }
    straight = float(made_of.detour(direct.curves).mean())
    return {"ways": found, "another_take": twice, "paired": nearer, "direct_detour": straight}


def _recognition(config: Config, data: dataset.Dataset, direct: motions.Motions) -> dict[str, float]:
    """Forests that learn OT23's set (halves, and selected transitions) made in each way, and see direct ones."""
    pairs = [(data.labels.index(a), data.labels.index(b)) for a, b in makehuman4d.TABLE5_PAIRS]
    halves = motions.halves(data, "train")
    onsets = made_of.onsets_of(halves)
    first, second = _selected(onsets, set(pairs), len(data.labels)).T
    judged, which = _transition_classifier.labelled(direct, pairs)
    found = {}
    for path, pace in WAYS:
        curves = made_of.walk(onsets.curves[first], onsets.curves[second], path=path, pace=pace).curves
        labels = onsets.end[first], onsets.end[second]
        between = motions.Motions(curves, *labels, *(field[first] for field in onsets[3:]))
        train, target = _transition_classifier.labelled(motions.join(halves, between), pairs)
        forest = RandomForestClassifier(config.trees, random_state=config.seed, n_jobs=-1)
        forest.fit(train.curves.reshape(len(target), -1), target)
        named = forest.predict(judged.curves.reshape(len(which), -1))
        found[made_of.name((path, pace))] = float(np.mean(named == which))
    return found


def _selected(onsets: motions.Motions, wanted: set[tuple[int, int]], labels: int) -> np.ndarray:
    """The pairs of onsets (P, 2) that `motion_examples.transitions` takes: nearest to the mean peaks."""
    peaks = onsets.curves[:, -1]
    prototypes = augment.prototypes(peaks, onsets.end - 1, classes=labels - 1)
    chosen = augment.select(peaks, onsets.end - 1, prototypes, per_pair=transitions.TRANSITIONS_PER_PAIR, reuse=1).pairs
    ends = zip(*onsets.end[chosen].T.tolist(), strict=True)
    return chosen[[pair in wanted for pair in ends]]


def _table(metrics: dict[str, Any], noise: float) -> str:
    parts = _onsets_table(metrics["onsets"], noise), _peaks_table(metrics), _sentences(metrics)
    return "\n\n".join(parts)


def _onsets_table(onsets: dict[str, Any], noise: float) -> str:
    columns = {
        "length_ratio": "path length", "peak_ratio": "peak", "acceleration_ratio": "acceleration",
        "jitter_ratio": "acceleration / length", "nearest_mm": "nearest real, mm", "nearest_angle": "the same, radians",
        "noise_mm": f"moved by {noise:g} mm of noise, mm",
    }  # fmt: skip
    found = {"same expression, the two": onsets["parents"]} | {
        f"{kind}, {path}": onsets[kind][path] for kind in KINDS for path in PATHS
    }
    rows = [(name, *(row.get(column, "") for column in columns)) for name, row in found.items()]
    return _run.markdown(("between onsets of two people, over the mean of the two", *columns.values()), rows)


def _peaks_table(metrics: dict[str, Any]) -> str:
    peaks, names = metrics["peaks"], ("distance_mm", "distance_aligned_mm", "speed_rms", "acceleration_ratio")
    names += ("detour_ratio", "halfway_ratio")
    rows = [(way, *(row[n] for n in names), metrics["recognition"][way]) for way, row in peaks["ways"].items()]
    rows.append(("direct, another take", *(peaks["another_take"][n] for n in names), ""))
    header = (
        f"from peak to peak, against {metrics['transitions']:,} direct transitions of {metrics['people']} people",
        "distance, mm", "ends made to agree, mm", "speed profile, rms", "acceleration, ratio", "detour, ratio",
        "displacement halfway, ratio", "direct ones recognised",
    )  # fmt: skip
    return _run.markdown(header, rows)


def _sentences(metrics: dict[str, Any]) -> str:
    less = metrics["onsets"][KINDS[0]]["sphere_less"]
    nearest = f"in mm {less['nearest_mm']:.0%}, in radians {less['nearest_angle']:.0%}"
    each = "; ".join(
        f"{pace} pace, {row['sphere_nearer']:.1%}, {row['difference_mm']:+.3f} ± {row['standard_error_mm']:.3f} mm"
        for pace, row in metrics["peaks"]["paired"].items()
    )
    return (
        f"How often the sphere's onset is nearer to a real one than the straight line's: {nearest}. How often its "
        f"transition is nearer to the direct one, and by how much it is farther: {each}."
    )


if __name__ == "__main__":
    _run.main("interpolation", Config, run)
