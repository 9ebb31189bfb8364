"""Write docs/validation/tests.md, the list of tests that `make validate` carries out: `python docs/make_tests_page.py`."""

from __future__ import annotations

import tomllib
from pathlib import Path

FOLDER = Path(__file__).parent
PAGE, LIST = FOLDER / "validation" / "tests.md", FOLDER.parent / "tests" / "validation.toml"
_HEAD = """# What the tests cover, and when they run

This page is for developers. `make test` runs lint, spelling, types and the tests that take seconds each. `make validate` runs
the long tests below; run it before each release and after each larger change. Whatever a long test covers as a whole has
shorter tests of its parts in `make test`.
"""


def page() -> str:
    """Return the page, made from tests/validation.toml."""
    groups = tomllib.loads(LIST.read_text(encoding="utf-8"))["group"]
    parts = [_HEAD]
    for group in groups:
        title, _, why = group["reason"].partition(": ")
        names = [f"| `{file}` | {', '.join(_words(name) for name in group[file])} |" for file in group if file != "reason"]
        about = [f"{why[0].upper()}{why[1:]}", ""] if why else []
        parts.append("\n".join([f"## {title.rstrip('.')}\n", *about, "| file | tests |", "|---|---|", *names, ""]))
    return "\n".join([*parts, "This page is written by `python docs/make_tests_page.py`.\n"])


def _words(name: str) -> str:
    """Return a test's name as words, with its parameter."""
    plain, _, parameter = name.removeprefix("test_").partition("[")
    return plain.replace("_", " ") + (f" ({parameter.rstrip(']')})" if parameter else "")


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
