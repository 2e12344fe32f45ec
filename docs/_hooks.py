"""Build hooks: publish the committed results and the fault table with the site.

Markdown in `docs/` links to files of the repository by their real relative path, such as
`../../experiments/results/table1.png`, so that links also work where the repository is browsed. MkDocs serves files
below `docs/` only. These hooks copy the linked results into the site under `repository/` and rewrite the links.
"""

from __future__ import annotations

import os
import re
import sys
from pathlib import Path

from mkdocs.structure.files import File

ROOT = Path(__file__).resolve().parent.parent
LINK = re.compile(r"(?<=\]\()((?:\.\./)+)([\w/.-]+\.\w+|LICENSE)(?=[)#])")
FAULTS = "<!-- faults -->"
sys.path.insert(0, str(ROOT))


def _target(page: str, up: str, path: str) -> str | None:
    """Return the repository path that a link leads to when it leaves `docs/`, else None."""
    found = Path(os.path.normpath(Path("docs", page).parent / up / path))
    return None if found.parts[0] == "docs" else found.as_posix()


def on_files(files, config):
    """Add every linked file outside `docs/` to the site."""
    wanted = set()
    for page in files.documentation_pages():
        text = Path(page.abs_src_path).read_text(encoding="utf-8")
        wanted |= {_target(page.src_uri, *match.groups()) for match in LINK.finditer(text)}
    for name in sorted(wanted - {None}):
        files.append(File.generated(config, f"repository/{name}", abs_src_path=str(ROOT / name)))
    return files


def on_page_markdown(markdown, page, config, files):
    """Rewrite links that leave `docs/`, and put the table of fault outcomes in its place."""
    depth = page.file.src_uri.count("/")

    def rewrite(match: re.Match) -> str:
        name = _target(page.file.src_uri, *match.groups())
        return match[0] if name is None else "../" * depth + f"repository/{name}"

    markdown = LINK.sub(rewrite, markdown)
    if FAULTS in markdown:
        from tests.faults import table

        markdown = markdown.replace(FAULTS, table.table(ROOT / "tests" / "faults" / "outcomes.jsonl"))
    return markdown
