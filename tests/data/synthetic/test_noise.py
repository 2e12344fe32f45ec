"""Registration noise: its size, its smoothness, and that it is off unless asked for."""

import numpy as np
import pytest

from facejax.data.synthetic import makehuman4d, noise
from facejax.mesh import graph


def test_every_vertex_moves_by_sigma():
    found = noise.field(400, np.random.default_rng(0), sigma=0.3)
    assert found.shape == (400, 3260, 3) and found.dtype == np.float32
    size = np.sqrt((found.astype(np.float64) ** 2).sum(-1).mean(0))
    np.testing.assert_allclose(size, 0.3, rtol=0.15)
    assert size.mean() == pytest.approx(0.3, rel=0.02)


def test_neighbours_move_together_and_far_vertices_do_not(template):
    found = noise.field(400, np.random.default_rng(1), sigma=0.5)
    distance = graph.geodesic(template.vertices, template.faces, [int(template.landmarks[30])])
    here = found[:, template.landmarks[30]]

    def correlation(mask):
        return np.mean(here[:, None] * found[:, mask]) / np.mean(here**2)

    assert correlation((distance > 0) & (distance < 5)) > 0.85
    assert abs(correlation(distance > 90)) < 0.1


def test_a_noisy_dataset_stands_beside_the_clean_one(tiny_spec, tmp_path):
    spec = tiny_spec._replace(subjects=1, level=0, meshes=20)
    clean, noisy, again = (
        makehuman4d.prepare(s, folder=tmp_path / n)
        for s, n in ((spec, "a"), (spec._replace(noise=0.2), "b"), (spec._replace(noise=0.2), "c"))
    )
    assert clean.path.name != noisy.path.name
    off = np.linalg.norm(noisy.landmarks - np.asarray(clean.landmarks), axis=-1)
    assert np.sqrt((off**2).mean()) == pytest.approx(0.2, rel=0.15)
    np.testing.assert_array_equal(noisy.neutral, clean.neutral)
    np.testing.assert_array_equal(noisy.landmarks, again.landmarks)
    np.testing.assert_array_equal(noisy.vertices[:, noisy.landmark_index], noisy.landmarks[noisy.drawn])


def test_too_much_is_refused():
    with pytest.raises(ValueError, match=r"0\.\.2 mm, got 5"):
        noise.field(1, np.random.default_rng(0), sigma=5)
