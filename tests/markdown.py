"""README and docs as text: code blocks, links, and figures that are marked with their source.

A figure is marked in front, `<!-- figure: SOURCE -->0.35x`. SOURCE is one value or `value / value`; a value is

    NAME word ... key=value ... .field   the row of experiments/results/NAME.json with these values, in any field or in
                                         the named one; region is "head" and noise 0 unless given, field `mean_mm`
    NAME /key/key                        a path in that file

NAME `cpu` and `h200` stand for benchmarks/results. Words with spaces are quoted. The number is rounded to the digits
shown; `%` after it multiplies by 100.
"""

from __future__ import annotations

import json
import re
import shlex
from decimal import Decimal
from functools import cache
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
PAGES = {path.relative_to(ROOT).as_posix(): path.read_text() for path in [ROOT / "README.md", *DOCS.rglob("*.md")]}
FIGURE = re.compile(r"<!-- figure: (.+?) -->(-?[\d,.]*\d(?:e-?\d+)?)( ?%)?")
BENCHMARKS = ("cpu", "h200")
DEFAULTS = {"region": "head", "noise_mm": 0, "landmark_noise_mm": 0}


def examples(text: str) -> list[str]:
    """Return the Python blocks that are marked to be run."""
    return re.findall(r"<!-- test: run -->\n```python\n(.*?)```", text, re.DOTALL)


def commands(text: str) -> list[str]:
    """Return the arguments of every `facejax` line in `sh` blocks."""
    blocks = "\n".join(re.findall(r"```sh\n(.*?)```", text, re.DOTALL))
    return re.findall(r"^facejax (.+?)(?:\s+#.*)?$", blocks, re.MULTILINE)


def prose(text: str) -> str:
    """Return the text without code blocks."""
    return re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE)


def links(text: str) -> list[str]:
    """Return the targets of all links that are not web addresses."""
    return re.findall(r"\]\((?!https?:)([^)\s]+)\)", prose(text))


def figures(text: str) -> list[tuple[str, str, str]]:
    """Return (source, number, "%" or "") of all marked figures."""
    return [(source, number, percent.strip()) for source, number, percent in FIGURE.findall(prose(text))]


def value(source: str) -> float:
    """Return the value that a marker names. Raises `LookupError` unless it is exactly one."""
    words = shlex.split(source)
    if "/" in words:
        at = words.index("/")
        return _look_up(words[:at]) / _look_up(words[at + 1 :])
    return _look_up(words)


def shown(number: float, like: str) -> str:
    """Return a number with as many digits as in `like`."""
    if "e" in like:
        return f"{number:.{len(like.split('e')[0].partition('.')[2])}e}"
    return f"{number:,.{len(like.partition('.')[2])}f}" if "," in like else f"{number:.{-_exponent(like)}f}"


def _exponent(number: str) -> int:
    exponent = Decimal(number).as_tuple().exponent
    assert isinstance(exponent, int)
    return exponent


@cache
def _document(name: str) -> dict[str, Any]:
    if name in BENCHMARKS:
        parts = json.loads((ROOT / "benchmarks" / "results" / f"{name}.json").read_text())["benchmarks"]
        return {"rows": [row for part in parts for row in part["rows"]]}
    return json.loads((ROOT / "experiments" / "results" / f"{name}.json").read_text())


def _look_up(words: list[str]) -> float:
    name, *rest = words
    found: Any = _document(name)
    if rest[0].startswith("/"):
        for key in rest[0][1:].split("/"):
            found = found[int(key) if isinstance(found, list) else key]
        return float(found)
    field = "mean_mm"
    wanted: list[tuple[str | None, Any]] = []
    for word in rest:
        if word.startswith("."):
            field = word[1:]
        elif "=" in word:
            key, _, text = word.partition("=")
            wanted.append((key, float(text)))
        else:
            wanted.append((None, word))
    rows = found["rows"]
    named = {key for key, _ in wanted}
    if any(word in ("head", "face") for word in rest):
        named.add("region")
    wanted += [(key, default) for key, default in DEFAULTS.items() if key in rows[0] and key not in named]
    matching = [row for row in rows if all(_has(row, *want) for want in wanted)]
    if len(matching) != 1:
        raise LookupError(f"{' '.join(words)}: expected one row, found {len(matching)}")
    return float(matching[0][field])


def _has(row: dict[str, Any], key: str | None, wanted: Any) -> bool:
    return row[key] == wanted if key else wanted in (x for x in row.values() if isinstance(x, str))
