"""Recordings of Live Link Face: timecodes, gaps, sides; invalid files are rejected with line and column."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

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
    assert "dropped 2 rows with duplicate times" in found.notes


def test_rows_without_a_face_become_a_gap(path):
    _csv(path, TIMES)
    lines = path.read_text().splitlines()
    for i in range(10, 20):
        lines[i] = f"{lines[i].split(',')[0]},0" + (",,," if i % 2 else "")
    path.write_text("\n".join([*lines[:30], "", *lines[30:]]))
    found = livelink.read(path)
    assert len(found.times) == 80 and len(found.gaps) == 1
    assert found.gaps[0][1] == pytest.approx(11 / 30, abs=1e-4)
    assert "dropped 10 rows without a face" in found.notes


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
    "blank": (lambda lines: [" "], r"line 1: missing columns timecode, eyeBlinkLeft, eyeLookDownLeft and 53 more"),
    "column": (
        lambda lines: [lines[0].replace("JawOpen", "Jaw"), *lines[1:]],
        "line 1: missing columns jawOpen; expected",
    ),
    "no rows": (lambda lines: lines[:1], "contains no row with a face"),
    "short": (_row("12:00:00:10.000,61,0.5"), "line 4: expected 63 columns as in line 1, got 3"),
    "long": (_row(lambda words: [*words, "1"]), "line 4: expected 63 columns as in line 1, got 64"),
    "word": (_swap(2, "shut"), r"line 4, column EyeBlinkLeft: expected a number in -0\.5\.\.2, got 'shut'"),
    "nothing": (_swap(20, ""), "line 4, column MouthClose: expected a number"),
    "nan": (_swap(3, "nan"), "line 4, column EyeLookDownLeft: .* got 'nan'"),
    "infinite": (_swap(54, "inf"), "line 4, column HeadYaw: .* got 'inf'"),
    "percent": (_swap(2, "85.0"), "line 4, column EyeBlinkLeft: .* got '85.0'"),
    "degrees": (_swap(55, "12.5"), r"line 4, column HeadPitch: expected a number in -6\.28\.\.6\.28, got '12\.5'"),
    "clock": (_swap(0, "1.25"), "line 4, column Timecode: expected HH:MM:SS:FF.fff, got '1.25'"),
    "hour": (_swap(0, "24:00:00:00.000"), "line 4, column Timecode: invalid time of day '24:00:00:00.000'"),
    "frame": (_swap(0, "13:03:20:60.000"), "line 4, column Timecode: frame 60, expected below 60"),
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
    with pytest.raises(livelink.RecordingError, match="not UTF-8 text"):
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
