"""Every experiment on a dataset of the user's own: other labels, other people, and none of makehuman4d's extras."""

import json

import numpy as np
import pytest

from experiments import (
    _motion_transfer,
    classification,
    composed,
    dataset_card,
    expression_lstm,
    figure9,
    generators,
    interpolation,
    motion_quality,
    nonlinearity,
    rbf_warp,
    specificity,
    table2,
    unseen_subjects,
)
from facejax.data import dataset, motions, transitions
from facejax.data.synthetic import makehuman4d
from facejax.inference import pipeline
from facejax.training.recipes import fit_motion
from tests.test_dense_experiments import tiny  # noqa: F401 (a fixture)
from tests.test_experiments import check, own_cache  # noqa: F401 (a fixture)

LABELS = ("neutral", "grin", "gape", "frown")
KNOWN_AS = {"grin": "high_smile", "gape": "mouth_open", "frown": "anger"}


@pytest.fixture(scope="module")
def own(tmp_path_factory):
    """Ten train, four validate, five test; what they do is called otherwise than in makehuman4d."""
    made = makehuman4d.prepare(makehuman4d.Spec(0, 19, 1000), folder=tmp_path_factory.mktemp("made"))
    folder = tmp_path_factory.mktemp("own")
    takes = [s for s in made.sequences if s.label in KNOWN_AS.values()]
    rows = np.concatenate([np.arange(s.start, s.start + s.frames) for s in takes])
    back = {known: name for name, known in KNOWN_AS.items()}
    starts = np.cumsum([0] + [s.frames for s in takes])[:-1].tolist()
    kept = np.isin(made.drawn, rows)
    place = np.full(len(made.landmarks), -1)
    place[rows] = np.arange(len(rows))
    drawn = place[made.drawn[kept]]
    order = np.argsort(drawn)
    arrays = {
        "faces": made.faces, "neutral": made.neutral, "landmarks": made.landmarks[rows], "drawn": drawn[order],
        "vertices": made.vertices[kept][order], "landmark_index": made.landmark_index,
    }  # fmt: skip
    for name, array in arrays.items():
        np.save(folder / f"{name}.npy", array)
    splits = ["train"] * 10 + ["validation"] * 4 + ["test"] * 5
    index = {
        "schema": dataset.SCHEMA,
        "name": "own",
        "labels": LABELS,
        "rate": 30,
        "spec": {"source": "test"},
        "subjects": [{"name": f"p{i}", "split": split} for i, split in enumerate(splits)],
        "sequences": [s._replace(label=back[s.label], start=at)._asdict() for s, at in zip(takes, starts, strict=True)],
        "shapes": {name: list(array.shape) for name, array in arrays.items()},
    }
    (folder / "index.json").write_text(json.dumps(index))
    return folder


@pytest.fixture(scope="module")
def model(own, tmp_path_factory):
    """Its motion, and the released way to meshes: the triangles are MakeHuman's."""
    data, path = dataset.open_dataset(own), tmp_path_factory.mktemp("model") / "own.safetensors"
    known = motions.join(*transitions.all_pairs(data, "train", per_pair=8))
    chart = transitions.fit_chart(known, labels=len(LABELS), rank=transitions.default_rank(known))
    examples = transitions.encode_examples(chart, known)
    motion = fit_motion.fit_flow(examples, chart, path.with_suffix(""), plan=fit_motion.FlowPlan(steps=2, batch=8))
    starts = transitions.fit_start_poses(chart, motions.halves(data, "train"))
    pipeline.save(path, pipeline.load().replace(labels=pipeline.Labels(LABELS), motion=motion, starts=starts))
    return path


@pytest.mark.parametrize("experiment", [specificity, classification, composed], ids=lambda module: module.__name__)
def test_generated_motion(own_cache, own, model, experiment, tmp_path):  # noqa: F811
    options = {"classification": {"trees": 10}, "composed": {"chains": 1}}.get(experiment.__name__.split(".")[1], {})
    with pytest.raises(ValueError, match=r"the released models: expected the labels of .*, neutral, grin, gape, frown"):
        experiment.run(experiment.Config(out=tmp_path / "o", data=own, **options))
    experiment.run(experiment.Config(out=tmp_path / "o", data=own, models=(model,), samples=3, **options))
    metrics = check(tmp_path / "o", "people")
    assert metrics["people"] == 5 and metrics["made"]["dataset"] == {"source": "test"}
    if "per_transition" in metrics:
        assert len(metrics["per_transition"]) == 12 and "grin>gape" in metrics["per_transition"]


def test_generators_are_chosen(own_cache, own, model, tmp_path, monkeypatch):  # noqa: F811
    monkeypatch.setattr(transitions, "SPREAD_PER_PAIR", 3)
    monkeypatch.setattr(transitions, "CHART_PER_PAIR", 8)
    options = {"variants": ("gaussian", "flow"), "seeds": (0,), "flow_steps": 2}
    with pytest.raises(ValueError, match="the released models: expected the labels"):
        generators.run(generators.Config(out=tmp_path / "o", data=own, **options))
    generators.run(generators.Config(out=tmp_path / "o", data=own, model=model, **options))
    assert check(tmp_path / "o", "chosen")["chosen"] in ("gaussian", "flow")
    assert pipeline.load(tmp_path / "o" / "flow-0.safetensors").labels == LABELS


def test_too_few_people_are_told(own_cache, own, model, monkeypatch):  # noqa: F811
    monkeypatch.setattr("experiments._motion_eval.MIN_COUNT", 6)
    with pytest.raises(ValueError, match="expected 6 or more people in the test split, got 5"):
        specificity.run(specificity.Config(data=own, models=(model,)))


def test_motion_quality(own_cache, own, model, tmp_path):  # noqa: F811
    motion_quality.run(motion_quality.Config(out=tmp_path / "o", data=own, model=model, samples=3))
    metrics = check(tmp_path / "o", "pairs", "people")
    assert metrics["people"] == {"held out": 9, "trained on": 10} and set(metrics["amplitude_ratio"]) == set(LABELS[1:])


def test_card_and_unseen_subjects(own_cache, own, tmp_path):  # noqa: F811
    dataset_card.run(dataset_card.Config(out=tmp_path / "a", data=own))
    metrics = check(tmp_path / "a", "levels", "speed_mm_per_s")
    assert metrics["levels"][own.name]["subjects"] == {"train": 10, "validation": 4, "test": 5}
    assert {p.name for p in (tmp_path / "a").glob("*.png")} == {"dataset_card.png", "expressions.png"}
    unseen_subjects.run(unseen_subjects.Config(out=tmp_path / "b", data=own, steps=2))
    assert {row["level"] for row in check(tmp_path / "b", "rows")["rows"]} == {own.name}


def test_expression_networks(own_cache, own, tmp_path):  # noqa: F811
    expression_lstm.run(expression_lstm.Config(out=tmp_path / "o", data=own, steps=2, variants=("truth",)))
    assert set(check(tmp_path / "o", "test")["test"]) == set(LABELS[1:])
    assert (tmp_path / "o" / "sheet.png").exists()
    with pytest.raises(ValueError, match="leave out --data"):
        expression_lstm.run(expression_lstm.Config(out=tmp_path / "p", data=own, release=True))
    assert not (tmp_path / "p").exists()


def test_warps(own_cache, own, tmp_path):  # noqa: F811
    rbf_warp.run(rbf_warp.Config(out=tmp_path / "o", data=own, frames=30, quick=True))
    metrics = check(tmp_path / "o", "test", "still")
    assert set(metrics["still"]) == {"head", "face", "worst vertex", "normals"}
    assert min(row["error_mm"]["face"] for row in metrics["test"]) < metrics["still"]["face"]
    assert {p.name for p in (tmp_path / "o").glob("*.png")} == {
        "rbf_warp.png", "heat.png", "sequence.png", "faces.png",
    }  # fmt: skip


def test_noise_of_landmarks(tiny, own, tmp_path):  # noqa: F811
    options = {"quick": True, "data": own, "methods": ("ridge",), "splits": ("test",)}
    found = nonlinearity.run(nonlinearity.Config(out=tmp_path / "o", **options))
    assert {row["level"] for row in found["rows"]} == {own.name}
    assert len(found["floor"]) == 1 and own.name in (tmp_path / "o" / "table.md").read_text()


def test_motion_carried_between_people(tiny, own, model, tmp_path):  # noqa: F811
    options = {"out": tmp_path / "a", "quick": True, "people": 2, "passages": 2, "methods": ("still", "rbf")}
    rows = table2.run(table2.Config(data=own, speech=own, **options))["rows"]
    errors = {(row["method"], row["region"]): row for row in rows}
    assert errors["rbf", "face"]["own_mm"] < errors["still", "face"]["own_mm"]
    with pytest.raises(ValueError, match="--recording animates people of makehuman4d"):
        table2.run(table2.Config(data=own, recording=tmp_path / "take.csv", **options))
    with pytest.raises(ValueError, match=r"expected --recording .*, or --speech"):
        table2.run(table2.Config(data=own, **options))
    found = figure9.run(figure9.Config(out=tmp_path / "b", data=own, model=model))
    assert [row["target"] for row in found["transfer"]] == ["p14", "p15"]
    assert all(0 < row["mean_mm"] < 3 * row["still_mm"] for row in found["transfer"])
    with pytest.raises(ValueError, match="name one of them"):
        figure9.run(figure9.Config(out=tmp_path / "b", data=own, model=model, recording=tmp_path / "take.csv"))
    with pytest.raises(ValueError, match="trained on another dataset than makehuman4d: give that dataset with --data"):
        figure9.run(figure9.Config(out=tmp_path / "b", model=model))
    with pytest.raises(ValueError, match="--people: expected three of"):
        figure9.run(figure9.Config(out=tmp_path / "b", data=own, model=model, people=(1, 2, 99)))


def test_a_take_is_carried_onto_itself_and_stretched(own):
    data = dataset.open_dataset(own)
    take = _motion_transfer.find_recording(data, 14, "gape")
    np.testing.assert_allclose(_motion_transfer.transfer(take, take, data.landmark_index), take.landmarks, atol=2e-3)
    np.testing.assert_array_equal(
        take.vertices[:, data.landmark_index], (take.rest[data.landmark_index] + take.landmarks)[take.at]
    )
    longer = take._replace(landmarks=np.repeat(take.landmarks, 2, axis=0))
    carried = _motion_transfer.transfer(take, longer, data.landmark_index)
    np.testing.assert_allclose(carried[[0, -1]], take.landmarks[[0, -1]], atol=2e-3)
    energy = [np.linalg.norm(curve, axis=-1).mean(axis=-1) for curve in (carried, take.landmarks)]
    assert energy[0].argmax() // 2 == pytest.approx(energy[1].argmax(), abs=1)
    assert _motion_transfer.find_recording(data, 14, "sneer") is None


def test_what_only_makehuman4d_has(own_cache, own, tmp_path):  # noqa: F811
    with pytest.raises(ValueError, match="only makehuman4d contains directly performed peak-to-peak transitions"):
        interpolation.run(interpolation.Config(out=tmp_path / "o", data=own))
