"""Entry point of the `facejax` command: parse the arguments, check them, run the command.

Invalid input ends with one line on standard error, exit code 2, and no file written. Arguments are checked before the
command's module, and with it JAX, is imported.
"""

from __future__ import annotations

import errno
import importlib
import os
import sys
from collections.abc import Callable
from typing import Any

import tyro

import facejax
from facejax.cli.arguments import Animate, Command, Data, Demo, Export, Fit, Generate, Labels, Register, View
from facejax.io import errors

DESCRIPTION = (
    "4D facial expressions: animate faces, prepare datasets, train models. `facejax --version` prints the version."
)
_DISK_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def main(arguments: list[str] | None = None) -> None:
    """Run one command; `arguments` are those of the process by default.

    Raises:
      SystemExit: code 2 for invalid input or a failed command, 130 after an interrupt.
    """
    arguments = sys.argv[1:] if arguments is None else arguments
    if arguments == ["--version"]:
        print(f"facejax {facejax.__version__}")
        return
    command = tyro.cli(Command, prog="facejax", description=DESCRIPTION, args=arguments)
    try:
        _COMMANDS[type(command)](command)
    except BrokenPipeError:
        # The reader of standard output, such as `head`, has closed it: not an error.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except KeyboardInterrupt:
        raise SystemExit(130) from None
    except (ValueError, RuntimeError, OSError, MemoryError, OverflowError) as error:
        print(f"facejax: {errors.one_line(_message(error, command))}", file=sys.stderr)
        raise SystemExit(2) from None


def _message(error: Exception, command: Command) -> str:
    if isinstance(error, OSError) and error.errno in _DISK_FULL and error.filename is None:
        # A failed write does not carry the name of its file.
        return f"{getattr(command, 'out', None) or 'output'} cannot be written: {error.strerror}"
    return str(error) or type(error).__name__


def _runner(module: str) -> Callable[[Any], None]:
    """Return a function that checks a command, then imports `facejax.cli.MODULE` and calls its `run`."""

    def run(command: Any) -> None:
        from facejax.cli import checks  # imports NumPy, which `--help` does not need

        checks.check(command)
        importlib.import_module(f"facejax.cli.{module}").run(command)

    return run


_COMMANDS = {
    Generate: _runner("generate"),
    Animate: _runner("animate"),
    Register: _runner("register"),
    Demo: _runner("demo"),
    Labels: _runner("labels"),
    Data: _runner("datasets"),
    Fit: _runner("fit"),
    Export: _runner("export"),
    View: _runner("view"),
}


if __name__ == "__main__":
    main()
