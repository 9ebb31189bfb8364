"""`scarpsim simulate`: observe a wall before and after rockfall."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from pipeline.cli.command_output import CommandOutput, record_document
from pipeline.cli.imports import fast_imports
from pipeline.cli.parser import add_output_options, at_least, one_of
from scene.common.errors import InputError

SUMMARY = "simulate how a sensor observes a rock wall before and after rockfall, and map the differences"
EXAMPLE = """  simulate --sensor tls
  simulate --sensor stereo --config my_site.yaml --seed 7 --set rockfall.count=200 --out runs/my_site"""
_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""Environment variables that set the number of threads of the numerical libraries."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `simulate` on its parser."""
    parser.add_argument(
        "--sensor", required=True, type=one_of("stereo", "tls"), metavar="stereo|tls", help="sensor that observes the wall"
    )
    parser.add_argument(
        "--config", type=Path, metavar="FILE", help="config file or bundled site (default: the bundled demo.yaml)"
    )
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder for the results (default: a new one under runs/)")
    parser.add_argument("--seed", type=at_least(0), metavar="N", help="seed of all random numbers (default: the config's)")
    parser.add_argument(
        "--set", action="append", default=[], dest="overrides", metavar="KEY=VALUE", help="override a key of the config, as a.b=c"
    )
    parser.add_argument("--resume", action="store_true", help="continue the interrupted run in the folder --out")
    parser.add_argument(
        "--threads",
        type=at_least(1, at_most=1024),
        metavar="N",
        help="number of threads (default: all); it does not change the results",
    )
    add_output_options(parser)


def run(arguments: argparse.Namespace) -> CommandOutput:
    """Simulate a wall before and after rockfall as a sensor observes it, or continue a simulation, and write the report."""
    if arguments.resume and not arguments.out:
        raise InputError("the option needs the folder of the run to continue", where="--resume", remedy="add --out DIR")
    if arguments.threads:
        _use_threads(arguments.threads)
    with fast_imports():
        from pipeline.config.bundled import bundled_config, config_path
        from pipeline.config.simulation import load_config
        from pipeline.formats.files.atomic import new_folder
        from pipeline.report.progress import shown_progress
        from pipeline.run import simulation as pipeline_run

    out = arguments.out or new_folder(Path("runs"), arguments.sensor)
    path = config_path("sites", arguments.config) if arguments.config else bundled_config("", "demo")
    config = load_config(path, arguments.overrides, arguments.sensor, arguments.seed)
    arguments.kept = f"finished epochs are in {out} and usable; continue with --resume --out {out}"
    with shown_progress(quiet=arguments.quiet) as progress:
        summary = pipeline_run.simulate(config, arguments.sensor, out, resume=arguments.resume, progress=progress)
    told = [*(f"note: {note}" for note in summary.notes), f"report: {summary.report}"]
    return CommandOutput("\n".join(told), record_document(summary.report, "run.json"))


def _use_threads(count: int) -> None:
    """Limit the number of threads of all numerical libraries."""
    for variable in _THREAD_VARIABLES:  # the libraries read them when they are imported
        os.environ[variable] = str(count)
    import cv2

    from scene.common.backend import dr

    cv2.setNumThreads(count)
    dr.set_thread_count(count)
