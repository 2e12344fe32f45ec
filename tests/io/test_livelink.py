"""Recordings of Live Link Face: timecodes, gaps, rest, sides; garbled files are refused by line and column."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from facejax.data.synthetic import makehuman, rig
from facejax.io import livelink

REAL = Path(__file__).resolve().parents[3] / "shared" / "data" / "livelink" / "alex_rom_3.csv"


def _capital(name):
    return name[0].upper() + name[1:]


# The app's own header: jaw and mouth name the right side first.
APP = [_capital(name) for name in livelink.BLENDSHAPES]
for part in ("Jaw", "Mouth"):
    left, right = APP.index(f"{part}Left"), APP.index(f"{part}Right")
    APP[left], APP[right] = APP[right], APP[left]
EYES = [f"{side}Eye{angle}" for side in ("Left", "Right") for angle in ("Yaw", "Pitch", "Roll")]
HEADER = ["Timecode", "BlendShapeCount", *APP, "HeadYaw", "HeadPitch", "HeadRoll", *EYES]


def _clock(seconds, base=60):
    whole = int(np.floor(seconds + 1e-9))
    hours, minutes, left = whole // 3600 % 24, whole // 60 % 60, whole % 60
    return f"{hours:02}:{minutes:02}:{left:02}:{(seconds - whole) * base:06.3f}"


def _csv(path, times, *, base=60, header=HEADER, **columns):
    """A recording at these seconds since midnight; columns by the header's names, 0 otherwise."""
    rows = [",".join(header)]
    for i, seconds in enumerate(times):
        values = {"Timecode": _clock(seconds, base), "BlendShapeCount": "61"}
        values |= {name: f"{np.broadcast_to(column, len(times))[i]:.10f}" for name, column in columns.items()}
        rows.append(",".join(values.get(_capital(name), "0.0000000000") for name in header))
    path.write_text("\n".join(rows) + "\n")
    return path


def _column(recording, name):
    return recording.weights[:, livelink.BLENDSHAPES.index(name)]


TIMES = 47_000 + np.arange(90) / 30


@pytest.fixture
def path(tmp_path):
    return tmp_path / "take.csv"


def test_columns_come_by_name_in_one_order(path):
    ramp = np.linspace(0, 1, 90)
    _csv(path, TIMES, EyeBlinkLeft=ramp, TongueOut=0.5, HeadYaw=-0.2, HeadRoll=0.1)
    found = livelink.read(path)
    assert found.weights.shape == (90, 52) and found.weights.dtype == np.float32
    np.testing.assert_allclose(_column(found, "eyeBlinkLeft"), ramp, atol=1e-6)
    np.testing.assert_allclose(found.head, np.tile([-0.2, 0, 0.1], (90, 1)), atol=1e-6)
    np.testing.assert_allclose(found.times, np.arange(90) / 30, atol=1e-4)
    assert found.gaps == () and "timecode read as 60 frames per second" in found.notes
    shuffled = [HEADER[i] for i in np.random.default_rng(0).permutation(len(HEADER))]
    lower = [name[0].lower() + name[1:] for name in shuffled]
    _csv(path, TIMES, header=lower, EyeBlinkLeft=ramp, TongueOut=0.5)
    path.write_text("\ufeff" + path.read_text().replace("\n", "\r\n"))
    np.testing.assert_array_equal(_column(livelink.read(path, base=60), "eyeBlinkLeft"), _column(found, "eyeBlinkLeft"))


def test_sides_that_the_app_confuses_are_put_right(path):
    _csv(path, TIMES, JawLeft=0.1, MouthLeft=0.6, MouthSmileLeft=0.3)
    found = livelink.read(path)
    for name, value in {
        "jawRight": 0.1,
        "jawLeft": 0,
        "mouthRight": 0.6,
        "mouthLeft": 0,
        "mouthSmileLeft": 0.3,
    }.items():
        np.testing.assert_allclose(_column(found, name), value, atol=1e-6)
    assert sum("exchanged" in note for note in found.notes) == 2
    trusted = livelink.read(path, trust_sides=True)
    np.testing.assert_allclose(_column(trusted, "mouthLeft"), 0.6, atol=1e-6)
    assert not any("exchanged" in note for note in trusted.notes)
    # A header with left first means what it says.
    honest = ["Timecode", "BlendShapeCount", *map(_capital, livelink.BLENDSHAPES), "HeadYaw", "HeadPitch", "HeadRoll"]
    _csv(path, TIMES, header=honest, MouthLeft=0.6)
    np.testing.assert_allclose(_column(livelink.read(path), "mouthLeft"), 0.6, atol=1e-6)


@pytest.mark.parametrize("base", livelink.TIMECODE_RATES)
def test_the_rate_of_the_timecode_is_inferred(path, base):
    _csv(path, 100 + np.arange(75) / base, base=base)
    found = livelink.read(path)
    np.testing.assert_allclose(found.times, np.arange(75) / base, atol=2e-3 / base)
    assert f"timecode read as {base} frames per second" in found.notes


def test_within_one_second_the_rate_is_a_guess_that_can_be_overruled(path):
    _csv(path, 100 + np.arange(10) / 60, base=60)
    assert "timecode read as 30 frames per second" in livelink.read(path).notes
    np.testing.assert_allclose(livelink.read(path, base=60).times, np.arange(10) / 60, atol=1e-4)
    _csv(path, 100 + np.arange(40) / 60, base=60)
    assert "timecode read as 60 frames per second" in livelink.read(path).notes


def test_midnight_gaps_duplicates_and_disorder(path):
    seconds = np.arange(90) / 30
    keep = np.r_[0:30, 33:60, 75:90]
    ramp = seconds[keep]
    times = 86_399 + ramp
    order = np.r_[0:5, 3:20, 22, 21, 20, 23 : len(keep)]  # rows 3 and 4 twice, three rows the wrong way round
    _csv(path, times[order], JawOpen=ramp[order] / 3)
    found = livelink.read(path)
    np.testing.assert_allclose(found.times, ramp, atol=1e-4)
    np.testing.assert_allclose(_column(found, "jawOpen"), ramp / 3, atol=1e-6)
    np.testing.assert_allclose(found.gaps, [(29 / 30, 4 / 30), (59 / 30, 16 / 30)], atol=1e-4)
    assert "left out 2 rows of a time that was there before" in found.notes


def test_rows_without_a_face_become_a_gap(path):
    _csv(path, TIMES)
    lines = path.read_text().splitlines()
    for i in range(10, 20):
        lines[i] = f"{lines[i].split(',')[0]},0" + (",,," if i % 2 else "")
    path.write_text("\n".join([*lines[:30], "", *lines[30:]]))
    found = livelink.read(path)
    assert len(found.times) == 80 and len(found.gaps) == 1
    assert found.gaps[0][1] == pytest.approx(11 / 30, abs=1e-4)
    assert "left out 10 rows without a face" in found.notes


def test_resampling_is_linear_and_holds_still_over_long_gaps():
    times = np.array([0, 0.1, 0.3, 1.3, 1.4])
    weights = np.zeros((5, 52), np.float32)
    weights[:, 0] = times
    gaps = ((0.1, 0.2), (0.3, 1.0))
    recording = livelink.Recording(weights, np.tile(weights[:, :1], 3), times, gaps)
    found = livelink.resample(recording, rate=20, bridge=0.5)
    np.testing.assert_allclose(found.times, np.arange(29) / 20)
    expected = np.where((found.times > 0.3) & (found.times < 1.3), 0.3, found.times)
    np.testing.assert_allclose(found.weights[:, 0], expected, atol=1e-6)
    np.testing.assert_allclose(found.head[:, 2], expected, atol=1e-6)
    assert found.gaps == ((0.3, 1.0),) and "held still over 1 gaps longer than 0.5 s" in found.notes
    bridged = livelink.resample(recording, rate=20, bridge=2)
    np.testing.assert_allclose(bridged.weights[:, 0], bridged.times, atol=1e-6)
    assert bridged.gaps == () and bridged.notes == ()


def test_resampling_refuses_nonsense_and_takes_a_single_row():
    one = livelink.Recording(np.ones((1, 52), np.float32), np.ones((1, 3), np.float32), np.zeros(1))
    np.testing.assert_array_equal(livelink.resample(one).weights, one.weights)
    assert livelink.rest_weights(one).shape == (52,)
    for rate in (0, -1, np.nan, np.inf):
        with pytest.raises(ValueError, match="rate must be positive"):
            livelink.resample(one, rate=rate)
    with pytest.raises(ValueError, match="more than 1000000 frames"):
        livelink.resample(one._replace(times=np.array([86_400.0])), rate=60)


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
    found = livelink.rest_weights(recording)
    np.testing.assert_allclose(found, quiet, atol=0.01)
    above = livelink.subtract_rest(recording)
    assert above.weights.min() >= 0 and np.abs(above.weights[:40]).max() < 0.05
    np.testing.assert_array_equal(above.weights, livelink.subtract_rest(recording, found).weights)


def test_above_rest_keeps_what_is_full():
    recording = livelink.Recording(np.ones((2, 52), np.float32), np.zeros((2, 3)), np.arange(2.0))
    np.testing.assert_allclose(livelink.subtract_rest(recording, np.full(52, 0.4)).weights, 1, rtol=1e-6)
    np.testing.assert_allclose(livelink.subtract_rest(recording, np.ones(52)).weights, 0)
    with pytest.raises(ValueError, match=r"resting must be \(52,\), got \(3,\)"):
        livelink.subtract_rest(recording, np.zeros(3))


def test_unit_weights_drive_the_rig(path):
    _csv(path, TIMES[:3], EyeBlinkRight=[0, 0.5, 1], JawOpen=[0, 0, 0.7], TongueOut=1.0)
    weights = livelink.unit_weights(livelink.read(path), rig.unit_names())
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


def _row(line):
    """Garbles the fourth line of a good recording."""

    def garble(lines):
        words = lines[3].split(",")
        lines[3] = line if isinstance(line, str) else ",".join(line(words))
        return lines

    return garble


def _swap(at, word):
    return _row(lambda words: [*words[:at], word, *words[at + 1 :]])


BAD = {
    "empty": (lambda lines: [], "0 bytes"),
    "blank": (lambda lines: [" "], r"line 1: lacks the columns timecode, eyeBlinkLeft, eyeLookDownLeft and 53 more"),
    "column": (lambda lines: [lines[0].replace("JawOpen", "Jaw"), *lines[1:]], "line 1: lacks the columns jawOpen; is"),
    "no rows": (lambda lines: lines[:1], "holds no row with a face"),
    "short": (_row("12:00:00:10.000,61,0.5"), "line 4: expected 63 columns as in line 1, got 3"),
    "long": (_row(lambda words: [*words, "1"]), "line 4: expected 63 columns as in line 1, got 64"),
    "word": (_swap(2, "shut"), r"line 4, column EyeBlinkLeft: expected a number in -0\.5\.\.2, got 'shut'"),
    "nothing": (_swap(20, ""), "line 4, column MouthClose: expected a number"),
    "nan": (_swap(3, "nan"), "line 4, column EyeLookDownLeft: .* got 'nan'"),
    "infinite": (_swap(54, "inf"), "line 4, column HeadYaw: .* got 'inf'"),
    "percent": (_swap(2, "85.0"), "line 4, column EyeBlinkLeft: .* got '85.0'"),
    "degrees": (_swap(55, "12.5"), r"line 4, column HeadPitch: expected a number in -6\.28\.\.6\.28, got '12\.5'"),
    "clock": (_swap(0, "1.25"), "line 4, column Timecode: expected HH:MM:SS:FF.fff, got '1.25'"),
    "hour": (_swap(0, "24:00:00:00.000"), "line 4, column Timecode: no time of day: '24:00:00:00.000'"),
    "frame": (_swap(0, "13:03:20:60.000"), "line 4, column Timecode: frame 60 of 60 per second"),
}


@pytest.mark.parametrize("name", BAD)
def test_garbled_recordings_are_refused(path, name):
    garble, message = BAD[name]
    lines = garble(_csv(path, TIMES[:6]).read_text().splitlines())
    path.write_text("\n".join(lines))
    with pytest.raises(livelink.RecordingError, match=message) as caught:
        livelink.read(path)
    assert "take.csv" in str(caught.value) and "\n" not in str(caught.value)


def test_missing_large_and_foreign_files(path, tmp_path, monkeypatch):
    with pytest.raises(livelink.RecordingError, match="no such file"):
        livelink.read(path)
    with pytest.raises(livelink.RecordingError, match=r"expected a file of|cannot be read"):
        livelink.read(tmp_path)
    path.write_bytes(b"\xff\xfe\x00\x01")
    with pytest.raises(livelink.RecordingError, match="not a text in UTF-8"):
        livelink.read(path)
    _csv(path, TIMES[:6])
    monkeypatch.setattr(livelink, "MAX_ROWS", 5)
    with pytest.raises(livelink.RecordingError, match="6 rows; at most 5"):
        livelink.read(path)
    monkeypatch.setattr(livelink, "MAX_BYTES", 1000)
    with pytest.raises(livelink.RecordingError, match="expected a file of 1 to 1000"):
        livelink.read(path)


@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(at=st.integers(0, 10**6), new=st.text(alphabet=',:;.-+eE019nai \n\x00"', max_size=4), drop=st.integers(0, 30))
def test_no_damage_escapes_as_another_error(tmp_path, at, new, drop):
    whole = _csv(tmp_path / "good.csv", TIMES[:4], JawOpen=0.2).read_text()
    at %= len(whole)
    path = tmp_path / "bad.csv"
    path.write_text(whole[:at] + new + whole[at + drop :])
    try:
        found = livelink.read(path)
    except livelink.RecordingError as error:
        assert "bad.csv" in str(error)
    else:
        assert np.isfinite(found.weights).all() and np.all(np.diff(found.times) > 0)


def test_a_real_recording():
    if not REAL.exists():
        pytest.skip("the recording alex_rom_3.csv is not beside this checkout")
    found = livelink.read(REAL)
    assert found.weights.shape == (4030, 52) and found.times[-1] == pytest.approx(134.38, abs=0.01)
    np.testing.assert_allclose([gap[0] for gap in found.gaps], [19.83, 70.82, 120.65], atol=0.01)
    np.testing.assert_allclose([gap[1] for gap in found.gaps], 4 / 60, atol=1e-4)
    resting = livelink.rest_weights(found)
    near = np.linalg.norm(found.weights - resting, axis=1) < 0.25
    assert near.mean() > 0.1 and np.ptp(found.times[near]) > 120
    above = livelink.resample(livelink.subtract_rest(found))
    assert len(above.times) == 4032 and above.gaps == ()
    # Eyes close fully, and the sides agree: the mouth goes where the eye narrows and the corner is stretched.
    assert _column(above, "eyeBlinkLeft").max() > 0.95
    aside = _column(above, "mouthLeft") - _column(above, "mouthRight")
    for part in ("eyeBlink", "cheekSquint", "mouthStretch", "mouthUpperUp"):
        lean = _column(above, f"{part}Left") - _column(above, f"{part}Right")
        assert lean[aside < -0.3].mean() < min(0, lean[aside > 0.2].mean()), part
