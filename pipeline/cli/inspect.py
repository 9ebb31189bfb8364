"""`scarpsim inspect`: predict what a planned set-up achieves, before anything is simulated."""

from __future__ import annotations

import argparse
from pathlib import Path

from pipeline.cli.command_output import CommandOutput, record_document
from pipeline.cli.imports import fast_imports
from pipeline.cli.parser import add_output_options, at_least, one_of

SUMMARY = "map what a planned set-up achieves: precision, spacing, blind spots, smallest block"
EXAMPLE = """  scarpsim inspect my_site.yaml
  scarpsim inspect my_series.yaml --series
  scarpsim inspect my_site.yaml --sensor tls --set station.distance_m=100 --set planning.block_size_m=[0.2] --out plans/100m"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `scarpsim inspect` on its parser."""
    parser.add_argument(
        "config",
        type=Path,
        metavar="CONFIG",
        help="config file as `scarpsim init` writes it, or a bundled site, such as glendale",
    )
    parser.add_argument(
        "--sensor", type=one_of("stereo", "tls"), metavar="stereo|tls", help="sensor to inspect (default: all of the config)"
    )
    parser.add_argument(
        "--series",
        action="store_true",
        help="also predict what the config's series shows: smallest rockfall and lead times, by trial epochs (minutes)",
    )
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder for maps and report (default: a new one under runs/)")
    parser.add_argument("--seed", type=at_least(0), metavar="N", help="seed of a procedural wall (default: the config's)")
    parser.add_argument(
        "--set", action="append", default=[], dest="overrides", metavar="KEY=VALUE", help="override a key of the config, as a.b=c"
    )
    add_output_options(parser)


def run(arguments: argparse.Namespace) -> CommandOutput:
    """Predict what a set-up of sensors can see (precision, point spacing, smallest block) as maps, and write the report."""
    with fast_imports():
        from pipeline.config.bundled import config_path
        from pipeline.config.simulation import load_config
        from pipeline.formats.files.atomic import empty_folder, new_folder
        from pipeline.planning.inspect import PLAN_FILE, inspect, write_plans
        from pipeline.planning.report import summary
        from pipeline.planning.series import plan_series
        from pipeline.planning.series_report import series_summary
        from pipeline.report.progress import shown_progress

    config = load_config(config_path("sites", arguments.config), arguments.overrides, arguments.sensor, arguments.seed)
    sensors = [arguments.sensor] if arguments.sensor else config.sensor_names()
    out = empty_folder(arguments.out or new_folder(Path("runs"), "inspect"))
    with shown_progress(quiet=arguments.quiet) as progress:
        progress.plan({"report": 6.0})
        series = [plan_series(config, sensor, progress) for sensor in sensors] if arguments.series else []
        plans = inspect(config, sensors, progress)
        with progress.stage("report"):
            report = write_plans(out, config, plans, series)
    told = [*(summary(plan) for plan in plans), *(series_summary(plan) for plan in series), f"report: {report}"]
    return CommandOutput("\n\n".join(told), record_document(report, PLAN_FILE))
