"""The released models, from labels to meshes."""

import jax
import numpy as np
import pytest

from facejax.data.synthetic import expression_recipes, makehuman, makehuman4d, performance, rig
from facejax.inference import pipeline
from facejax.io import weights
from facejax.models import model_file
from facejax.models.decoders import s2d_dec
from facejax.models.motion import generators, motion3dgan, motion3dgan_reference
from tests.models.motion.test_motion3dgan import plain_weights


@pytest.fixture(scope="module")
def models():
    return pipeline.load()


@pytest.fixture(scope="module")
def person():
    return makehuman.subject(103)


KEY = jax.random.key(7)


def test_released_models_describe_themselves(models):
    assert models.labels == expression_recipes.LABELS
    assert models.about["made"]["command"].startswith("python -m experiments.pretrain")
    assert models.about["made"]["dataset"]["level"] == 3
    assert len(models.face.vertices) == 3260 and models.face.landmark_index.shape == (68,)


def test_landmarks_start_at_the_face_and_come_home(models, person):
    rest = person.vertices[np.asarray(models.face.landmark_index)]
    moved = pipeline.landmarks(models, KEY, ["neutral", "high_smile", "mouth_open", "neutral"], person.vertices)
    assert moved.shape == (1 + 3 * 29, 68, 3)
    np.testing.assert_allclose(moved[0], rest, atol=1e-4)
    np.testing.assert_allclose(moved[-1], rest, atol=1e-3)
    distance = np.linalg.norm(np.asarray(moved) - rest, axis=-1).mean(axis=-1)
    assert distance[29] > 1.0 and distance[58] > 2.0
    # No jump at a joint: the largest step is nowhere much larger than its neighbours' size allows.
    steps = np.linalg.norm(np.diff(moved, axis=0), axis=-1).max(axis=-1)
    assert steps[[28, 29, 57, 58]].max() < 0.8 * steps.max() + 0.5


def test_meshes_carry_the_landmarks_and_hold_still_at_rest(models, person):
    moved = pipeline.landmarks(models, KEY, ["neutral", "surprise"], person.vertices)
    vertices = np.asarray(pipeline.meshes(models, moved, person.vertices))
    assert vertices.shape == (30, 3260, 3)
    np.testing.assert_allclose(vertices[0], person.vertices, atol=0.5)
    carried = vertices[:, np.asarray(models.face.landmark_index)]
    assert np.linalg.norm(carried - np.asarray(moved), axis=-1).mean() < 0.6
    back = np.linalg.norm(vertices[-1] - person.vertices, axis=-1)
    assert back[np.asarray(models.face.mask)].mean() > 3 * back[~np.asarray(models.face.mask)].mean()


def test_meshes_unrefined_and_of_a_detectors_landmarks(models, person):
    """Against the person's own rig: the network gains little, and who is told of noise loses little."""
    rest, at = person.vertices, np.asarray(models.face.landmark_index)
    weights_of = performance.perform("happiness", 103, seed=makehuman4d.SEED).weights[::6]
    true = rig.pose(rig.build(person, level=3), weights_of)[:, : len(rest)]
    noisy = (true[:, at] + 0.5 * np.random.default_rng(0).standard_normal((len(true), 68, 3))).astype(np.float32)

    def error(marks, **options):
        return np.linalg.norm(np.asarray(pipeline.meshes(models, marks, rest, **options)) - true, axis=-1).mean()

    right, plain = error(true[:, at]), error(true[:, at], refined=False)
    assert right < plain < 1.5 * right and plain < 0.05
    assert error(noisy, noise=0.5) < 0.3 * error(noisy)
    assert error(noisy, noise=None) < 1.05 * error(noisy, noise=0.5)
    assert error(true[:, at], noise=None) < 1.05 * plain


def test_s2d_dec_is_another_way_to_meshes(models, person, tmp_path):
    params = s2d_dec.init(jax.random.key(0), models.hierarchy)
    path = tmp_path / "s2d.safetensors"
    pipeline.save(path, models.replace(decoder=params))
    again = pipeline.load(path)
    assert again.about["decoder"] == model_file.S2D and isinstance(again.decoder, s2d_dec.S2DDec)
    marks = pipeline.landmarks(again, KEY, ["neutral", "anger"], person.vertices, frames=3)
    moved = marks - pipeline.neutral_landmarks(again, person.vertices)
    expected = person.vertices + np.asarray(s2d_dec.apply(params, models.hierarchy, moved))
    np.testing.assert_allclose(pipeline.meshes(again, marks, person.vertices), expected, atol=1e-3)
    # It sees no face, so that all of it goes into one program.
    traced = jax.jit(lambda marks, face: pipeline.meshes(again, marks, face))(marks, person.vertices)
    np.testing.assert_allclose(traced, expected, atol=1e-3)
    with pytest.raises(ValueError, match="noise is not supported by S2D-Dec"):
        pipeline.meshes(again, marks, person.vertices, noise=0.5)


def test_same_key_same_motion_and_samples_differ(models, person):
    one, again = (pipeline.landmarks(models, KEY, ["neutral", "anger"], person.vertices) for _ in range(2))
    np.testing.assert_array_equal(one, again)
    drawn = np.asarray(pipeline.landmarks(models, KEY, ["neutral", "anger"], person.vertices, samples=4))
    assert drawn.shape == (4, 30, 68, 3)
    apart = [np.abs(a - b).max() for i, a in enumerate(drawn) for b in drawn[:i]]
    assert min(apart) > 0.3


def test_motion_scales_with_intensity_and_with_the_face(models, person):
    rest = person.vertices[np.asarray(models.face.landmark_index)]
    once, twice, none = (
        np.asarray(pipeline.landmarks(models, KEY, ["neutral", "fear"], person.vertices, intensity=i)) - rest
        for i in (1.0, 2.0, 0.0)
    )
    np.testing.assert_allclose(twice, 2 * once, atol=1e-3)
    np.testing.assert_allclose(none, 0, atol=1e-4)
    larger = np.asarray(pipeline.landmarks(models, KEY, ["neutral", "fear"], 1.5 * person.vertices)) - 1.5 * rest
    np.testing.assert_allclose(larger, 1.5 * once, atol=1e-3)


def test_frames_and_a_start_at_a_peak(models, person):
    rest = person.vertices[np.asarray(models.face.landmark_index)]
    moved = np.asarray(pipeline.landmarks(models, KEY, ["mouth_open", "neutral"], person.vertices, frames=12))
    assert moved.shape == (12, 68, 3)
    assert np.linalg.norm(moved[0] - rest, axis=-1).mean() > 2.0
    np.testing.assert_allclose(moved[-1], rest, atol=1e-3)


def test_a_long_chain_neither_drifts_nor_jumps(models, person):
    """Twenty transitions: every visit to a label looks like the first."""
    cycle = ["high_smile", "mouth_open", "surprise", "mouth_side", "anger"]
    moved = np.asarray(pipeline.landmarks(models, KEY, ["neutral", *cycle * 4], person.vertices, samples=8))
    rest = person.vertices[np.asarray(models.face.landmark_index)]
    largest = np.linalg.norm(moved - rest, axis=-1).max(axis=-1)[:, 29::29].mean(axis=0).reshape(4, 5)
    np.testing.assert_allclose(largest[3], largest[0], rtol=0.35)
    steps = np.linalg.norm(np.diff(moved, axis=1), axis=-1).max(axis=-1)
    joints = np.arange(29, moved.shape[1] - 1, 29)
    assert steps[:, joints].mean() < 1.5 * steps.mean()


def test_captions_follow_the_joints():
    assert pipeline.captions(["a", "b", "c"], frames=30) == ((0, "a → b"), (29, "b → c"))
    assert pipeline.captions(["a", "b", "c"], frames=(10, 7)) == ((0, "a → b"), (9, "b → c"))


def test_natural_durations_belong_to_the_motion(models, person):
    labels = ["neutral", "surprise", "mouth_side", "neutral"]
    frames = pipeline.durations(models, KEY, labels)
    # In the training data onsets are a random draw of 18 to 39 frames at 60 frames per second, ways home of 20 to 45.
    assert len(frames) == 3 and all(7 <= count <= 30 for count in frames)
    twice = pipeline.durations(models, KEY, labels, rate=60)
    assert all(abs((a - 1) - 2 * (b - 1)) <= 1 for a, b in zip(twice, frames, strict=True))
    moved = pipeline.landmarks(models, KEY, labels, person.vertices, frames=frames)
    assert len(moved) == 1 + sum(count - 1 for count in frames)
    evenly = np.asarray(pipeline.landmarks(models, KEY, labels, person.vertices))
    peaks = np.cumsum([0] + [count - 1 for count in frames])
    np.testing.assert_allclose(np.asarray(moved)[peaks], evenly[::29], atol=1e-3)
    with pytest.raises(ValueError, match="rate must be above 0"):
        pipeline.durations(models, KEY, labels, rate=0)


def test_samples_do_not_depend_on_how_many_are_drawn(models, person):
    few, many = (
        np.asarray(pipeline.landmarks(models, KEY, ["anger", "fear"], person.vertices, samples=n)) for n in (2, 4)
    )
    np.testing.assert_allclose(few, many[:2], atol=2e-3)


@pytest.mark.parametrize(
    ("labels", "options", "message"),
    [
        (["neutral", "high_smlie"], {}, "unknown label 'high_smlie': did you mean high_smile"),
        (["neutral", "qqqq"], {}, "expected one of neutral, bareteeth"),
        (["neutral"], {}, "a start and an end"),
        (["neutral", "anger", "anger"], {}, "'anger' follows itself"),
        (["neutral", "anger"], {"frames": 1}, "2 or more"),
        (["neutral", "anger"], {"frames": (30, 30)}, "one number, or 1 for 1 transitions, got 2"),
        (["neutral", "anger"], {"frames": 12.5}, "whole numbers of 2 or more, got 12.5"),
        (["neutral", "anger"], {"samples": 0}, "1 or more"),
        (["neutral", "anger"], {"intensity": 2.5}, r"0\.\.2, got 2.5"),
    ],
)
def test_bad_requests_are_named(models, person, labels, options, message):
    with pytest.raises(ValueError, match=message):
        pipeline.landmarks(models, KEY, labels, person.vertices, **options)


def test_wrong_shapes_are_named(models, person):
    with pytest.raises(ValueError, match=r"expected vertices \(3260, 3\).*got \(10, 3\)"):
        pipeline.landmarks(models, KEY, ["neutral", "anger"], np.zeros((10, 3)))
    with pytest.raises(ValueError, match=r"landmarks: expected \(..., 68, 3\)"):
        pipeline.meshes(models, np.zeros((5, 51, 3)), person.vertices)
    with pytest.raises(ValueError, match=r"expected about .* mm: give vertices in millimetres"):
        pipeline.landmarks(models, KEY, ["neutral", "anger"], person.vertices / 1000)
    with pytest.raises(ValueError, match="got the one name 'anger'"):
        pipeline.landmarks(models, KEY, "anger", person.vertices)
    inside = jax.jit(lambda face: pipeline.neutral_landmarks(models, face))(person.vertices)
    np.testing.assert_array_equal(inside, pipeline.neutral_landmarks(models, person.vertices))


def test_saved_models_load_the_same(models, person, tmp_path):
    path = tmp_path / "models.safetensors"
    pipeline.save(path, models)
    again = pipeline.load(path)
    for a, b in zip(jax.tree.leaves(models), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(a, b)
    assert path.stat().st_size < 25e6


def test_a_file_keeps_its_kind_of_generator(models, tmp_path):
    chart = models.motion.chart
    narrow = motion3dgan_reference.Config(width_divisor=64, noise=4)
    with plain_weights():
        others = {
            "gan": motion3dgan.generator.init(KEY, chart, config=motion3dgan.Config(width=16, noise=8)),
            "reference": motion3dgan_reference.generator.init(KEY, chart, config=narrow),
        }
    for kind, generator in others.items():
        path = tmp_path / f"{kind}.safetensors"
        pipeline.save(path, models.replace(motion=generator))
        again = pipeline.load(path)
        assert generators.kind(again.motion) == again.about["generator"] == kind
        assert jax.tree.structure(again.motion) == jax.tree.structure(generator)
        for a, b in zip(jax.tree.leaves(again.motion), jax.tree.leaves(generator), strict=True):
            np.testing.assert_array_equal(a, b)
    moved = np.asarray(pipeline.displacements(again, KEY, ["neutral", "anger"], samples=1, frames=4))
    assert moved.shape == (1, 4, 68, 3) and np.isfinite(moved).all()


def test_files_that_hold_no_models_are_named(tmp_path):
    path = tmp_path / "other.safetensors"
    weights.save(path, {"a": np.zeros(3, np.float32)}, metadata={"shapes": {"a": ["float32", [3]]}, "generator": "gan"})
    with pytest.raises(weights.WeightsError, match="does not describe facejax models"):
        pipeline.load(path)
    with pytest.raises(weights.WeightsError, match="no such weights file"):
        pipeline.load(tmp_path / "none.safetensors")
