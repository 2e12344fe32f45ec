"""One call for all formats."""

import numpy as np
import pytest
from PIL import Image

from facejax import io
from facejax.viz import eyes_teeth


@pytest.mark.parametrize("name", ["a.glb", "a.html", "a.webp", "a.gif", "a.png", "a.npz", "frames/"])
def test_an_animation_in_every_format(tmp_path, moving, name):
    vertices, faces = moving
    eye = eyes_teeth.eyeball((0, 20, 80), 12)
    marks = np.arange(5)
    text = {"captions": ((0, "neutral → smile"), (3, "smile")), "landmarks": marks, "extras": (eye,)}
    io.save(f"{tmp_path}/{name}", vertices, faces, fps=20, size=(40, 50), **text)
    assert [entry.name for entry in tmp_path.iterdir()] == [name.strip("/")]
    if name == "frames/":
        read = np.stack([io.load_mesh(path).vertices for path in sorted((tmp_path / "frames").iterdir())])
        np.testing.assert_array_equal(read, vertices)
    if name == "a.npz":
        with np.load(tmp_path / name) as arrays:
            np.testing.assert_array_equal(arrays["vertices"], vertices)
            np.testing.assert_array_equal(arrays["landmarks"], vertices[:, marks])
            assert arrays["fps"] == 20
    if name in ("a.webp", "a.gif", "a.png"):
        with Image.open(tmp_path / name) as picture:
            assert picture.size[0] >= 40 and getattr(picture, "n_frames", 1) == (1 if name == "a.png" else 5)


@pytest.mark.parametrize("name", ["a.ply", "a.obj", "a.npz", "a.png", "a.glb", "a.html"])
def test_a_still_face(tmp_path, ball, name):
    vertices, faces = ball
    io.save(tmp_path / name, vertices, faces, size=(40, 50))
    if name in ("a.ply", "a.obj", "a.npz"):
        mesh = io.load_mesh(tmp_path / name)
        np.testing.assert_array_equal(mesh.vertices.astype(np.float32), vertices)
        np.testing.assert_array_equal(mesh.faces, faces)
    if name == "a.png":
        with Image.open(tmp_path / name) as picture:
            assert picture.size == (40, 50)


def test_an_existing_folder_takes_a_sequence(tmp_path, moving):
    io.save(tmp_path, *moving)
    assert len(list(tmp_path.glob("*.ply"))) == 5


def test_refusals(tmp_path, moving):
    with pytest.raises(ValueError, match="holds one mesh, got 5 frames"):
        io.save(tmp_path / "a.ply", *moving)
    with pytest.raises(ValueError, match=r"unknown format '\.fbx'"):
        io.save(tmp_path / "a.fbx", *moving)
    assert not list(tmp_path.iterdir())
