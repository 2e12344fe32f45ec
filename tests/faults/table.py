"""The outcomes that `make faults` recorded, as the README's table: `python tests/faults/table.py FILE`."""

import json
import sys
from pathlib import Path


def table(path: Path) -> str:
    """A line for each fault and place, its tries added up."""
    rows: dict[tuple[str, str], list] = {}
    for line in path.read_text(encoding="utf-8").splitlines():
        entry = json.loads(line)
        row = rows.setdefault((entry["fault"], entry["where"]), [0, []])
        row[0] += entry["tries"]
        row[1] += [entry["outcome"]] if entry["outcome"] not in row[1] else []
    lines = ["| fault | where | tries | outcome |", "| --- | --- | --- | --- |"]
    for (fault, where), (tries, outcomes) in sorted(rows.items()):
        lines.append(f"| {fault} | {where} | {tries:,} | {'; '.join(outcomes)} |")
    return "\n".join(lines)


if __name__ == "__main__":
    print(table(Path(sys.argv[1])))
