"""Expression networks as a file and by name: what comes back, and what is refused."""

import jax
import numpy as np
import pytest

from facejax.inference import expressions
from facejax.io import weights
from facejax.models import expression_lstm
from facejax.models.labels import Labels
from facejax.models.records import Provenance

L = 6


def made(start="zero", components=None, labels=("anger", "fear")):
    config = expression_lstm.Config(landmarks=L, hidden=8, layers=2, start=start, components=components)
    rng = np.random.default_rng(0)
    steps, neutral = 0.01 * rng.normal(size=(4, 10, L, 3)), rng.normal(size=(4, L, 3))
    scale = expression_lstm.measure(steps, np.ones((4, 10), bool), neutral, config=config)
    one = [expression_lstm.init(jax.random.key(i), scale, config=config) for i in range(len(labels))]
    params = jax.tree.map(lambda *leaves: 3 * np.stack(leaves), *one)
    return expressions.Expressions(Labels(labels), params, config, 25.0, 40, Provenance({"seed": 3}))


@pytest.mark.parametrize("options", [{}, {"components": 5}, {"start": "neutral"}, {"labels": ("anger",)}])
def test_a_file_gives_the_same_motion(tmp_path, options):
    networks = made(**options)
    expressions.save(tmp_path / "n.safetensors", networks)
    found = expressions.load(tmp_path / "n.safetensors")
    assert found.labels == networks.labels and found.config == networks.config and dict(found.about) == {"seed": 3}
    assert (found.rate, found.frames) == (25.0, 40)
    neutral = np.random.default_rng(1).normal(size=(L, 3))
    for label in networks.labels:
        a, b = (expressions.displacements(n, label, neutral, stop=0.0) for n in (networks, found))
        assert a.shape == (40, L, 3)
        np.testing.assert_allclose(a, b, atol=5e-3 * np.abs(a).max())  # half precision


def test_a_file_of_something_else_is_refused(tmp_path):
    weights.save(tmp_path / "w.safetensors", {"a": np.zeros(3)}, metadata={"labels": ["x"]})
    with pytest.raises(weights.WeightsError, match="does not describe expression networks"):
        expressions.load(tmp_path / "w.safetensors")
    with pytest.raises(weights.WeightsError, match="no such weights file"):
        expressions.load(tmp_path / "none.safetensors")
    networks = made()
    expressions.save(tmp_path / "n.safetensors", networks.replace(config=networks.config._replace(hidden=9)))
    with pytest.raises(weights.WeightsError, match="does not match the model"):
        expressions.load(tmp_path / "n.safetensors")


def test_names_and_shapes_that_are_wrong():
    networks = made("neutral")
    with pytest.raises(ValueError, match="'angr': did you mean anger"):
        expressions.displacements(networks, "angr")
    with pytest.raises(ValueError, match="expected one of anger, fear"):
        expressions.displacements(networks, "zzz")
    with pytest.raises(ValueError, match=r"neutral: expected landmarks at rest \(..., 6, 3\)"):
        expressions.displacements(networks, "anger")
    with pytest.raises(ValueError, match="neutral"):
        expressions.displacements(networks, "anger", np.zeros((5, 3)))
    with pytest.raises(ValueError, match="stop must lie"):
        expressions.displacements(networks, "anger", np.eye(6, 3), stop=1.0)


def test_the_size_and_place_of_a_face_do_not_matter():
    networks = made("neutral")
    neutral = np.random.default_rng(1).normal(size=(L, 3)).astype(np.float32)
    a = expressions.displacements(networks, "anger", neutral, stop=0.0)
    b = expressions.displacements(networks, "anger", 70 * neutral + [5, -3, 2], stop=0.0)
    np.testing.assert_allclose(a, b, atol=1e-5 * np.abs(a).max() + 1e-7)
    many = expressions.displacements(networks, "anger", np.stack([neutral, -neutral]), stop=0.0)
    np.testing.assert_allclose(many[0], a, atol=1e-6)


def test_the_released_networks_move_a_face_and_bring_it_home():
    networks = expressions.load()
    assert networks.labels == ("anger", "disgust", "fear", "happiness", "sadness", "surprise")
    assert networks.about["made"]["dataset"]["level"] == 3
    for label in networks.labels:
        curve = np.asarray(expressions.displacements(networks, label))
        away = np.linalg.norm(curve, axis=(1, 2))
        assert 25 <= len(curve) <= networks.frames and curve.shape[1:] == (68, 3)
        assert away[0] == 0 and away[-1] < 0.35 * away.max()
        # The farthest from neutral somewhere in the middle, by as much as an expression moves a face.
        assert 8 < away.argmax() < len(curve) - 5 and 0.02 < away.max() < 0.4
        # Asked for more than anything that it learnt from, it still stops when the expression is over.
        longer = np.asarray(expressions.displacements(networks, label, frames=3 * networks.frames))
        assert longer.shape == curve.shape
        np.testing.assert_allclose(longer, curve, atol=1e-4)
