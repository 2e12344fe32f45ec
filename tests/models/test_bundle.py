"""Model files: what is written is read, and every field of the metadata is checked."""

import copy
import random

import jax
import numpy as np
import pytest
from safetensors.numpy import load_file

from facejax.inference import pipeline
from facejax.io import weights
from facejax.models import bundle
from tests import tiny_models


@pytest.fixture(scope="module", params=["gpmm", "s2d"])
def written(request, tmp_path_factory):
    """A model file: its path, its arrays by name and its metadata."""
    path = tmp_path_factory.mktemp("models") / f"{request.param}.safetensors"
    bundle.save(path, tiny_models.make(decoder=request.param))
    return path, load_file(path), weights.load_metadata(path)


def test_models_are_read_as_they_were_written(written):
    path, _, about = written
    models = bundle.load(path)
    assert models.labels == tiny_models.LABELS and models.about["generator"] == "flow"
    again = path.with_name("again.safetensors")
    bundle.save(again, models)
    for one, other in zip(jax.tree.leaves(bundle.load(again)), jax.tree.leaves(models), strict=True):
        np.testing.assert_array_equal(one, other)
    assert weights.load_metadata(again)["shapes"] == about["shapes"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"labels": None}, "field 'labels': expected a list of names, got None"),
        ({"labels": "neutral"}, "field 'labels': expected a list of names, got 'neutral'"),
        ({"labels": ["neutral"]}, "field 'labels': expected 2 to 10000 names, got 1"),
        ({"labels": ["neutral", "smile", 3]}, "field 'labels': entry 2 is 3, expected a name"),
        ({"labels": ["neutral", "smile", "smile"]}, "field 'labels': entry 2 repeats the name 'smile'"),
        ({"labels": ["neutral", "smile", "frown\n"]}, "field 'labels': entry 2 is"),
        ({"labels": ["neutral", "smile", "frown", "more"]}, r"\[3, 3, \d+\], expected \(K, K, R\) with K = 4"),
        ({"labels": [f"label {i}" for i in range(45)]}, "with K = 45 .45 names in 'labels'"),
        ({"generator": None}, "field 'generator': expected one of gan, reference, flow, got None"),
        ({"generator": "vae"}, "field 'generator': .* got 'vae'"),
        ({"generator": "gan"}, "field 'shapes': motion/weights/skip is missing"),
        ({"decoder": 3}, "field 'decoder': expected one of s2d, refined, got 3"),
        ({"shapes": None}, "field 'shapes': expected the dtypes and shapes"),
        ({"shapes": {"face/vertices": ["float32", [-1, 3]]}}, "face/vertices is .* expected a dtype and a shape"),
        ({"shapes": {"face/vertices": ["O", [3, 3]]}}, "face/vertices is .* expected a dtype and a shape"),
    ],
)
def test_a_wrong_field_is_named_in_one_line(written, tmp_path, change, message):
    _, arrays, about = written
    path = tmp_path / "changed.safetensors"
    fields = {name: value for name, value in {**about, **change}.items() if value is not None}
    weights.save(path, arrays, metadata=fields)
    with pytest.raises(weights.WeightsError, match=message) as error:
        bundle.load(path)
    assert str(path) in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("face/faces", 10**6, "face/faces: expected indices of 162 vertices"),
        ("face/landmark_index", -1, "face/landmark_index: expected indices of 162 vertices"),
        ("face/vertices", np.nan, "face/vertices: expected finite numbers"),
        ("hierarchy/spirals/0", 10**6, "level 0: a table has a vertex index out of range"),
    ],
)
def test_arrays_that_no_mesh_has_are_named(written, tmp_path, name, value, message):
    _, arrays, about = written
    changed = arrays[name].copy()
    changed.flat[0] = value
    weights.save(tmp_path / "w.safetensors", arrays | {name: changed}, metadata=about)
    with pytest.raises(weights.WeightsError, match=message):
        bundle.load(tmp_path / "w.safetensors")


def test_metadata_changed_at_random_is_refused_or_read(written, tmp_path):
    _, arrays, about = written
    values = [
        None,
        0,
        -1,
        2**70,
        1.5,
        float("nan"),
        "",
        "neutral",
        "a\x00b",
        [],
        {},
        [[]],
        True,
        ["float32", [3]],
        "é" * 300,
    ]
    rng, refused = random.Random(0), 0
    path = tmp_path / "mutated.safetensors"
    for _ in range(120):
        fields = copy.deepcopy(about)
        place, key = fields, rng.choice(["labels", "generator", "decoder", "shapes"])
        while isinstance(place[key], dict | list) and place[key] and rng.random() < 0.8:
            place = place[key]
            key = rng.choice(list(place) if isinstance(place, dict) else range(len(place)))
        if isinstance(place, dict) and rng.random() < 0.2:
            del place[key]
        else:
            place[key] = rng.choice(values)
        weights.save(path, arrays, metadata=fields)
        try:
            models = pipeline.load(path)
        except weights.WeightsError as error:
            refused += 1
            assert "\n" not in str(error) and len(str(error)) < 2000
        else:  # such as another name of a label
            assert len(models.labels) == 3
    assert refused > 80
