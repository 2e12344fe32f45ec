"""Cuts drawn and written: what is found on known performers, and the table that is read back."""

import numpy as np
import pytest

from experiments import segmentation
from facejax.data import dataset
from facejax.data.importers import apex_detection, registry
from facejax.data.synthetic import makehuman4d
from tests.test_experiments import check


def test_cuts_are_held_against_the_performers(tiny_store, tmp_path, monkeypatch):
    monkeypatch.setattr(makehuman4d, "prepare", lambda spec: tiny_store)
    errors = segmentation.run(segmentation.Config(out=tmp_path, quick=True, panels=4))["errors"]
    check(tmp_path, "recordings", "errors")
    assert [row["cut"] for row in errors] == list(apex_detection.Phases._fields)
    for row in errors:
        assert 0 < row["mean_frames"] < 8 and row["mean_frames"] <= row["worst_frames"]
    # Thresholds lie inside of the motion.
    assert errors[0]["bias_frames"] > 0 > errors[3]["bias_frames"]
    with pytest.raises(ValueError, match="panels"):
        segmentation.run(segmentation.Config(out=tmp_path, panels=0))


def test_the_table_is_read_back(tiny_store, tmp_path):
    (tmp_path / "root" / "S0").mkdir(parents=True)
    for name, take in zip(("grin_01", "grin_02"), tiny_store.sequences, strict=False):
        curve = np.asarray(tiny_store.landmarks[take.start : take.start + take.frames])
        moved = np.repeat(np.asarray(tiny_store.neutral[0])[None], len(curve), axis=0)
        moved[:, tiny_store.landmark_index] = curve
        np.savez(tmp_path / "root" / "S0" / f"{name}.npz", vertices=moved, faces=tiny_store.faces)
    (tmp_path / "marks.json").write_text(str(np.asarray(tiny_store.landmark_index).tolist()))
    options = {"landmarks": tmp_path / "marks.json"}
    data = registry.prepare("folder", tmp_path / "root", tmp_path / "store", **options)
    segmentation.run(segmentation.Config(out=tmp_path / "o", data=data.path))
    table = (tmp_path / "o" / "cuts.csv").read_text().splitlines()
    assert len(table) == 3 and table[1].startswith("S0,grin_01,")
    first = table[1].split(",")
    first[2:] = ["0", "9", "10", "20"]
    (tmp_path / "cuts.csv").write_text("\n".join([table[0], ",".join(first), table[2]]))
    again = registry.prepare("folder", tmp_path / "root", tmp_path / "again", phases=tmp_path / "cuts.csv", **options)
    assert dataset.Sequence(*again.sequences[0])[4:8] == (0, 9, 10, 20)
    assert again.sequences[1][4:8] == data.sequences[1][4:8]
