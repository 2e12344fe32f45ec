"""Corpora: the motions that the pipeline makes, in shards that anybody can check."""

import json

import jax
import numpy as np
import pytest

from facejax.data import corpora
from facejax.data.synthetic import makehuman
from facejax.inference import corpus, pipeline

LABELS = ("neutral", "high_smile", "neutral")


@pytest.fixture(scope="module")
def models():
    return pipeline.load()


@pytest.fixture(scope="module")
def faces(models):
    return {"average": models.face.vertices, "S001": makehuman.subject(1).vertices}


@pytest.fixture(scope="module")
def written(models, faces, tmp_path_factory):
    heard, out = [], tmp_path_factory.mktemp("corpus") / "out"
    request = corpus.Request(12, frames=6, shard=5)
    found = corpus.generate(models, request, faces, out, progress=lambda *told: heard.append(told))
    return found, heard


def test_shards_hold_every_motion_once(written, models):
    found, heard = written
    assert len(found) == 12 and [shard.count for shard in found.shards] == [5, 5, 2]
    assert heard == [(0, 3), (1, 3), (2, 3), (3, 3)]
    found.verify()
    parts = list(found)
    marks, labels, person = (
        np.concatenate([part[name] for part in parts]) for name in ("landmarks", "labels", "person")
    )
    assert marks.shape == (12, 6, 68, 3) and labels.shape == (12, 2) and np.isfinite(marks).all()
    assert (labels[:, 0] != labels[:, 1]).all() and len({*map(tuple, labels.tolist())}) > 6
    assert set(person) == {0, 1} and found.index["people"] == ["average", "S001"]
    assert tuple(found.index["labels"]) == models.labels
    assert len({one.tobytes() for one in marks}) == 12


def test_a_motion_is_that_of_the_pipeline(models, faces, tmp_path):
    """Motion i is sample i of `pipeline.landmarks`, whatever the shard."""
    request = corpus.Request(5, LABELS, seed=3, frames=6, intensity=1.5, meshes=True, shard=3)
    found = corpus.generate(models, request, {"average": faces["average"]}, tmp_path)
    marks, vertices = (np.concatenate([part[name] for part in found]) for name in ("landmarks", "vertices"))
    expected = pipeline.landmarks(
        models, jax.random.key(3), LABELS, faces["average"], samples=5, frames=6, intensity=1.5
    )
    np.testing.assert_allclose(marks, expected, atol=1e-4)
    np.testing.assert_allclose(vertices, pipeline.meshes(models, expected, faces["average"]), atol=1e-3)


def test_what_is_missing_is_made_again_and_nothing_else(models, faces, written, tmp_path):
    request = corpus.Request(12, frames=6, shard=5)
    again = corpus.generate(models, request, faces, tmp_path / "again")
    kept = (tmp_path / "again" / again.shards[0].file).stat().st_mtime_ns
    (tmp_path / "again" / again.shards[1].file).unlink()
    damaged = bytearray((tmp_path / "again" / again.shards[2].file).read_bytes())
    damaged[-200] ^= 1
    (tmp_path / "again" / again.shards[2].file).write_bytes(damaged)
    (tmp_path / "again" / "index.json").unlink()
    with pytest.raises(corpora.CorpusError, match="not finished"):
        corpora.load(tmp_path / "again")
    corpus.generate(models, request, faces, tmp_path / "again")
    assert (tmp_path / "again" / again.shards[0].file).stat().st_mtime_ns == kept
    assert [shard.sha256 for shard in corpora.load(tmp_path / "again").shards] == [s.sha256 for s in written[0].shards]
    corpora.load(tmp_path / "again").verify()
    with pytest.raises(ValueError, match="holds a run with another seed"):
        corpus.generate(models, request._replace(seed=8), faces, tmp_path / "again")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"count": 0}, "count: expected 1 to"),
        ({"intensity": 3.0}, "intensity must lie in 0..2"),
        ({"labels": ("neutral", "smiel")}, "unknown label 'smiel'"),
        ({"labels": ("neutral",)}, "at least a start and an end"),
        ({"frames": 1}, "whole numbers of 2 or more"),
        ({"shard": 10**9}, "shard: 1000000000 sequences"),
        ({"shard": 0}, "shard: 0 sequences"),
        ({"count": 10**8, "shard": 1}, "make 100000000 files"),
        ({"count": 10**8}, "MB are free"),
    ],
)
def test_requests_that_cannot_be_met_are_refused(models, faces, tmp_path, change, message, monkeypatch):
    usage = corpus.shutil.disk_usage(tmp_path)._replace(free=10**9)
    monkeypatch.setattr(corpus.shutil, "disk_usage", lambda path: usage)
    with pytest.raises(ValueError, match=message):
        corpus.generate(models, corpus.Request(**{"count": 4, "frames": 6} | change), faces, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_damage_is_named(written, tmp_path):
    found, _ = written
    copy = tmp_path / "copy"
    (copy / "shards").mkdir(parents=True)
    for path in found.path.rglob("*.npz"):
        (copy / "shards" / path.name).write_bytes(path.read_bytes())
    index = json.loads((found.path / "index.json").read_text())
    (copy / "index.json").write_text(json.dumps(index))
    name = found.shards[1].file
    data = bytearray((copy / name).read_bytes())
    data[len(data) // 2] ^= 1
    (copy / name).write_bytes(data)
    with pytest.raises(corpora.CorpusError, match=r"000001\.npz is damaged"):
        corpora.load(copy).verify()
    (copy / name).write_bytes(data[:-1])
    with pytest.raises(corpora.CorpusError, match=r"000001\.npz: \d+ bytes, expected"):
        corpora.load(copy).read(1)
    for wrong in ("../../etc/passwd", "/etc/passwd", "shards/../../x.npz"):
        index["shards"][0]["file"] = wrong
        (copy / "index.json").write_text(json.dumps(index))
        with pytest.raises(corpora.CorpusError, match="invalid shard name"):
            corpora.load(copy)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"labels": None}, "labels: expected names"),
        ({"people": [1]}, "people: expected names"),
        ({"unit": "m"}, "expected millimetres"),
        ({"length": None}, "a length in frames"),
        ({"length": 7}, r"landmarks are \(5, 6, 68, 3\), expected \(n, 7, K, 3\)"),
        ({"labels": ["neutral"]}, "labels: expected integers below 1"),
        ({"people": ["average"]}, "person: expected integers below 1"),
    ],
)
def test_an_index_that_its_shards_go_against_is_refused(written, change, message):
    found, _ = written
    place = found.path / "index.json"
    whole = place.read_text()
    place.write_text(json.dumps(json.loads(whole) | change))
    try:
        with pytest.raises(corpora.CorpusError, match=message):
            list(corpora.load(found.path))
    finally:
        place.write_text(whole)


def test_numbers_that_are_none_are_refused(written):
    found, _ = written
    part = found.read(0)
    part["landmarks"] = np.where(np.arange(5)[:, None, None, None] == 1, np.nan, part["landmarks"])
    with pytest.raises(ValueError, match="landmarks are not all finite"):
        corpora._check(part, found.index)
