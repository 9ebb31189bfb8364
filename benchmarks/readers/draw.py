"""Draw public definitions, pages and messages for readers who have not seen the code, and write the page of their grades.

    python benchmarks/readers/draw.py SEED OUT.json         60 definitions, 15 pages, 40 messages, each with a number
    python benchmarks/readers/draw.py --page                docs/validation/readers.md from the grades that are kept

A reader says of each item what it does, what its arguments are and why it exists, and a grade of how well that could be told:
3 at once, 2 after a second reading, 1 in part, 0 not at all. Grades are kept in docs/validation/readers/.
"""

from __future__ import annotations

import ast
import functools
import json
import random
import statistics
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
FOLDER, PAGE = ROOT / "docs" / "validation" / "readers", ROOT / "docs" / "validation" / "readers.md"
PACKAGES = ("scene", "sensors", "pipeline")
COUNTS = {"definition": 60, "page": 15, "message": 40}
_HEAD = """# What readers understand

This page shows how well readers who had not seen the code understood it. Each round drew 60 public definitions, 15 pages and 40
messages at random. A reader saw a definition's signature and docstring alone, a page, or a message, said what it means, and
gave a grade: 3 if it could be told at once, 2 after a second reading, 1 in part, 0 not at all. What got less than 2 was
rewritten afterwards, except messages that only pass on another message.

"""


def definitions() -> Iterator[dict[str, str]]:
    """Public functions, classes and methods with their signatures and docstrings."""
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            tree = ast.parse(path.read_text(encoding="utf-8"))
            for node in tree.body:
                yield from _public(node, f"{path.relative_to(ROOT)}")


def _public(node: ast.stmt, place: str) -> Iterator[dict[str, str]]:
    if not isinstance(node, ast.FunctionDef | ast.ClassDef) or node.name.startswith("_"):
        return
    if any(ast.unparse(each) == "overload" for each in node.decorator_list):
        return  # the function below the overloads has the docstring
    yield {"where": f"{place}: {node.name}", "text": f"{_signature(node)}\n{ast.get_docstring(node) or '(no docstring)'}"}
    for inner in node.body if isinstance(node, ast.ClassDef) else ():
        if isinstance(inner, ast.FunctionDef) and not inner.name.startswith("_") and ast.get_docstring(inner):
            yield {"where": f"{place}: {node.name}.{inner.name}", "text": f"{_signature(inner)}\n{ast.get_docstring(inner)}"}


def _signature(node: ast.FunctionDef | ast.ClassDef) -> str:
    if isinstance(node, ast.FunctionDef):
        returns = f" -> {ast.unparse(node.returns)}" if node.returns else ""
        return f"def {node.name}({ast.unparse(node.args)}){returns}"
    fields = [ast.unparse(each) for each in node.body if isinstance(each, ast.AnnAssign)]
    return "\n    ".join([f"class {node.name}", *fields])


def pages() -> Iterator[dict[str, str]]:
    """Pages of the documentation that people read."""
    for path in [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]:
        if "readers" not in path.parts:
            yield {"where": str(path.relative_to(ROOT)), "text": "(read the file)"}


def messages() -> Iterator[dict[str, str]]:
    """Errors that users see, as they stand in the code, with the texts that the module keeps in constants."""
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            tree = ast.parse(path.read_text(encoding="utf-8"))
            texts = _constants(tree)
            for node, function in _errors(tree):
                given = texts | _given_texts(tree, function) | _local_texts(function, node.lineno)
                filled = _WithTexts(given).visit(node)
                parts = [ast.unparse(filled.args[0]), *(f"{key.arg}: {ast.unparse(key.value)}" for key in filled.keywords)]
                yield {"where": f"{path.relative_to(ROOT)}:{node.lineno}", "text": "; ".join(parts)}


def _errors(tree: ast.Module) -> Iterator[tuple[ast.Call, ast.AST]]:
    """Calls of InputError, each with the innermost function in which it stands."""

    def within(node: ast.AST, function: ast.AST) -> Iterator[tuple[ast.Call, ast.AST]]:
        for child in ast.iter_child_nodes(node):
            yield from within(child, child if isinstance(child, ast.FunctionDef) else function)
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "InputError" and node.args:
            yield node, function

    yield from within(tree, tree)


def _local_texts(function: ast.AST, line: int) -> dict[str, ast.expr]:
    """Return the texts that a function last assigns to names before a line, as users see them in place of the names."""
    found: dict[str, ast.expr] = {}
    assigned = [node for node in ast.walk(function) if isinstance(node, ast.Assign) and node.lineno < line]
    for node in sorted(assigned, key=lambda node: node.lineno) if isinstance(function, ast.FunctionDef) else ():
        if len(node.targets) == 1 and isinstance(node.targets[0], ast.Name):
            found[node.targets[0].id] = node.value
    texts = ast.Constant | ast.JoinedStr | ast.IfExp | ast.BoolOp
    return {name: value for name, value in found.items() if isinstance(value, texts)}


def _given_texts(tree: ast.Module, function: ast.AST) -> dict[str, ast.expr]:
    """Return the texts that a function gets as arguments: those of its first call in the module, or its defaults."""
    if not isinstance(function, ast.FunctionDef):
        return {}
    every = function.args
    names = [each.arg for each in every.args]
    found: dict[str, ast.expr] = dict(zip(names[len(names) - len(every.defaults) :], every.defaults, strict=True))
    found |= {each.arg: value for each, value in zip(every.kwonlyargs, every.kw_defaults, strict=True) if value is not None}
    calls = (node for node in ast.walk(tree) if isinstance(node, ast.Call) and _called(node) == function.name)
    for call in list(calls)[:1]:
        found |= dict(zip([name for name in names if name not in ("self", "cls")], call.args, strict=False))
        found |= {key.arg: key.value for key in call.keywords if key.arg}
    return {name: value for name, value in found.items() if isinstance(value, ast.Constant | ast.JoinedStr)}


def _called(call: ast.Call) -> str:
    """Return the name of the function or method that a call calls."""
    return str(getattr(call.func, "id", getattr(call.func, "attr", "")))


def _constants(tree: ast.Module) -> dict[str, ast.expr]:
    """Return the texts that a module assigns to names at its top level."""
    return {
        target.id: node.value
        for node in tree.body
        if isinstance(node, ast.Assign) and isinstance(node.value, ast.Constant | ast.JoinedStr)
        for target in node.targets
        if isinstance(target, ast.Name)
    }


class _WithTexts(ast.NodeTransformer):
    """Put the text of a constant in the place of its name."""

    def __init__(self, texts: dict[str, ast.expr]) -> None:
        self._texts = texts

    def visit_JoinedStr(self, node: ast.JoinedStr) -> ast.expr:
        """Join texts that an f-string contains to it; leave its other parts as they are."""
        values: list[ast.expr] = []
        for value in node.values:
            name = value.value if isinstance(value, ast.FormattedValue) else None
            text = self._texts.get(name.id) if isinstance(name, ast.Name) else None
            if isinstance(text, ast.JoinedStr):
                values += text.values
            else:
                values.append(ast.Constant(str(text.value)) if isinstance(text, ast.Constant) else value)
        return ast.JoinedStr(values)

    def visit_Name(self, node: ast.Name) -> ast.expr:
        """Replace a name of a constant."""
        return self._texts.get(node.id, node)


@functools.cache
def everything() -> dict[str, list[dict[str, str]]]:
    """Return the definitions, pages and messages of the repository from which the readers' samples are drawn, by kind."""
    return {"definition": list(definitions()), "page": list(pages()), "message": list(messages())}


def drawn(seed: int) -> list[dict[str, Any]]:
    """Draw the items of one round."""
    source = random.Random(seed)
    items: list[dict[str, Any]] = []
    for kind, every in everything().items():
        items += [{"kind": kind, **each} for each in source.sample(every, COUNTS[kind])]
    return [{"number": number, **each} for number, each in enumerate(items, start=1)]


def page() -> str:
    """Return the page, from files of grades: a list of {number, kind, where, grade, understood}."""
    lines = ["| round | kind | items | median grade | below 2 |", "|---|---|---|---|---|"]
    failed = ["| round | item | grade | what was unclear |", "|---|---|---|---|"]
    rounds = {int(path.stem.rpartition("_")[2]): path for path in FOLDER.glob("round_*.json")}
    for number in sorted(rounds):
        graded = json.loads(rounds[number].read_text(encoding="utf-8"))
        for kind in COUNTS:
            grades = [each["grade"] for each in graded if each["kind"] == kind]
            if grades:
                below = sum(grade < 2 for grade in grades)
                lines.append(f"| {number} | {kind}s | {len(grades)} | {statistics.median(grades):g} | {below} |")
        failed += [
            f"| {number} | `{each['where']}` | {each['grade']} | {each['understood'].replace('|', '/')} |"
            for each in graded
            if each["grade"] < 2
        ]
    end = (
        "\nThe draws and grades are in `docs/validation/readers/`; `python benchmarks/readers/draw.py --page` writes this page.\n"
    )
    return _HEAD + "\n".join(lines) + "\n\n## What got less than 2\n\n" + "\n".join(failed) + "\n" + end


def main() -> None:
    if sys.argv[1:] == ["--page"]:
        PAGE.write_text(page(), encoding="utf-8")
        return
    seed, out = sys.argv[1:]
    Path(out).write_text(json.dumps(drawn(int(seed)), indent=1), encoding="utf-8")
    print(f"{sum(COUNTS.values())} items: {out}")


if __name__ == "__main__":
    main()
