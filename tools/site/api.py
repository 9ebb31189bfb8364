"""The API reference: a page for each folder of modules, read from the source by griffe; nothing is imported."""

from __future__ import annotations

import ast
from pathlib import Path

ROOT = Path(__file__).parents[2]
_PACKAGES = ("scene", "sensors", "pipeline")
_LEFT_OUT = ("pipeline/cli",)
"""Folders with a page of their own elsewhere."""
_INTRODUCTION = """# API

From the docstrings. What is public, and stays, is listed in [From Python](../python.md): `from pipeline import simulate, plan,
compare, calibrate, measure, diagnose, make_dataset, detect, open_run`, and the building blocks ([pipeline.api](pipeline.api.md)).
The other modules are the program's own and may change.

A module's folder says what it knows: `scene` knows no sensor, `sensors` know the scene's ray caster, `pipeline` joins them.

| folder | modules |
|---|---|
"""


def pages() -> dict[str, str]:
    """Return the index and a page for each folder that holds modules."""
    made, rows = {}, []
    for package in _PACKAGES:
        for folder in sorted({path.parent for path in (ROOT / package).rglob("*.py")}):
            name = folder.relative_to(ROOT).as_posix()
            modules = sorted(path for path in folder.glob("*.py") if path.stem != "__init__")
            if name in _LEFT_OUT or not modules:
                continue
            dotted = name.replace("/", ".")
            made[f"reference/api/{dotted}.md"] = _page(dotted, modules)
            listed = ", ".join(f"`{path.stem}`" for path in modules)
            rows.append(f"| [{dotted}]({dotted}.md) | {listed} |")
    return {"reference/api/index.md": _INTRODUCTION + "\n".join(rows) + "\n", **made}


def _page(dotted: str, modules: list[Path]) -> str:
    parts = [f"# {dotted}", *(f"::: {dotted}.{path.stem}" for path in modules)]
    described = ast.get_docstring(ast.parse((modules[0].parent / "__init__.py").read_text()))
    return "\n\n".join([parts[0], *([described] if described else []), *parts[1:]]) + "\n"
