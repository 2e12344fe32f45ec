"""Interpolation of motions on the sphere of SRVFs against linear interpolation in 3D.

OT23, section 4.1, states that interpolation on the sphere "leads to cleaner results than interpolating directly in
the 3D space". Three measurements, in which only random forests are trained:

Between performed onsets of two people, at 0.25, 0.5 and 0.75: path length, peak displacement and acceleration
relative to the two onsets, distance to the nearest real motion, and sensitivity to noise. From peak to peak: the
distance of the paper's transitions (on the sphere, at an even pace), of straight ones, and of both at other paces,
from transitions that the same person performed directly, which capture datasets do not contain. Recognition: a forest
trained on one construction classifies directly performed transitions of other people.

Direct transitions here are those of a rig: the activations of one expression decay while those of the other rise,
each with its own timing. They are closer to a straight line than those of real people may be.

    python -m experiments.interpolation --publish

Expected distance from the direct transitions at the performed pace: 0.619 mm on the sphere, 0.405 mm for straight
lines. Time: 3.5 minutes on 2 cores of an AMD EPYC.
"""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path
from typing import Any

import numpy as np
from sklearn.ensemble import RandomForestClassifier

from experiments import _datasets, _interpolation_eval, _interpolation_plots, _run, _transition_classifier
from experiments._interpolation_eval import PACES, PATHS, VARIANTS
from facejax import augment
from facejax.data import dataset, motions, transitions
from facejax.data.synthetic import makehuman4d
from facejax.evaluation import motion_metrics

HELD_OUT = ("validation", "test")
KINDS = ("same expression", "two expressions")


@dataclasses.dataclass(frozen=True)
class Config:
    out: Path = Path("runs/interpolation")
    """Folder for the results."""
    seed: int = 0
    """Seed of the pairs of people and of the forests."""
    data: Path | None = None
    """Prepared makehuman4d with other options (noise, head motion) to use in place of the default one."""
    level: int = 3
    """Realism level of makehuman4d, 0 to 3."""
    subjects: int = 120
    """Number of subjects of makehuman4d."""
    meshes: int = 20_000
    """Number of meshes of makehuman4d."""
    per_expression: int = 30
    """Number of pairs of onsets to interpolate between, per expression of the first."""
    noise: float = 0.2
    """Sigma of the tracking noise added to every coordinate, mm."""
    people: int = 4
    """Number of people who perform a second take of their direct transitions."""
    trees: int = 300
    """Number of trees of a forest."""
    publish: bool = False
    """Also write the committed results in experiments/results."""


def run(config: Config) -> dict[str, Any]:
    """Make the three measurements and draw the figures."""
    begun = time.perf_counter()
    data = _data(config)
    onsets = _interpolation_eval.onsets_only(_interpolation_eval.read_splits(data, HELD_OUT))
    direct = _interpolation_eval.read_splits(data, HELD_OUT, motions.direct_transitions)
    built = _transitions(onsets, direct)
    metrics = {
        "onsets": _onsets(config, data, onsets),
        "peaks": _peaks(config, data, built, direct),
        "recognition": _recognition(config, data, direct),
        "transitions": len(direct.curves),
        "people": len(np.unique(direct.subject)),
    }
    config.out.mkdir(parents=True, exist_ok=True)
    figure = _interpolation_plots.plot(config.out / "interpolation.png", metrics, direct)
    _interpolation_plots.sheet(config.out / "sheet.png", data, built, direct)
    made = _run.record(config, seconds=time.perf_counter() - begun, dataset=data.index["spec"])
    _run.finish("interpolation", config, metrics, made=made, table=_table(metrics, config.noise), figure=figure)
    if config.publish:
        _run.publish_file(config.out / "sheet.png", "interpolation_sheet.png")
    return metrics


def _data(config: Config) -> dataset.Dataset:
    if config.data is None:
        return makehuman4d.prepare(makehuman4d.Spec(config.level, config.subjects, config.meshes))
    data = dataset.open_dataset(config.data)
    if not _datasets.is_makehuman(data):
        raise ValueError(f"{data.path}: only makehuman4d contains directly performed peak-to-peak transitions")
    return data


def _onsets(config: Config, data: dataset.Dataset, onsets: motions.Motions) -> dict[str, Any]:
    """Evaluate interpolation between the onsets of two people; the nearest real ones are training subjects'."""
    scale = float(onsets.scale.mean())
    pool = _interpolation_eval.onsets_only(motions.halves(data, "train"))
    noise = np.random.default_rng(config.seed).standard_normal(onsets.curves.shape, np.float32)
    noisy = onsets.curves + config.noise / scale * noise
    real = _interpolation_eval.nearest_real(onsets.curves, onsets.end, pool, scale)
    drawn_pairs = _interpolation_eval.draw_pairs(onsets, config.per_expression, config.seed)
    parents = drawn_pairs["same expression"]
    found: dict[str, Any] = {"parents": {name: float(values[parents].mean()) for name, values in real.items()}}
    for kind, pairs in drawn_pairs.items():
        # Motions between two expressions have no real counterpart.
        known = pool if kind == "same expression" else None
        each = {
            path: _interpolation_eval.interpolation_scores(onsets, noisy, pairs, path, known, scale) for path in PATHS
        }
        found[kind] = {
            path: {name: float(values.mean()) for name, values in rows.items()}
            | {f"{name}_by_tau": values.mean(axis=1) for name, values in rows.items()}
            for path, rows in each.items()
        }
        found[kind]["sphere_less"] = {
            name: float(np.mean(values < each["linear"][name])) for name, values in each["sphere"].items()
        }
    return found


def _transitions(
    onsets: motions.Motions, direct: motions.Motions
) -> dict[tuple[str, str], _interpolation_eval.PeakTransitions]:
    """Build every variant of each direct transition from the same person's onsets."""
    row = {who: k for k, who in enumerate(zip(onsets.subject.tolist(), onsets.end.tolist(), strict=True))}
    first, second = (
        onsets.curves[[row[who] for who in zip(direct.subject.tolist(), labels.tolist(), strict=True)]]
        for labels in (direct.start, direct.end)
    )
    return {
        (path, pace): _interpolation_eval.peak_transitions(first, second, path=path, pace=pace)
        for path, pace in VARIANTS
    }


def _peaks(config: Config, data: dataset.Dataset, built, direct: motions.Motions) -> dict[str, Any]:
    """Compare every variant, and another take, with the direct transitions."""
    scale = float(direct.scale.mean())
    found = {
        _interpolation_eval.variant_name(way): _interpolation_eval.compare_with_direct(transition, direct, scale)
        for way, transition in built.items()
    }
    each = {name: row.pop("each_aligned_mm") for name, row in found.items()}
    people = np.unique(direct.subject)
    some = people[np.linspace(0, len(people) - 1, min(config.people, len(people))).astype(int)]
    once = direct.take(np.isin(direct.subject, some))
    even = next(iter(built.values())).tau[: len(once.curves)]
    twice = _interpolation_eval.compare_with_direct(
        _interpolation_eval.PeakTransitions(_interpolation_eval.perform_again(data, once).curves, even), once, scale
    )
    del twice["each_aligned_mm"]
    nearer = {}
    for pace in PACES:
        gain = (
            each[_interpolation_eval.variant_name(("sphere", pace))]
            - each[_interpolation_eval.variant_name(("linear", pace))]
        )
        by_person = np.array([gain[direct.subject == person].mean() for person in people])
        nearer[pace] = {
            "sphere_nearer": float(np.mean(gain < 0)),
            "difference_mm": float(by_person.mean()),
            "standard_error_mm": float(by_person.std(ddof=1) / np.sqrt(len(people))),
        }
    straight = float(motion_metrics.detour(direct.curves).mean())
    return {"ways": found, "another_take": twice, "paired": nearer, "direct_detour": straight}


def _recognition(config: Config, data: dataset.Dataset, direct: motions.Motions) -> dict[str, float]:
    """Train a forest on OT23's training set per variant of its transitions; return the accuracy on direct ones."""
    pairs = [(data.labels.index(a), data.labels.index(b)) for a, b in makehuman4d.TABLE5_PAIRS]
    halves = motions.halves(data, "train")
    onsets = _interpolation_eval.onsets_only(halves)
    first, second = _selected(onsets, set(pairs), len(data.labels)).T
    judged, which = _transition_classifier.select_pairs(direct, pairs)
    found = {}
    for path, pace in VARIANTS:
        curves = _interpolation_eval.peak_transitions(
            onsets.curves[first], onsets.curves[second], path=path, pace=pace
        ).curves
        labels = onsets.end[first], onsets.end[second]
        between = motions.Motions(curves, *labels, *(field[first] for field in onsets[3:]))
        train, target = _transition_classifier.select_pairs(motions.join(halves, between), pairs)
        forest = RandomForestClassifier(config.trees, random_state=config.seed, n_jobs=-1)
        forest.fit(train.curves.reshape(len(target), -1), target)
        named = forest.predict(judged.curves.reshape(len(which), -1))
        found[_interpolation_eval.variant_name((path, pace))] = float(np.mean(named == which))
    return found


def _selected(onsets: motions.Motions, wanted: set[tuple[int, int]], labels: int) -> np.ndarray:
    """Return the pairs of onsets (P, 2) that `data.transitions.transitions` selects: nearest to the mean peaks."""
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
