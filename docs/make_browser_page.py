"""Write docs/validation/browser.md, what the browser tests did and found: `python docs/make_browser_page.py`.

The tests write the record from which the page is made, browser.json beside the page:

    BROWSER_RECORD=docs/validation/browser.json pytest tests/browser
"""

from __future__ import annotations

import json
import re
from collections import Counter
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).parent / "validation"
RECORD, PAGE = FOLDER / "browser.json", FOLDER / "browser.md"
OPENED = {
    "simulate_tls": "report of `simulate`, laser scanner",
    "simulate_stereo": "report of `simulate`, stereo pair",
    "compare": "report of `compare`",
    "inspect": "report of `inspect`",
    "icp-study": "report of `icp-study`",
    "calibrate": "report of `calibrate`",
    "gap": "report of `gap`",
    "identifiability": "report of `gap --identifiability`",
    "monitor": "report of `monitor`",
    "test_a_folder_in_the_viewer[gap]": "viewer on a folder of `gap`",
    "test_a_folder_in_the_viewer[data set]": "viewer on a data set",
    "test_a_folder_in_the_viewer[monitor]": "viewer on a folder of `monitor`",
    "test_the_controls_by_mouse": "viewer on a run, all controls by mouse",
    "test_the_controls_by_keyboard": "viewer on a pair of runs, all controls by keyboard",
    "test_the_site_by_keyboard": "search in the documentation by keyboard",
}
"""What each test opens, by the test's name or, for tests of reports, by its parameter."""
COUNTS = ("files", "clicks", "keys", "console errors", "missing files", "axe runs", "severe violations", "lesser violations")


def page(record: dict[str, Any]) -> str:
    """Return the page, made from the record."""
    rows: dict[str, Counter[str]] = {}
    for test, tally in record["tests"].items():
        rows.setdefault(_opened(test), Counter()).update(tally)
    total: Counter[str] = sum(rows.values(), Counter())
    wide, narrow = record["widths_px"]
    table = [f"| {what} | {' | '.join(str(tally[count]) for count in COUNTS)} |" for what, tally in rows.items()]
    table.append(f"| **all {len(rows)}** | {' | '.join(f'**{total[count]}**' for count in COUNTS)} |")
    head = " | ".join(("opened", "files loaded", *COUNTS[1:])).replace("axe runs", "runs of axe-core")
    passed = len(record["tests"]) - record["failed"]
    pages = sum(not what.startswith("search") for what in rows)
    return f"""# What the browser tests do and find

This page is for users who want to know whether reports, viewer and documentation work in a browser, and for developers who change
them. The tests in `tests/browser` make small outputs with each command, and open them with Playwright {record["playwright"]} in
Debian's Chromium {record["chromium"]}. The browser has no access to the network. `make test` runs these tests where Chromium is
installed. Two long pages of the documentation are left to `make validate`.

Of {len(record["tests"])} tests, {passed} passed. The [table of what was found](#what-was-found) has {len(rows)} rows, because the
two tests of each report share a row: one looks at the report, the other uses it by keyboard. The tests opened {pages} different
pages, fewer than rows, because the search is tested on the page of another row. They loaded {total["files"]} files,
clicked {total["clicks"]} times, pressed {total["keys"]} keys, and saw {total["console errors"]} console errors and
{total["missing files"]} missing files. In {total["axe runs"]} runs, axe-core found {total["severe violations"]} serious or
critical violations and {total["lesser violations"]} lesser ones.

## What is checked

| check | where | it fails if |
|---|---|---|
| console | each page | the console shows an error, or a script stops with one |
| missing files | each page | a request fails or is answered with an error, or an image has no content |
| width | reports, viewer, documentation | the page is wider than a window of {wide} px (a desktop) or {narrow} px (a phone) |
| barriers | reports, documentation, viewer | axe-core {record["axe"]} finds a serious or critical violation of WCAG 2.1 A or AA |
| mouse | viewer | a control does not do what it says: next, previous, whole wall, points, epoch, play |
| keyboard | reports, viewer, search | a control is not reached with Tab alone, or does not work with arrows, space or Enter |
| focus | reports | Tab stops at something that is not outlined |

The rules of axe-core include its best practices. Contrast of text was measured in {total["color-contrast runs"]} of the
{total["axe runs"]} runs, and alternative texts of images in {total["image-alt runs"]}. The other runs met nothing of that kind.
Axe-core runs at both widths, except in the viewer, where it runs at {wide} px.

## What was found

Clicks and keys are those of the tests; they do not include a search text that is typed. The severe violations are those that
axe-core grades serious or critical. The lesser ones are moderate or minor and fail no test. Where
the table has 0 keys for a report, Tab has nothing to reach in it: no link, no table to scroll and no part that folds.

| {head} |
|{"---|" * (len(COUNTS) + 1)}
{chr(10).join(table)}

## What is not checked

No other browser is used, and no screen reader. Automatic rules find only some of the barriers that people meet. Of the
documentation, one or two pages of each kind are opened.

Carried out at commit {record["commit"]} on {record["machine"]}. "Glibc" in the name of the machine is the version of its C
library.

Written by `python docs/make_browser_page.py` from `browser.json`, which the tests write with
`BROWSER_RECORD=docs/validation/browser.json pytest tests/browser`.
"""


def _opened(test: str) -> str:
    """Return what a test opens, in words."""
    parameter = re.sub(r".*\[(.*)\]", r"\1", test)
    if test.startswith("test_a_page_of_the_site"):
        return f"documentation, `{parameter}`"
    return OPENED[test] if test in OPENED else OPENED[parameter]


if __name__ == "__main__":
    PAGE.write_text(page(json.loads(RECORD.read_text(encoding="utf-8"))), encoding="utf-8")
