"""Tables, bar charts and rendered faces of `experiments.expression_lstm`."""

from __future__ import annotations

from pathlib import Path

import matplotlib
import numpy as np

from experiments import _run
from facejax.data import dataset
from facejax.data.synthetic import makehuman
from facejax.inference import expressions, retarget
from facejax.viz import eyes_teeth, render

matplotlib.use("Agg")
import matplotlib.pyplot as plt

PREFIX = 10  # true frames given to the network
SHOWN, FRAMES, PICTURE = 107, 8, (170, 212)  # test subject of the sheet, frames per sequence, pixels


def error_ratios(row: dict[str, float]) -> dict[str, float]:
    """Return the errors over the strongest baseline's, and motion energy and acceleration over real motion."""
    return {
        "next": row["next_network"] / min(row["next_velocity"], row["next_mean"]),
        "rest": row["rest_network"] / min(row["rest_velocity"], row["rest_mean"], row["rest_mean_steps"]),
        "whole": row["whole_network"] / row["whole_mean"],
        "energy": row["energy"],
        "acceleration": row["acceleration"],
    }


def variants_table(table: dict[str, dict], seconds: dict[str, float]) -> str:
    """Return the Markdown table of all training variants, means and ranges over expressions."""
    rows = []
    for name, found in table.items():
        each = [error_ratios(row) for row in found.values()]
        means = [float(np.mean([ratio[key] for ratio in each])) for key in ("next", "rest", "whole")]
        spans = ["{:.2f} to {:.2f}".format(*_span([r[key] for r in each])) for key in ("energy", "acceleration")]
        rows.append((name, *means, f"{max(ratio['whole'] for ratio in each):.3f}", *spans, f"{seconds[name]:.0f}"))
    header = (
        "validation subjects and 120 more, six emotions", "next frame", f"after {PREFIX} frames", "from neutral",
        "the worst emotion", "energy", "acceleration", "training, s",
    )  # fmt: skip
    note = (
        "Errors over those of the strongest of constant velocity and the mean sequence; motion over that of recordings."
    )
    return f"{note}\n\n{_run.markdown(header, rows)}"


def test_table(judged: dict[str, dict]) -> str:
    """Return the Markdown table of errors per expression in millimetres, beside all baselines."""
    rows = []
    for label, row in judged.items():
        rows.append(
            (
                label,
                *("{next_network:.3f} / {next_velocity:.3f} / {next_mean:.3f}".format(**row),),
                "{rest_network:.2f} / {rest_velocity:.2f} / {rest_mean:.2f} / {rest_mean_steps:.2f}".format(**row),
                "{whole_network:.3f} / {whole_mean:.3f} = {ratio:.3f}".format(**row, ratio=error_ratios(row)["whole"]),
                "{energy:.2f} ({energy_mean:.2f})".format(**row),
                "{acceleration:.2f} ({acceleration_mean:.2f})".format(**row),
            )
        )
    header = (
        "test subjects and 120 more, mm", "next frame: network / velocity / mean",
        f"after {PREFIX} frames: network / velocity / mean / mean steps", "from neutral: network / mean",
        "energy over real (the mean's)", "acceleration",
    )  # fmt: skip
    return _run.markdown(header, rows)


def _span(values) -> tuple[float, float]:
    return min(values), max(values)


def plot(path: Path, judged: dict[str, dict]) -> Path:
    """Plot the errors per expression as bars."""
    figure, axes = plt.subplots(1, 3, figsize=(13, 3.8), constrained_layout=True)
    colours = ("#6a9a58", "#c46b4e", "#5b8db8", "#9a86b0")
    kinds = (
        (f"after {PREFIX} true frames", ("rest_network", "rest_velocity", "rest_mean", "rest_mean_steps")),
        ("from the neutral face", ("whole_network", "whole_mean")),
    )
    for axis, (title, fields) in zip(axes, kinds, strict=False):
        for i, field in enumerate(fields):
            place = np.arange(len(judged)) + 0.8 / len(fields) * (i - (len(fields) - 1) / 2)
            name = field.split("_", 1)[1].replace("_", " ")
            axis.bar(place, [r[field] for r in judged.values()], 0.8 / len(fields), label=name, color=colours[i])
        axis.set_xticks(range(len(judged)), list(judged), rotation=30)
        axis.set_title(title)
        axis.set_ylabel("landmark error, mm")
        axis.legend(frameon=False)
    axes[0].set_ylim(0, 1.3 * max(r["rest_mean"] for r in judged.values()))
    for i, field in enumerate(("energy", "acceleration")):
        axes[2].bar(np.arange(len(judged)) + 0.4 * (i - 0.5), [r[field] for r in judged.values()], 0.4, label=field)
        means = [r[f"{field}_mean"] for r in judged.values()]
        axes[2].plot(np.arange(len(judged)) + 0.4 * (i - 0.5), means, "k_", label="the mean's" if i == 0 else None)
    axes[2].axhspan(0.8, 1.3, color="#88aa66", alpha=0.2)
    axes[2].set_xticks(range(len(judged)), list(judged), rotation=30)
    axes[2].set_title("motion from the neutral face, over real")
    axes[2].legend(frameon=False)
    return _run.save_figure(figure, path)


def sheet(path: Path, networks: expressions.Expressions, data: dataset.Dataset | None = None) -> None:
    """Render each network's expression on one unseen face, warped by radial basis functions (SL21, figure 5).

    The face is a MakeHuman test subject, or the last subject of a dataset.
    """
    shape = makehuman.template()
    faces, index, rest = shape.faces, shape.landmarks, shape.vertices
    if data is None:
        shown = makehuman.subject(SHOWN).vertices
    else:
        faces, index, shown = (np.asarray(x) for x in (data.faces, data.landmark_index, data.neutral[-1]))
        rest = np.asarray(data.neutral).mean(axis=0)
    face = retarget.prepare(shown, faces, shown[index], rest[index])
    teeth, rows = eyes_teeth.Props(shape.vertices[shape.landmarks], *makehuman.template_props()), []
    camera = render.fit_camera(face.vertices, size=PICTURE, turn=15)
    for label in networks.labels:
        curve = np.asarray(expressions.displacements(networks, label, face.landmarks))
        chosen = curve[np.linspace(0, len(curve) - 1, FRAMES).round().astype(int)]
        marks = np.asarray(retarget.landmarks_of(face, chosen))
        parts = eyes_teeth.parts(teeth, face.landmarks, marks)
        moved = np.asarray(retarget.animate(face, chosen))
        rows.append(render.frames(moved, face.faces, size=PICTURE, camera=camera, extras=parts))
    render.save(path, render.contact_sheet(rows, row_labels=list(networks.labels)))
