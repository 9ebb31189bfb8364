"""Runs the notebooks and stores their outputs in them; the site shows these, the tests run the notebooks again.

python docs/run_notebooks.py [NAME ...]
"""

from __future__ import annotations

import base64
import io
import sys
import tempfile
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from PIL import Image

FOLDER = Path(__file__).parent / "notebooks"
_PNG, _COLOURS = "image/png", 64


def executed(path: Path, folder: Path) -> nbformat.NotebookNode:
    """Return the notebook with its outputs, run in `folder`. Raises nbclient's CellExecutionError where a cell fails."""
    notebook = nbformat.read(path, as_version=4)
    client = NotebookClient(notebook, timeout=600, record_timing=False, resources={"metadata": {"path": str(folder)}})
    return client.execute()


def slim(notebook: nbformat.NotebookNode) -> None:
    """Pictures with few colours, no more metadata than the site needs."""
    notebook.metadata = {"kernelspec": notebook.metadata["kernelspec"], "language_info": {"name": "python"}}
    for output in (output for cell in notebook.cells for output in cell.get("outputs", ())):
        if _PNG in output.get("data", ()):
            with Image.open(io.BytesIO(base64.b64decode(output["data"][_PNG]))) as picture:
                few = picture.convert("RGB").quantize(_COLOURS, dither=Image.Dither.NONE)
            buffer = io.BytesIO()
            few.save(buffer, "PNG", optimize=True)
            output["data"][_PNG] = base64.b64encode(buffer.getvalue()).decode("ascii")


def main(names: list[str]) -> None:
    """Renew the notebooks named, or all."""
    for path in sorted(FOLDER.glob("*.ipynb")):
        if names and path.stem not in names:
            continue
        with tempfile.TemporaryDirectory() as folder:
            notebook = executed(path, Path(folder))
        slim(notebook)
        nbformat.write(notebook, path)


if __name__ == "__main__":
    main(sys.argv[1:])
