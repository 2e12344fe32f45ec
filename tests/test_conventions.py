"""Conventions: geometry functions under JAX's transformations, and the one way that imports point."""

import ast
import inspect
import re
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from facejax.geometry import align, host, interpolation, rbf, sphere, srvf

ROOT = Path(__file__).resolve().parents[1]
T, L, K = 6, 4, 3


def array(seed, *shape):
    return jnp.asarray(np.random.default_rng(seed).normal(size=shape), jnp.float32)


def point(lead, seed):
    raw = array(seed, *lead, T - 1, L, 3)
    return raw / sphere.norm(raw)[..., None, None, None]


def tangent(lead, seed):
    return sphere.project(point(lead, 1), array(seed, *lead, T - 1, L, 3))


def cluster(lead):
    """Points near one another, where the Karcher mean is unique."""
    raw = point(lead, 1)[..., None, :, :, :] + 0.5 * point((*lead, K), 2)
    return raw / sphere.norm(raw)[..., None, None, None]


def curve(lead, seed=1):
    return array(seed, *lead, T, L, 3)


def similarity(lead):
    return align.procrustes(array(1, *lead, L, 3), array(2, *lead, L, 3), scaling=True)


# Every public function of the room: its arguments for a batch of the shape `lead`, and its static options.
CASES = {
    "sphere.safe_sqrt": (lambda lead: (array(1, *lead) ** 2,), {}),
    "sphere.inner": (lambda lead: (point(lead, 1), point(lead, 2)), {}),
    "sphere.norm": (lambda lead: (tangent(lead, 2),), {}),
    "sphere.project": (lambda lead: (point(lead, 1), array(2, *lead, T - 1, L, 3)), {}),
    "sphere.exp": (lambda lead: (point(lead, 1), tangent(lead, 2)), {}),
    "sphere.log": (lambda lead: (point(lead, 1), point(lead, 2)), {}),
    "sphere.distance": (lambda lead: (point(lead, 1), point(lead, 2)), {}),
    "sphere.geodesic": (lambda lead: (point(lead, 1), point(lead, 2), array(3, *lead)), {}),
    "sphere.transport": (lambda lead: (point(lead, 1), point(lead, 2), tangent(lead, 3)), {}),
    "sphere.extrinsic_mean": (lambda lead: (cluster(lead),), {}),
    "sphere.karcher_mean": (lambda lead: (cluster(lead),), {"steps": 30}),
    "srvf.encode": (lambda lead: (curve(lead),), {}),
    "srvf.decode": (lambda lead: (point(lead, 1), array(2, *lead), array(3, *lead, L, 3)), {}),
    "srvf.displacement": (lambda lead: (point(lead, 1), array(2, *lead)), {}),
    "srvf.arc_length_fraction": (lambda lead: (point(lead, 1),), {}),
    "srvf.length": (lambda lead: (curve(lead),), {}),
    "align.centre": (lambda lead: (array(1, *lead, L, 3),), {}),
    "align.normalise": (lambda lead: (curve(lead), array(2, *lead, L, 3)), {}),
    "align.denormalise": (lambda lead: (curve(lead), array(2, *lead) ** 2, array(3, *lead, 3)), {}),
    "align.procrustes": (lambda lead: (array(1, *lead, L, 3), array(2, *lead, L, 3)), {"scaling": True}),
    "align.apply": (lambda lead: (similarity(lead), array(3, *lead, L, 3)), {}),
    "align.resample": (lambda lead: (curve(lead),), {"frames": 9, "by": "arc"}),
    "align.interpolate": (lambda lead: (curve(lead), 2 * array(2, *lead, 7) ** 2), {}),
    "rbf.warp": (lambda lead: (array(1, *lead, 9, L), array(2, *lead, L, 3)), {}),
}
# Functions that are not jitted: NumPy on the host, or either kind of array.
HOST = {"rbf.fit", "rbf.weights", "rbf.apply", "rbf.refit", "host.procrustes", "interpolation.smoothstep"}
MODULES = {
    "sphere": sphere,
    "srvf": srvf,
    "align": align,
    "rbf": rbf,
    "host": host,
    "interpolation": interpolation,
}


def function(name):
    module, short = name.split(".")
    return getattr(MODULES[module], short)


def assert_close(a, b):
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert x.dtype == y.dtype
        np.testing.assert_allclose(x, y, rtol=1e-5, atol=3e-6)


def test_every_public_geometry_function_is_listed_and_jitted():
    public = {
        f"{room}.{name}"
        for room, module in MODULES.items()
        for name, value in vars(module).items()
        if callable(value) and getattr(value, "__module__", "") == module.__name__
        if not name.startswith("_") and not inspect.isclass(value)
    }
    assert public == set(CASES) | HOST
    for name in public:
        assert hasattr(function(name), "lower") != (name in HOST), f"{name}: jitted, or listed under HOST"
        assert function(name).__doc__, f"{name} has no docstring"


@pytest.mark.parametrize("lead", [(), (1,), (3, 2)], ids=str)
@pytest.mark.parametrize("name", CASES)
def test_eager_jit_and_vmap_agree(name, lead):
    build, options = CASES[name]
    args = build(lead)
    batched = function(name)(*args, **options)
    with jax.disable_jit():
        assert_close(function(name)(*args, **options), batched)
    mapped = jax.tree_util.Partial(function(name), **options)
    for _ in lead:
        mapped = jax.vmap(mapped)
    assert_close(mapped(*args), batched)


@pytest.mark.parametrize("name", CASES)
def test_calls_of_one_shape_trace_once(name):
    build, options = CASES[name]
    args = build(())
    function(name).clear_cache()
    function(name)(*args, **options)
    function(name)(*jax.tree.map(lambda x: 0.5 * x, args), **options)
    assert function(name)._cache_size() == 1


# The rooms of facejax, from the ground up, and what each may import besides itself. `io.atomic` is a room of its own:
# it imports nothing, and `viz` writes its files through it.
BELOW = {
    "assets": set(),
    "io.atomic": set(),
    "geometry": set(),
    "mesh": {"geometry", "io.atomic"},
    "landmarks": {"geometry"},
    "losses": {"geometry"},
    "metrics": {"geometry"},
    "augment": {"geometry"},
    "viz": {"geometry", "mesh", "io.atomic"},
    "io": {"geometry", "mesh", "landmarks", "viz", "io.atomic"},
    "models": {"geometry", "mesh", "io", "io.atomic"},
    "data": {"geometry", "mesh", "landmarks", "augment", "io", "io.atomic", "models"},
}
BELOW["training"] = set(BELOW)
BELOW["inference"] = set(BELOW)
BELOW["evaluation"] = set(BELOW)
BELOW["export"] = set(BELOW)
BELOW["cli"] = set(BELOW)


def imports(path, module):
    """The dotted names that a file imports, relative ones resolved, those inside functions included."""
    package = module if path.name == "__init__.py" else module.rpartition(".")[0]
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"), str(path))):
        if isinstance(node, ast.Import):
            yield from ((alias.name, node.lineno) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                parents = package.split(".")[: len(package.split(".")) - node.level + 1]
                base = ".".join([*parents, base]).rstrip(".")
            yield from ((f"{base}.{alias.name}", node.lineno) for alias in node.names)


def module_name(root, path):
    parts = path.relative_to(root).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def modules(root, top):
    """Dotted name -> path, of every module under one top-level package."""
    return {module_name(root, path): path for path in sorted((root / top).rglob("*.py"))}


def room(name):
    """The room of a dotted name under facejax; "" for the package itself."""
    parts = name.split(".")[1:]
    return ".".join(parts[:2]) if ".".join(parts[:2]) in BELOW else "".join(parts[:1])


def violations(root):
    """Every import under `root` that points the wrong way, as `module:line reaches name`."""
    found = []
    paths = modules(root, "facejax")
    for module, path in paths.items():
        here = room(module)
        if here and here not in BELOW:
            found.append(f"{module}: its room, {here}, is not in the table")
        for name, line in imports(path, module):
            top = name.split(".")[0]
            wrong = top in ("experiments", "benchmarks", "tests")
            if top == "facejax" and here in BELOW:
                wrong = room(name) not in BELOW[here] | {here, ""}
            if wrong:
                found.append(f"{module}:{line} reaches {name}")
    for top in ("experiments", "benchmarks"):
        for module, path in modules(root, top).items():
            for name, line in imports(path, module):
                start, _, rest = name.partition(".")
                private = start == top and (not rest or rest.startswith("_"))
                if start in ("experiments", "benchmarks", "tests") and not private:
                    found.append(f"{module}:{line} reaches {name}")
    return found


def graph(root):
    """Module -> the modules of the package that it imports."""
    paths = modules(root, "facejax")
    edges = {}
    for module, path in paths.items():
        names = {name for name, _ in imports(path, module)}
        # `from package import name` names a module, or something inside the package's __init__.
        names = {name if name in paths else name.rpartition(".")[0] for name in names}
        edges[module] = sorted(name for name in names if name in paths and name != module)
    return edges


def cycle(edges):
    """One cycle of a graph as a list of nodes, or None."""
    state = {}

    def visit(node, trail):
        state[node] = "open"
        for after in edges[node]:
            if state.get(after) == "open":
                return [*trail[trail.index(after) :], after]
            if after not in state and (found := visit(after, [*trail, after])):
                return found
        state[node] = "done"
        return None

    for node in edges:
        if node not in state and (found := visit(node, [node])):
            return found
    return None


def test_imports_point_one_way():
    assert violations(ROOT) == []


def test_no_module_imports_itself_in_a_circle():
    edges = graph(ROOT)
    assert "facejax.geometry.sphere" in edges["facejax.geometry.srvf"]
    assert cycle(edges) is None


def test_jaxopt_is_imported_by_one_module_at_most():
    users = [
        path
        for path in sorted((ROOT / "facejax").rglob("*.py"))
        if any(name.split(".")[0] == "jaxopt" for name, _ in imports(path, module_name(ROOT, path)))
    ]
    assert len(users) <= 1, users


@pytest.mark.parametrize(
    ("file", "line", "wrong"),
    [
        ("facejax/geometry/new.py", "from facejax.mesh import graph", True),
        ("facejax/geometry/new.py", "from ..models import lstm", True),
        ("facejax/geometry/new.py", "def f():\n    import facejax.io", True),
        ("facejax/geometry/new.py", "from . import sphere", False),
        ("facejax/viz/new.py", "from facejax.io import atomic", False),
        ("facejax/viz/new.py", "from facejax.io import meshes", True),
        ("facejax/io/new.py", "from facejax.viz import render", False),
        ("facejax/io/new.py", "from facejax.models import bundle", True),
        ("facejax/training/loop.py", "from facejax.inference import pipeline", True),
        ("facejax/inference/new.py", "from facejax.evaluation import baselines", True),
        ("facejax/data/new.py", "from facejax.io import meshes", False),
        ("facejax/data/importers/new.py", "from facejax import inference", True),
        ("facejax/inference/pipeline.py", "from facejax.cli import main", True),
        ("facejax/cli/main.py", "from facejax.inference import pipeline", False),
        ("facejax/attic/new.py", "import json", True),
        ("facejax/new.py", "import json", True),
        ("facejax/losses.py", "import experiments.pretrain", True),
        ("facejax/losses.py", "import tests", True),
        ("experiments/one.py", "from experiments import two", True),
        ("experiments/one.py", "from experiments import _run", False),
        ("experiments/one.py", "from facejax.cli import runtime", False),
        ("benchmarks/one.py", "from experiments import _run", True),
    ],
)
def test_the_check_finds_what_points_the_wrong_way(tmp_path, file, line, wrong):
    (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / file).write_text(line + "\n")
    assert bool(violations(tmp_path)) == wrong


def test_folders_hold_no_more_than_a_reader_can_survey():
    """At most six modules and thirteen folders at the package's root, at most 15 modules in a folder."""
    package = ROOT / "facejax"
    folders = [path for path in package.rglob("*") if path.is_dir() and path.name != "__pycache__"]
    assert len(list(package.glob("*.py"))) <= 6
    assert sum(path.parent == package for path in folders) <= 13
    assert [path for path in folders if len(list(path.glob("[!_]*.py"))) > 15] == []


def test_the_check_finds_a_circle(tmp_path):
    (tmp_path / "facejax").mkdir()
    for name, other in (("a", "b"), ("b", "c"), ("c", "a")):
        (tmp_path / "facejax" / f"{name}.py").write_text(f"from facejax import {other}\n")
    assert cycle(graph(tmp_path)) == ["facejax.a", "facejax.b", "facejax.c", "facejax.a"]


def public_definitions():
    """(module, definition) of every public function and class at the top level of facejax's modules."""
    for module, path in modules(ROOT, "facejax").items():
        for node in ast.parse(path.read_text(encoding="utf-8"), str(path)).body:
            if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
                yield module, node


# A docstring begins with a verb in the imperative or with a noun phrase: not with a clause, a preposition or code.
CLAUSE = re.compile(r"(What|How|Where|When|Whether|Which|Who|Why|The same|As|Of|If|From|With|Without|In|On|For|By)\b|`")


def test_docstrings_begin_with_a_verb_or_a_noun_phrase():
    found = [
        f"{module}.{node.name}: {(ast.get_docstring(node) or 'no docstring').splitlines()[0]}"
        for module, node in public_definitions()
        if not ast.get_docstring(node) or CLAUSE.match(ast.get_docstring(node))
    ]
    assert found == [], "\n".join(found)


def arguments(node):
    return [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]


def test_an_axis_of_devices_is_a_device_mesh():
    """`mesh` is a surface: a parameter of JAX's type Mesh is called `device_mesh`."""
    found = [
        f"{module}.{node.name}({argument.arg})"
        for module, node in public_definitions()
        if isinstance(node, ast.FunctionDef)
        for argument in arguments(node)
        if argument.annotation and re.search(r"\bMesh\b", ast.unparse(argument.annotation))
        if argument.arg != "device_mesh"
    ]
    assert found == []


# What may stand before a random key: parameters of models, and functions (optimisers, a critic, a field).
BEFORE_KEY = {"params", "models", "generator", "starts", "chart", "optimiser", "optimisers", "score", "field"}


def test_a_random_key_comes_before_the_data():
    found = [
        f"{module}.{node.name}({', '.join(names)})"
        for module, node in public_definitions()
        if isinstance(node, ast.FunctionDef)
        for names in [[argument.arg for argument in (*node.args.posonlyargs, *node.args.args)]]
        if "key" in names and not set(names[: names.index("key")]) <= BEFORE_KEY
    ]
    assert found == []


@pytest.mark.parametrize("module", ["facejax", "facejax.data.importers.worker", "facejax.geometry.interpolation"])
def test_modules_that_read_files_in_processes_of_their_own_import_no_jax(module):
    code = f"import sys, {module}; sys.exit('jax' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT).returncode == 0
