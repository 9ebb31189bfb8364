"""Run the benchmarks of docs/validation/performance.md, keep their figures, and write the table of that page.

    python benchmarks/performance.py                        all rows, about an hour on two quiet cores
    python benchmarks/performance.py --only tls epoch_tls   some rows; the others keep their figures
    python benchmarks/performance.py --page                 the table from the figures that are kept

Each benchmark runs twice, with an empty cache of compiled kernels and with the one that the first run filled. The figures are
kept in docs/validation/performance.json, each row with machine, load, commit and date. The README takes its times from there.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import platform
import re
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from documents import write_between
from measure import empty_kernel_cache

ROOT = Path(__file__).parents[1]
RECORD, PAGE = (ROOT / "docs" / "validation" / f"performance.{kind}" for kind in ("json", "md"))
MARKS = "<!-- performance -->", "<!-- end of performance -->"
_NUMBER = r"\s+([\d.]+)"


@dataclass(frozen=True)
class Row:
    """A row of the table.

    what: what is measured; command: words after `python benchmarks/`; figures: name with unit of each figure, and the regular
    expression that finds it in what the command prints; aim: what each figure should be.
    """

    what: str
    command: str
    figures: dict[str, str]
    aim: str


RATIO, MEMORY = {"ratio": rf"ratio{_NUMBER}"}, {"GB": rf"peak memory[a-z ]*{_NUMBER} GB"}
ICP = {
    "of Open3D's time": r"ours, default\s+[\d.]+\s+[\d.]+\s+([\d.]+)",
    "of it (points shuffled)": r"ours, points shuffled\s+[\d.]+\s+[\d.]+\s+([\d.]+)",
    "GB": rf"peak memory{_NUMBER} GB",
}
ROWS = {
    "tls": Row(
        "laser scan: 5 million pulses on 1.3 million triangles, with noise",
        "tls.py",
        {"of the bare ray rate": rf"share of the bare rate{_NUMBER}", "x Open3D's rate": rf"rate over Open3D's{_NUMBER}"}
        | MEMORY,
        "at least 0.5 and 1",
    ),
    "tls_beam": Row(
        "laser scan with a wide beam: 1 million pulses of 19 sub-rays",
        "tls_beam.py",
        {
            "of the bare rate, the sub-rays of a pulse side by side": rf"share of the bare rate, beam{_NUMBER}",
            "of the bare rate, one sub-ray of all pulses after the other": rf"over the bare rate, set by set{_NUMBER}",
        }
        | MEMORY,
        "at least 0.5 and 0.75",
    ),
    "startup": Row(
        "start of `simulate` until it builds the wall",
        "startup.py",
        {"s": rf"until it builds the wall[:]{_NUMBER} s", "s of processor time": r"until it builds the wall[^(]+\(([\d.]+) s"},
        "at most 0.8 s",
    ),
    "tls_process": Row(
        "mesh file to LAS file as one process: 2.8 million pulses on 1.3 million triangles, one ray each",
        "tls_process.py --sub-rays 1",
        {"s": rf"process from PLY to LAS{_NUMBER} s", "s of processor time": rf"CPU time of all threads{_NUMBER} s"}
        | {"M pulses/s": rf"observation, pulses/s{_NUMBER} M", "GiB": rf"peak memory{_NUMBER} GiB"},
        "at most 3.5 s, at least 4 M pulses/s, at most 1.5 GiB",
    ),
    "tls_process_beam": Row(
        "the same with 19 sub-rays, the scene on which HELIOS++ was measured",
        "tls_process.py --sub-rays 19",
        {"s": rf"process from PLY to LAS{_NUMBER} s", "s of processor time": rf"CPU time of all threads{_NUMBER} s"}
        | {"M pulses/s": rf"observation, pulses/s{_NUMBER} M", "GiB": rf"peak memory{_NUMBER} GiB"},
        "at most 8 s, at least 0.5 M pulses/s, at most 1.5 GiB",
    ),
    "demo": Row(
        "the demo, stereo pair and laser scanner",
        "processes.py --only demo",
        {"s (stereo pair)": rf"demo stereo{_NUMBER} s", "s (laser scanner)": rf"demo tls{_NUMBER} s"},
        "at most 60 s",
    ),
    "surface": Row(
        "surface from 45,000 points",
        "processes.py --only surface",
        {"s": rf"surface{_NUMBER} s", "s of processor time": r"surface[^,]+, processor\s+([\d.]+) s"},
        "at most 1 s",
    ),
    "detect": Row(
        "`detect default` on maps of 2,385 x 482 px and of 1,790 x 1,790 px",
        "processes.py --only detect",
        {"s (smaller map)": rf"detect smaller{_NUMBER} s", "s (larger map)": rf"detect larger{_NUMBER} s"}
        | {"GB": r"detect larger[^G]+,\s+([\d.]+) GB"},
        "at most 15 s and 30 s",
    ),
    "laz": Row(
        "LAZ file of 3 million points with three extra dimensions",
        "laz.py",
        {"x laspy's writing rate": rf"writing rate over laspy's{_NUMBER}", "M points/s read": rf"reading rate{_NUMBER}"} | MEMORY,
        "at least 1 and 1",
    ),
    "stereo": Row("stereo pair of medium quality, same wall", "stereo.py", RATIO | MEMORY, "ratio to the bare casts at most 3"),
    "sgbm": Row(
        "stereo pair with rendered pictures matched by SGBM",
        "sgbm.py",
        RATIO | MEMORY,
        "ratio to render and matcher at most 1.5; 8 GB",
    ),
    "carve": Row("carving 1,500 blocks out of 2.5 million triangles", "carve.py", RATIO, "ratio to one bare boolean at most 2"),
    "carve_large": Row(
        "the same out of 16 million triangles", "carve.py --large", {"GB": r"carve\s+[\d.]+\s+([\d.]+)"}, "at most 6 GB"
    ),
    "difference": Row("memory of a difference map of 3500 x 1500 px", "difference.py", MEMORY, "no aim"),
    "icp": Row("registration (ICP) of 1 million points", "icp.py", ICP, "at most half of Open3D's time"),
    "epoch_stereo": Row(
        "stereo epoch of Glendale with 1,500 blocks and all products",
        "epoch.py",
        {"s": rf"one epoch{_NUMBER} s"} | RATIO | MEMORY,
        "about 30 s, ratio at most 5, 4 GB",
    ),
    "epoch_tls": Row(
        "the same epoch with a laser scan of 6.4 million pulses",
        "epoch.py tls",
        {"s": rf"one epoch{_NUMBER} s"} | RATIO | MEMORY,
        "about 30 s, ratio at most 5, 4 GB",
    ),
    "gap_tls": Row(
        "`gap`, about 1 million ranges",
        "gap.py tls",
        {"s": rf"all steps, [\d,]+ points{_NUMBER} s"} | MEMORY,
        "60 s, 4 GB",
    ),
    "gap_stereo": Row(
        "`gap`, about 1 million disparities",
        "gap.py stereo",
        {"s": rf"all steps, [\d,]+ points{_NUMBER} s"} | MEMORY,
        "60 s, 4 GB",
    ),
}
"""The rows by name. A benchmark that empties the cache itself, as gap.py does, prints each figure twice; the last one counts."""


def figures(row: Row, text: str) -> dict[str, float | None]:
    """Return the row's figures in what its command printed; None for one that is not there."""
    found = {name: re.findall(pattern, text) for name, pattern in row.figures.items()}
    return {name: float(values[-1]) if values else None for name, values in found.items()}


def machine() -> str:
    """Return processor, cores and memory of this machine in words."""
    information = Path("/proc/cpuinfo").read_text(encoding="utf-8") if Path("/proc/cpuinfo").exists() else ""
    name = re.search(r"model name\s*:\s*(.+)", information)
    gigabytes = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9
    return f"{name[1] if name else platform.machine()}, {os.cpu_count()} cores, {gigabytes:.0f} GB"


def measured(row: Row) -> dict[str, Any]:
    """Run a row's benchmark with the empty and with the filled kernel cache; return its figures, with where and when."""
    script, *words = row.command.split()
    command = [sys.executable, str(ROOT / "benchmarks" / script), *words]
    found: dict[str, Any] = {"load": round(os.getloadavg()[0], 1)}
    with empty_kernel_cache() as environment:
        for cache in ("empty", "filled"):
            done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
            found[cache] = figures(row, done.stdout)
    revision = subprocess.run(["git", "rev-parse", "--short", "HEAD"], cwd=ROOT, capture_output=True, text=True, check=False)
    when = datetime.datetime.now(tz=datetime.UTC).date().isoformat()
    return found | {"machine": machine(), "commit": revision.stdout.strip(), "date": when}


def table(record: dict[str, Any]) -> str:
    """Return the table of the rows that have figures, and the machines on which they were measured."""
    lines = ["| what | filled kernel cache | empty | aim | command | measured |", "|---|---|---|---|---|---|"]
    machines = list(dict.fromkeys(each["machine"] for each in record.values()))
    for name, row in ROWS.items():
        if found := record.get(name):
            filled, empty = (_words(found[cache]) for cache in ("filled", "empty"))
            where = f"{found['date']}, {found['commit']}, load {found['load']}, machine {machines.index(found['machine']) + 1}"
            lines.append(f"| {row.what} | {filled} | {empty} | {row.aim} | `benchmarks/{row.command}` | {where} |")
    places = [f"Machine {number}: {each}." for number, each in enumerate(machines, 1)]
    return "\n".join([*lines, "", " ".join(places), "", "This table is written by `python benchmarks/performance.py`."])


def _words(values: dict[str, float | None]) -> str:
    """Return figures with their units."""
    return ", ".join(f"{name} {value:g}" if name == "ratio" else f"{value:g} {name}" for name, value in values.items() if value)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=list(ROWS), default=list(ROWS))
    parser.add_argument("--page", action="store_true", help="measure nothing")
    given = parser.parse_args()
    record = json.loads(RECORD.read_text(encoding="utf-8")) if RECORD.exists() else {}
    for name in [] if given.page else given.only:
        print(f"== {ROWS[name].command}", flush=True)
        record[name] = measured(ROWS[name])
        print(_words(record[name]["filled"]), flush=True)
        RECORD.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    if record:
        write_between(PAGE, MARKS, table(record))


if __name__ == "__main__":
    main()
