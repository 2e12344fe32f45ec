"""FLAME's landmark embedding in every form that it comes in."""

import pickle

import numpy as np
import pytest
import trimesh

from facejax import io
from facejax.io.landmarks import LandmarkError

BALL = trimesh.creation.icosphere(subdivisions=2)
VERTICES, FACES = np.asarray(BALL.vertices), np.asarray(BALL.faces, np.int32)
RNG = np.random.default_rng(0)
STATIC = RNG.integers(0, len(FACES), 51), RNG.dirichlet(np.ones(3), 51)
CONTOUR = RNG.integers(0, len(FACES), (79, 17)), RNG.dirichlet(np.ones(3), (79, 17))
FULL = np.concatenate([CONTOUR[0][0], STATIC[0]]), np.concatenate([CONTOUR[1][0], STATIC[1]])


def points(embedding):
    return np.einsum("lk,lkx->lx", embedding[1], VERTICES[FACES[embedding[0]]])


def write_object(path, content):
    np.save(path, np.array(content, dtype=object), allow_pickle=True)


@pytest.mark.parametrize("kind", ["full", "dynamic"])
def test_landmark_embedding(tmp_path, kind):
    content = {"static_lmk_faces_idx": STATIC[0], "static_lmk_bary_coords": STATIC[1]}
    content |= {"dynamic_lmk_faces_idx": CONTOUR[0], "dynamic_lmk_bary_coords": CONTOUR[1]}
    if kind == "full":
        content |= {"full_lmk_faces_idx": FULL[0][None], "full_lmk_bary_coords": FULL[1][None]}
    write_object(tmp_path / "landmark_embedding.npy", content)
    found = io.landmarks.read(tmp_path / "landmark_embedding.npy", VERTICES, FACES)
    np.testing.assert_allclose(found.points, points(FULL))
    assert found.index is None


@pytest.mark.parametrize("suffix", ["pkl", "npz"])
def test_the_static_51(tmp_path, suffix):
    content = {"lmk_face_idx": STATIC[0].astype(np.uint32), "lmk_b_coords": STATIC[1]}
    path = tmp_path / f"flame_static_embedding.{suffix}"
    if suffix == "pkl":
        path.write_bytes(pickle.dumps(content, protocol=2))
    else:
        np.savez(path, **content)
    np.testing.assert_allclose(io.landmarks.read(path, VERTICES, FACES).points, points(STATIC))


def test_what_is_no_embedding_is_named(tmp_path):
    def told(name, write, *mesh):
        write(tmp_path / name)
        with pytest.raises(LandmarkError) as error:
            io.landmarks.read(tmp_path / name, *mesh)
        assert name in str(error.value)
        return str(error.value)

    mesh = VERTICES, FACES
    good = {"lmk_face_idx": STATIC[0], "lmk_b_coords": STATIC[1]}
    assert "not a landmark embedding: contains []" in told("a.npz", lambda p: np.savez(p, other=STATIC[0]), *mesh)
    assert "expected one object" in told("b.npy", lambda p: np.save(p, VERTICES), *mesh)
    assert "out of range" in told("c.npz", lambda p: np.savez(p, **good | {"lmk_face_idx": STATIC[0] + 300}), *mesh)
    assert "a sum of 1" in told("d.npz", lambda p: np.savez(p, **good | {"lmk_b_coords": STATIC[1] * 2}), *mesh)
    assert "expected (L,) integers" in told("e.npz", lambda p: np.savez(p, **good | {"lmk_face_idx": 1.5}), *mesh)
    assert "need the mesh's vertices and faces" in told("f.npz", lambda p: np.savez(p, **good))
    assert "contains a list" in told("g.pkl", lambda p: p.write_bytes(pickle.dumps([1])), *mesh)
    assert "which is not allowed" in told("h.pkl", lambda p: p.write_bytes(pickle.dumps(print)), *mesh)
    assert "is not a zip" in told("i.npz", lambda p: p.write_bytes(b"PK"), *mesh).lower()
