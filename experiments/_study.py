"""Web page, answer files and statistics of `experiments.user_study`.

The page and the participants' CSV files identify an item by an opaque name; only `items.json` holds its kind:
"composed", "peak" (neutral → peak), "predecessor" (neutral → peak by another generator) or "real".
"""

from __future__ import annotations

import base64
import csv
import hashlib
import json
import re
import string
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy import stats

from experiments import _run

TEMPLATE = Path(__file__).with_name("_study.html")
HEADER = ("participant", "seed", "version", "order", "item", "labels", "nat", "lab", "seconds")
SCORES = ("nat", "lab")
GROUPS = {"ours": ("composed", "peak"), **{kind: (kind,) for kind in ("composed", "peak", "predecessor", "real")}}
# OT23, section 4.4; its 28 animations are assumed to be those of the proposed model.
PAPER = {"ours": {"nat": 7.22, "lab": 7.05}, "peak": {"nat": 7.39}, "predecessor": {"nat": 5.82}}
PAPER_PARTICIPANTS = 23
NAMES = {
    "ours": "generated, all of ours",
    "composed": "three transitions",
    "peak": "neutral → peak, ours",
    "predecessor": "neutral → peak, predecessor",
    "real": "neutral → peak, real",
}


class Film(NamedTuple):
    """One animation on the page."""

    name: str  # opaque
    labels: tuple[str, ...]
    milliseconds: int
    size: tuple[int, int]  # width, height
    webp: bytes


class Answer(NamedTuple):
    """The scores of one participant for one item."""

    participant: str
    kind: str
    nat: int
    lab: int


def write_page(path: Path, items: Sequence[Film], high: Film, low: Film) -> str:
    """Write the page with all pictures embedded and return its version.

    `high` and `low` are the examples of the scores 10 and 0. Items are sorted by their opaque names. The version is a
    hash of all pictures and all text.
    """
    items = sorted(items)
    template = TEMPLATE.read_text("utf-8")
    names = " ".join(film.name for film in (*items, high, low))
    version = hashlib.sha256(f"{template}{names}".encode()).hexdigest()[:12]
    examples = {"high": _film(high), "low": _film(low)}
    study = {"version": version, "items": [_film(film) for film in items], "examples": examples}
    text = string.Template(template).substitute(
        # Inside a script element only "<" could close the element or open a comment.
        study=json.dumps(study).replace("<", "\\u003c"),
        header=json.dumps(HEADER),
        width=f"{high.size[0]}px",
        aspect="{} / {}".format(*high.size),
    )
    _run.write_text(path, text)
    return version


def _film(film: Film) -> dict[str, Any]:
    coded = base64.b64encode(film.webp).decode()
    return {"id": film.name, "labels": film.labels, "milliseconds": film.milliseconds, "film": coded}


def read_items(path: Path) -> dict[str, Any]:
    """Read `items.json`. Raises `ValueError` if it is missing or damaged."""
    try:
        study = json.loads(path.read_text("utf-8"))
        whole = {"version", "items", "weights", "made"} <= set(study) and "dataset" in study["made"]
        if not whole or not all({"kind", "labels"} <= set(item) for item in study["items"].values()):
            raise ValueError("version, items, kind, labels, weights or made is missing")
    except (OSError, ValueError, LookupError, TypeError, AttributeError) as error:
        raise ValueError(f"{path} cannot be read ({error}): give the items.json written with the page") from error
    return study


def read_scores(paths: Sequence[Path], study: dict[str, Any]) -> list[Answer]:
    """Read the answers from CSV files, or from folders of them.

    Raises:
        ValueError: with file, line and field, for content that the page does not write.
    """
    files = [file for path in paths for file in (sorted(path.glob("*.csv")) if path.is_dir() else [path])]
    if not files:
        raise ValueError(f"--scores: expected files of participants, found none in {[str(path) for path in paths]}")
    answers, seen = [], {}
    for path in files:
        line, here = 1, {}
        for line, row in _rows(path):
            _check(path, line, row, study)
            given = row["participant"], row["item"]
            if given in seen:
                _refuse(path, line, "item", "one answer", f"{row['item']!r} again, after {seen[given]}")
            seen[given] = f"{path}, line {line}"
            here[row["participant"]] = here.get(row["participant"], 0) + 1
            kind = study["items"][row["item"]]["kind"]
            answers.append(Answer(row["participant"], kind, *(int(row[name]) for name in SCORES)))
        wanted = len(study["items"])
        for count in here.values() or [0]:
            if count != wanted:
                _refuse(path, line, "item", f"{wanted} answers of each participant", f"{count} at the file's end")
    return answers


def _rows(path: Path) -> Iterator[tuple[int, dict[str, str]]]:
    """Yield line numbers and rows; a byte order mark is allowed."""
    try:
        lines = csv.reader(path.read_text("utf-8-sig").splitlines(), strict=True)
        header = next(lines, [])
        if tuple(header) != HEADER:
            _refuse(path, 1, "header", repr(",".join(HEADER)), repr(",".join(header)))
        for values in lines:
            if len(values) != len(HEADER):
                _refuse(path, lines.line_num, "row", f"{len(HEADER)} fields", str(len(values)))
            yield lines.line_num, dict(zip(HEADER, values, strict=True))
    except (UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"{path}: expected comma-separated UTF-8 text, got something else ({error})") from error


def _check(path: Path, line: int, row: dict[str, str], study: dict[str, Any]) -> None:
    item = study["items"].get(row["item"])
    labels = ">".join(item["labels"]) if item else ""
    count = len(study["items"])
    checks = (
        ("participant", re.fullmatch("[0-9a-f]{12}", row["participant"]), "12 hexadecimal digits"),
        ("seed", _whole(row["seed"], 0, 2**32 - 1), f"a whole number, 0 to {2**32 - 1}"),
        ("version", row["version"] == study["version"], f"{study['version']!r}, the page of items.json"),
        ("order", _whole(row["order"], 1, count), f"a whole number, 1 to {count}"),
        ("item", item, "a name in items.json"),
        ("labels", row["labels"] == labels, repr(labels)),
        *((name, _whole(row[name], 0, 10), "a whole number, 0 to 10") for name in SCORES),
        ("seconds", re.fullmatch(r"[0-9]+(\.[0-9]+)?", row["seconds"]), "a number, 0 or more"),
    )
    for field, sound, expected in checks:
        if not sound:
            _refuse(path, line, field, expected, repr(row[field]))


def _whole(text: str, low: int, high: int) -> bool:
    return re.fullmatch("[0-9]{1,10}", text) is not None and low <= int(text) <= high


def _refuse(path: Path, line: int, field: str, expected: str, got: str) -> None:
    raise ValueError(f"{path}, line {line}, {field}: expected {expected}, got {got}")


def summary(answers: Sequence[Answer]) -> dict[str, Any]:
    """Return mean, standard deviation and the 95 % confidence interval of the mean over participants."""
    people = sorted({answer.participant for answer in answers})
    groups, means = {}, {}
    for group, kinds in GROUPS.items():
        # Incomplete groups are left out: "ours" without one of its two kinds would be a different mean.
        chosen = [answer for answer in answers if answer.kind in kinds]
        if {answer.kind for answer in chosen} != set(kinds):
            continue
        groups[group] = {"ratings": len(chosen), "paper": PAPER.get(group, {})}
        for name in SCORES:
            values = np.array([getattr(answer, name) for answer in chosen], float)
            by = [[getattr(a, name) for a in chosen if a.participant == person] for person in people]
            mean = means[group, name] = np.array([np.mean(scores) for scores in by])
            spread = float(values.std(ddof=1)) if len(values) > 1 else None
            groups[group][name] = {"mean": float(values.mean()), "std": spread, "interval": interval(mean)}
    found = {"participants": len(people), "ratings": len(answers), "groups": groups}
    if {"peak", "predecessor"} <= set(groups):
        # Same labels, faces and participants: paired differences have a narrower interval than two means.
        gain = {name: means["peak", name] - means["predecessor", name] for name in SCORES}
        found["gain"] = {name: {"mean": float(x.mean()), "interval": interval(x)} for name, x in gain.items()}
    return found


def interval(values: np.ndarray) -> list[float] | None:
    """Return the 95 % confidence interval of the mean of values (n,) by Student's t; None for fewer than two values."""
    if len(values) < 2:
        return None
    half = float(stats.t.ppf(0.975, len(values) - 1) * values.std(ddof=1) / np.sqrt(len(values)))
    return [float(values.mean()) - half, float(values.mean()) + half]


def table(found: dict[str, Any]) -> str:
    """Return a `summary` as Markdown."""
    rows = []
    for group, row in found["groups"].items():
        cells = [_cell(row[name]) for name in SCORES]
        paper = " / ".join(f"{row['paper'][name]:.2f}" if name in row["paper"] else "–" for name in SCORES)
        rows.append((NAMES[group], *cells, row["ratings"], paper if row["paper"] else "–"))
    header = (
        "0 to 10, mean ± std (95 % of the mean)", "NAT", "LAB", "ratings",
        f"OT23, {PAPER_PARTICIPANTS} participants: NAT / LAB",
    )  # fmt: skip
    text = f"Participants: {found['participants']}, ratings: {found['ratings']}.\n\n{_run.markdown(header, rows)}"
    if "gain" in found:
        gains = (f"{name.upper()} {row['mean']:+.2f}{_span(row['interval'])}" for name, row in found["gain"].items())
        text += f"\n\nNeutral → peak, ours less predecessor, the same labels and faces: {', '.join(gains)}."
    return text


def _cell(score: dict[str, Any]) -> str:
    spread = "" if score["std"] is None else f" ± {score['std']:.2f}"
    return f"{score['mean']:.2f}{spread}{_span(score['interval'])}"


def _span(bounds: list[float] | None) -> str:
    return "" if bounds is None else " ({:.2f} to {:.2f})".format(*bounds)
