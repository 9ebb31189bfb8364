"""`scarpsim icp-study`: find the registration settings that suit a run."""

from __future__ import annotations

import argparse
from pathlib import Path

from pipeline.cli.command_output import CommandOutput, record_document
from pipeline.cli.parser import add_output_options, at_least, one_of
from scene.common.errors import InputError

SUMMARY = "find the ICP settings that recover a run's true transform best"
EXAMPLE = """  scarpsim icp-study runs/my_site
  scarpsim icp-study my_site.yaml --sensor stereo --epochs 2 --offset-m 0.05 --out study"""

MOST_EPOCHS, MOST_REPEATS = 99, 99
"""Limits of the study's size. Each epoch and repeat takes about forty registrations, and more add no information."""
MOST_OFFSET_M = 100.0
"""Largest offset, m. It exceeds the error of any real set-up, and ICP could not correct more."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `scarpsim icp-study` on its parser."""
    parser.add_argument(
        "source",
        type=Path,
        metavar="RUN|CONFIG",
        help="folder of a run, or a config file or bundled site, which is simulated first",
    )
    parser.add_argument(
        "--sensor", type=one_of("stereo", "tls"), metavar="stereo|tls", help="sensor of the config (default: the first)"
    )
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder for the results (default: a new one under runs/)")
    parser.add_argument(
        "--epochs",
        type=at_least(1, at_most=MOST_EPOCHS),
        default=1,
        metavar="N",
        help="number of epochs to register (default: 1)",
    )
    parser.add_argument(
        "--repeats",
        type=at_least(1, at_most=MOST_REPEATS),
        default=3,
        metavar="N",
        help="number of random subsets per sampling ratio (default: 3)",
    )
    parser.add_argument(
        "--offset-m",
        type=float,
        default=0.03,
        metavar="M",
        help="first displace each epoch by a known motion of this size, m (default: 0.03)",
    )
    parser.add_argument("--seed", type=at_least(0), metavar="N", help="seed of all random numbers (default: the config's)")
    parser.add_argument(
        "--set", action="append", default=[], dest="overrides", metavar="KEY=VALUE", help="override a key of the config, as a.b=c"
    )
    add_output_options(parser)


def run(arguments: argparse.Namespace) -> CommandOutput:
    """Find the settings of ICP that register a run's epochs best, and write the report."""
    from pipeline.config.bundled import config_path
    from pipeline.config.simulation import load_config
    from pipeline.formats.files.atomic import empty_folder, new_folder
    from pipeline.icp_study.report import summary, write_icp_study
    from pipeline.icp_study.study import simulated_surfaces, study, surfaces_of_run
    from pipeline.registration.register import IcpConfig
    from pipeline.report.progress import shown_progress
    from scene.common.keyed_random import KeyedRandom

    if not 0 <= arguments.offset_m <= MOST_OFFSET_M:
        raise InputError(
            f"the offset is {arguments.offset_m:g} m",
            where="--offset-m",
            allowed=f"0 to {MOST_OFFSET_M:g} m",
            remedy="give a length in this range",
        )
    out = empty_folder(arguments.out or new_folder(Path("runs"), "icp_study"))
    with shown_progress(quiet=arguments.quiet) as progress:
        if arguments.source.is_dir():
            config, sensor, surfaces = surfaces_of_run(arguments.source, arguments.epochs)
        else:
            config = load_config(config_path("sites", arguments.source), arguments.overrides, arguments.sensor, arguments.seed)
            sensor = arguments.sensor or config.sensor_names()[0]
            surfaces = simulated_surfaces(config, sensor, arguments.epochs, progress)
        settings = {"offset_m": arguments.offset_m, "repeats": arguments.repeats}
        found = study(sensor, surfaces, config.icp or IcpConfig(), KeyedRandom(config.seed), **settings, progress=progress)
    report = write_icp_study(out, found)
    return CommandOutput(f"{summary(found)}\nreport: {report}", record_document(report, "icp_study.json"))
