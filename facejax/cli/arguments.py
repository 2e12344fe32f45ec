"""What the command line takes: one record per command, its fields the flags and their help."""

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
    """Folder for the results; made if it is missing."""
    end: str | None = None
    """Expression to arrive at; `facejax labels` lists them. A corpus may go without: each motion then has its own."""
    start: str = "neutral"
    """Expression to start from."""
    then: UseAppendAction[tuple[str, ...]] = ()
    """A further expression; repeat the flag: `--then A --then B`."""
    face: Path | None = None
    """Neutral face (PLY, OBJ, GLB or NPZ): the model's 3,260 vertices, or MakeHuman's body. Default: the average. With
    --landmarks any scan of a head."""
    landmarks: Path | None = None
    """Of a scan in any topology, whose own vertices are animated; see `facejax register`."""
    model: Path | None = None
    """Weights to use in place of the released ones."""
    seed: int = 7
    """Another seed, another motion."""
    samples: int = 1
    """How many motions to draw."""
    frames: int | Literal["natural"] = 30
    """Frames of each transition; "natural": as long as people take, generated with the motion."""
    fps: float = 30.0
    """Frames per second of the results."""
    intensity: float = 1.0
    """Scale of the motion, 0 to 2."""
    formats: tuple[Format, ...] = ("glb", "html", "webp")
    """What to write; the landmarks come as NPZ in any case. "ply" and "obj" write a folder of frames."""
    count: int | None = None
    """Write a corpus instead: so many motions, as NPZ files with an index. Stopped, it goes on when called again."""
    people: int = 0
    """With --count: draw each motion's face from so many MakeHuman people. Default: the one face."""
    meshes: bool = False
    """With --count: vertices as well as landmarks."""
    shard: int | None = None
    """With --count: motions in a file, by default as many as make 64 MB."""
    distributed: bool = False
    """With --count: share the work with the other processes of a job, see `facejax.runtime.join_distributed`."""


@dataclasses.dataclass(frozen=True)
class Animate:
    """Animate any mesh through its landmarks: by an expression network, by transitions, or by a recording."""

    out: Path
    """Folder for the results; made if it is missing."""
    mesh: Path | None = None
    """Any face or head (PLY, OBJ, GLB, NPZ), in any topology, unit and pose. Default: a MakeHuman face."""
    landmarks: Path | None = None
    """Its 68, 66, 51 or 83 landmarks: JSON of vertices, positions or triangles, MeshLab .pp, plain text, or the
    embedding of FLAME. MakeHuman's head, 3,260 vertices, goes without."""
    expression: str | None = None
    """Driven by an expression network: anger, disgust, fear, happiness, sadness or surprise."""
    end: str | None = None
    """Driven by generated transitions: the expression to arrive at; `facejax labels` lists them."""
    start: str = "neutral"
    """With --end: the expression to start from."""
    then: UseAppendAction[tuple[str, ...]] = ()
    """With --end: a further expression; repeat the flag."""
    livelink: Path | None = None
    """Driven by a recording of Live Link Face (CSV)."""
    begin: float = 0.0
    """With --livelink: seconds into the recording."""
    seconds: float = 10.0
    """With --livelink: how much of it."""
    keep_rest: bool = False
    """With --livelink: take the weights as they are, not relative to the person's resting face."""
    person: int | None = None
    """Without --mesh: which MakeHuman person (100 to 119 are test subjects). Default: the average face."""
    frames: int | Literal["natural"] | None = None
    """Frames of each transition (30; "natural": as long as people take), or at most of an expression."""
    whole: bool = False
    """With --expression: go on to the last frame, though the expression is over."""
    seed: int = 7
    """With --end: another seed, another motion."""
    model: Path | None = None
    """Weights to use in place of the released ones."""
    kernel: str | None = None
    """Radial basis function: gaussian, multiquadric, thin_plate, triharmonic or wendland_c2."""
    sigma: float | None = None
    """Width of the kernel, in spacings of the landmarks."""
    smoothing: float = 0.0
    """Above 0, noisy landmarks need not be met exactly."""
    pin: bool = True
    """Hold rims still that are far from every landmark, such as the neck's."""
    head: bool = False
    """The motion turns the head, too (networks trained on heads that move): let all of the mesh go with it."""
    intensity: float = 1.0
    """Scale of the motion, 0 to 2."""
    fps: float | None = None
    """Frames per second of the results; as the motion was made by default."""
    formats: tuple[Format, ...] = ("glb", "html", "webp")
    """What to write; the landmarks come as NPZ in any case. "ply" and "obj" write a folder of frames."""


@dataclasses.dataclass(frozen=True)
class Register:
    """Bring the template onto a scan of a head: any vertices, holes, noise, unit and pose."""

    scan: Positional[Path]
    """The scan: PLY, OBJ, GLB or NPZ."""
    landmarks: Path
    """On it: 68, 66, 51 or 83, or seven (outer and inner corner of the right eye, inner and outer of the left, tip of
    the nose, right and left corner of the mouth), or any with names of the 68; formats as of `facejax animate`."""
    out: Path
    """Folder for the template on the scan, its 68 landmarks, a picture and the distances; made if it is missing."""


@dataclasses.dataclass(frozen=True)
class Demo:
    """Animate three unseen faces: neutral, high_smile, mouth_open, neutral."""

    out: Path = Path("runs/demo")
    """Folder for the results."""
    seed: int = 7
    """Another seed, other motions."""


@dataclasses.dataclass(frozen=True)
class Labels:
    """List the expressions that the model knows."""

    model: Path | None = None
    """Weights to ask in place of the released ones."""


@dataclasses.dataclass(frozen=True)
class MakeHuman:
    """Prepare the free 4D dataset, or write neutral faces to try (`--sample`)."""

    sample: Path | None = None
    """Write neutral faces into this folder, and prepare nothing."""
    count: int = 5
    """How many faces to write."""
    level: Literal[0, 1, 2, 3] = 3
    """Realism of the dataset."""
    head_motion: bool = False
    """Let heads turn and lean."""
    noise: float = 0.0
    """Registration noise in mm, smooth over the surface; 0.1 to 0.5 is what scans have."""
    out: Path | None = None
    """Where the dataset goes; the user's cache by default."""


Layout = Literal["folder", "coma", "d3dfacs", "florence4d", "vocaset", "bu3dfe", "bu4dfe", "livelink"]


@dataclasses.dataclass(frozen=True)
class Prepare:
    """Read recordings into a dataset: your own, or a dataset that you have. Stopped, it goes on when called again."""

    source: Positional[Layout]
    """How they lie. folder: ROOT/SUBJECT/RECORDING/*.ply (.obj, .npy, .npz), or ROOT/SUBJECT/RECORDING.npz."""
    root: Path
    """The dataset's folder."""
    out: Path
    """Where the prepared dataset goes: a folder that is not there yet."""
    landmarks: Path | None = None
    """Of the first subject's neutral mesh: JSON of vertices, positions or triangles, MeshLab .pp, plain text, or the
    embedding of FLAME. bu4dfe and livelink go without."""
    unit: Literal["mm", "cm", "m"] | None = None
    """Of the meshes; recognised by the size of the face by default."""
    fps: float | None = None
    """Frames per second of the recordings; the dataset's own by default, of folders 30."""
    rest: Literal["first", "mean"] | None = None
    """Who has no neutral mesh is at rest in the first frame of the first recording (default), or in the mean of the
    first frames of all."""
    gaps: bool = False
    """Take recordings that lack frames as they are, and say so."""
    hold: bool = False
    """Take the rigid motion of the head out."""
    labels: Path | None = None
    """CSV of subject, recording, label; by default a label is the recording's name without a number at the end."""
    people: Path | None = None
    """CSV of subject and what is known: split (train, validation, test), sex."""
    cuts: Path | None = None
    """CSV of subject, recording, onset, apex_start, apex_end, offset, as frames from 0 on; found by default."""
    template: Path | None = None
    """vocaset: a mesh with FLAME's triangles."""
    actors: int | None = None
    """livelink: on how many MakeHuman people the recordings are played (12)."""
    meshes: int = 20_000
    """How many meshes are stored, drawn by a fixed seed; landmarks are stored of all frames."""
    workers: int | None = None
    """Processes; by default one for each processor where there is much to read."""


@dataclasses.dataclass(frozen=True)
class Data:
    """Prepare a dataset: the free one, or your own meshes."""

    what: OmitArgPrefixes[
        Annotated[MakeHuman, subcommand("makehuman", prefix_name=False)]
        | Annotated[Prepare, subcommand("prepare", prefix_name=False)]
    ]


@dataclasses.dataclass(frozen=True)
class Fit:
    """Train models on a prepared dataset, for `facejax generate --model`. Stopped, it goes on when called again."""

    data: Path
    """A prepared dataset, your own (`facejax data prepare folder`) or makehuman4d's folder."""
    out: Path
    """The models: a file that ends in .safetensors. Checkpoints lie in a folder beside it."""
    seed: int = 0
    """Of the initial weights and the order of the data."""
    quick: bool = False
    """A few steps only, to see that everything is in order."""
    distributed: bool = False
    """Share each batch with the other processes of a job, see `facejax.runtime.join_distributed`."""


@dataclasses.dataclass(frozen=True)
class View:
    """Show an animation or a mesh: writes one HTML page and opens it."""

    file: Positional[Path]
    """NPZ with `vertices` and `faces`, PLY, OBJ, GLB, or an HTML page made before."""
    out: Path | None = None
    """Where the page goes; beside the file by default."""
    fps: float | None = None
    """Frames per second; the file's own, or 30."""
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
    | Annotated[View, subcommand("view", prefix_name=False)]
)
