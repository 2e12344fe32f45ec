"""The experiments on landmarks -> mesh, on tiny datasets and for a step or two: they run, keep results, go on."""

import dataclasses
import json

import numpy as np
import pytest

from experiments import (
    _datasets,
    _mesh_eval,
    _run,
    figure5,
    figure6,
    figure9,
    nonlinearity,
    table1,
    table2,
    table3,
    table4,
)
from facejax.data import dataset
from facejax.data.mesh_subset import of_split
from facejax.data.synthetic import makehuman4d
from facejax.evaluation import baselines, vertex_error
from facejax.training.recipes import fit_gpmm
from tests.cli.test_main import recorded
from tests.test_experiments import check, own_cache  # noqa: F401 (a fixture)


@pytest.fixture
def tiny(own_cache, monkeypatch):  # noqa: F811
    """Six people, two steps, few candidates."""
    monkeypatch.setattr(_datasets, "QUICK", {"subjects": 6, "meshes": 260})
    monkeypatch.setattr(_mesh_eval, "QUICK_STEPS", 2)
    monkeypatch.setattr(_mesh_eval, "QUICK_COMPONENTS", 8)
    monkeypatch.setattr(_datasets, "FOLDS", 2)
    monkeypatch.setattr(fit_gpmm, "FOLDS", 2)
    monkeypatch.setattr(fit_gpmm, "SMOOTHNESS_GRID", (0.0, 0.03))
    monkeypatch.setattr(fit_gpmm, "NOISE_GRID", (1e-4,))
    monkeypatch.setattr(fit_gpmm, "EVALUATED_PEOPLE", 1)


def test_table1_has_a_row_for_each_and_goes_on(tiny, tmp_path, monkeypatch):
    small = {"quick": True, "level": 1}
    table1.run(table1.Config(out=tmp_path / "o", methods=("s2d",), splits=("test",), **small))
    rows = check(tmp_path / "o", "rows")["rows"]
    assert [r["region"] for r in rows] == ["head", "face"] and rows[0]["chosen"] == [{"steps": 2}]
    config = table1.Config(out=tmp_path / "o", methods=("ridge", "rbf"), splits=("identity", "test"), **small)
    table1.run(config)
    metrics = check(tmp_path / "o", "rows", "mode", "paper_mm")
    rows = metrics["rows"]
    assert metrics["mode"] == "quick" and len(rows) == 2 * 2 * 2
    assert {(r["method"], r["split"], r["region"]) for r in rows} == {
        (m, s, r) for m in config.methods for s in config.splits for r in ("head", "face")
    }
    assert all(r["mean_mm"] > 0 and r["std_mm"] > 0 for r in rows)
    assert all(len(r["folds_mm"]) == (2 if r["split"] == "identity" else 1) for r in rows)
    # Known results are read, not made again.
    monkeypatch.setattr(baselines, "METHODS", dict.fromkeys(baselines.METHODS))
    table1.run(config)
    assert json.loads((tmp_path / "o" / "metrics.json").read_text())["rows"] == rows
    # The curves are of the same results.
    curves = figure5.run(
        figure5.Config(out=tmp_path / "f", runs=tmp_path / "o", methods=config.methods, splits=("identity",), **small)
    )["curves"]
    check(tmp_path / "f", "edges_mm", "curves")
    assert len(curves) == 4 and all(np.all(np.diff(c["share"]) >= 0) and c["share"][-1] > 0.99 for c in curves)


def test_table1_on_a_store_of_ones_own(tiny, tiny_store, tmp_path):
    found = table1.run(
        table1.Config(out=tmp_path / "o", quick=True, data=tiny_store.path, methods=("still",), splits=("expression",))
    )
    assert found["data"] == "makehuman4d" and found["rows"][0]["mean_mm"] > 0.1


def test_a_result_is_made_anew_when_what_it_depends_on_changes(tiny, tiny_store, tmp_path, monkeypatch):
    case = _datasets.cases(tiny_store, ["identity"])[0]
    regions, options = _datasets.region_masks(tiny_store), baselines.Options()
    first = _mesh_eval.evaluate("still", case, tmp_path, options, regions)[0.0]
    again = _mesh_eval.evaluate("still", case, tmp_path, options, regions)[0.0]
    np.testing.assert_array_equal(first.distances.total, again.distances.total)
    fewer = case._replace(test=case.test.thin(2))
    assert _mesh_eval.evaluate("still", fewer, tmp_path, options, regions)[0.0].distances.count < first.distances.count


def test_cases_share_nobody_or_no_expression(tiny_store):
    people = set(tiny_store.subjects("train")) | set(tiny_store.subjects("validation"))
    identity = _datasets.cases(tiny_store, ["identity"])
    assert len(identity) == 4 and {i for c in identity for i in c.test.subjects} == people
    assert all(not set(c.train.subjects) & set(c.test.subjects) and c.by == "subjects" for c in identity)
    expression = _datasets.cases(tiny_store, ["expression"])
    held = [set(c.test.labels) for c in expression]
    assert all(not set(c.train.labels) & h and c.by == "labels" for c, h in zip(expression, held, strict=True))
    assert "anger" not in set.union(*held)
    (test,) = _datasets.cases(tiny_store, ["test"])
    assert set(test.test.subjects) == set(tiny_store.subjects("test")) and set(test.train.subjects) == people
    with pytest.raises(ValueError, match="unknown split 'age'"):
        _datasets.cases(tiny_store, ["age"])


@pytest.mark.parametrize(
    ("name", "identity", "expression"),
    [
        ("d3dfacs", 3, {f"e{i:02}" for i in range(11)}),
        ("bu3dfe", 10, {"angry", "disgust"}),
        ("florence4d", 40, {"e00", "e01"}),
        ("coma", 3, {f"e{i:02}" for i in range(4)}),
    ],
)
def test_published_splits(tiny_store, name, identity, expression):
    """Of OT23 4.1, on an index that stands for the dataset: one mesh of each person and expression."""
    labels = (
        [f"e{i:02}" for i in range(14)] + ["angry", "disgust"] if name == "bu3dfe" else [f"e{i:02}" for i in range(14)]
    )
    count = {"d3dfacs": 10, "bu3dfe": 20, "florence4d": 60, "coma": 12}[name]
    recordings = [dataset.Sequence(p, label, 0, 1, 0, 0, 0, 0, 0.1) for p in range(count) for label in labels]
    # Whom the dataset's own splits keep apart is among the paper's people all the same.
    splits = [makehuman4d.split_of(i, count) for i in range(count)]
    people = [
        {"name": f"p{i}", "split": split, "sex": "female" if i < 45 else "male"} for i, split in enumerate(splits)
    ]
    data = tiny_store._replace(
        index=tiny_store.index | {"name": name, "subjects": people},
        sequences=tuple(recordings),
        drawn=np.arange(len(recordings)),
        vertices=np.broadcast_to(tiny_store.vertices[:1], (len(recordings), *tiny_store.vertices.shape[1:])),
    )
    by_person, *more = _datasets.cases(data, ["identity"])
    assert len(more) == (3 if name == "coma" else 0)
    assert len(by_person.test.subjects) == identity
    by_label = _datasets.cases(data, ["expression"])[0]
    assert set(by_label.test.labels) == expression and by_label.test.count + by_label.train.count == len(recordings)
    held = by_person.test.subjects
    if name == "florence4d":
        assert set(held) == {*range(15, 45), *range(50, 60)}
        del people[2]["sex"]
        with pytest.raises(ValueError, match=r"subject p2 has no sex \(female or male\), which the Florence"):
            _datasets.cases(data, ["identity"])
    else:
        assert set(held) == set(range(identity))


def test_table3_in_both_directions(tiny, tmp_path, monkeypatch):
    monkeypatch.setattr(table3, "LEVEL", 0)
    found = table3.run(table3.Config(out=tmp_path / "o", quick=True, methods=("ridge",)))
    check(tmp_path / "o", "rows", "paper_mm")
    head = [r for r in found["rows"] if r["region"] == "head"]
    errors = {r["direction"]: r["mean_mm"] for r in head if r["method"] == "ridge"}
    (noise,) = [r["mean_mm"] for r in head if r["method"] == table3.ALONE]
    assert 0.5 * table3.NOISE < noise < 2 * table3.NOISE
    assert set(errors) == {"A to B", "A to B, clean", "B to A"}
    assert errors["A to B"] > errors["A to B, clean"] > 0


def test_table4_trains_each_variant(tiny, tmp_path, monkeypatch):
    monkeypatch.setattr(table4, "VARIANTS", {name: table4.VARIANTS[name] for name in ("S1", "S3, inverse, reference")})
    found = table4.run(table4.Config(out=tmp_path / "o", quick=True, level=0))
    check(tmp_path / "o", "rows", "paper_mm")
    assert len({r["mean_mm"] for r in found["rows"]}) == 4


def test_nonlinearity_with_noise_and_floor(tiny, tmp_path, monkeypatch):
    # Two people to judge: what landmarks leave open is seen between people.
    monkeypatch.setattr(_datasets, "QUICK", {"subjects": 12, "meshes": 300})
    config = nonlinearity.Config(
        out=tmp_path / "o", quick=True, levels=(0,), noises=(0.0,), methods=("ridge",), splits=("test",)
    )
    found = nonlinearity.run(config)
    check(tmp_path / "o", "rows", "floor")
    head = {(r["method"], r["landmark_noise_mm"]): r["mean_mm"] for r in found["rows"] if r["region"] == "head"}
    assert set(head) == {(m, n) for m in ("ridge", "told") for n in (0.0, 0.5, 1.0)}
    assert head["ridge", 0.0] < 0.1 * head["ridge", 1.0] and head["told", 1.0] < head["ridge", 1.0]


def test_table2_carries_a_recording_to_others(tiny, tmp_path, monkeypatch):
    take = recorded(tmp_path / "take.csv")
    config = table2.Config(
        recording=take, out=tmp_path / "o", quick=True, people=1, passages=2, seconds=0.5, methods=("still", "rbf")
    )
    with pytest.raises(ValueError, match="expected two or more test subjects, got 1"):
        table2.run(config)
    monkeypatch.setattr(_datasets, "QUICK", {"subjects": 12, "meshes": 300})
    monkeypatch.setattr(table2, "LEVEL", 0)
    for wrong, message in (
        ({"people": 0}, "--people and --passages of 1 or more"),
        ({"seconds": 9.0}, "--seconds: exp"),
    ):
        with pytest.raises(ValueError, match=message):
            table2.run(dataclasses.replace(config, **wrong))
    rows = {(r["method"], r["region"]): r for r in table2.run(config)["rows"]}
    check(tmp_path / "o", "rows", "window")
    assert rows["rbf", "face"]["own_mm"] < rows["still", "face"]["own_mm"]
    for row in rows.values():
        assert row["transferred_window_mm"] <= row["transferred_mm"]
        assert row["own_window_mm"] <= row["own_mm"]


def test_figures_of_faces(tiny, tmp_path):
    found = figure6.run(
        figure6.Config(out=tmp_path / "a", runs=tmp_path / "r", quick=True, level=0, methods=("still", "rbf"))
    )
    check(tmp_path / "a", "rows", "red_mm")
    errors = {m: np.mean([r["mean_mm"] for r in found["rows"] if r["method"] == m]) for m in ("still", "rbf")}
    assert errors["rbf"] < errors["still"] and (tmp_path / "a" / "figure6.png").exists()
    found = figure9.run(figure9.Config(out=tmp_path / "b"))
    check(tmp_path / "b", "transfer", "chains")
    assert all(row["mean_mm"] < 0.8 * row["still_mm"] for row in found["transfer"])
    assert {p.name for p in (tmp_path / "b").glob("*.glb")} == {
        "chain1.glb", "chain2.glb", "source.glb", "transfer1.glb", "transfer2.glb",
    }  # fmt: skip


def test_datasets_have_folders_of_their_own(tmp_path):
    plain, own, other = (
        table1.Config(out=tmp_path, data=data) for data in (None, tmp_path / "a" / "store", tmp_path / "b" / "store")
    )
    folders = [config.folder() for config in (plain, own, other, dataclasses.replace(own, quick=True))]
    assert folders[0] == tmp_path and len(set(folders)) == 4
    assert folders[3] == folders[1] / "quick" and folders[1].name.startswith("store-")


@pytest.mark.parametrize("less", [["--quick"], ["--folds", "1"]])
def test_only_the_full_experiment_is_published(tmp_path, capsys, monkeypatch, less):
    monkeypatch.setattr("sys.argv", ["table1", "--publish", *less, "--out", str(tmp_path)])
    with pytest.raises(SystemExit) as end:
        _run.main("table1", table1.Config, table1.run)
    assert end.value.code == 2 and f"leave out {less[0]}" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_figures_of_the_papers_epochs_do_not_replace_the_others(tmp_path, monkeypatch):
    monkeypatch.setattr(_run, "RESULTS", tmp_path / "results")
    for paper in (False, True):
        config = table1.Config(out=tmp_path, publish=True, paper=paper, trained_on="a GPU" * paper)
        made = _run.record(config, seconds=1.0)
        assert made["machine"].get("trained_on", "") == config.trained_on
        _run.finish("table1", config, {"paper": paper}, made=made, table="| a |")
    assert sorted(p.name for p in (tmp_path / "results").iterdir()) == [
        "table1-paper.json", "table1-paper.md", "table1.json", "table1.md",
    ]  # fmt: skip
    assert json.loads((tmp_path / "results" / "table1.json").read_text())["paper"] is False


def test_the_first_folds_alone(tiny_store, tmp_path):
    plain = table1.Config(out=tmp_path, data=tiny_store.path, methods=("ridge",), splits=("identity",), quick=True)
    rows = table1.run(dataclasses.replace(plain, folds=1))["rows"]
    assert [len(row["folds_mm"]) for row in rows] == [1, 1]
    with pytest.raises(ValueError, match="--folds 0"):
        table1.run(dataclasses.replace(plain, folds=0))


def test_two_datasets_in_other_topologies_are_told(tiny_store):
    _datasets.check_same_topology(tiny_store, tiny_store)
    with pytest.raises(ValueError, match="have different landmarks"):
        _datasets.check_same_topology(
            tiny_store, tiny_store._replace(landmark_index=np.asarray(tiny_store.landmark_index)[::-1])
        )
    with pytest.raises(ValueError, match="have different triangles"):
        _datasets.check_same_topology(tiny_store, tiny_store._replace(faces=np.asarray(tiny_store.faces)[:-1]))


def test_modes_exclude_each_other():
    with pytest.raises(ValueError, match="--quick and --paper"):
        table1.run(table1.Config(quick=True, paper=True))
    with pytest.raises(ValueError, match="unknown method 'magic'"):
        table1.run(table1.Config(quick=True, methods=("magic",)))


def test_distances_add_up(tiny_store):
    meshes = of_split(tiny_store, "train")
    parts = [vertex_error.distances(_still, meshes.where(meshes.owner == s), _all(meshes)) for s in meshes.subjects]
    whole = vertex_error.distances(_still, meshes, _all(meshes))
    total = parts[0]
    for part in parts[1:]:
        total = total.add(part)
    np.testing.assert_allclose(total.total, whole.total)
    assert total.count == whole.count and (total.histogram == whole.histogram).all()


def _still(marks, rest):
    return np.broadcast_to(rest, (len(marks), *rest.shape))


def _all(meshes):
    return {"head": np.ones(meshes.data.neutral.shape[1], bool)}
