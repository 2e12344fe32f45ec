"""The command line: `facejax generate | animate | register | demo | labels | data | fit | view`, a thin skin.

Bad input ends with one line on standard error, exit code 2, and nothing written.
"""

from __future__ import annotations

import errno
import os
import sys
import webbrowser
from pathlib import Path

import tyro

from facejax.cli.arguments import Animate, Command, Data, Demo, Fit, Generate, Labels, Prepare, Register, View
from facejax.io import atomic

_UNWRITTEN = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def main(arguments: list[str] | None = None) -> None:
    """Entry point of the `facejax` command."""
    command = tyro.cli(Command, prog="facejax", description="4D facial expressions.", args=arguments)
    try:
        _bounded(command)
        _COMMANDS[type(command)](command)
    except BrokenPipeError:
        # Somebody closed our output, `head` say: that is no error of theirs.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except KeyboardInterrupt:
        raise SystemExit(130) from None
    except (ValueError, RuntimeError, OSError, MemoryError, OverflowError) as error:
        said = str(error) or type(error).__name__
        if isinstance(error, OSError) and error.errno in _UNWRITTEN and error.filename is None:  # a write tells no name
            said = f"{getattr(command, 'out', None) or 'output'} cannot be written: {error.strerror}"
        print(f"facejax: {atomic.one_line(said)}", file=sys.stderr)
        raise SystemExit(2) from None


def _bounded(command: Command) -> None:
    """Numbers that would fill the memory before anything else could refuse them."""
    for name, least, most in (("seed", 0, 2**32 - 1), ("frames", 2, 10_000), ("samples", 1, 1_000)):
        value = getattr(command, name, None)
        if isinstance(value, int) and not least <= value <= most:
            more = "; --count writes a corpus of many" if name == "samples" and value > most else ""
            raise ValueError(f"--{name} must lie in {least}..{most}, got {value}{more}")


def _generate(command: Generate) -> None:
    from facejax.cli import generate

    if command.count is not None:
        return _corpus(command)
    for name in ("people", "meshes", "shard", "distributed"):
        if getattr(command, name) != getattr(Generate, name):
            raise ValueError(f"--{name} goes with --count")
    if command.end is None:
        raise ValueError("--end is missing: the expression to arrive at; `facejax labels` lists them")
    worn = None
    if command.landmarks is None:
        neutral, notes = generate.read_neutral(command.face, command.model)
    elif command.face is None:
        raise ValueError(f"--landmarks {command.landmarks}: of which scan? name it with --face")
    else:
        from facejax.inference import scans

        worn, notes = scans.bind_scan(scans.read(command.face, command.landmarks))
        neutral = worn.neutral
    labels = (command.start, command.end, *command.then)
    done = generate.generate(
        neutral, labels, command.out, worn=worn, model=command.model, seed=command.seed, samples=command.samples,
        frames=command.frames, fps=command.fps, intensity=command.intensity, formats=command.formats,
    )  # fmt: skip
    _said((done, tuple(f"{command.face}: {note}" for note in notes)))


def _corpus(command: Generate) -> None:
    from facejax.cli import datasets
    from facejax.inference import corpus

    for name in ("samples", "fps", "formats", "landmarks"):
        if getattr(command, name) != getattr(Generate, name):
            raise ValueError(f"--{name} does not go with --count")
    if command.frames == "natural":
        raise ValueError("--frames natural does not go with --count: all motions of a corpus are of one length")
    if command.end is None and (command.then or command.start != Generate.start):
        raise ValueError("--end is missing: --start and --then name a motion, without them each one is drawn")
    if command.people and command.face:
        raise ValueError(f"--people {command.people} and --face {command.face}: name one of them")
    labels = () if command.end is None else (command.start, command.end, *command.then)
    request = corpus.Request(
        command.count, labels, command.seed, command.frames, command.intensity, command.meshes, command.shard
    )
    _said(
        datasets.generate_corpus(
            request, command.out, face=command.face, people=command.people, model=command.model,
            distributed=command.distributed,
        )
    )  # fmt: skip


def _animate(command: Animate) -> None:
    from facejax.cli import generate
    from facejax.data.synthetic import makehuman
    from facejax.inference import motion_sources

    drivers = ("expression", "end", "livelink")
    named = [f"--{name}" for name in drivers if getattr(command, name) is not None]
    if len(named) != 1:
        raise ValueError(
            f"animate: expected one of --expression, --end and --livelink, got {' and '.join(named) or 'none'}"
        )
    if command.mesh is None and command.landmarks is not None:
        raise ValueError(f"--landmarks {command.landmarks}: of which mesh? name it with --mesh")
    if command.mesh is not None and command.person is not None:
        raise ValueError(f"--person {command.person} and --mesh {command.mesh}: name one of them")
    own = {"expression": ("whole",), "end": ("start", "then", "seed"), "livelink": ("begin", "seconds", "keep_rest")}
    for driver in set(drivers) - {named[0][2:]}:
        for name in own[driver]:
            if getattr(command, name) != getattr(Animate, name):
                raise ValueError(f"--{name.replace('_', '-')} goes with --{driver}, not with {named[0]}")
    person = None if command.person is None else makehuman.subject(command.person)
    shown = {"fps": command.fps, "formats": command.formats}
    if command.livelink is not None:
        recording = motion_sources.read_recording(
            command.livelink, begin=command.begin, seconds=command.seconds, at_rest=not command.keep_rest
        )
        name = command.livelink.stem
        if command.mesh is None:
            return _said(
                generate.play(
                    recording, person or makehuman.average(), name, command.out, intensity=command.intensity, **shown
                )
            )
        motion = motion_sources.from_recording(recording, name=name)
    elif command.expression is not None:
        if command.frames == motion_sources.NATURAL:
            raise ValueError("--frames natural is of transitions; an expression takes its own time without --frames")
        motion = motion_sources.from_expression(
            command.expression, frames=command.frames, whole=command.whole, weights=command.model
        )
    else:
        labels = (command.start, command.end, *command.then)
        frames = 30 if command.frames is None else command.frames
        motion = motion_sources.from_labels(labels, seed=command.seed, frames=frames, weights=command.model)
    options = {
        "head": command.head,
        "pin": command.pin,
        "sigma": command.sigma,
        "smoothing": command.smoothing,
        **shown,
    }
    options |= {} if command.kernel is None else {"kernel": command.kernel}
    source = {"mesh": command.mesh, "landmarks": command.landmarks, "person": person}
    _said(generate.animate(motion, command.out, **source, intensity=command.intensity, **options))


def _said(result: tuple[list[Path], tuple[str, ...]]) -> None:
    """Print what was assumed to standard error, and the files to standard output."""
    done, notes = result
    for note in notes:
        print(atomic.one_line(note), file=sys.stderr)
    print("\n".join(str(path) for path in done))


def _register(command: Register) -> None:
    from facejax.cli import outputs
    from facejax.inference import scans

    scan = scans.read(command.scan, command.landmarks)
    outputs.make_output_folder(command.out)
    _said(scans.save(scan, scans.fit(scan), command.out))


def _demo(command: Demo) -> None:
    from facejax.cli import demo

    print(demo.run(command.out, seed=command.seed).read_text())


def _labels(command: Labels) -> None:
    from facejax.cli import generate

    print("\n".join(generate.labels(command.model)))


def _data(command: Data) -> None:
    from facejax.cli import datasets
    from facejax.data.synthetic import makehuman4d

    command = command.what
    if isinstance(command, Prepare):
        made = datasets.prepare_recordings(
            command.source, command.root, command.out, landmarks=command.landmarks, unit=command.unit,
            labels=command.labels, people=command.people, phases=command.cuts,
            remove_head_motion=command.hold, max_meshes=command.meshes,
            workers=command.workers, rate=command.fps, rest=command.rest, gaps=command.gaps, template=command.template,
            actors=command.actors,
        )  # fmt: skip
        splits = [f"{split}: {', '.join(names)}" for split, names in made.people().items() if names]
        _said(([made.path], (*made.index["notes"], *splits)))
    elif command.sample is not None:
        print("\n".join(str(path) for path in datasets.sample_faces(command.sample, command.count)))
    else:
        spec = makehuman4d.Spec(level=command.level, head_motion=command.head_motion, noise=command.noise)
        print(datasets.prepare(spec, folder=command.out))


def _fit(command: Fit) -> None:
    from facejax.cli import datasets

    path, errors = datasets.fit(
        command.data, command.out, quick=command.quick, seed=command.seed, distributed=command.distributed
    )
    if errors:
        print("people held out: {head:.3f} mm over the mesh, {face:.3f} mm over the face".format(**errors))
    print(path)


def _view(command: View) -> None:
    from facejax.cli import generate

    page = generate.view(command.file, command.out, fps=command.fps)
    print(page)
    if command.open:
        webbrowser.open(page.resolve().as_uri())


_COMMANDS = {
    Generate: _generate,
    Animate: _animate,
    Register: _register,
    Demo: _demo,
    Labels: _labels,
    Data: _data,
    Fit: _fit,
    View: _view,
}


if __name__ == "__main__":
    main()
