"""The README is true: its Python runs, its commands parse, its links lead somewhere, its tables are the results."""

import json
import re
from pathlib import Path

import pytest

from facejax.cli import main
from tests.faults import table as faults

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()
EXAMPLES = re.findall(r"<!-- test: run -->\n```python\n(.*?)```", README, re.DOTALL)


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda text: text.splitlines()[-1][:40])
def test_examples_run(example, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    exec(compile(example, "README.md", "exec"), {})


def test_the_api_example_is_there_and_short():
    assert len(EXAMPLES) >= 2
    body = [line for line in EXAMPLES[0].splitlines() if line and not line.startswith(("import", "from"))]
    assert len(body) == 5


def test_commands_parse(capsys, monkeypatch):
    """Every `facejax ...` line of the README is accepted by the command line, up to running it."""
    blocks = "\n".join(re.findall(r"```sh\n(.*?)```", README, re.DOTALL))
    lines = re.findall(r"^facejax (.+?)(?:\s+#.*)?$", blocks, re.MULTILINE)
    assert len(lines) >= 5
    for line in lines:
        seen = []
        monkeypatch.setattr(main, "_COMMANDS", {kind: seen.append for kind in main._COMMANDS})
        main.main(line.split())
        assert len(seen) == 1, line


def test_links_and_modules_exist():
    for target in re.findall(r"\]\((?!http)([^)#]+)\)", README):
        assert (ROOT / target).exists(), target
    for module in set(re.findall(r"python -m (experiments|benchmarks)\.([a-z]\w+)", README)):
        assert (ROOT / module[0] / f"{module[1]}.py").exists(), module


def test_the_table_of_faults_is_that_of_the_record():
    """Of tests/faults/outcomes.jsonl, which `make faults` wrote."""
    (quoted,) = re.findall(r"<!-- faults -->\n(.*?)\n<!-- end -->", README, re.DOTALL)
    assert quoted == faults.table(ROOT / "tests" / "faults" / "outcomes.jsonl")


def test_result_tables_are_quoted_unchanged():
    """A table between `<!-- results: NAME -->` and `<!-- end -->` is the one in experiments/results/NAME.md."""
    quoted = re.findall(r"<!-- results: (\w+) -->\n(.*?)\n<!-- end -->", README, re.DOTALL)
    assert quoted
    for name, table in quoted:
        made = (ROOT / "experiments" / "results" / f"{name}.md").read_text()
        assert table.strip() in made, name
        record = json.loads((ROOT / "experiments" / "results" / f"{name}.json").read_text())["made"]
        assert {"command", "commit", "machine", "seed", "seconds", "dataset"} <= set(record)
