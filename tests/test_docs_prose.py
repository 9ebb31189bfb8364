"""The form of the pages that users read: short, to the point, and without the project's own history."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
README, CHANGELOG = ROOT / "README.md", ROOT / "CHANGELOG.md"
GUIDES = sorted([*(DOCS / "howto").glob("*.md"), *(DOCS / "tutorials").glob("*.md")])
USER_PAGES = [README, DOCS / "index.md", *GUIDES, *sorted((DOCS / "explanation").glob("*.md"))]
TO_BE_REWRITTEN: set[str] = set()
"""Pages of docs/explanation that are still too long or tell the project's history. Take a page out once it is rewritten."""
MOST_WORDS, MOST_README_LINES, MOST_CHANGE_WORDS = 1200, 75, 20
_CODE = re.compile(r"^ *```.*?^ *```|^ {4,}[^\n]*$", re.MULTILINE | re.DOTALL)
_TABLE = re.compile(r"^\|.*$", re.MULTILINE)
_COMMIT = re.compile(r"\b(?=[a-f]*\d)(?=\d*[a-f])[0-9a-f]{7,40}\b")
_SEED = re.compile(r"(?<!-)\bseeds?(?: of)? \d+")
_LINK = re.compile(r"\]\((?!https?:|#)([^)#\s]+)")


def _rewritten(page: Path) -> bool:
    return page.parent.name != "explanation" or page.name not in TO_BE_REWRITTEN


@pytest.mark.parametrize(
    "page", [page for page in USER_PAGES if _rewritten(page)], ids=lambda page: f"{page.parent.name}/{page.name}"
)
def test_a_page_for_users_is_short_and_names_no_commit_or_seed(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    words = len(_TABLE.sub("", _CODE.sub("", text)).split())
    assert words <= MOST_WORDS, f"{words} words; move evidence to docs/validation, or split the page"
    assert _COMMIT.findall(text) == []
    assert _SEED.findall(text) == []


@pytest.mark.parametrize("page", GUIDES, ids=lambda page: page.stem)
def test_a_guide_begins_with_whom_it_is_for(page: Path) -> None:
    title, first, *_ = page.read_text(encoding="utf-8").split("\n\n")
    assert title.startswith("# ")
    assert re.match(r"This (?:guide|tutorial) is for ", first)


def test_the_readme_fits_one_screen() -> None:
    text = README.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= MOST_README_LINES
    assert not re.search(r"\([^()\n]*\([^()\n]*\)[^()\n]*\)", _CODE.sub("", text)), "nested parentheses"


@pytest.mark.parametrize("page", [README, CHANGELOG, ROOT / "CONTRIBUTING.md"], ids=lambda page: page.name)
def test_links_out_of_the_site_lead_somewhere(page: Path) -> None:
    """The site checks the links of docs/."""
    missing = [link for link in _LINK.findall(page.read_text(encoding="utf-8")) if not (ROOT / link).exists()]
    assert missing == []


def test_a_change_takes_one_short_line() -> None:
    changes = re.findall(r"^- (.*)$", CHANGELOG.read_text(encoding="utf-8"), re.MULTILINE)
    assert [change for change in changes if len(change.split()) > MOST_CHANGE_WORDS] == []


def test_the_version_is_the_same_everywhere() -> None:
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    locked = tomllib.loads((ROOT / "uv.lock").read_text())["package"]
    assert [package["version"] for package in locked if package["name"] == "scarpsim"] == [version]
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert cited["version"] == version
    released = re.findall(r"^## (\d[\d.]*) - (\S+)$", CHANGELOG.read_text(encoding="utf-8"), re.MULTILINE)
    assert released[0] == (version, str(cited["date-released"]))
