"""Comparison of benchmark ratios with the committed baseline.

Absolute times depend on the machine more than on the code, so the baseline holds ratios to a peer measured in the same
run. A ratio's tolerance is 1.5 times the spread that several runs of one commit showed, at least 15 and at most 50 %.
"""

from __future__ import annotations

import json
import math
import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

BASELINE = Path(__file__).with_name("baseline.json")
MIN_TOLERANCE, SPREAD_FACTOR = 0.15, 1.5


def baseline(runs: Sequence[Sequence[Mapping[str, Any]]]) -> dict[str, dict[str, Any]]:
    """Return, for each row with a peer, the median ratio over several runs and its tolerance."""
    ratios: dict[str, list[float]] = {}
    for row in (row for rows in runs for row in rows if row["ratio"] is not None):
        ratios.setdefault(row["name"], []).append(row["ratio"])
    found = {}
    for name, seen in ratios.items():
        middle = statistics.median(seen)
        tolerance = max(MIN_TOLERANCE, SPREAD_FACTOR * (max(seen) - min(seen)) / middle)
        found[name] = {"ratio": round(middle, 4), "tolerance": round(min(tolerance, 0.5), 3), "runs": len(seen)}
    return found


def read(path: Path) -> dict[str, Any]:
    """Read a baseline file. Raises `ValueError` for another file."""
    try:
        found = json.loads(path.read_text())
        for row in found["rows"].values():
            if not (_number(row["ratio"]) and row["ratio"] > 0 and _number(row["tolerance"])):
                raise ValueError("ratio and tolerance must be finite numbers, the ratio above 0")
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(
            f"{path}: not a baseline file ({error}); `python -m benchmarks --publish` writes one"
        ) from error
    return found


def rows_of(paths: Sequence[Path]) -> list[dict[str, Any]]:
    """Read the rows of result files of benchmarks. Raises `ValueError` for another file."""
    rows = []
    for path in paths:
        try:
            found = json.loads(path.read_text())
            # A file of one benchmark, or the published file of all.
            mine = [row for part in found.get("benchmarks", [found]) for row in part["rows"]]
            for row in mine:
                if not (isinstance(row["name"], str) and (row["ratio"] is None or _number(row["ratio"]))):
                    raise ValueError(f"a row without name or ratio: {str(row)[:60]}")
            if not mine:
                raise ValueError("holds no rows")
            rows += mine
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise ValueError(f"{path}: not a result file of a benchmark ({error}); --json writes one") from error
    return rows


def slower(rows: Sequence[Mapping[str, Any]], known: Mapping[str, Mapping[str, float]]) -> list[str]:
    """Return the names of rows whose ratio has fallen by more than its tolerance."""
    return [row["name"] for row in rows if row["name"] in known and _fell(row, known[row["name"]])]


def table(rows: Sequence[Mapping[str, Any]], known: Mapping[str, Mapping[str, float]]) -> str:
    """Return a Markdown table of all rows with a ratio, beside the baseline."""
    lines = ["| work | ratio | baseline | change | tolerated | |", "|" + " --- |" * 6]
    for row in (row for row in rows if row["ratio"] is not None):
        if row["name"] not in known:
            lines.append(f"| `{row['name']}` | {row['ratio']:.2f} | | | | new |")
            continue
        before = known[row["name"]]
        change, word = row["ratio"] / before["ratio"] - 1, "slower" if _fell(row, before) else "as before"
        cells = f"{row['ratio']:.2f} | {before['ratio']:.2f} | {change:+.0%} | -{before['tolerance']:.0%}"
        lines.append(f"| `{row['name']}` | {cells} | {'faster' if change > before['tolerance'] else word} |")
    return "\n".join(lines)


def _number(value: Any) -> bool:
    return isinstance(value, (int, float)) and math.isfinite(value)


def _fell(row: Mapping[str, Any], before: Mapping[str, float]) -> bool:
    return row["ratio"] is not None and row["ratio"] < before["ratio"] * (1 - before["tolerance"])
