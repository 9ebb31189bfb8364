"""Every public name is listed in docs/reference/python.md with its parameters; notebooks and examples use no others.

python tests/api/test_public.py    writes the list again
"""

from __future__ import annotations

import ast
import inspect
import re
import sys
from pathlib import Path

import pytest

import pipeline
import scene
import sensors

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "reference" / "python.md"
PACKAGES = (pipeline, sensors, scene)
NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.ipynb"))
_LIST = re.compile(r"(?<=```text\n)(.*)(?=```)", re.DOTALL)


def listed() -> str:
    """Every public name: of functions with their parameters, of classes with their public attributes."""
    return "".join(
        f"{package.__name__}\n" + "".join(f"  {_described(package, name)}\n" for name in sorted(package.__all__))
        for package in PACKAGES
    )


def _described(package: object, name: str) -> str:
    value = getattr(package, name)
    if inspect.isfunction(value):
        return f"{name}({_parameters(value)})"
    own = value.__module__.startswith("pipeline.api")
    attributes = [key for key in _attributes(value) if not key.startswith("_")] if own else []
    return f"{name}: {', '.join(attributes)}" if attributes else name


def _attributes(value: type) -> list[str]:
    return list(dict.fromkeys([*getattr(value, "__dataclass_fields__", {}), *vars(value)]))


def _parameters(function: object) -> str:
    shown, keyword_only = [], False
    for each in inspect.signature(function).parameters.values():  # type: ignore[arg-type]
        if each.kind == each.KEYWORD_ONLY and not keyword_only and "*" not in "".join(shown):
            shown.append("*")
        keyword_only |= each.kind == each.KEYWORD_ONLY
        mark = {each.VAR_POSITIONAL: "*", each.VAR_KEYWORD: "**"}.get(each.kind, "")
        shown.append(f"{mark}{each.name}" + ("" if each.default is each.empty else "="))
    return ", ".join(shown)


def test_the_page_lists_what_is_public() -> None:
    found = _LIST.search(PAGE.read_text())
    assert found is not None
    assert found.group() == listed(), "write it anew: python tests/api/test_public.py"


def test_every_public_name_is_explained() -> None:
    silent = [name for package in PACKAGES for name in package.__all__ if not (getattr(package, name).__doc__ or "").strip()]
    assert silent == []


def sources() -> dict[str, str]:
    """Return the code of the notebooks and of the Python examples in the documentation, by file."""
    import nbformat

    found = {
        path.name: "\n".join(cell.source for cell in nbformat.read(path, as_version=4).cells if cell.cell_type == "code")
        for path in NOTEBOOKS
    }
    for page in (PAGE, ROOT / "docs" / "howto" / "add_sensor.md"):
        found |= {f"{page.name} {number}": code for number, code in enumerate(_examples(page))}
    return found


def _examples(page: Path) -> list[str]:
    return re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL)


@pytest.mark.parametrize(("where", "code"), sources().items(), ids=lambda value: value if "\n" not in value else "")
def test_it_uses_public_names_only(where: str, code: str) -> None:
    names = {package.__name__: set(package.__all__) for package in PACKAGES}
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.ImportFrom) and str(node.module).split(".")[0] in names:
            assert {alias.name for alias in node.names} <= names.get(str(node.module), set()), f"{where}: from {node.module}"
        if isinstance(node, ast.Import):
            assert not any(alias.name.split(".")[0] in names and "." in alias.name for alias in node.names), where


def test_the_whole_way_takes_at_most_25_lines() -> None:
    """From a mesh to a compared pair of sensors, a diagnosis and a data set."""
    code = sources()["own_mesh.ipynb"]
    assert len([line for line in code.splitlines() if line.strip()]) <= 25
    assert {"compare(", "diagnose(", "make_dataset(", "wall.ply"} <= set(re.findall(r"\w+\(|wall\.ply", code))


def test_the_page_of_building_blocks_measures_the_volume() -> None:
    code = next(code for code in _examples(PAGE) if "make_blocks" in code)
    *before, last = code.strip().splitlines()
    space: dict[str, object] = {}
    exec("\n".join(before), space)
    measured, true = eval(last.partition("#")[0], space)
    assert float(measured) == pytest.approx(true, rel=0.25)


def test_own_sensor_page_runs() -> None:
    define, use = _examples(ROOT / "docs" / "howto" / "add_sensor.md")
    space: dict[str, object] = {"__name__": "own"}
    exec(compile(define, "sensor.md", "exec", dont_inherit=True), space)
    *before, last = use.strip().splitlines()
    exec("\n".join(before), space)
    change = eval(last.removesuffix(".plot()"), space)
    assert float(change.where(change.block == 1).median()) > 0.1


def test_types_are_shipped() -> None:
    assert all((Path(str(package.__file__)).parent / "py.typed").is_file() for package in PACKAGES)


if __name__ == "__main__":
    text = PAGE.read_text()
    head = text if "```text" in text else text + "```text\n"
    start = head.index("```text\n") + len("```text\n")
    PAGE.write_text(head[:start] + listed() + "```\n" + head[start:].partition("```\n")[2])
    sys.exit()
