"""The notebooks of docs/notebooks as pages, with the outputs that are stored in them."""

from __future__ import annotations

import re
from pathlib import Path

import nbformat
from nbconvert import MarkdownExporter

FOLDER = Path(__file__).parents[2] / "docs" / "notebooks"
_PICTURE = re.compile(r"!\[png\]\((output_(\d+)_\d+\.png)\)")


def pages() -> dict[str, str | bytes]:
    """Return a page for each notebook and the pictures in it."""
    made: dict[str, str | bytes] = {}
    for path in sorted(FOLDER.glob("*.ipynb")):
        made |= _page(path)
    return made


def _page(path: Path) -> dict[str, str | bytes]:
    """Return the page and its pictures. A cell's metadata say, as `alt`, what its pictures show."""
    notebook = nbformat.read(path, as_version=4)
    text, resources = MarkdownExporter().from_notebook_node(notebook)

    def with_text(found: re.Match[str]) -> str:
        return f"![{notebook.cells[int(found[2])].metadata['alt']}]({path.stem}/{found[1]})"

    header = f"The notebook is `docs/notebooks/{path.name}`; the tests run it.\n"
    title, _, rest = text.lstrip().partition("\n")
    page = "\n".join([title, "", header, _PICTURE.sub(with_text, rest)])
    return {
        f"notebooks/{path.stem}.md": page,
        **{f"notebooks/{path.stem}/{name}": data for name, data in resources["outputs"].items()},
    }
