"""Coverage-guided fuzzing of a reader: `python tests/faults/guided.py READER --seconds N`.

Atheris records which lines of the reader a file executes, and mutates those files further that execute new ones. Run it
by hand where `pip install atheris` works (Python 3.11 to 3.13 on Linux). Readers and their errors are those of
`tests.faults.fuzz`. Stops at the first crash with its trace, and keeps the file in the folder; prints one JSON line at
the end of the time.
"""

import argparse
import json
import os
import sys
import tempfile
import time
import warnings
from pathlib import Path

import atheris

sys.path.insert(0, str(Path(__file__).parents[2]))

# Everything that reads files of strangers, and the pure-Python parsers that it uses.
WATCHED = [
    "facejax.io",
    "facejax.data",
    "numpy.lib._format_impl",
    "zipfile",
    "pickle",
    "csv",
    "json",
]
WATCHED += ["pygltflib", "xml.etree"]
with atheris.instrument_imports(include=WATCHED):
    from tests.faults import fuzz

    KNOWN = fuzz.readers()


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("reader", choices=KNOWN)
    parser.add_argument("--seconds", type=int, default=60)
    given = parser.parse_args()
    with atheris.instrument_imports(include=WATCHED):
        reader = KNOWN[given.reader]()
    counts, begun = {"read": 0, "refused": 0}, time.monotonic()
    folder = Path(tempfile.mkdtemp(prefix="guided-"))
    corpus = folder / "corpus"
    corpus.mkdir()
    for number, content in enumerate(reader.files):
        (corpus / str(number)).write_bytes(content)
    path = folder / f"file{reader.suffix}"

    def one(content: bytes) -> None:
        if time.monotonic() - begun > given.seconds:
            print(json.dumps({"reader": given.reader, **counts, "kinds": len(list(corpus.iterdir()))}), flush=True)
            os._exit(0)  # libFuzzer would take an exception for a crash
        path.write_bytes(content)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                reader.read(path)
            counts["read"] += 1
        except reader.errors as error:
            assert "\n" not in str(error) and str(folder) in str(error), f"not one line with the file's name: {error!r}"
            counts["refused"] += 1

    atheris.Setup([sys.argv[0], str(corpus), "-max_len=8192", "-timeout=20", f"-artifact_prefix={folder}/"], one)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
