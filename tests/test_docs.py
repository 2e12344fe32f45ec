"""README and docs: Python blocks run, commands parse, links and references exist, figures are those of the results.

`make docs` runs `mkdocs build --strict` besides, which needs the extra `docs`.
"""

import ast
import importlib
import importlib.util
import inspect
import pkgutil
import re
import shlex
from pathlib import Path
from typing import Any

import pytest

import facejax
from facejax.cli import main
from tests import markdown
from tests.faults import table as faults
from tests.markdown import DOCS, PAGES, ROOT

EXAMPLES = list(dict.fromkeys(example for text in PAGES.values() for example in markdown.examples(text)))
COMMANDS = [(page, command) for page, text in PAGES.items() for command in markdown.commands(text)]
FIGURES = [(page, *figure) for page, text in PAGES.items() for figure in markdown.figures(text)]
REFERENCE = re.compile(r"\[([^\]]*)\]\[(facejax(?:\.\w+)+)\]")


EXTRAS = {"onnxruntime"}


def names_of(node: ast.Import | ast.ImportFrom) -> set[str]:
    """Return the packages that a statement imports."""
    found = [node.module or ""] if isinstance(node, ast.ImportFrom) else [alias.name for alias in node.names]
    return {name.split(".")[0] for name in found}


def installed(node: ast.Import | ast.ImportFrom) -> bool:
    return all(importlib.util.find_spec(name) for name in names_of(node))


def resolve(name: str) -> Any:
    """Return the module or attribute with a dotted name. Raises `ImportError` or `AttributeError`."""
    parts = name.split(".")
    for count in range(len(parts), 0, -1):
        try:
            found = importlib.import_module(".".join(parts[:count]))
        except ModuleNotFoundError:
            continue
        for part in parts[count:]:
            found = getattr(found, part)
        return found
    raise ImportError(name)


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda text: text.splitlines()[-1][:40])
def test_examples_run(example, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    exec(compile(example, "example", "exec"), {})


@pytest.mark.parametrize("page", [page for page in PAGES if "```python" in PAGES[page]])
def test_functions_and_keywords_of_python_blocks_exist(page):
    """Also those of blocks that are not run."""
    for block in re.findall(r"```python\n(.*?)```", PAGES[page], re.DOTALL):
        tree = ast.parse(block)
        imports = [node for node in tree.body if isinstance(node, ast.Import | ast.ImportFrom)]
        # Packages of extras need not be installed.
        imports = [node for node in imports if not (names_of(node) & EXTRAS) or installed(node)]
        names: dict[str, Any] = {}
        exec(compile(ast.Module(imports, []), page, "exec"), names)
        for call in (node for node in ast.walk(tree) if isinstance(node, ast.Call)):
            path = ast.unparse(call.func)
            if not re.fullmatch(r"\w+(\.\w+)*", path) or path.split(".")[0] not in names:
                continue
            function = eval(path, names)
            keywords = {keyword.arg for keyword in call.keywords}
            if keywords and hasattr(function, "__module__") and function.__module__.startswith("facejax"):
                assert keywords <= set(inspect.signature(function).parameters), f"{page}: {path}"


@pytest.mark.parametrize("page, command", COMMANDS, ids=lambda value: value[:60])
def test_commands_parse(page, command, monkeypatch):
    """Every `facejax ...` line is accepted by the command line, up to running it."""
    called = []
    monkeypatch.setattr(main, "_COMMANDS", {kind: called.append for kind in main._COMMANDS})
    main.main(shlex.split(command))
    assert len(called) == 1


def test_there_are_commands_and_figures_to_check():
    assert len(COMMANDS) >= 20 and len(FIGURES) >= 60 and len(EXAMPLES) >= 5


def test_shell_completion_is_written(tmp_path):
    page = PAGES["docs/howto/completion.md"]
    for shell in ("bash", "zsh"):
        assert f"facejax --tyro-write-completion {shell} " in page
        with pytest.raises(SystemExit) as stop:
            main.main(["--tyro-write-completion", shell, str(tmp_path / shell)])
        assert not stop.value.code
        assert "facejax" in (tmp_path / shell).read_text()


def slug(heading: str) -> str:
    """Return the anchor that MkDocs gives a heading."""
    return re.sub(r"[\s-]+", "-", re.sub(r"[^\w\s-]", "", heading.lower())).strip("-")


def test_links_exist():
    for page, text in PAGES.items():
        for target in markdown.links(text):
            path, _, anchor = target.partition("#")
            found = (ROOT / page).parent / path if path else ROOT / page
            assert found.exists(), f"{page}: {target}"
            if anchor:
                headings = re.findall(r"^#+ (.+)$", markdown.prose(found.read_text()), re.MULTILINE)
                slugs = {
                    re.sub(r"[\s-]+", "-", re.sub(r"[^\w\s-]", "", heading.lower())).strip("-") for heading in headings
                }
                assert anchor in slugs, f"{page}: {target}"


def test_examples_are_listed():
    named = set(re.findall(r"^\| `(\w+\.py)` \|", PAGES["docs/quickstart.md"], re.MULTILINE))
    assert named == {path.name for path in (ROOT / "examples").glob("*.py")}


def test_modules_of_experiments_and_benchmarks_exist():
    for page, text in PAGES.items():
        for room, name in set(re.findall(r"python -m (experiments|benchmarks)\.([a-z]\w+)", text)):
            assert (ROOT / room / f"{name}.py").exists(), f"{page}: {room}.{name}"


def test_references_resolve():
    """`[text][facejax.x.y]` and `facejax.x.y` in backticks name something that can be imported."""
    missing = []
    for page, text in PAGES.items():
        old = page == "docs/glossary.md"  # names of modules that are gone
        named = {name for _, name in REFERENCE.findall(text)}
        if not old:
            named |= set(re.findall(r"`(facejax(?:\.\w+)+)(?:\(|`)", text))
        for name in named:
            try:
                resolve(name)
            except (ImportError, AttributeError):
                missing.append(f"{page}: {name}")
    assert not missing


def test_every_renamed_module_is_there():
    rows = re.findall(r"^\| `(facejax[\w.]+)` \| (`.+`) \|$", PAGES["docs/glossary.md"], re.MULTILINE)
    assert len(rows) > 80
    for _, new in rows:
        for name in re.findall(r"`([\w.]+)`", new):
            resolve(name)


def test_the_list_of_jobs_names_functions():
    jobs = re.findall(r"^\| (.+?) \| \[`([\w.]+)`\]\[([\w.]+)\] \|$", PAGES["docs/find.md"], re.MULTILINE)
    assert len(jobs) >= 30
    for job, _, name in jobs:
        assert callable(resolve(name)), job


def public_modules() -> list[str]:
    """Return all modules of facejax without an underscore, and the packages that define something themselves."""
    found = ["facejax"]
    for module in pkgutil.walk_packages(facejax.__path__, "facejax."):
        if any(part.startswith("_") for part in module.name.split(".")):
            continue
        if module.ispkg:
            path = ROOT / Path(*module.name.split(".")) / "__init__.py"
            if not re.search(r"^(?:def |class |__all__)", path.read_text(), re.MULTILINE):
                continue
        found.append(module.name)
    return found


def test_every_public_module_has_its_place_in_the_reference():
    text = "\n".join(path.read_text() for path in (DOCS / "api").glob("*.md"))
    documented = re.findall(r"^::: ([\w.]+)$", text, re.MULTILINE)
    assert len(documented) == len(set(documented))
    assert set(documented) == set(public_modules())


def test_every_experiment_and_picture_has_its_page():
    names = {path.stem for path in (ROOT / "experiments").glob("[a-z]*.py")}
    pages = {path.stem for path in (DOCS / "experiments").glob("*.md")} - {"index"}
    assert pages == names
    text = "\n".join(path.read_text() for path in DOCS.rglob("*.md"))
    for path in (ROOT / "experiments" / "results").glob("*.md"):
        assert f'--8<-- "experiments/results/{path.name}"' in text, path.name
    unused = {path.name for path in (ROOT / "experiments" / "results").glob("*.png")} - set(
        re.findall(r"experiments/results/([\w-]+\.png)", text)
    )
    assert unused <= {"table1-paper.png"}


def test_included_files_exist():
    for page, text in PAGES.items():
        for name in re.findall(r'^--8<-- "(.+)"$', text, re.MULTILINE):
            assert (ROOT / name).exists(), f"{page}: {name}"


def test_the_faults_page_has_a_place_for_the_table():
    assert PAGES["docs/faults.md"].count("<!-- faults -->") == 1
    assert faults.table(ROOT / "tests" / "faults" / "outcomes.jsonl").count("| damaged file |") >= 15


@pytest.mark.parametrize("page", [page for page in PAGES if markdown.figures(PAGES[page])])
def test_figures_are_those_of_the_results(page):
    text = markdown.prose(PAGES[page])
    assert text.count("<!-- figure:") == len(markdown.figures(text))
    assert not re.search(r"^\s*<!-- figure:", text, re.MULTILINE), (
        "a marker must not begin a line: it would end the paragraph"
    )
    for source, number, percent in markdown.figures(text):
        expected = markdown.value(source) * (100 if percent else 1)
        assert number == markdown.shown(expected, number), f"{source}: {expected:.6g}"


def test_nothing_is_fetched_by_the_site():
    """No web fonts and no scripts or styles of other hosts."""
    config = (ROOT / "mkdocs.yml").read_text()
    assert "font: false" in config
    assert not re.search(r"extra_(?:javascript|css)|https?://|repo_url", config)
    assert not re.search(r"<script|<link|```mermaid", "\n".join(PAGES.values()))
