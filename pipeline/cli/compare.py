"""`scarpsim compare`: simulate several sensors on the same wall with the same blocks."""

from __future__ import annotations

import argparse
from pathlib import Path

from pipeline.cli.command_output import CommandOutput, record_document
from pipeline.cli.parser import add_output_options, at_least, between, one_of

SUMMARY = "compare sensors on one wall and the same blocks: noise, level of detection, smallest block, completeness"
EXAMPLE = """  scarpsim compare my_site.yaml
  scarpsim compare my_site.yaml riegl_vz400i glendale_high --epochs 8 --sizes-m 0.05 0.5 --measured my_epochs --out comparison"""

MOST_EPOCHS = 999
"""Largest number of epochs to simulate."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `scarpsim compare` on its parser."""
    parser.add_argument(
        "configs",
        nargs="+",
        metavar="CONFIG",
        help="config file, run folder, sensor model file, or name of a bundled site, scanner or noise model; all sensors use the "
        "wall and the blocks of the first config",
    )
    parser.add_argument("--measured", type=Path, nargs="+", default=[], metavar="FOLDER", help="measured epochs to compare with")
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder for the results (default: a new one under runs/)")
    parser.add_argument(
        "--epochs",
        type=at_least(1, at_most=MOST_EPOCHS),
        default=6,
        metavar="N",
        help="number of epochs with rockfall (default: 6)",
    )
    parser.add_argument(
        "--blocks",
        type=one_of("sweep", "config"),
        default="sweep",
        help="sweep: blocks that grow from epoch to epoch; config: the config's blocks (default: sweep)",
    )
    parser.add_argument(
        "--sizes-m",
        type=between(0.001, 1000.0),
        nargs=2,
        default=(0.05, 0.8),
        metavar=("FIRST", "LAST"),
        help="block size of the sweep in the first and the last epoch, m (default: 0.05 0.8)",
    )
    parser.add_argument("--seed", type=at_least(0), metavar="N", help="seed of all random numbers (default: the first config's)")
    parser.add_argument(
        "--own-step",
        action="store_true",
        help="let each scanner preset use its own angular step (default: all use the step of the first config)",
    )
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        dest="overrides",
        metavar="KEY=VALUE",
        help="override a key of every config, as a.b=c",
    )
    add_output_options(parser)


def run(arguments: argparse.Namespace) -> CommandOutput:
    """Simulate and compare several sensors on the same wall and write the report."""
    from pipeline.comparison.comparison import compare_sensors
    from pipeline.comparison.report import COMPARISON_FILE, summary, write_comparison
    from pipeline.comparison.sensor_setups import sensor_setups
    from pipeline.formats.files.atomic import empty_folder, new_folder
    from pipeline.report.progress import shown_progress

    sensors = sensor_setups(arguments.configs, arguments.overrides, arguments.seed, own_step=arguments.own_step)
    out = empty_folder(arguments.out or new_folder(Path("runs"), "compare"))
    sizes = tuple(arguments.sizes_m) if arguments.blocks == "sweep" else None
    with shown_progress(quiet=arguments.quiet) as progress:
        progress.plan({"report": 6.0})
        comparison = compare_sensors(sensors, arguments.measured, arguments.epochs, sizes, progress)
        with progress.stage("report"):
            report = write_comparison(out, comparison)
    return CommandOutput(f"{summary(comparison)}\nreport: {report}", record_document(report, COMPARISON_FILE))
