"""Cost against size: times of one task at several sizes along an axis, and the exponent of their power law."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import _timing

Row = dict[str, Any]


def along(
    name: str, axis: str, sizes: Iterable[int], make: Callable[[int], Callable[[], Any]], *, repeats: int = 7
) -> list[Row]:
    """Time the function that `make(size)` returns for each size; one row per size."""
    rows = []
    for size in sizes:
        (times,) = _timing.interleaved({name: make(size)}, repeats=repeats).values()
        rows.append({"name": name, "axis": axis, "size": size, **times})
        print(f"{name}, {size:,} {axis}: {times['median_s']:.4g} s", file=sys.stderr, flush=True)
    return rows


def exponent(rows: Sequence[Row]) -> float:
    """Fit the exponent of cost over size, without the smallest sizes, where constant costs dominate."""
    # The largest four of five sizes, three of four, all of three or fewer.
    upper = sorted(rows, key=lambda row: row["size"])[len(rows) // 2 - 1 :]
    size, cost = (np.log([row[key] for row in upper]) for key in ("size", "median_s"))
    return float(np.polyfit(size, cost, 1)[0])


def curves(rows: Iterable[Row]) -> dict[tuple[str, str], list[Row]]:
    """Group rows by (axis, name), in order of appearance."""
    found: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        found.setdefault((row["axis"], row["name"]), []).append(row)
    return found


def table(rows: Iterable[Row]) -> str:
    """Return a Markdown table of the smallest and largest size and the exponent of each curve."""
    lines = ["| work | axis | from | to | cost grows as |", "|" + " --- |" * 5]
    for (axis, name), curve in curves(rows).items():
        ends = (f"{row['size']:,}: {1e3 * row['median_s']:.3g} ms" for row in (curve[0], curve[-1]))
        lines.append(f"| `{name}` | {axis} | {' | '.join(ends)} | {axis}^{exponent(curve):.2f} |")
    return "\n".join(lines)


def plot(rows: Iterable[Row], path: Path) -> None:
    """Plot cost against size on logarithmic scales, one panel per axis."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    from facejax.io import atomic

    found = curves(rows)
    axes = list(dict.fromkeys(axis for axis, _ in found))
    columns = min(3, len(axes))
    lines = -(-len(axes) // columns)
    size = (4.6 * columns, 4.0 * lines)
    figure, panels = plt.subplots(lines, columns, figsize=size, squeeze=False, layout="constrained")
    for panel in panels.flat[len(axes) :]:
        panel.axis("off")
    for axis, panel in zip(axes, panels.flat, strict=False):
        for (along_axis, name), curve in found.items():
            if along_axis == axis:
                sizes, cost = ([row[key] for row in curve] for key in ("size", "median_s"))
                panel.loglog(sizes, [1e3 * t for t in cost], "o-", ms=3, label=f"{name}: {exponent(curve):.2f}")
        low, high = panel.get_xlim()
        floor = panel.get_ylim()[0]
        guide = np.array([low, high])
        panel.loglog(guide, floor * guide / low, ":", color="grey", lw=1, label="linear")
        panel.set_xlim(low, high)
        panel.set_ylim(bottom=10 ** math.floor(math.log10(floor)))
        panel.set(xlabel=axis, ylabel="ms")
        panel.legend(fontsize=7, title="work: exponent", title_fontsize=7)
        panel.grid(alpha=0.3)
    with atomic.replace_file(path) as temporary:
        figure.savefig(temporary, dpi=110)
    plt.close(figure)
