"""`scarpsim gap`: where simulation and measurement disagree, what explains it, and the model with that in it."""

from __future__ import annotations

import argparse
from pathlib import Path

from pipeline.cli.parser import at_least

SUMMARY = "find where a measurement and the model disagree, name the effect, add it, show the gap shrink"
EXAMPLE = """  scarpsim gap my_measurement --out diagnosis
  scarpsim gap my_measurement --identifiability"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("measurement", type=Path, metavar="MEASUREMENT", help="folder with measurement.yaml")
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder for the results (default: a new one under runs/)")
    parser.add_argument("--seed", type=at_least(0), default=1, metavar="N", help="seed of the null distributions (default: 1)")
    parser.add_argument(
        "--identifiability", action="store_true", help="only say what this geometry can tell apart; looks at no residual"
    )


def run(arguments: argparse.Namespace) -> int:
    from pipeline.cli.simulate import new_folder
    from pipeline.gap.identifiability import identifiability, table
    from pipeline.gap.measurement import read_measurement
    from pipeline.gap.report import summary, write
    from pipeline.gap.workflow import diagnose

    measurement = read_measurement(arguments.measurement)
    if arguments.identifiability:
        print(table(identifiability(measurement)))
        return 0
    found = diagnose(measurement, arguments.seed)
    report = write(arguments.out or new_folder(Path("runs"), "gap"), found, measurement)
    print(f"{summary(found)}\nreport: {report}")
    return 0
