"""What MkDocs calls while it builds the site: pages that are made from the program, and folders in the navigation."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[2]
sys.path[:0] = [str(ROOT), str(Path(__file__).parent)]

import api  # noqa: E402
import commands  # noqa: E402
import configuration  # noqa: E402
import licences  # noqa: E402
import notebooks  # noqa: E402
import scanners  # noqa: E402

_MAKERS = (api, commands, configuration, licences, notebooks, scanners)
"""Modules with `pages()`: the path in the site and the content of each page or picture that they make."""
_FIRST = ("index.md", "README.md")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the made pages and write the navigation's folders out."""
    for maker in _MAKERS:
        for path, content in maker.pages().items():
            files.append(File.generated(config, path, content=content))
    pages = sorted(file.src_uri for file in files.documentation_pages())
    config.nav = _written_out(config.nav, pages, set(_named(config.nav)))
    return files


def _named(entry: Any) -> Iterator[str]:
    """Every entry of the navigation, whatever its depth."""
    if isinstance(entry, str):
        yield entry
    else:
        for part in entry.values() if isinstance(entry, dict) else entry:
            yield from _named(part)


def _written_out(entry: Any, pages: list[str], named: set[str]) -> Any:
    """Return the navigation with folders replaced by the pages in them (an index first) that are named nowhere else."""
    if isinstance(entry, list):
        parts = [_written_out(part, pages, named) for part in entry]
        return [page for part in parts for page in (part if isinstance(part, list) else [part])]
    if isinstance(entry, dict):
        return {title: _written_out(part, pages, named) for title, part in entry.items()}
    if not entry.endswith("/"):
        return entry
    deeper = [other for other in named if other.endswith("/") and other != entry and other.startswith(entry)]
    inside = [page for page in pages if page.startswith(entry) and not page.startswith(tuple(deeper)) and page not in named]
    return sorted(inside, key=lambda page: (page.removeprefix(entry) not in _FIRST, page))
