"""The outcomes that `make faults` recorded, as the table of docs/faults.md: `python tests/faults/table.py FILE`."""

import json
import sys
from pathlib import Path

APART = ("damaged file",)  # one line for each place; of other faults, one for all places with one outcome


def table(path: Path) -> str:
    """A line for each fault and outcome: tries and counts added up, the largest of what was measured."""
    rows: dict[tuple, list[dict]] = {}
    for line in path.read_text(encoding="utf-8").splitlines():
        entry = json.loads(line)
        key = entry["fault"], entry["outcome"], entry["where"] if entry["fault"] in APART else ""
        rows.setdefault(key, []).append(entry)
    lines = ["| fault | where | tries | outcome |", "| --- | --- | --- | --- |"]
    for key in sorted(rows):
        places = sorted({entry["where"] for entry in rows[key]})
        where = ", ".join(places) if len(places) < 8 else f"{len(places)} kinds of file"
        tries = sum(entry["tries"] for entry in rows[key])
        lines.append(f"| {key[0]} | {where} | {tries:,} | {told(key[1], rows[key])} |")
    return "\n".join(lines)


def told(outcome: str, entries: list[dict]) -> str:
    counts = [
        f"{sum(entry[name] for entry in entries):,} {what}"
        for name, what in (("refused", "refused in one line"), ("read", "read"))
        if name in entries[0]
    ]
    parts = [outcome, ", ".join(counts)]
    for name, unit in (("seconds", "s"), ("mb", "MB")):
        if name in entries[0]:
            parts.append(f"{max(entry[name] for entry in entries):.0f} {unit} at most")
    return "; ".join(part for part in parts if part)


if __name__ == "__main__":
    print(table(Path(sys.argv[1])))
