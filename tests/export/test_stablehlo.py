"""Exports to StableHLO: the pipeline's numbers without facejax, and one error for files that are damaged."""

import hashlib
import json
import shutil
import subprocess
import sys

import numpy as np
import pytest

from facejax.cli import main
from facejax.export import manifest, stablehlo
from facejax.inference import expressions, pipeline
from facejax.io import weights
from tests import tiny_models
from tests.export import exports

ATOL = 1e-4  # mm; another compilation rounds differently

# A program that has only JAX, NumPy and safetensors.
WITHOUT_FACEJAX = """
import json, sys
import jax, numpy as np
from jax import export
from safetensors.numpy import load_file

jax.config.update("jax_disable_most_optimizations", True)  # compiles faster
folder, calls, out = sys.argv[1:]
manifest = json.load(open(f"{folder}/manifest.json"))
weights = load_file(f"{folder}/weights.safetensors")
found = {}
for name, arrays in np.load(calls, allow_pickle=True).item().items():
    entry = manifest["functions"][name.split("-")[0]]
    function = export.deserialize(bytearray(open(f"{folder}/{entry['file']}", "rb").read()))
    params = {key: weights[key] for key in entry["params"]}
    outputs = function.call(params, {row["name"]: arrays[row["name"]] for row in entry["inputs"]})
    found |= {f"{name}.{key}": value for key, value in outputs.items()}
assert not [name for name in sys.modules if name.startswith("facejax")]
np.savez(out, **found)
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """An export of all functions of small models; tests must not change it."""
    out = tmp_path_factory.mktemp("export") / "models"
    files = stablehlo.export(tiny_models.make(), out, networks=exports.networks())
    assert sorted(files) == sorted(out.iterdir()) and all(path.is_file() for path in files)
    return out


@pytest.fixture
def copy(folder, tmp_path):
    return shutil.copytree(folder, tmp_path / "copy")


def change(folder, function):
    """Rewrite the manifest of an export."""
    path = folder / "manifest.json"
    index = json.loads(path.read_text())
    function(index)
    path.write_text(json.dumps(index))


def digest(path):
    return hashlib.sha256(path.read_bytes()).hexdigest()


def test_a_new_process_without_facejax_gives_the_same_vertices(folder, tmp_path):
    models = tiny_models.make()
    arrays, face, motion = exports.inputs(models)
    short, _, short_motion = exports.inputs(models, batch=3, frames=(5,))  # another batch, length and number of labels
    many = np.concatenate([motion[0], short_motion[0]])[:17]  # more than the decoder takes at once
    calls = {
        "prepare": {"neutral": models.face.vertices},
        "motion": short,
        "chain": arrays,
        "decoder-many": arrays | {"landmarks": many},
        "decoder-one": arrays | {"landmarks": many[:1]},
    }
    calls = {name: {key: np.asarray(value) for key, value in given.items()} for name, given in calls.items()}
    np.save(tmp_path / "calls.npy", calls, allow_pickle=True)
    command = [sys.executable, "-I", "-c", WITHOUT_FACEJAX, folder, tmp_path / "calls.npy", tmp_path / "found.npz"]
    done = subprocess.run([str(word) for word in command], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    found = np.load(tmp_path / "found.npz")
    assert {array.dtype for array in found.values()} == {np.dtype("float32")}
    expected = {
        "motion.landmarks": short_motion,
        "chain.vertices": pipeline.vertices(models, face, motion),
        "decoder-many.vertices": pipeline.vertices(models, face, many),
        "decoder-one.vertices": pipeline.vertices(models, face, many)[:1],
        "prepare.rest": face.landmarks,
        "prepare.size": face.size,
    }
    for name, array in expected.items():
        np.testing.assert_allclose(found[name], array, atol=ATOL, err_msg=name)


def test_loaded_functions_take_named_arrays_of_any_batch_and_time(folder):
    loaded = stablehlo.load(folder)
    assert list(loaded) == ["motion", "prepare", "decoder", "decoder_linear", "chain", "lstm"]
    models = tiny_models.make()
    face = pipeline.prepare(models, models.face.vertices)
    prepared = {name: array for name, array in exports.inputs(models)[0].items() if name in loaded["decoder"].inputs}
    for batch in (1, 5):
        landmarks = np.asarray(face.landmarks) + np.random.default_rng(0).normal(size=(batch, 4, 3))  # float64
        found = loaded["decoder_linear"](**prepared, landmarks=landmarks)["vertices"]
        expected = pipeline.vertices(models, face, landmarks.astype(np.float32), refined=False)
        np.testing.assert_allclose(found, expected, atol=ATOL)
    neutral = np.random.default_rng(2).normal(size=(2, 4, 3)).astype(np.float32)
    for frames in (2, 11):
        expected = expressions.displacements(exports.networks(), "joy", neutral, frames=frames, stop=0)
        curve = np.zeros((2, frames, 4, 3))
        found = loaded["lstm"](label=0, curve=curve, known=1, neutral=neutral)["continued"]
        np.testing.assert_allclose(found, expected, atol=1e-5)


def test_inputs_that_do_not_fit_are_named(folder):
    loaded = stablehlo.load(folder)
    models = tiny_models.make()
    arrays, _, _ = exports.inputs(models)
    motion = {name: arrays[name] for name in loaded["motion"].inputs}
    wrong = {
        "missing or unknown: blur": {name: array for name, array in motion.items() if name != "blur"},
        "missing or unknown: extra": motion | {"extra": 1},
        r"labels: expected int32 \(batch, transitions \+ 1\), got \(2, 5\); batch is 2; transitions is 2": motion
        | {"labels": np.zeros((2, 5), int)},
        r"rest: expected float32 \(4, 3\), got \(3, 3\)": motion | {"rest": np.zeros((3, 3))},
        r"intensity: expected float32 \(batch\), got \(\)": motion | {"intensity": 1.0},
        "labels: expected int32, got float64": motion | {"labels": np.zeros((2, 3))},
    }
    for message, given in wrong.items():
        with pytest.raises(ValueError, match=message):
            loaded["motion"](**given)


MANIFESTS = {
    "format: expected stablehlo, got 'onnx'": lambda index: index.update(format="onnx"),
    "version: expected 1, got '2'": lambda index: index.update(version=2),
    "jax: expected a text, got 'None'": lambda index: index.pop("jax"),
    "labels: expected a list of names": lambda index: index.update(labels="neutral"),
    "weights.file: expected a file name": lambda index: index["weights"].update(file="../weights.safetensors"),
    "functions: expected an object of functions": lambda index: index.update(functions={}),
    "functions.motion.sha256: expected 64": lambda index: index["functions"]["motion"].update(sha256="0"),
    "functions.motion.file: expected a file name": lambda index: index["functions"]["motion"].update(
        file="/a.stablehlo"
    ),
    "functions.motion.params: expected names of": lambda index: index["functions"]["motion"]["params"].append("x"),
    "functions.motion.inputs.0.dtype": lambda index: index["functions"]["motion"]["inputs"][0].update(dtype="object"),
    "expected a dimension": lambda index: index["functions"]["motion"]["inputs"][0].update(shape=["b**9"]),
    "outputs.0.shape: expected sizes": lambda index: index["functions"]["lstm"]["outputs"][0].update(shape=[-1]),
    "weights.arrays.a.shape": lambda index: index["weights"]["arrays"].update(a={"shape": 3, "dtype": "float32"}),
    "constraints: expected a list": lambda index: index["functions"]["lstm"].update(constraints=None),
}


@pytest.mark.parametrize("message", MANIFESTS)
def test_a_damaged_manifest_is_refused_by_field(copy, message):
    change(copy, MANIFESTS[message])
    with pytest.raises(manifest.ExportError) as caught:
        stablehlo.load(copy)
    assert str(copy / "manifest.json") in str(caught.value) and message in str(caught.value)


@pytest.mark.parametrize("text", [b"", b"[1]", b"{", b"\xff", b"[" * 5000, b" " * (manifest.MAX_BYTES + 1)])
def test_what_is_no_manifest_is_refused(copy, text):
    (copy / "manifest.json").write_bytes(text)
    with pytest.raises(manifest.ExportError, match=r"manifest\.json"):
        stablehlo.load(copy)


def test_damaged_files_are_named(copy):
    blob = copy / "decoder.stablehlo"
    whole = blob.read_bytes()
    blob.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(manifest.ExportError, match=r"decoder.stablehlo: damaged: its SHA-256 is not the one"):
        stablehlo.load(copy)
    change(copy, lambda index: index["functions"]["decoder"].update(sha256=digest(blob)))
    with pytest.raises(manifest.ExportError, match=r"decoder.stablehlo: jax .* cannot load it"):
        stablehlo.load(copy)
    blob.unlink()
    with pytest.raises(manifest.ExportError, match=r"decoder.stablehlo: cannot be read"):
        stablehlo.load(copy)


def test_a_function_that_differs_from_the_manifest_is_refused(copy):
    def swap(index):
        index["functions"]["decoder"].update(file="chain.stablehlo", sha256=digest(copy / "chain.stablehlo"))

    change(copy, swap)
    with pytest.raises(manifest.ExportError, match=r"chain.stablehlo: params differ from manifest.json"):
        stablehlo.load(copy)


def test_weights_that_differ_from_the_manifest_are_refused(copy):
    change(copy, lambda index: index["weights"]["arrays"]["motion/chart/p"].update(shape=[1, 2]))
    with pytest.raises(weights.WeightsError, match="motion/chart/p should be"):
        stablehlo.load(copy)


def test_only_an_export_is_replaced(copy, tmp_path):
    models = tiny_models.make()
    stablehlo.export(models, copy, functions=["decoder_linear"], platforms=["cpu"])
    assert {path.name for path in copy.iterdir()} == {
        "manifest.json",
        "weights.safetensors",
        "decoder_linear.stablehlo",
    }
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("keep")
    with pytest.raises(ValueError, match="holds other files than an export"):
        stablehlo.export(models, tmp_path / "mine")
    with pytest.raises(ValueError, match="platforms: expected some of cpu, cuda, rocm, tpu, got abacus"):
        stablehlo.export(models, copy, platforms=["abacus"])
    assert (tmp_path / "mine" / "notes.txt").read_text() == "keep"


def test_the_command_writes_an_export(tmp_path, capsys):
    out = tmp_path / "out"
    main.main(["export", "stablehlo", "--functions", "decoder_linear", "--out", str(out)])
    assert capsys.readouterr().out.split() == [
        str(out / name) for name in ("manifest.json", "weights.safetensors", "decoder_linear.stablehlo")
    ]
    index = json.loads((out / "manifest.json").read_text())
    assert index["command"] == f"facejax export stablehlo --out {out} --functions decoder_linear"
    assert stablehlo.load(out)["decoder_linear"].outputs["vertices"].shape[1:] == (3260, 3)
    for arguments, message in (
        (["--functions", "nothing", "--out", str(out)], "functions: expected some of"),
        (["--out", str(tmp_path)], "holds other files than an export"),
        (["--model", str(tmp_path / "absent"), "--out", str(out)], "no such weights file"),
    ):
        with pytest.raises(SystemExit) as stop:
            main.main(["export", "stablehlo", *arguments])
        assert stop.value.code == 2
        err = capsys.readouterr().err
        assert message in err and err.count("\n") == 1
