"""What got slower than its own ratio to the peer, since the baseline that is committed.

Absolute times say more of a machine than of the code. A ratio to a peer in the same run is the code's own; the baseline
holds it with the part by which it may fall before that counts: half as much again as what several runs of one commit
differed by, and 15 to 50 %.
"""

from __future__ import annotations

import json
import math
import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

BASELINE = Path(__file__).with_name("baseline.json")
LEAST, MARGIN = 0.15, 1.5  # the least tolerance, and how much more than the spread seen is taken for noise


def baseline(runs: Sequence[Sequence[Mapping[str, Any]]]) -> dict[str, dict[str, Any]]:
    """For each row with a peer: the median ratio of several runs' rows, and its tolerance."""
    ratios: dict[str, list[float]] = {}
    for row in (row for rows in runs for row in rows if row["ratio"] is not None):
        ratios.setdefault(row["name"], []).append(row["ratio"])
    found = {}
    for name, seen in ratios.items():
        middle = statistics.median(seen)
        tolerance = max(LEAST, MARGIN * (max(seen) - min(seen)) / middle)
        found[name] = {"ratio": round(middle, 4), "tolerance": round(min(tolerance, 0.5), 3), "runs": len(seen)}
    return found


def read(path: Path) -> dict[str, Any]:
    """A baseline file. Raises `ValueError` where it is none."""
    try:
        found = json.loads(path.read_text())
        for row in found["rows"].values():
            if not (_number(row["ratio"]) and row["ratio"] > 0 and _number(row["tolerance"])):
                raise ValueError("ratio and tolerance must be numbers")
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(
            f"{path}: not a baseline of ratios ({error}); `python -m benchmarks --publish` writes one"
        ) from error
    return found


def rows_of(paths: Sequence[Path]) -> list[dict[str, Any]]:
    """The rows of files that benchmarks wrote. Raises `ValueError` for another file."""
    rows = []
    for path in paths:
        try:
            found = json.loads(path.read_text())
            # One benchmark's, or all of them as they are published.
            mine = [row for part in found.get("benchmarks", [found]) for row in part["rows"]]
            for row in mine:
                if not (isinstance(row["name"], str) and (row["ratio"] is None or _number(row["ratio"]))):
                    raise ValueError(f"a row without name or ratio: {str(row)[:60]}")
            if not mine:
                raise ValueError("holds no rows")
            rows += mine
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise ValueError(f"{path}: not the figures of a benchmark ({error}); --json writes them") from error
    return rows


def slower(rows: Sequence[Mapping[str, Any]], known: Mapping[str, Mapping[str, float]]) -> list[str]:
    """The names of rows whose ratio has fallen by more than the baseline tolerates."""
    return [row["name"] for row in rows if row["name"] in known and _fell(row, known[row["name"]])]


def table(rows: Sequence[Mapping[str, Any]], known: Mapping[str, Mapping[str, float]]) -> str:
    """Every row with a ratio beside the baseline's, as Markdown."""
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
