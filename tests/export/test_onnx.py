"""ONNX files against JAX, in ONNX Runtime on the CPU: tiny models, all kinds of generators and decoders."""

import functools
import importlib.util
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from facejax.export import functions, onnx, onnx_forms, onnx_graph
from facejax.inference import pipeline
from facejax.mesh import spiral_conv, strain
from tests import tiny_models
from tests.export import exports

TOLERANCE_MM = 1e-4
NEEDED = pytest.mark.skipif(
    any(importlib.util.find_spec(name) is None for name in onnx.PACKAGES), reason="jax2onnx, onnx or onnxruntime"
)


models_of = functools.cache(tiny_models.make)


@functools.cache
def converted(name, **options):
    function = onnx.catalogue(models_of(**options), [name])[name]
    return function, onnx.convert(function)


def run(proto, inputs):
    runtime = pytest.importorskip("onnxruntime")
    options = runtime.SessionOptions()
    options.log_severity_level = 3
    session = runtime.InferenceSession(proto.SerializeToString(), options)
    assert [one.name for one in session.get_inputs()] == list(inputs)
    return session.run(None, {name: np.asarray(value) for name, value in inputs.items()})


@NEEDED
@pytest.mark.parametrize("generator", ["flow", "gan"])
def test_one_file_makes_batches_of_motions_of_any_number_of_transitions_and_frames(generator):
    models = models_of(generator=generator)
    function, proto = converted("motion", generator=generator)
    for batch, frames in ((1, [7]), (3, [4, 9])):
        arrays, _, expected = exports.inputs(models, batch=batch, frames=frames)
        (found,) = run(proto, {name: arrays[name] for name in function.inputs})
        np.testing.assert_allclose(found, expected, atol=TOLERANCE_MM)


@NEEDED
def test_the_chain_makes_batches_of_vertices():
    models = models_of()
    function, proto = converted("chain")
    arrays, face, motion = exports.inputs(models, batch=3, frames=[4, 9])  # as for the motion: compiled already
    (found,) = run(proto, {name: arrays[name] for name in function.inputs})
    np.testing.assert_allclose(found, pipeline.vertices(models, face, motion), atol=TOLERANCE_MM)


@NEEDED
def test_one_file_continues_curves_of_any_number_of_frames():
    networks = exports.networks(start="neutral")  # has all operations of "zero", and reads the face
    function = onnx.catalogue(models_of(), ["lstm"], networks=networks)["lstm"]
    proto, rng = onnx.convert(function), np.random.default_rng(0)
    for batch, frames, known, label in ((1, 2, 1, 0), (3, 9, 4, 1), (2, 5, 5, 0)):
        inputs = {
            "label": np.int32(label), "known": np.int32(known),
            "curve": 0.1 * rng.normal(size=(batch, frames, 4, 3)), "neutral": rng.normal(size=(batch, 4, 3)),
        }  # fmt: skip
        inputs = {name: np.asarray(inputs[name], spec.dtype) for name, spec in function.inputs.items()}
        (found,) = run(proto, inputs)
        np.testing.assert_allclose(found, function.call(function.params, *inputs.values())[0], atol=1e-5)


@NEEDED
@pytest.mark.parametrize("decoder", ["gpmm", "s2d"])
def test_one_file_decodes_any_number_of_frames_of_any_face(decoder):
    models = models_of(decoder=decoder)
    names = ["decoder", "decoder_linear"] if decoder == "gpmm" else ["decoder"]
    for name in names:
        function, proto = converted(name, decoder=decoder)
        for frames, stretch in ((1, 1.0), (5, 1.1)):
            face = pipeline.prepare(models, np.float32(stretch) * models.face.vertices)
            moved = face.landmarks + jax.random.normal(jax.random.key(frames), (frames, 4, 3))
            arrays = functions.face_arrays(face)
            inputs = {key: arrays[key] for key in function.inputs if key != "landmarks"} | {"landmarks": moved}
            (found,) = run(proto, inputs)
            expected = pipeline.vertices(models, face, moved, refined=name == "decoder")
            np.testing.assert_allclose(found, expected, atol=TOLERANCE_MM)


@NEEDED
def test_a_folder_has_the_files_and_a_manifest_and_is_replaced_whole(tmp_path):
    models, out = models_of(), tmp_path / "onnx"
    for _ in range(2):
        files = onnx.export(models, out, functions=["decoder_linear"])
    assert files == [out / "manifest.json", out / "decoder_linear.onnx"]
    assert sorted(path.name for path in out.iterdir()) == ["decoder_linear.onnx", "manifest.json"]
    manifest = json.loads((out / "manifest.json").read_text())
    row = manifest["functions"]["decoder_linear"]
    assert row["bytes"] == (out / row["file"]).stat().st_size
    assert row["inputs"][-1] == {"name": "landmarks", "shape": ["batch", 4, 3], "dtype": "float32"}
    assert row["outputs"] == [{"name": "vertices", "shape": ["batch", 162, 3], "dtype": "float32"}]
    assert manifest["labels"] == list(models.labels) and manifest["opset"] == onnx.OPSET
    with pytest.raises(ValueError, match="expected some of motion"):
        onnx.export(models, out, functions=["prepare"])
    assert (out / "manifest.json").exists()
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "notes").write_text("")
    with pytest.raises(ValueError, match="holds other files"):
        onnx.export(models, tmp_path / "other")


@NEEDED
def test_loops_pass_on_nothing_that_does_not_change():
    _, proto = converted("motion", generator="flow")

    def loops(graph):
        for node in graph.node:
            for attribute in node.attribute:
                if attribute.HasField("g"):
                    yield from [node] if node.op_type == "Loop" else []
                    yield from loops(attribute.g)

    found = list(loops(proto.graph))
    # One over transitions, one over steps of integration: trip count, condition, and what changes.
    assert len(found) == 2
    assert all(len(node.input) < 12 for node in found)
    assert onnx_graph.hoist_constants(proto.graph) == 0


def test_the_forms_for_onnx_are_equal_up_to_rounding():
    models = models_of()
    tables, hierarchy = models.decoder.tables, models.hierarchy
    rng = np.random.default_rng(0)
    for stencil in (*hierarchy.climbs, hierarchy.surface):
        x = jnp.asarray(rng.normal(size=(stencil.back.shape[2], 1, 6)), jnp.float32)
        kernel = jnp.asarray(rng.normal(size=(len(stencil.source), 6, 5)), jnp.float32)
        expected = spiral_conv.spiral_conv(x, kernel, stencil)
        np.testing.assert_allclose(onnx_forms.spiral_conv(x, kernel, stencil), expected, atol=2e-5)
    rest = jnp.asarray(models.face.vertices)[:, None]
    moved = jnp.asarray(rng.normal(size=rest.shape), jnp.float32)
    for found, expected in zip(onnx_forms.strain(moved, rest, tables), strain.strain(moved, rest, tables), strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-5)
    with pytest.raises(ValueError, match="expected one sample"):
        onnx_forms.spiral_conv(jnp.zeros((len(rest), 2, 6)), kernel, hierarchy.surface)


def test_missing_packages_are_named(monkeypatch):
    monkeypatch.setattr(onnx.importlib.util, "find_spec", lambda name: None if name == "onnx" else object())
    with pytest.raises(onnx.PackagesMissing, match="need the packages onnx:"):
        onnx.require_packages()
