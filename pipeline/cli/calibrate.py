"""`scarpsim calibrate`: measure the noise of real epochs and fit the noise parameters of the simulation to it."""

from __future__ import annotations

import argparse
from pathlib import Path

from pipeline.cli.command_output import CommandOutput, record_document
from pipeline.cli.parser import add_output_options, at_least, one_of

SUMMARY = "measure the noise of real epochs and fit the simulation's noise to it"
EXAMPLE = """  scarpsim calibrate my_measurement --out calibration
  scarpsim calibrate maps/*.tif --sensor stereo --config my_site.yaml --set calibration.stable_areas=[[10,5,15,10]]
  simulate --sensor stereo --config my_site.yaml --set sensor=calibration/calibrated.yaml"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `scarpsim calibrate` on its parser."""
    parser.add_argument(
        "measured",
        type=Path,
        nargs="+",
        metavar="MEASUREMENT|MAPS",
        help="a folder with measurement.yaml, a folder of difference maps (also a run), or difference maps (GeoTIFF)",
    )
    parser.add_argument(
        "--config", type=Path, metavar="FILE", help="config of the site (default: the run's, otherwise demo.yaml)"
    )
    parser.add_argument(
        "--sensor", type=one_of("stereo", "tls"), metavar="stereo|tls", help="sensor that measured (default: as the inputs say)"
    )
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder for the results (default: a new one under runs/)")
    parser.add_argument("--seed", type=at_least(0), metavar="N", help="seed of the simulations (default: the config's)")
    parser.add_argument(
        "--set", action="append", default=[], dest="overrides", metavar="KEY=VALUE", help="override a key of the config, as a.b=c"
    )
    parser.add_argument(
        "--no-greedy", action="store_true", help="skip the greedy search of the thesis, which is only for comparison"
    )
    add_output_options(parser)


def run(arguments: argparse.Namespace) -> CommandOutput:
    """Fit the noise of a sensor model to measured epochs and write the report."""
    from pipeline.calibration.calibrate import calibrate
    from pipeline.calibration.inputs import config_of, sensor_of
    from pipeline.calibration.report import summary
    from pipeline.calibration.write import RECORD_FILE, write
    from pipeline.config.bundled import bundled_config, config_path
    from pipeline.config.simulation import load_config
    from pipeline.formats.files.atomic import empty_folder, new_folder
    from pipeline.report.progress import shown_progress

    given = config_path("sites", arguments.config) if arguments.config else config_of(arguments.measured)
    out = empty_folder(arguments.out or new_folder(Path("runs"), "calibrate"))
    path = given or bundled_config("", "demo")
    config = load_config(path, arguments.overrides, arguments.sensor, arguments.seed)
    sensor = sensor_of(arguments.measured, config, arguments.sensor)
    with shown_progress(quiet=arguments.quiet) as progress:
        progress.plan({"report": 5.0})
        result = calibrate(config, sensor, arguments.measured, progress, with_greedy=not arguments.no_greedy)
        with progress.stage("report"):
            report = write(out, config, result, arguments.measured)
    return CommandOutput(f"{summary(result)}\nreport: {report}", record_document(report, RECORD_FILE))
