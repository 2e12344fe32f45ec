"""The page: its data read back without a browser, its texts escaped; and used for real in Chromium."""

import base64
import json
import re
import zlib

import numpy as np
import pytest
from PIL import Image

from facejax.viz import eyes_teeth, html_viewer, scene

NASTY = '</script><img src=x onerror="window.stolen=1"><!-- $title & "quotes" \u2028'


def _blob(text: str, name: str) -> bytes:
    return zlib.decompress(base64.b64decode(re.search(rf'id="{name}">([^<]*)</script>', text)[1]))


def _meta(text: str) -> dict:
    return json.loads(re.search(r'id="meta">([^<]*)</script>', text)[1])


def _positions(text: str) -> np.ndarray:
    """The decoder of the page once more, in numpy."""
    meta = _meta(text)
    low, high = np.frombuffer(_blob(text, "positions"), np.uint8).reshape(2, -1).astype(np.uint16)
    steps = (low | high << 8).reshape(meta["frames"], meta["points"], 3)
    whole = np.add.accumulate(steps, axis=0, dtype=np.uint16).view(np.int16)
    return np.array(meta["origin"]) + meta["step"] * whole


def test_positions_come_back_within_the_promised_error(tmp_path, moving):
    vertices, faces = moving
    html_viewer.write(tmp_path / "face.html", vertices, faces, fps=24, landmarks=np.array([3, 5]))
    text = (tmp_path / "face.html").read_text("utf-8")
    meta = _meta(text)
    positions = _positions(text)
    extent = np.ptp(vertices.reshape(-1, 3), axis=0).max()
    assert meta["step"] == pytest.approx(extent / 65534, rel=1e-5) and meta["step"] / 2 < 0.01
    np.testing.assert_allclose(positions[:, :-2], vertices, atol=meta["step"] / 2 + 1e-5)
    np.testing.assert_allclose(positions[:, -2:], vertices[:, [3, 5]], atol=meta["step"] / 2 + 1e-5)
    assert (meta["fps"], meta["landmarks"], meta["face"]) == (24, 2, vertices.shape[1])


def test_extreme_steps_do_not_overflow(tmp_path, ball):
    vertices, faces = ball
    frames = np.stack([vertices, -vertices, vertices])
    html_viewer.write(tmp_path / "face.html", frames, faces)
    text = (tmp_path / "face.html").read_text("utf-8")
    np.testing.assert_allclose(_positions(text), frames, atol=_meta(text)["step"] / 2 + 1e-5)


def test_parts_and_colours(tmp_path, moving):
    vertices, faces = moving
    eye = eyes_teeth.eyeball((0, 20, 80), 12)
    tint = np.linspace(0, 1, vertices.shape[1] * 3).reshape(-1, 3)
    html_viewer.write(tmp_path / "face.html", vertices, faces, extras=(eye,), colours=tint)
    text = (tmp_path / "face.html").read_text("utf-8")
    surface = np.frombuffer(_blob(text, "surface"), np.uint8).reshape(-1, 4)
    np.testing.assert_allclose(surface[:, :3] / 255, np.concatenate([tint, eye.colour]), atol=0.002)
    triangles = np.frombuffer(_blob(text, "triangles"), "<u4").reshape(-1, 3)
    np.testing.assert_array_equal(triangles, np.concatenate([faces, eye.faces + vertices.shape[1]]))
    with pytest.raises(ValueError, match="colours must be"):
        html_viewer.write(tmp_path / "face.html", vertices, faces, colours=tint[:-1])


def test_texts_are_escaped_and_nothing_is_fetched(tmp_path, moving):
    html_viewer.write(tmp_path / "face.html", *moving, title=NASTY, captions=((0, NASTY),))
    text = (tmp_path / "face.html").read_text("utf-8")
    assert "<img" not in text and text.count("</script>") == 5 and text.count("<!--") == 1
    assert _meta(text)["captions"] == [[0, NASTY]]
    assert not re.search(r"https?://|src=|@import", re.sub(r"src=x", "", text))


def test_a_refused_scene_leaves_no_file(tmp_path, moving):
    with pytest.raises(ValueError, match=r"outside 0\.\.4"):
        html_viewer.write(tmp_path / "face.html", *moving, captions=((9, "late"),))
    assert not list(tmp_path.iterdir())


@pytest.mark.browser
def test_the_page_in_chromium(tmp_path, moving, browser):
    vertices, faces = moving
    tooth = scene.Part(vertices[:, :60] * 0.5, faces[:4] % 60, (1, 1, 1))
    captions = ((0, "neutral → smile"), (3, NASTY))
    html_viewer.write(
        tmp_path / "face.html",
        vertices,
        faces,
        title=NASTY,
        captions=captions,
        landmarks=np.arange(40),
        extras=(tooth,),
    )
    job = {"file": str(tmp_path / "face.html"), "folder": str(tmp_path), "last": len(vertices) - 1}
    answer = browser("open_page.cjs", job)
    assert answer["errors"] == [] and answer["requests"] == []
    assert not answer["failure"] and not answer["injected"]
    assert answer["title"].split() == NASTY.split() and answer["caption"] == NASTY
    assert answer["playing"] == "Pause" and answer["count"].endswith(f"/ {len(vertices)}")
    shot = {path.stem: np.asarray(Image.open(path).convert("RGB"), int) for path in tmp_path.glob("*.png")}
    centre = shot["start"][220:380, 160:320].reshape(-1, 3)
    assert centre.std(axis=0).min() > 3 and (centre[:, 0] > centre[:, 2]).mean() > 0.9  # lit skin, not blank
    for other in ("end", "landmarks", "wire"):
        assert np.abs(shot["start"] - shot[other]).max(-1)[60:480].mean() > 0.05, other
    assert np.abs(shot["end"] - shot["turned"]).max(-1).mean() > 0.5
    assert np.abs(shot["start"] - shot["again"])[60:480].max() <= 2
