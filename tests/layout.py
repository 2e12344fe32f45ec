"""Figures of the package's layout: modules per folder, their lengths, imports between folders, and start times.

    python -m tests.layout [FOLDER]     # a checkout of any version, by default this one

Start times are the medians of five runs, after one that warms the file cache.
"""

import argparse
import ast
import os
import statistics
import subprocess
import sys
import time
from pathlib import Path

COMMANDS = {
    "import facejax": ["-c", "import facejax"],
    "facejax --help": ["-c", "import sys; sys.argv = ['facejax', '--help']; MAIN"],
    "facejax labels": ["-c", "import sys; sys.argv = ['facejax', 'labels']; MAIN"],
}


def modules(root: Path) -> dict[str, Path]:
    """Return the package's modules, by dotted name."""
    paths = sorted((root / "facejax").rglob("*.py"))
    return {".".join(path.relative_to(root).with_suffix("").parts).removesuffix(".__init__"): path for path in paths}


def imports(name: str, path: Path, known: set[str]) -> set[str]:
    """Return the modules of the package that one of them imports, inside functions as well."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            package = name.split(".") if path.name == "__init__.py" else name.split(".")[:-1]
            base = package[: len(package) - node.level + 1] if node.level else []
            base = ".".join([*base, *([node.module] if node.module else [])])
            found |= {f"{base}.{alias.name}" if f"{base}.{alias.name}" in known else base for alias in node.names}
    return (found & known) - {name, "facejax"}


def room(name: str) -> str:
    """Return the folder below the package that a module lies in; a module at the root is a room of its own."""
    return name.split(".")[1] if "." in name else name


def seconds(root: Path, arguments: list[str]) -> float:
    """Return the median time of a Python process."""
    entry = "from facejax.cli.main import main" if (root / "facejax/cli").is_dir() else "from facejax.cli import main"
    command = [sys.executable, *(argument.replace("MAIN", f"{entry}; main()") for argument in arguments)]
    taken = []
    for _ in range(6):
        start = time.perf_counter()
        environment = {**os.environ, "PYTHONPATH": str(root)}
        subprocess.run(command, cwd=root, env=environment, check=True, capture_output=True)
        taken.append(time.perf_counter() - start)
    return statistics.median(taken[1:])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", nargs="?", type=Path, default=Path(__file__).parents[1])
    root = parser.parse_args().folder.resolve()
    paths = modules(root)
    lines = {name: len(path.read_text("utf-8").splitlines()) for name, path in paths.items()}
    folders: dict[str, int] = {}
    for path in paths.values():
        if path.name not in ("__init__.py", "__main__.py"):
            folder = str(path.parent.relative_to(root))
            folders[folder] = folders.get(folder, 0) + 1
    arrows = {(name, target) for name, path in paths.items() for target in imports(name, path, set(paths))}
    rooms = {(room(name), room(target)) for name, target in arrows if room(name) != room(target)}
    longest = max(lines, key=lambda name: lines[name])
    print(f"modules at the root: {folders['facejax']}")
    print(f"most modules in a folder: {max(folders.values())} ({max(folders, key=lambda folder: folders[folder])})")
    print(f"modules per folder: {', '.join(f'{name} {count}' for name, count in sorted(folders.items()))}")
    print(f"longest module: {lines[longest]} lines ({longest})")
    print(
        f"imports between modules: {len(arrows)}; between rooms: {len(rooms)}, of {len({room(n) for n in paths})} rooms"
    )
    print(f"README: {len((root / 'README.md').read_text('utf-8').splitlines())} lines")
    for name, arguments in COMMANDS.items():
        print(f"{name}: {1e3 * seconds(root, arguments):.0f} ms")


if __name__ == "__main__":
    main()
