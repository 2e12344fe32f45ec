"""Arguments of the command line: one record per command; its fields are the flags, their docstrings the help."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import OmitArgPrefixes, Positional, UseAppendAction, subcommand

Format = Literal["glb", "html", "webp", "gif", "mp4", "png", "npz", "ply", "obj"]


@dataclasses.dataclass(frozen=True)
class Generate:
    """Animate a neutral face through two or more expressions; with --count write a corpus of many motions."""

    out: Path
    """Output folder; created if it is missing."""
    end: str | None = None
    """Final expression; `facejax labels` lists them. With --count it may be left out: each motion then has random
    labels."""
    start: str = "neutral"
    """Initial expression."""
    then: UseAppendAction[tuple[str, ...]] = ()
    """A further expression, to chain several; repeat the flag: `--then A --then B`."""
    face: Path | None = None
    """Neutral face (PLY, OBJ, GLB or NPZ): the model's 3,260 vertices, or MakeHuman's body. Default: the average face.
    With --landmarks: a scan of a head in any topology."""
    landmarks: Path | None = None
    """Landmarks of a scan given by --face, whose own vertices are animated; see `facejax register`."""
    model: Path | None = None
    """Model file; default: the released models."""
    seed: int = 7
    """Random seed of the motion."""
    samples: int = 1
    """Number of motions."""
    frames: int | Literal["natural"] = 30
    """Frames of each transition; "natural": generated with the motion, as in the training data, where an onset is a
    random draw of 18 to 39 frames at 60 frames per second."""
    fps: float = 30.0
    """Frames per second of the output."""
    intensity: float = 1.0
    """Scale of the displacements, 0 to 2."""
    formats: tuple[Format, ...] = ("glb", "html", "webp")
    """Output formats; landmarks are always written as NPZ. "ply" and "obj" write a folder of frames."""
    count: int | None = None
    """Write a corpus of N motions instead, as NPZ files with an index. Run again to resume an interrupted one."""
    people: int = 0
    """With --count: draw each motion's face from N MakeHuman people. Default: one face for all motions."""
    meshes: bool = False
    """With --count: write vertices as well as landmarks."""
    shard: int | None = None
    """With --count: motions per file; default: as many as fit in 64 MB."""
    distributed: bool = False
    """With --count: share the work with the other processes of a job, see `facejax.cli.runtime.join_distributed`."""


@dataclasses.dataclass(frozen=True)
class Animate:
    """Animate any mesh through its landmarks: by an expression network, by generated transitions, or by a recording."""

    out: Path
    """Output folder; created if it is missing."""
    mesh: Path | None = None
    """Face or head (PLY, OBJ, GLB, NPZ) in any topology, unit and pose. Default: a MakeHuman face."""
    landmarks: Path | None = None
    """Its 68, 66, 51 or 83 landmarks: JSON of vertices, positions or triangles, MeshLab .pp, plain text, or a landmark
    embedding of FLAME. MakeHuman's head of 3,260 vertices does not need them."""
    expression: str | None = None
    """Motion of an expression network: anger, disgust, fear, happiness, sadness or surprise."""
    end: str | None = None
    """Motion of generated transitions: the final expression; `facejax labels` lists them."""
    start: str = "neutral"
    """With --end: the initial expression."""
    then: UseAppendAction[tuple[str, ...]] = ()
    """With --end: a further expression; repeat the flag."""
    livelink: Path | None = None
    """Motion of a Live Link Face recording (CSV)."""
    begin: float = 0.0
    """With --livelink: start time in the recording, in seconds."""
    seconds: float = 10.0
    """With --livelink: duration in seconds."""
    keep_rest: bool = False
    """With --livelink: use the recorded weights, not their differences from the person's resting face."""
    person: int | None = None
    """Without --mesh: index of a MakeHuman person (100 to 119 are test subjects). Default: the average face."""
    frames: int | Literal["natural"] | None = None
    """Frames of each transition (default 30; "natural": generated with the motion, as in the training data, where an
    onset is a random draw of 18 to 39 frames at 60 frames per second), or the maximal length of an expression."""
    whole: bool = False
    """With --expression: play all frames, also those after the expression has ended."""
    seed: int = 7
    """With --end: random seed of the motion."""
    model: Path | None = None
    """Model file, or file of expression networks; default: the released one."""
    kernel: str | None = None
    """Radial basis function: gaussian, multiquadric, thin_plate, triharmonic or wendland_c2."""
    sigma: float | None = None
    """Width of the kernel, in units of the landmarks' spacing."""
    smoothing: float = 0.0
    """Smoothing of noisy landmarks; 0 interpolates them exactly."""
    pin: bool = True
    """Keep rims fixed that are far from every landmark, such as the neck's."""
    head: bool = False
    """Apply the motion's rigid head rotation to the whole mesh (for networks trained on heads that move)."""
    intensity: float = 1.0
    """Scale of the displacements, 0 to 2."""
    fps: float | None = None
    """Frames per second of the output; default: those of the motion."""
    formats: tuple[Format, ...] = ("glb", "html", "webp")
    """Output formats; landmarks are always written as NPZ. "ply" and "obj" write a folder of frames."""


@dataclasses.dataclass(frozen=True)
class Register:
    """Register the template to a scan of a head in any topology, unit and pose, with holes and noise."""

    scan: Positional[Path]
    """The scan: PLY, OBJ, GLB or NPZ."""
    landmarks: Path
    """Landmarks of the scan: 68, 66, 51 or 83, or seven (outer and inner corner of the right eye, inner and outer of
    the left, nose tip, right and left corner of the mouth), or any with names of the 68; formats as of
    `facejax animate`."""
    out: Path
    """Output folder for the registered template, its 68 landmarks, a picture and the distances; created if it is
    missing."""


@dataclasses.dataclass(frozen=True)
class Demo:
    """Animate three unseen faces: neutral, high_smile, mouth_open, neutral."""

    out: Path = Path("runs/demo")
    """Output folder."""
    seed: int = 7
    """Random seed of the motions."""


@dataclasses.dataclass(frozen=True)
class Labels:
    """List the expressions of a model."""

    model: Path | None = None
    """Model file; default: the released models."""


@dataclasses.dataclass(frozen=True)
class MakeHuman:
    """Generate the free synthetic 4D dataset, or write neutral sample faces (`--sample`)."""

    sample: Path | None = None
    """Write neutral faces to this folder instead of a dataset."""
    count: int = 5
    """With --sample: number of faces."""
    level: Literal[0, 1, 2, 3] = 3
    """Realism of the dataset."""
    head_motion: bool = False
    """Add rigid head motion."""
    noise: float = 0.0
    """Registration noise in mm, smooth over the surface; real scans have 0.1 to 0.5."""
    out: Path | None = None
    """Folder of the dataset; default: the user's cache."""


Layout = Literal["folder", "coma", "d3dfacs", "florence4d", "vocaset", "bu3dfe", "bu4dfe", "livelink"]


@dataclasses.dataclass(frozen=True)
class Prepare:
    """Convert recordings into a dataset: your own, or a public dataset. Run again to resume an interrupted one."""

    source: Positional[Layout]
    """Layout of the files. folder: ROOT/SUBJECT/RECORDING/*.ply (.obj, .npy, .npz), or ROOT/SUBJECT/RECORDING.npz."""
    root: Path
    """Folder of the recordings."""
    out: Path
    """Output folder of the dataset; it must not exist."""
    landmarks: Path | None = None
    """Landmarks of the first subject's neutral mesh: JSON of vertices, positions or triangles, MeshLab .pp, plain text,
    or a landmark embedding of FLAME. Not needed by bu4dfe and livelink."""
    unit: Literal["mm", "cm", "m"] | None = None
    """Unit of the meshes; default: inferred from the size of the face."""
    fps: float | None = None
    """Frames per second of the recordings; default: those of the dataset, 30 for folders."""
    rest: Literal["first", "mean"] | None = None
    """Neutral mesh of subjects without one: the first frame of their first recording (default), or the mean of the
    first frames of all."""
    gaps: bool = False
    """Accept recordings with missing frames, and report them."""
    hold: bool = False
    """Remove the rigid motion of the head."""
    labels: Path | None = None
    """CSV of subject, recording, label; default: the recording's name without a final number."""
    people: Path | None = None
    """CSV of subject and attributes: split (train, validation, test), sex."""
    cuts: Path | None = None
    """CSV of subject, recording, onset, apex_start, apex_end, offset, as frame numbers from 0; default: detected."""
    template: Path | None = None
    """vocaset: a mesh with FLAME's triangles."""
    actors: int | None = None
    """livelink: number of MakeHuman people that perform the recordings (12)."""
    meshes: int = 20_000
    """Number of meshes to store, drawn with a fixed seed; landmarks of all frames are stored."""
    workers: int | None = None
    """Number of processes; default: one per processor for large datasets."""


@dataclasses.dataclass(frozen=True)
class Data:
    """Prepare a dataset: the free synthetic one, or your own meshes."""

    what: OmitArgPrefixes[
        Annotated[MakeHuman, subcommand("makehuman", prefix_name=False)]
        | Annotated[Prepare, subcommand("prepare", prefix_name=False)]
    ]


@dataclasses.dataclass(frozen=True)
class Fit:
    """Train models on a dataset, for `facejax generate --model`. Run again to resume an interrupted training."""

    data: Path
    """Folder of a prepared dataset: your own (`facejax data prepare folder`) or makehuman4d."""
    out: Path
    """Output model file; it must end in .safetensors. Checkpoints are kept in a folder beside it."""
    seed: int = 0
    """Random seed of the initial weights and the order of the data."""
    quick: bool = False
    """Train a few steps only, as a test of the set-up."""
    distributed: bool = False
    """Share each batch with the other processes of a job, see `facejax.cli.runtime.join_distributed`."""


@dataclasses.dataclass(frozen=True)
class Export:
    """Write functions of the models as files that other programs run without facejax."""

    format: Positional[Literal["stablehlo", "onnx", "web"]]
    """stablehlo: programs that JAX compiles for any platform; onnx: ONNX models; web: a page that runs in a browser."""
    out: Path
    """Output folder; an export that it holds is replaced."""
    model: Path | None = None
    """Model file; default: the released models."""
    functions: tuple[str, ...] = ()
    """Names of functions, such as `decoder`; default: all of the format. Not with web."""
    runtime: Path | None = None
    """For web: folder `dist` of the npm package onnxruntime-web; default: fetched by npm."""


@dataclasses.dataclass(frozen=True)
class View:
    """Show an animation or a mesh in a browser: write one HTML page and open it."""

    file: Positional[Path]
    """NPZ with `vertices` and `faces`, PLY, OBJ, GLB, or an HTML page written before."""
    out: Path | None = None
    """The page, or a folder for it; default: beside the file."""
    fps: float | None = None
    """Frames per second; default: those of the file, or 30."""
    open: bool = True
    """Open the page in a browser."""


Command = (
    Annotated[Generate, subcommand("generate", prefix_name=False)]
    | Annotated[Animate, subcommand("animate", prefix_name=False)]
    | Annotated[Register, subcommand("register", prefix_name=False)]
    | Annotated[Demo, subcommand("demo", prefix_name=False)]
    | Annotated[Labels, subcommand("labels", prefix_name=False)]
    | Annotated[Data, subcommand("data", prefix_name=False)]
    | Annotated[Fit, subcommand("fit", prefix_name=False)]
    | Annotated[Export, subcommand("export", prefix_name=False)]
    | Annotated[View, subcommand("view", prefix_name=False)]
)
