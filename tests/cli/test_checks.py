"""Arguments are refused before JAX is imported; what the checks repeat of other modules is equal to them."""

import inspect
import re
import shutil
import subprocess
import sys

import numpy as np
import pytest

import facejax
from facejax.cli import arguments, checks, labels, main
from facejax.data.importers import registry
from facejax.data.synthetic import noise
from facejax.geometry import rbf
from facejax.inference import expressions
from facejax.io import landmarks, meshes
from facejax.models import bundle

# Runs the command line in a process of its own, and says whether JAX was imported.
SCRIPT = """
import sys
from facejax.cli import main
try:
    main.main(sys.argv[1:])
    code = 0
except SystemExit as stop:
    code = stop.code or 0
print("jax" in sys.modules, "jaxlib" in sys.modules)
sys.exit(code)
"""


def run(*given, cwd):
    """(exit code, output without the last line, error output) of a command that must not import JAX."""
    command = [sys.executable, "-c", SCRIPT, *(str(x) for x in given)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=cwd, check=False)
    *lines, imported = done.stdout.splitlines()
    assert imported == "False False", (given, done.stderr)
    return done.returncode, lines, done.stderr


GENERATE = ("generate", "--out", "o")
ANIMATE = ("animate", "--out", "o")


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ((*GENERATE, "--end", "anger", "--intensity", 5), "intensity must lie in 0..2, got 5.0"),
        ((*GENERATE, "--end", "anger", "--frames", 1), "--frames must lie in 2..10000, got 1"),
        ((*GENERATE, "--end", "anger", "--seed", -1), "--seed must lie in 0..4294967295, got -1"),
        ((*GENERATE, "--end", "anger", "--fps", 0), "--fps must lie above 0, up to 1000, got 0.0"),
        ((*GENERATE, "--end", "anger", "--samples", 0), "--samples must lie in 1..1000, got 0"),
        ((*GENERATE, "--end", "anger", "--samples", 1000, "--frames", 500), "1000 samples have 500000 frames"),
        ((*GENERATE, "--end", "smile"), "unknown label 'smile': did you mean high_smile"),
        ((*GENERATE, "--end", "anger", "--then", "anger"), "'anger' follows itself"),
        ((*GENERATE, "--end", "anger", "--face", "no.ply"), "no.ply: no such file"),
        ((*GENERATE, "--end", "anger", "--face", "text.stl"), "text.stl: unknown mesh format '.stl'; expected .ply"),
        ((*GENERATE, "--end", "anger", "--face", "a.ply", "--landmarks", "no.json"), "no.json: no such file"),
        ((*GENERATE, "--end", "anger", "--face", "a.ply", "--landmarks", "a.ply"), "unknown landmark format '.ply'"),
        ((*GENERATE, "--end", "anger", "--landmarks", "a.json"), "requires --face"),
        ((*GENERATE, "--end", "anger", "--model", "no.safetensors"), "no.safetensors"),
        ((*GENERATE, "--end", "anger", "--shard", 3), "--shard requires --count"),
        ((*GENERATE, "--count", 3, "--shard", 0), "--shard must be 1 or more, got 0"),
        ((*GENERATE, "--count", 3, "--end", "qqqq"), "unknown label 'qqqq': expected one of neutral"),
        (("generate", "--end", "anger", "--out", "text.stl/o"), "text.stl is not a folder); name another folder"),
        (ANIMATE, "expected one of --expression, --end and --livelink, got none"),
        ((*ANIMATE, "--expression", "feer"), "no network for the expression 'feer': did you mean fear"),
        ((*ANIMATE, "--expression", "fear", "--frames", "natural"), "--frames natural requires --end"),
        ((*ANIMATE, "--end", "anger", "--kernel", "cubic"), "kernel: expected one of gaussian"),
        ((*ANIMATE, "--end", "anger", "--sigma", -1), "sigma: expected a positive number"),
        ((*ANIMATE, "--end", "anger", "--smoothing", -1), "smoothing: expected 0 or more, got -1.0"),
        ((*ANIMATE, "--end", "anger", "--person", -1), "--person must be 0 or more, got -1"),
        ((*ANIMATE, "--livelink", "no.csv"), "no.csv: no such file"),
        ((*ANIMATE, "--livelink", "a.csv", "--seconds", 0), "expected --begin of 0 or more and --seconds above 0"),
        (("register", "no.ply", "--landmarks", "a.json", "--out", "o"), "no.ply: no such file"),
        (("demo", "--seed", -1), "--seed must lie in 0..4294967295, got -1"),
        (("labels", "--model", "text.stl"), "text.stl"),
        (("data", "makehuman", "--sample", "o", "--count", 0), "--count must lie in 1..1000, got 0"),
        (("data", "makehuman", "--noise", 3), "noise must lie in 0..2 mm, got 3.0"),
        (("data", "prepare", "folder", "--root", "no", "--out", "o"), "no: no such folder"),
        (
            ("data", "prepare", "coma", "--root", ".", "--out", "o", "--actors", 3),
            "--actors is not supported by the coma importer",
        ),
        (("data", "prepare", "folder", "--root", ".", "--out", "o", "--labels", "no.csv"), "no.csv: no such file"),
        (("fit", "--data", "no", "--out", "m.safetensors"), "index.json"),
        (("view", "no.ply"), "no.ply: no such file"),
        (("view", "no.html"), "no.html: no such file"),
        (("view", "a.ply", "--out", "page.png"), "page.png: the page's name must end in .html"),
    ],
)  # fmt: skip
def test_arguments_are_refused_without_jax(tmp_path, given, message):
    for name in ("text.stl", "a.ply", "a.json", "a.csv"):
        (tmp_path / name).write_text("x")
    before = sorted(path.name for path in tmp_path.iterdir())
    code, printed, err = run(*given, cwd=tmp_path)
    assert code == 2 and printed == [] and message in err, err
    assert err.startswith("facejax: ") and err.count("\n") == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == before


def test_help_version_and_labels_need_no_jax(tmp_path):
    assert run("--version", cwd=tmp_path) == (0, [f"facejax {facejax.__version__}"], "")
    code, printed, _ = run("--help", cwd=tmp_path)
    assert code == 0 and any("--version" in line for line in printed)
    code, printed, _ = run("labels", cwd=tmp_path)
    assert code == 0 and tuple(printed) == bundle.load().labels
    assert labels.read_labels(released=labels.EXPRESSIONS) == expressions.load().labels


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_names_every_command_and_flag(capsys, shell):
    with pytest.raises(SystemExit) as stop:
        main.main(["--tyro-print-completion", shell])
    script = capsys.readouterr().out
    assert stop.value.code in (None, 0) and "facejax" in script
    for word in ("generate", "animate", "register", "demo", "labels", "makehuman", "prepare", "fit", "view"):
        assert word in script
    assert all(flag in script for flag in ("keep-rest", "distributed", "intensity"))


def test_the_bash_completion_is_valid_and_completes(tmp_path, capsys):
    if shutil.which("bash") is None:
        pytest.skip("bash is not installed")
    with pytest.raises(SystemExit):
        main.main(["--tyro-print-completion", "bash"])
    (tmp_path / "facejax.bash").write_text(capsys.readouterr().out)
    done = subprocess.run(["bash", "-n", tmp_path / "facejax.bash"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def formats(error):
    return set(re.search(r"expected (.*)$", str(error))[1].split(", "))


def test_what_the_checks_repeat_is_up_to_date():
    assert (labels.MODELS, labels.EXPRESSIONS) == (bundle.RELEASED, expressions.RELEASED)
    assert set(checks.KERNELS) == set(rbf.KERNELS)
    assert checks.MAX_NOISE_MM == noise.MAX_SIGMA_MM
    with pytest.raises(meshes.MeshError) as error:
        meshes.read("face.unknown")
    assert formats(error.value) == set(checks.MESHES)
    with pytest.raises(landmarks.LandmarkError) as error:
        landmarks.read("face.unknown")
    assert formats(error.value) == set(checks.LANDMARKS)
    flags = {"rate": "fps"}
    for layout, scan in registry.SCANS.items():
        parameters = {flags.get(name, name) for name in inspect.signature(scan).parameters}
        assert set(checks.IMPORTER_OPTIONS[layout]) == parameters - {"root", "level"}, layout


def test_every_command_has_a_check_and_a_module():
    kinds = {kind.__args__[0] if hasattr(kind, "__args__") else kind for kind in arguments.Command.__args__}
    assert set(main._COMMANDS) == kinds
    assert set(checks._CHECKS) == (kinds - {arguments.Data}) | {arguments.MakeHuman, arguments.Prepare}


@pytest.mark.parametrize("intensity", [-0.1, 2.1, np.nan])
def test_intensity_is_checked_by_one_function(intensity, tmp_path):
    command = arguments.Generate(out=tmp_path, end="anger", intensity=intensity)
    with pytest.raises(ValueError, match=rf"intensity must lie in 0\.\.2, got {intensity}"):
        checks.check(command)
