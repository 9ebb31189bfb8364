"""Try each kind of file that a public report says broke another program, and write docs/validation/field_reports.md.

`python benchmarks/field_reports/run.py`. It takes some seconds; tests/test_field_reports.py tries the same.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from benchmarks.field_reports import annotations, cameras, meshes, points, rasters  # noqa: E402
from benchmarks.field_reports.report import Report  # noqa: E402
from pipeline.formats.files.atomic import write_text  # noqa: E402

PAGE = ROOT / "docs" / "validation" / "field_reports.md"
KINDS: dict[str, Sequence[Report]] = {
    "Points": points.REPORTS,
    "Meshes": meshes.REPORTS,
    "Elevation models": rasters.REPORTS,
    "Cameras": cameras.REPORTS,
    "Annotations": annotations.REPORTS,
}
_HEAD = """# Files that broke other programs

This page shows what scarpsim does with files of the kinds that users of other programs reported as misread, refused or fatal.
It is for those who wonder whether their own files will be read as they are meant. The reports are public threads of the
trackers of those programs. For each we wrote a small file of our own with the reported property, gave it to scarpsim, and
compared the result with the truth that the file was made from. Each row has the property of the file with its report, what a
program should do with it, and what scarpsim does. A refusal is right where the file does not say enough; then the message is
shown. All rows are right.
"""
_END = "This page is written by `python benchmarks/field_reports/run.py`, and the test suite tries every row again.\n"


def outcome(report: Report) -> str:
    """Try a report in an empty folder; return what came out, in words. Raises AssertionError where that is not right."""
    with tempfile.TemporaryDirectory() as folder:
        return report.tried(Path(folder))


def page() -> str:
    """Return the page, with the outcome of every report."""
    parts = [_HEAD]
    for title, reports in KINDS.items():
        rows = [
            f"| {report.fault} ([{report.thread}]({report.url})) | {report.right} | {outcome(report).replace('|', '/')} |"
            for report in reports
        ]
        parts.append(
            "\n".join([f"## {title}\n", "| the file | what is right | what scarpsim does |", "|---|---|---|", *rows, ""])
        )
    return "\n".join([*parts, _END])


if __name__ == "__main__":
    write_text(PAGE, page())
    print(f"{sum(map(len, KINDS.values()))} reports tried; {PAGE.relative_to(ROOT)} is written")
