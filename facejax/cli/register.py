"""`facejax register`: fit the template to a scan of a head."""

from __future__ import annotations

from facejax.cli import outputs
from facejax.cli.arguments import Register
from facejax.inference import scans


def run(command: Register) -> None:
    """Write the registered template, its landmarks, the distances and a picture."""
    scan = scans.read(command.scan, command.landmarks)
    outputs.make_output_folder(command.out)
    outputs.report(*scans.save(scan, scans.fit(scan), command.out))
