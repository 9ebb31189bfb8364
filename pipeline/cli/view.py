"""`scarpsim view`: show results in 3D on a web page that only this machine can open."""

from __future__ import annotations

import argparse
from pathlib import Path

from pipeline.cli.command_output import CommandOutput
from pipeline.cli.parser import at_least

SUMMARY = "show results in 3D in the browser: wall, differences, blocks, detections, residuals"
EXAMPLE = """  scarpsim view runs/my_run
  scarpsim view runs/my_run runs/other_sensor
  scarpsim view runs/my_run --detections found --port 8123
  scarpsim view diagnosis"""
_PORT = 8050


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `scarpsim view` on its parser."""
    parser.add_argument(
        "folder", type=Path, metavar="FOLDER", help="a run, a result of scarpsim gap or monitor, or a split of a data set"
    )
    parser.add_argument(
        "second",
        type=Path,
        nargs="?",
        metavar="SECOND",
        help="another run of the same wall, to compare with the first by a slider",
    )
    parser.add_argument("--detections", type=Path, metavar="FOLDER", help="result of scarpsim detect on the run")
    parser.add_argument(
        "--port",
        type=at_least(0, at_most=65_535),
        default=_PORT,
        metavar="N",
        help="port of the page; 0: any free port (default: %(default)s)",
    )
    parser.add_argument("--no-browser", action="store_true", help="print the address and open no browser")


def run(arguments: argparse.Namespace) -> CommandOutput:
    """Serve the page that shows results in a browser until it is interrupted."""
    from pipeline.view.server import serve

    serve(arguments.folder, arguments.second, arguments.detections, arguments.port, open_browser=not arguments.no_browser)
    return CommandOutput("the page is closed")
