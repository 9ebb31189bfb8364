"""The runner of the benchmarks: figures are read from what the scripts print, and table and README show the record's."""

from __future__ import annotations

import json
import re
from pathlib import Path

import performance
import pytest

ROOT = Path(__file__).parents[1]
EPOCH = "one epoch                  19.20 s   (target: about 30 s)\nratio                       1.90     (target: at most 5)\n"


def test_figures_are_read_and_what_is_missing_is_none() -> None:
    found = performance.figures(performance.ROWS["epoch_tls"], EPOCH + "peak memory of the epoch    3.90 GB  (target: 4 GB)\n")
    assert found == {"s": 19.2, "ratio": 1.9, "GB": 3.9}
    assert performance.figures(performance.ROWS["epoch_tls"], EPOCH)["GB"] is None


@pytest.mark.parametrize("name", performance.ROWS)
def test_every_figure_is_printed_by_its_script(name: str) -> None:
    """The fixed words of each regular expression stand in the script, so that a renamed line is noticed."""
    row = performance.ROWS[name]
    script = (ROOT / "benchmarks" / row.command.split()[0]).read_text()
    for pattern in row.figures.values():
        words = re.split(r"\\s|\[|\(", pattern)[0]
        assert words in script, (name, words)


def test_the_table_has_machine_commit_load_and_both_caches() -> None:
    values = {"machine": "a processor", "commit": "abc123", "date": "2026-11-27", "load": 0.2}
    record = {"epoch_tls": values | {"empty": {"s": 40.0, "ratio": None}, "filled": {"s": 31.0, "ratio": 2.9}}}
    text = performance.table(record)
    assert "| 31 s, ratio 2.9 | 40 s |" in text
    assert "2026-11-27, abc123, load 0.2, machine 1" in text
    assert "Machine 1: a processor." in text


@pytest.mark.skipif(not performance.RECORD.exists(), reason="`make benchmarks` has not been run since its figures are kept")
def test_page_and_readme_have_the_figures_of_the_record() -> None:
    record = json.loads(performance.RECORD.read_text())
    assert performance.table(record) in performance.PAGE.read_text()
    seconds = [round(record[name]["filled"]["s"]) for name in ("epoch_stereo", "epoch_tls")]
    assert "stereo pair {} s, laser scanner {} s".format(*seconds) in (ROOT / "README.md").read_text()
