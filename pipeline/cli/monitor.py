"""`scarpsim monitor`: find what fell between real epochs."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.cli.command_output import CommandOutput, record_document
from pipeline.cli.imports import fast_imports
from pipeline.cli.measurement import comma_separated_numbers, comma_separated_words
from pipeline.cli.parser import add_output_options, at_least, between, one_of
from scene.common.errors import InputError
from scene.common.lengths import METRES

if TYPE_CHECKING:
    from pipeline.monitoring.options import MonitorOptions

SUMMARY = "compare real epochs of a wall: registered maps, level of detection, a list of what fell"
EXAMPLE = """  scarpsim monitor march.laz april.laz --out april
  scarpsim monitor scans/2026-*.laz --stable stable.yaml --scanner riegl_vz400i --workers 2 --out year
  scarpsim monitor reference.laz --follow incoming --out live"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `scarpsim monitor` on its parser."""
    parser.add_argument(
        "epochs",
        nargs="+",
        type=Path,
        metavar="EPOCH",
        help="a scan, cloud, mesh or DEM, a folder of scans of one epoch, a run of simulate or one of its epoch folders; the "
        "first is the reference",
    )
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="new folder for maps, events and report")
    parser.add_argument("--reference", type=Path, metavar="FILE", help="compare with this instead of the first epoch")
    parser.add_argument(
        "--position",
        type=comma_separated_numbers(3),
        metavar="X,Y,Z",
        help="position of the sensor, or any point in front of the wall, in the points' coordinates, m, if no header gives it",
    )
    parser.add_argument(
        "--direction",
        type=comma_separated_numbers(3),
        metavar="X,Y,Z",
        help="measure change along it, towards the sensor (default: mean plane)",
    )
    parser.add_argument(
        "--views",
        type=one_of(*map(str, range(1, 7))),
        metavar="N",
        help="number of parts of the wall with maps of their own (default: as its corners and overhangs need)",
    )
    parser.add_argument("--scanner", metavar="PRESET", help="also predict the level of detection of this scanner")
    parser.add_argument("--model", type=Path, metavar="FILE", help="sensor model (model.yaml) instead of --scanner")
    parser.add_argument("--photographs", action="store_true", help="the epochs are from photographs")
    parser.add_argument("--stable", type=Path, metavar="FILE", help="stable rock: YAML list of boxes or polygons, m")
    parser.add_argument(
        "--targets", type=Path, metavar="FILE", help="targets of each epoch: CSV with the columns epoch, target, x, y, z; m"
    )
    parser.add_argument("--times", type=comma_separated_words, default=[], metavar="T,T,...", help="time of each epoch, ISO 8601")
    parser.add_argument(
        "--gsd", type=between(1e-4, 100.0), metavar="M", help="side of a pixel, m (default: from the points' density)"
    )
    parser.add_argument(
        "--unit",
        type=one_of(*METRES),
        metavar="|".join(METRES),
        help="unit of the epochs (default: as the files state, otherwise m)",
    )
    parser.add_argument(
        "--columns",
        type=comma_separated_words,
        default=[],
        metavar="x,y,z,...",
        help="columns of a text file; - for a column to ignore",
    )
    parser.add_argument(
        "--detector",
        default="none",
        metavar="default|baseline|none|FOLDER",
        help="find events with a detector instead of the level of detection (default: none)",
    )
    parser.add_argument("--workers", type=at_least(1), default=1, metavar="N", help="number of processes (default: 1)")
    parser.add_argument(
        "--follow", type=Path, metavar="FOLDER", help="also process each new file in this folder, until interrupted"
    )
    parser.add_argument("--resume", action="store_true", help="continue an interrupted monitoring in --out")
    parser.add_argument("--write-site", type=Path, metavar="FILE", help="write a config that simulates this site")
    add_output_options(parser)


def run(arguments: argparse.Namespace) -> CommandOutput:
    """Compare the measured epochs of a wall with the first one, and write difference maps, events and report."""
    with fast_imports():
        from pipeline.monitoring.follow import follow
        from pipeline.monitoring.reading import with_reference
        from pipeline.monitoring.report import headline
        from pipeline.monitoring.run import monitor_paths
        from pipeline.monitoring.write_site import write_site
        from pipeline.report.progress import shown_progress

    options = _options(arguments)
    paths = with_reference(arguments.reference, arguments.epochs) if arguments.reference else arguments.epochs
    keys = {"times": arguments.times, "workers": arguments.workers, "resume": arguments.resume}
    with shown_progress(quiet=arguments.quiet or arguments.follow is not None) as progress:
        if arguments.follow:
            result = follow(paths, arguments.follow, arguments.out, options, **keys)
        else:
            result = monitor_paths(paths, arguments.out, options, **keys, progress=progress)
    lines = headline(result)
    if arguments.write_site:
        write_site(result, arguments.write_site)
        lines.append(f"a config of this site: {arguments.write_site}")
    report = arguments.out / "report.html"
    return CommandOutput("\n".join([*lines, f"report: {report}"]), record_document(report, "monitor.json"))


def _options(arguments: argparse.Namespace) -> MonitorOptions:
    """Collect the options of the comparison from the arguments."""
    import numpy as np

    from pipeline.monitoring.options import MonitorOptions, read_areas

    if arguments.photographs and (arguments.scanner or arguments.model):
        raise InputError(
            "the option cannot be combined with --scanner or --model, which describe a laser scanner",
            where="--photographs",
            remedy="give one of them",
        )
    if arguments.scanner and arguments.model:
        raise InputError("the option cannot be combined with --model", where="--scanner", remedy="give only one of them")
    return MonitorOptions(
        position=None if arguments.position is None else np.array(arguments.position),
        direction=None if arguments.direction is None else np.array(arguments.direction),
        views=None if arguments.views is None else int(arguments.views),
        gsd_m=arguments.gsd,
        stable=() if arguments.stable is None else read_areas(arguments.stable),
        targets=arguments.targets,
        unit=arguments.unit,
        columns=tuple(arguments.columns),
        scanner=arguments.scanner,
        model=arguments.model,
        photographs=arguments.photographs,
        detector=arguments.detector,
    )
