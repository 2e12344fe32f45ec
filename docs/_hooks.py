"""Build hooks: publish the committed results and the fault table with the site, and keep fields out of the search.

Markdown in `docs/` links to files of the repository by their real relative path, such as
`../../experiments/results/table1.png`, so that links also work where the repository is browsed. MkDocs serves files
below `docs/` only. These hooks copy the linked results into the site under `repository/` and rewrite the links.

Fields of records and module constants have entries of their own in the API reference. Their titles are single words
(`mean`, `curve`), which would come before every function in the search; their record or module is found instead.
"""

from __future__ import annotations

import inspect
import json
import os
import pkgutil
import re
import sys
from pathlib import Path

from mkdocs.structure.files import File

ROOT = Path(__file__).resolve().parent.parent
LINK = re.compile(r"(?<=\]\()((?:\.\./)+)([\w/.-]+\.\w+|LICENSE)(?=[)#])")
FAULTS = "<!-- faults -->"
ATTRIBUTE = re.compile(r"#(facejax\.[\w.]+)$")
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


def on_post_build(config):
    """Remove fields and constants from the search index."""
    path = Path(config.site_dir, "search", "search_index.json")
    index = json.loads(path.read_text(encoding="utf-8"))
    index["docs"] = [entry for entry in index["docs"] if not _is_attribute(entry["location"])]
    path.write_text(json.dumps(index, ensure_ascii=False, separators=(",", ":")), encoding="utf-8")


def _is_attribute(location: str) -> bool:
    """Return whether an entry of the search index is a value, not a module, class or function."""
    if (match := ATTRIBUTE.search(location)) is None:
        return False
    try:
        found = pkgutil.resolve_name(match[1])
    except (ImportError, AttributeError):
        return True  # a field without a default
    return not (inspect.ismodule(found) or callable(found))
