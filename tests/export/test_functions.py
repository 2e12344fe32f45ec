"""The catalogue of exported functions: the numbers of the pipeline, from named arrays."""

import jax
import numpy as np
import pytest

from facejax.export import functions
from facejax.export.signature import Dimension
from facejax.inference import expressions, pipeline
from tests import tiny_models
from tests.export import exports


def call(function, arrays):
    found = function.call(function.params, *(arrays[name] for name in function.inputs))
    return dict(zip(function.outputs, found, strict=True))


# The others are compared in test_stablehlo.
@pytest.mark.parametrize(
    ("generator", "decoder", "names"),
    [("flow", "gpmm", ["prepare", "decoder_linear"]), ("gan", "s2d", ["prepare", "motion", "decoder"])],
)
def test_functions_give_what_the_pipeline_gives(generator, decoder, names):
    models = tiny_models.make(generator=generator, decoder=decoder)
    arrays, face, motion = exports.inputs(models)
    found = functions.catalogue(models, names)
    expected = {
        "motion": motion,
        "decoder": pipeline.vertices(models, face, motion[:, 3]),
        "decoder_linear": pipeline.vertices(models, face, motion[:, 3], refined=decoder != "gpmm"),
    }
    for name in found.keys() - {"prepare"}:
        (output,) = call(found[name], arrays | {"landmarks": motion[:, 3]}).values()
        np.testing.assert_allclose(output, expected[name], atol=2e-5)
    prepared = call(found["prepare"], {"neutral": models.face.vertices})
    assert list(prepared) == list(functions.face_arrays(face))
    for name, array in functions.face_arrays(face).items():
        np.testing.assert_allclose(prepared[name], array, rtol=1e-4, atol=1e-4)


def test_parameters_are_what_a_function_reads_in_float32():
    found = functions.catalogue(tiny_models.make(), ["motion", "prepare", "decoder", "decoder_linear", "chain"])
    assert found["decoder_linear"].params == {}
    assert found["chain"].params.keys() == found["motion"].params.keys() | found["decoder"].params.keys()
    assert not [name for name in found["chain"].params if "back" in name or "rest" in name or "kept" in name]
    assert not found["motion"].params.keys() & found["decoder"].params.keys()
    for function in found.values():
        assert {str(array.dtype) for array in function.params.values()} <= {"float32", "int32"}


@pytest.mark.parametrize("start", ["zero", "neutral"])
def test_the_lstm_gives_what_the_expression_networks_give(start):
    networks = exports.networks(start=start)
    function = functions.catalogue(tiny_models.make(), ["lstm"], networks=networks)["lstm"]
    neutral = np.random.default_rng(2).normal(size=(3, 4, 3)).astype(np.float32)
    expected = expressions.displacements(networks, "anger", neutral, frames=12, stop=0)
    expected = np.broadcast_to(expected, (3, 12, 4, 3))
    arrays = {"label": np.int32(1), "known": np.int32(1), "neutral": neutral}
    curve = np.full((3, 12, 4, 3), 7, np.float32)  # frames that are not known are not read
    np.testing.assert_allclose(call(function, arrays | {"curve": curve})["continued"], expected, atol=1e-6)
    prefix = expected[:, :5] + np.linspace(0, 0.1, 5, dtype=np.float32)[:, None, None]
    continued = expressions.displacements(networks, "anger", neutral, frames=12, prefix=prefix, stop=0)
    arrays |= {"known": np.int32(5), "curve": np.concatenate([prefix, curve[:, 5:]], axis=1)}
    np.testing.assert_allclose(call(function, arrays)["continued"], continued, atol=1e-6)


def test_arguments_have_symbolic_or_given_sizes():
    function = functions.catalogue(tiny_models.make(), ["motion"])["motion"]
    assert function.symbols == ("batch", "transitions", "frames")
    timeline, labels = (list(function.inputs).index(name) for name in ("timeline", "labels"))
    drawn = len(tiny_models.make().motion.chart.p) + 1
    given = function.arguments({"batch": 5, "transitions": 2, "frames": 7})
    assert (given[timeline].shape, given[labels].shape) == ((7, 2 * drawn), (5, 3))
    assert str(function.arguments()[timeline].shape) == f"(frames, {drawn}*transitions)"
    (output,) = function.outputs_spec({"batch": 5, "transitions": 2, "frames": 7}).values()
    assert output.shape == (5, 7, 4, 3)


@pytest.mark.parametrize("size", [Dimension("batch"), Dimension("b", 30), Dimension("b", 2, 1), Dimension("b", 1, 7)])
def test_dimensions_are_read_as_they_are_written(size):
    assert Dimension.parse(str(size)) == size
    assert str(jax.export.symbolic_shape(str(size))[0]) == str(size)


@pytest.mark.parametrize("text", ["", "3", "b - 1", "b*b", "__import__('os')", "b + 1 + 1", "9999999999*b"])
def test_other_dimensions_are_refused(text):
    with pytest.raises(ValueError, match="expected a dimension such as"):
        Dimension.parse(text)


def test_unknown_functions_are_named():
    with pytest.raises(ValueError, match=r"expected some of motion, .*got nothing"):
        functions.catalogue(tiny_models.make(), ["nothing"])
    with pytest.raises(ValueError, match="expected some of motion, prepare, decoder, chain, lstm, got decoder_linear"):
        functions.catalogue(tiny_models.make(decoder="s2d"), ["decoder_linear"])
