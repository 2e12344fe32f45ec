"""Fixtures that several rooms share: tiny meshes and datasets, Node and Chromium for the tests that need them."""

import json
import shutil
import subprocess
from pathlib import Path

import jax
import jaxtyping
import numpy as np
import pytest
import trimesh

# Modules whose shape annotations are checked when tests run; before anything of facejax is imported.
# An int is a float too, as for a static type checker: `alpha=1`.
TYPED = ["augment", "geometry", "landmarks", "losses", "mesh", "metrics", "models"]
jaxtyping.install_import_hook(
    [f"facejax.{name}" for name in TYPED], "beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))"
)

from facejax.data.synthetic import makehuman, makehuman4d  # noqa: E402
from tests import balls  # noqa: E402

CHROMIUM = ("chromium", "chromium-browser", "google-chrome")
# WebGL without a graphics card, and no talk with anybody's servers.
FLAGS = "--no-sandbox --use-gl=angle --use-angle=swiftshader --enable-unsafe-swiftshader --no-first-run "
FLAGS += "--disable-quic --disable-background-networking --disable-component-update --disable-sync"
ROOT = Path(__file__).parents[1]


def _ball(subdivisions: int = 2, radius: float = 80.0) -> tuple[np.ndarray, np.ndarray]:
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    return np.array(mesh.vertices, np.float32), np.array(mesh.faces, np.int32)


@pytest.fixture(params=["float32", "float64"])
def dtype(request):
    """Either precision, as JAX is told to have it."""
    with jax.enable_x64(request.param == "float64"):
        yield np.dtype(request.param)


@pytest.fixture(scope="session")
def template():
    """The MakeHuman head: 3,260 vertices."""
    return makehuman.template()


@pytest.fixture(scope="session")
def tiny_spec():
    """Six subjects: four train, one validates, one tests. Level 1, the cheapest that is not linear."""
    return makehuman4d.Spec(level=1, subjects=6, meshes=60)


@pytest.fixture(scope="session")
def tiny_store(tiny_spec, tmp_path_factory):
    """A small makehuman4d on disk."""
    return makehuman4d.prepare(tiny_spec, folder=tmp_path_factory.mktemp("data"))


@pytest.fixture(scope="session")
def ball_store():
    """A dataset in memory that is learnt in no time, see `tests.balls`."""
    return balls.make_ball_dataset()


@pytest.fixture
def ball():
    """A sphere: (N, 3) float32 mm, (F, 3) int32."""
    return _ball()


@pytest.fixture
def moving():
    """A sphere whose front grows a nose: (5, N, 3) float32, (F, 3); its back stands still, exactly."""
    frames = 5
    vertices, faces = _ball()
    front = np.maximum(vertices[:, 2:] / 80, 0) ** 2
    grow = np.linspace(0, 1, frames, dtype=np.float32)[:, None, None]
    return vertices + grow * front * np.array([5, 3, 30], np.float32), faces


@pytest.fixture
def node():
    """Runs a script of `tests/browser` under Node with a JSON argument; gives its JSON answer.

    Packages are found as Node finds them: in `node_modules` at the repository's root, or in NODE_PATH.
    """

    def run(script: str, argument, *packages: str):
        if shutil.which("node") is None:
            pytest.skip("Node is not installed")
        for package in packages:
            found = subprocess.run(["node", "-e", f"require.resolve({package!r})"], cwd=ROOT, capture_output=True)
            if found.returncode:
                pytest.skip(f"npm's {package} is not installed (npm install {package}, or set NODE_PATH)")
        command = ["node", str(Path(__file__).parent / "browser" / script), json.dumps(argument)]
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120)
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout)

    return run


@pytest.fixture
def browser(node):
    """As `node`, for scripts that drive Chromium; the argument gains its path."""
    paths = [path for path in map(shutil.which, CHROMIUM) if path]
    if not paths:
        pytest.skip("Chromium is not installed")
    return lambda script, argument, *packages: node(
        script, {"chromium": paths[0], "flags": FLAGS.split(), **argument}, "playwright-core", *packages
    )
