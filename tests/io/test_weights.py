"""Released weights survive the round trip and refuse every file that does not fit."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from facejax.io import weights


class Layer(NamedTuple):
    kernel: jax.Array
    bias: jax.Array


def tree() -> dict:
    layer = Layer(jnp.arange(6.0).reshape(2, 3), jnp.float32(0.5))
    return {
        "layers": [layer, layer._replace(bias=jnp.ones((), jnp.bfloat16))],
        "ids": (np.arange(3, dtype=np.int32),),
    }


def test_round_trip_is_exact_and_keeps_the_tree(tmp_path):
    path = tmp_path / "deep" / "model.safetensors"
    weights.save(path, tree(), metadata={"seed": 7, "labels": ["neutral", "bocca aperta à"]})
    got, metadata = weights.load(path, jax.eval_shape(tree))
    assert metadata == weights.load_metadata(path) == {"seed": 7, "labels": ["neutral", "bocca aperta à"]}
    assert jax.tree.structure(got) == jax.tree.structure(tree())
    for found, expected in zip(jax.tree.leaves(got), jax.tree.leaves(tree()), strict=True):
        assert found.dtype == expected.dtype and found.shape == expected.shape
        np.testing.assert_array_equal(found, expected)
    assert [p.name for p in path.parent.iterdir()] == ["model.safetensors"]


def test_transposed_arrays_are_written_in_reading_order(tmp_path):
    array = np.arange(12.0, dtype=np.float32).reshape(3, 4).T
    weights.save(tmp_path / "t", {"a": array})
    np.testing.assert_array_equal(weights.load(tmp_path / "t", {"a": array})[0]["a"], array)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t | {"more": np.zeros(2, np.float32)}, r"more is missing"),
        (lambda t: {"layers": t["layers"]}, r"ids/0 is unexpected"),
        (lambda t: t | {"ids": (np.zeros(4, np.int32),)}, r"ids/0 should be int32\[4\], is int32\[3\]"),
        (lambda t: t | {"ids": (np.zeros(3, np.int16),)}, r"ids/0 should be int16\[3\], is int32\[3\]"),
    ],
)
def test_a_file_of_another_model_is_refused(tmp_path, change, message):
    path = tmp_path / "model.safetensors"
    weights.save(path, tree())
    with pytest.raises(weights.WeightsError, match=f"model.safetensors.*{message}"):
        weights.load(path, change(tree()))


def test_missing_truncated_and_foreign_files_are_named(tmp_path):
    with pytest.raises(weights.WeightsError, match=r"absent.*: no such weights file"):
        weights.load(tmp_path / "absent", tree())
    weights.save(tmp_path / "whole", tree())
    data = (tmp_path / "whole").read_bytes()
    for size in (0, 5, 100, len(data) - 1):
        (tmp_path / "cut").write_bytes(data[:size])
        with pytest.raises(weights.WeightsError, match="cut is not a complete safetensors file"):
            weights.load(tmp_path / "cut", tree())
    from safetensors.numpy import save_file

    save_file({"a": np.zeros(1)}, tmp_path / "foreign")
    with pytest.raises(weights.WeightsError, match=r"foreign.*lacks the 'facejax' entry"):
        weights.load_metadata(tmp_path / "foreign")


def test_a_failed_write_leaves_the_old_file_alone(tmp_path, monkeypatch):
    path = tmp_path / "model"
    weights.save(path, tree())
    before = path.read_bytes()

    def fail(*_):
        raise OSError("disk full")

    monkeypatch.setattr(weights.os, "replace", fail)
    with pytest.raises(OSError, match="disk full"):
        weights.save(path, {"a": np.zeros(3)})
    assert path.read_bytes() == before and [p.name for p in tmp_path.iterdir()] == ["model"]


def test_names_that_collide_are_refused():
    with pytest.raises(ValueError, match="both named 'a/b'"):
        weights.names({"a": {"b": np.zeros(1)}, "a/b": np.zeros(1)})
