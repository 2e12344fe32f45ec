"""The README is short, and its example and tables are those of the code and the results."""

import json
import re

import pytest

from tests import markdown
from tests.markdown import PAGES, ROOT

README = PAGES["README.md"]


def test_it_is_short():
    assert len(README.splitlines()) <= 220


def test_the_api_example_is_there_and_short():
    body = [
        line for line in markdown.examples(README)[0].splitlines() if line and not line.startswith(("import", "from"))
    ]
    assert len(body) == 5


def test_it_has_a_few_commands():
    assert len(markdown.commands(README)) == 5


@pytest.mark.parametrize("room", ["results", "benchmarks"])
def test_tables_are_quoted_unchanged(room):
    """A table after `<!-- results: NAME -->` or `<!-- benchmarks: NAME -->` has rows of the published one, in order."""
    folder = {"results": ROOT / "experiments" / "results", "benchmarks": ROOT / "benchmarks" / "results"}[room]
    quoted = re.findall(rf"<!-- {room}: ([\w-]+) -->\n(.*?)\n<!-- end -->", README, re.DOTALL)
    assert len(quoted) == 1
    for name, table in quoted:
        published = (folder / f"{name}.md").read_text().splitlines()
        rows = table.splitlines()
        assert rows[:2] == published[:2]
        places = [published.index(row) for row in rows]
        assert places == sorted(set(places))
        if room == "results":
            assert places == list(range(len(places))), "a table of results is quoted whole"
            record = json.loads((folder / f"{name}.json").read_text())["made"]
            assert {"command", "commit", "machine", "seed", "seconds", "dataset"} <= set(record)
        else:
            assert re.search(r"\*\*0\.\d+x\*\*", table), "rows in which a peer is faster are not left out"
