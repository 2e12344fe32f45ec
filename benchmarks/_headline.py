"""Table of the benchmark rows that the README quotes, with targets and the ratio to each peer."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from benchmarks._measure import Row, seconds


class Work(NamedTuple):
    """One line of the table."""

    name: str
    words: str
    aim: str
    peers: tuple[str, ...] = ()  # prefixes of the names of peers; the fastest of each is shown


WORKS = (
    Work("s2d_forward_b16", "S2D-Dec forward, 16 meshes of 5,041 vertices", "3x; 40% of the roofline", ("torch",)),
    Work("s2d_forward_b1", "S2D-Dec forward, one mesh", "5x; under 5 ms", ("torch",)),
    Work("s2d_train_step_b16", "S2D-Dec training step, batch 16", "3x", ("torch",)),
    Work("lstm_train_step_b5", "LSTM 3 x 128 training step, 5 sequences of 135 x 204", "1x", ("torch",)),
    Work("lstm_train_step_b32", "the same, 32 sequences, shared among the cores", "1x", ("torch",)),
    Work("lstm_train_step_x6_b5", "six networks, a step of 5 sequences each", "1.25x", ("torch",)),
    Work("gan_step_b128", "Motion3DGAN step, 4 of the critic and 1 of the generator, batch 128", "1.2x", ("torch",)),
    Work("flow_step_b256", "training step of the flow, batch 256", "", ("torch",)),
    Work("srvf_encode_decode", "SRVF encode and decode, 1,000 motions of 30 x 204", "30x", ("fdasrsf", "geomstats")),
    Work("geodesic", "halfway along 1,000 geodesics of 30 x 204", "30x", ("fdasrsf", "geomstats")),
    Work("rbf_135x10000", "RBF, a new face and 135 frames of 10,000 vertices", "4x", ("SciPy",)),
    Work("rbf_refit_135x10000", "the same beside a new system for each frame, as in SL21", "100x", ("SciPy",)),
    Work("dictionary_fit", "64 atoms of 2,000 meshes of 3,260 vertices", "", ("scikit-learn",)),
    Work("pca_fit", "220 principal components of the same", "", ("scikit-learn",)),
    Work("labels_to_meshes_b16", "labels to meshes, 16 requests of 30 x 3,260 vertices", "600 meshes/s"),
    Work("labels_to_meshes_b1", "one request", ""),
    Work("labels_to_meshes_linear_b16", "16 requests by the GPMM estimate alone, `refined=False`", ""),
    Work("labels_to_meshes_s2d_b16", "16 requests by S2D-Dec", ""),
    Work("fresh_process_empty_cache", "the first request of a new process, nothing cached", ""),
    Work("fresh_process_warm_cache", "the same, compilation cache warm", ""),
    Work("s2d_training_20000_meshes", "a step of S2D-Dec's training on 20,000 meshes, in the loop", "under 2 GB"),
    Work("transitions_300000_performed", "300,000 peak → peak transitions between 1,440 onsets, streamed", ""),
    Work("lstm_step_devices", "LSTM step of 32 sequences, each core a device", "", ("one device",)),
    Work("s2d_step_devices", "S2D-Dec training step, batch 16, each core a device", "", ("one device",)),
    Work("corpus_devices", "512 motions of a corpus, each core a device", "", ("one device",)),
    Work("corpus_10000", "a corpus of 10,000 motions, with its index", ""),
    Work("corpus_1000000", "a million motions, extrapolated", ""),
)


def table(rows: Sequence[Row]) -> str:
    """Return the Markdown table of the lines that were measured."""
    known = {row["name"]: row for row in rows}
    lines = ["| work | target | facejax | peers |", "|" + " --- |" * 4]
    for work in WORKS:
        if work.name in known:
            row = known[work.name]
            lines.append(f"| {work.words} | {work.aim} | {_ours(row)} | {_theirs(row, work.peers)} |")
    return "\n".join(lines)


def _ours(row: Row) -> str:
    found = [seconds(row["median_s"])]
    if row["roofline_share"]:
        found.append(f"{row['roofline_share']:.0%} of the roofline")
    if row["unit"] in ("meshes", "transitions"):
        found.append(f"{row['per_s']:,.0f} {row['unit']}/s")
    if "efficiency" in row:
        found.append(f"efficiency {row['efficiency']:.0%}")
    if "megabytes" in row:
        found.append(f"{row['megabytes']:,.0f} MB")
    if "memory_mb" in row and not row["peer"]:
        found.append(f"{row['memory_mb']:,.0f} MB")
    return ", ".join(found)


def _theirs(row: Row, peers: tuple[str, ...]) -> str:
    found = []
    for peer in peers:
        sides: dict[str, dict[str, Any]] = row["sides"]
        times = [side["median_s"] for name, side in sides.items() if name.startswith(peer) and "sums" not in name]
        if times:
            found.append(f"**{_ratio(min(times) / row['median_s'])}** {_named(peer)} ({seconds(min(times))})")
    return ", ".join(found)


def _ratio(value: float) -> str:
    return f"{value:.0f}x" if value >= 20 else f"{value:.1f}x" if value >= 2 else f"{value:.2f}x"


def _named(peer: str) -> str:
    return {"torch": "PyTorch"}.get(peer, peer)
