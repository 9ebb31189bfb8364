"""The record of what the browser tests did and found, from which docs/make_browser_page.py writes its page.

BROWSER_RECORD=docs/validation/browser.json pytest tests/browser
"""

from __future__ import annotations

import importlib.metadata
import json
import os
import platform
import subprocess
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

from browser_pages import NARROW, WIDE

ROOT = Path(__file__).parents[1]


@dataclass
class BrowserRecord:
    """Counts of actions and findings, by test function and by what it looked at."""

    chromium: str = ""
    axe: str = ""
    tallies: dict[str, Counter[str]] = field(default_factory=dict)

    def add(self, test: str, tally: Counter[str]) -> None:
        """Add the counts of one test; its name is that of pytest, with the parameter in brackets."""
        self.tallies[test] = tally

    def write(self, path: Path, failed: int) -> None:
        """Write the record as JSON.

        Parameters
        ----------
        path : Path
            The file.
        failed : int
            Number of tests that failed.
        """
        commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], cwd=ROOT, capture_output=True, text=True, check=True)
        record = {
            "commit": commit.stdout.strip(),
            "machine": f"{platform.platform()}, {os.cpu_count()} cores",
            "chromium": self.chromium,
            "axe": self.axe,
            "widths_px": [WIDE, NARROW],
            "playwright": importlib.metadata.version("playwright"),
            "failed": failed,
            "tests": {test: dict(sorted(tally.items())) for test, tally in self.tallies.items()},
        }
        path.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


RECORD = BrowserRecord()
