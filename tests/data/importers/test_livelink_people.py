"""Recordings of Live Link Face played on MakeHuman's people: real motion, the free topology."""

import numpy as np
import pytest

from facejax.data import blendshapes, motions
from facejax.data.importers import base, registry
from facejax.data.synthetic import makehuman, rig
from facejax.io import livelink
from tests.cli.test_main import recorded


@pytest.fixture
def takes(tmp_path):
    """Two performers, two recordings each."""
    root = tmp_path / "takes"
    for performer in ("anna", "ben"):
        (root / performer).mkdir(parents=True)
        for i, name in enumerate(("mouth_open_01", "mouth_open_02")):
            recorded(root / performer / f"{name}.csv", 36 + 2 * i)
    return root


def test_every_performer_plays_people_of_their_own(takes, tmp_path):
    data = registry.prepare("livelink", takes, tmp_path / "store", actors=4, level=1)
    assert [(s["name"], s["performer"]) for s in data.index["subjects"]] == [
        ("anna-000", "anna"), ("ben-001", "ben"), ("anna-002", "anna"), ("ben-003", "ben"),
    ]  # fmt: skip
    assert [(s.subject, s.label, s.frames) for s in data.sequences] == [
        (i, "mouth_open", n) for i in range(4) for n in (36, 38)
    ]
    # What the rig makes of the recording's weights above rest.
    even = blendshapes.resample(blendshapes.subtract_rest(livelink.read(takes / "ben" / "mouth_open_01.csv")), rate=30)
    person = makehuman.subject(1)
    posed = rig.pose(rig.build(person, level=1), blendshapes.unit_weights(even, rig.unit_names()))[
        :, : len(person.vertices)
    ]
    first = data.sequences[2].start
    np.testing.assert_allclose(data.vertices[first : first + 36], posed, atol=1e-4)
    np.testing.assert_array_equal(data.neutral[1], person.vertices)
    assert data.landmarks.shape[1:] == (68, 3) and any("timecode read as 30" in note for note in data.index["notes"])
    assert set(motions.halves(data, "train").end.tolist()) == {0, 1}


def test_recordings_without_performers_and_what_is_wrong(tmp_path):
    root = tmp_path / "root"
    root.mkdir()
    recorded(root / "jaw.csv")
    data = registry.prepare("livelink", root, tmp_path / "store", actors=1, level=0, rate=15)
    assert data.index["rate"] == 15 and data.sequences[0].frames == 20 and data.labels == ("neutral", "jaw")
    with pytest.raises(base.SourceError, match="actors: 0, expected 1 or more"):
        registry.scan("livelink", root, actors=0)
    text = (root / "jaw.csv").read_text().splitlines()
    (root / "jaw.csv").write_text("\n".join([*text[:5], "10:00:00:99,61,x", *text[6:]]))
    with pytest.raises(base.SourceError, match=r"jaw.csv: line 6"):
        registry.scan("livelink", root)
    (root / "jaw.csv").unlink()
    with pytest.raises(base.SourceError, match="contains no recordings"):
        registry.scan("livelink", root)
