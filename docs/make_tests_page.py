"""Write docs/validation/tests.md, the list of tests that `make validate` carries out: `python docs/make_tests_page.py`."""

from __future__ import annotations

import ast
import tomllib
from pathlib import Path

FOLDER = Path(__file__).parent
PAGE, LIST = FOLDER / "validation" / "tests.md", FOLDER.parent / "tests" / "validation.toml"
_HEAD = """# What the tests cover, and when they run

This page lists the long tests, for developers who make a release or change a method. `make test` runs lint, spelling, types and
the tests that take seconds each. `make validate` runs the tests below. Run it before each release and after each larger change.
What a long test covers as a whole also has short tests of its parts in `make test`. Each table has the files with long tests,
how many they hold, and what a file tests. The sentence below a heading says which shorter tests cover the same.

On two cores of a quiet machine, with an empty kernel cache, `make test` with its 4,694 tests took 9.9 minutes. Installing the
packages, which it does the first time, takes one minute more if they are near.

The names of the long tests are in `tests/validation.toml`.
"""


def page() -> str:
    """Return the page, made from tests/validation.toml."""
    groups = tomllib.loads(LIST.read_text(encoding="utf-8"))["group"]
    parts = [_HEAD]
    for group in groups:
        title, _, why = group["reason"].partition(": ")
        names = [f"| `{file}` | {len(group[file])} | {_about(file)} |" for file in group if file != "reason"]
        about = [f"{why[0].upper()}{why[1:]}", ""] if why else []
        parts.append(
            "\n".join(
                [f"## {title.rstrip('.')}\n", *about, "| file | long tests | what the file tests |", "|---|---|---|", *names, ""]
            )
        )
    return "\n".join([*parts, "This page is written by `python docs/make_tests_page.py`.\n"])


def _about(file: str) -> str:
    """Return the first sentence of a test file's docstring, which says what it tests."""
    text = ast.get_docstring(ast.parse((FOLDER.parent / file).read_text(encoding="utf-8"))) or ""
    return " ".join(text.partition("\n\n")[0].split()).replace("|", "/")


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
