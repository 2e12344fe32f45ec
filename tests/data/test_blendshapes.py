"""ARKit weights: resampling over gaps, the resting face, and the units of the rig."""

from pathlib import Path

import numpy as np
import pytest

from facejax.data import blendshapes
from facejax.data.synthetic import makehuman, rig
from facejax.io import livelink

REAL = Path(__file__).resolve().parents[3] / "shared" / "data" / "livelink" / "alex_rom_3.csv"


def _column(recording, name):
    return recording.weights[:, livelink.BLENDSHAPES.index(name)]


def _recording(frames, **columns):
    """A recording at 30 frames per second; weights by name, 0 otherwise."""
    weights = np.zeros((frames, 52), np.float32)
    for name, values in columns.items():
        weights[:, livelink.BLENDSHAPES.index(name)] = values
    return livelink.Recording(weights, np.zeros((frames, 3), np.float32), np.arange(frames) / 30)


def test_resampling_is_linear_and_holds_still_over_long_gaps():
    times = np.array([0, 0.1, 0.3, 1.3, 1.4])
    weights = np.zeros((5, 52), np.float32)
    weights[:, 0] = times
    gaps = ((0.1, 0.2), (0.3, 1.0))
    recording = livelink.Recording(weights, np.tile(weights[:, :1], 3), times, gaps)
    found = blendshapes.resample(recording, rate=20, bridge=0.5)
    np.testing.assert_allclose(found.times, np.arange(29) / 20)
    expected = np.where((found.times > 0.3) & (found.times < 1.3), 0.3, found.times)
    np.testing.assert_allclose(found.weights[:, 0], expected, atol=1e-6)
    np.testing.assert_allclose(found.head[:, 2], expected, atol=1e-6)
    assert found.gaps == ((0.3, 1.0),) and "held the last pose in 1 gaps longer than 0.5 s" in found.notes
    bridged = blendshapes.resample(recording, rate=20, bridge=2)
    np.testing.assert_allclose(bridged.weights[:, 0], bridged.times, atol=1e-6)
    assert bridged.gaps == () and bridged.notes == ()


def test_resampling_refuses_nonsense_and_takes_a_single_row():
    one = livelink.Recording(np.ones((1, 52), np.float32), np.ones((1, 3), np.float32), np.zeros(1))
    np.testing.assert_array_equal(blendshapes.resample(one).weights, one.weights)
    assert blendshapes.rest_weights(one).shape == (52,)
    for rate in (0, -1, np.nan, np.inf):
        with pytest.raises(ValueError, match="rate must be positive"):
            blendshapes.resample(one, rate=rate)
    with pytest.raises(ValueError, match="more than 1000000 frames"):
        blendshapes.resample(one._replace(times=np.array([86_400.0])), rate=60)


def test_rest_is_the_pose_that_the_face_comes_back_to():
    rng = np.random.default_rng(1)
    quiet = rng.uniform(0, 0.3, 52)
    poses = np.clip(rng.normal(0, 0.5, (12, 52)), 0, 1)
    weights = np.repeat(quiet[None], 1200, axis=0)
    for i, pose in enumerate(poses):  # rests for 40 frames, then 60 frames of an expression
        bump = np.sin(np.linspace(0, np.pi, 60))[:, None]
        weights[100 * i + 40 : 100 * i + 100] += bump * (pose - quiet)
    weights += rng.normal(0, 0.005, weights.shape)
    recording = livelink.Recording(weights.astype(np.float32), np.zeros((1200, 3)), np.arange(1200) / 30)
    found = blendshapes.rest_weights(recording)
    np.testing.assert_allclose(found, quiet, atol=0.01)
    above = blendshapes.subtract_rest(recording)
    assert above.weights.min() >= 0 and np.abs(above.weights[:40]).max() < 0.05
    np.testing.assert_array_equal(above.weights, blendshapes.subtract_rest(recording, found).weights)


def test_above_rest_keeps_what_is_full():
    recording = livelink.Recording(np.ones((2, 52), np.float32), np.zeros((2, 3)), np.arange(2.0))
    np.testing.assert_allclose(blendshapes.subtract_rest(recording, np.full(52, 0.4)).weights, 1, rtol=1e-6)
    np.testing.assert_allclose(blendshapes.subtract_rest(recording, np.ones(52)).weights, 0)
    with pytest.raises(ValueError, match=r"resting must be \(52,\), got \(3,\)"):
        blendshapes.subtract_rest(recording, np.zeros(3))


def test_unit_weights_drive_the_rig():
    recording = _recording(3, eyeBlinkRight=[0, 0.5, 1], jawOpen=[0, 0, 0.7], tongueOut=1.0)
    weights = blendshapes.unit_weights(recording, rig.unit_names())
    names = rig.unit_names()
    assert weights.shape == (3, len(names)) and weights.dtype == np.float32
    np.testing.assert_allclose(weights[:, names.index("eyeBlinkRight")], [0, 0.5, 1])
    assert np.count_nonzero(weights.any(axis=0)) == 2
    assert set(livelink.BLENDSHAPES) - set(names) == {"tongueOut"}
    subject = makehuman.subject(100)
    posed = rig.pose(rig.build(subject, level=1), weights)
    moved = np.linalg.norm(posed - posed[0], axis=-1)
    np.testing.assert_allclose(posed[0], subject.neutral, atol=2e-5)
    # The subject's right is at x < 0.
    assert np.all(subject.neutral[moved[1] > 1, 0] < 0)


def test_a_real_recording():
    if not REAL.exists():
        pytest.skip("the recording alex_rom_3.csv is not beside this checkout")
    found = livelink.read(REAL)
    assert found.weights.shape == (4030, 52) and found.times[-1] == pytest.approx(134.38, abs=0.01)
    np.testing.assert_allclose([gap[0] for gap in found.gaps], [19.83, 70.82, 120.65], atol=0.01)
    np.testing.assert_allclose([gap[1] for gap in found.gaps], 4 / 60, atol=1e-4)
    resting = blendshapes.rest_weights(found)
    near = np.linalg.norm(found.weights - resting, axis=1) < 0.25
    assert near.mean() > 0.1 and np.ptp(found.times[near]) > 120
    above = blendshapes.resample(blendshapes.subtract_rest(found))
    assert len(above.times) == 4032 and above.gaps == ()
    # Eyes close fully, and the sides agree: the mouth goes where the eye narrows and the corner is stretched.
    assert _column(above, "eyeBlinkLeft").max() > 0.95
    aside = _column(above, "mouthLeft") - _column(above, "mouthRight")
    for part in ("eyeBlink", "cheekSquint", "mouthStretch", "mouthUpperUp"):
        lean = _column(above, f"{part}Left") - _column(above, f"{part}Right")
        assert lean[aside < -0.3].mean() < min(0, lean[aside > 0.2].mean()), part
