"""`scarpsim measurement`: build the folder that `gap` reads from raw scans and a reference surface."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.cli.command_output import CommandOutput
from pipeline.cli.parser import add_output_options, at_least, one_of
from scene.common.errors import InputError
from scene.common.lengths import METRES

if TYPE_CHECKING:
    from pipeline.measurement.folder import Interpretation
    from pipeline.measurement.request import Request

FARTHEST_M = 1e8
"""Largest coordinate, m; no coordinate system of a survey exceeds it."""
SUMMARY = "build the folder that gap reads from raw scans and a reference, and say how they were interpreted"
EXAMPLE = """  scarpsim measurement scan.e57 --reference wall.ply --scanner riegl_vz400i --out my_measurement
  scarpsim measurement cloud.laz --cameras cameras.xml --reference scan.laz --out my_measurement
  scarpsim measurement cloud.ply --reference wall.ply --photographs --out my_measurement
  scarpsim measurement scan.laz --reference half --scanner leica_p50 --position 12.1,40.3,2.5 --out my_measurement"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `scarpsim measurement` on its parser."""
    parser.add_argument(
        "scans",
        nargs="+",
        type=Path,
        metavar="SCAN",
        help="raw scan: las, laz, e57, ply, ptx, pts, xyz, csv; several scans are epochs, or scans from several places",
    )
    add_source_arguments(parser)
    parser.add_argument("--out", type=Path, required=True, metavar="FOLDER", help="new folder of the measurement")
    add_output_options(parser)


def add_source_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments that describe raw scans (files, units, columns, instrument) on a command's parser.

    The commands `measurement` and `gap` both take them.
    """
    parser.add_argument(
        "--reference",
        metavar="FILE|half",
        help="the known surface: a mesh, a cloud, another epoch or a DEM; half: one half of the scan itself",
    )
    parser.add_argument("--scanner", metavar="PRESET", help="preset or file of the scanner, such as riegl_vz400i")
    parser.add_argument("--model", type=Path, metavar="FILE", help="sensor model (model.yaml) instead of --scanner")
    parser.add_argument(
        "--position",
        type=comma_separated_numbers(3),
        metavar="X,Y,Z",
        help="position of the scanner in the points' frame, m, if no header gives it; with --photographs any point in front of "
        "the wall",
    )
    parser.add_argument(
        "--unit",
        type=one_of(*METRES),
        metavar="|".join(METRES),
        help="unit of the scan (default: as the file states, otherwise m); us-ft: US survey foot",
    )
    parser.add_argument(
        "--reference-unit", type=one_of(*METRES), metavar="|".join(METRES), help="unit of the reference (default: as for --unit)"
    )
    parser.add_argument(
        "--columns",
        type=comma_separated_words,
        default=[],
        metavar="x,y,z,...",
        help="columns of a text file; - for a column to ignore",
    )
    parser.add_argument(
        "--cameras",
        type=Path,
        metavar="FILE",
        help="cameras of points from photographs: cameras.yaml, Metashape XML or .psx, COLMAP",
    )
    parser.add_argument(
        "--photographs",
        action="store_true",
        help="the points, mesh or DEM are from photographs without known cameras; only the surface is compared",
    )
    parser.add_argument("--pair", type=pair, metavar="LEFT,RIGHT", help="labels of the two cameras in a project")
    parser.add_argument("--scan", type=at_least(1), metavar="N", help="number of the scan to read from a file with several")


def run(arguments: argparse.Namespace) -> CommandOutput:
    """Build a measurement folder, the input of `scarpsim gap`, from raw scans and say how they were interpreted."""
    found = build_measurement_folder(arguments, arguments.scans, arguments.out)
    return CommandOutput(f"{found.summary()}\npicture: {found.folder / 'understood.png'}", found.to_dict)


def build_measurement_folder(arguments: argparse.Namespace, scans: list[Path], out: Path) -> Interpretation:
    """Build a measurement folder, the input of `scarpsim gap`, from raw scans, and return how they were interpreted.

    Parameters
    ----------
    arguments : argparse.Namespace
        Parsed arguments that describe the scans, as `add_source_arguments` declares them.
    scans : list of Path
        Files of the scans.
    out : Path
        The folder to write.
    """
    from pipeline.formats.files.atomic import empty_folder
    from pipeline.measurement.build import build, build_stereo
    from pipeline.measurement.surface import build_surface

    empty_folder(out)
    request = _request(arguments, scans)
    if arguments.scanner and arguments.model:
        raise InputError("the option cannot be combined with --model", where="--scanner", remedy="give only one of them")
    if arguments.cameras and arguments.photographs:
        raise InputError("the option cannot be combined with --cameras", where="--photographs", remedy="leave one of them out")
    if arguments.photographs:
        return build_surface(request, out)
    return build_stereo(request, arguments.cameras, arguments.pair, out) if arguments.cameras else build(request, out)


def _request(arguments: argparse.Namespace, scans: list[Path]) -> Request:
    """Collect the arguments that describe raw scans."""
    from pipeline.measurement.request import Request

    if arguments.reference is None:
        raise InputError(
            "the option is missing",
            where="--reference",
            remedy="give a mesh, a cloud or another epoch, or the word half: half of the points then serve as reference",
        )
    return Request(
        scans,
        arguments.reference,
        arguments.scanner,
        arguments.model,
        arguments.position,
        arguments.unit,
        arguments.reference_unit,
        arguments.columns,
        arguments.scan,
    )


def comma_separated_words(text: str) -> list[str]:
    """Convert the text of an argument to a list of words, which it separates by commas; they become lower case."""
    return [word.strip().lower() for word in text.split(",")]


def pair(text: str) -> tuple[str, str]:
    """Convert the text of an argument to the labels of two cameras, which it separates by a comma."""
    labels = [label.strip() for label in text.split(",")]
    if len(labels) != 2 or not all(labels):
        raise argparse.ArgumentTypeError(f"got '{text}'; allowed: the labels of two cameras, separated by a comma")
    return labels[0], labels[1]


def comma_separated_numbers(count: int) -> Callable[[str], Any]:
    """Return a function that converts the text of an argument to `count` coordinates, which it separates by commas."""

    def check(text: str) -> tuple[float, ...]:
        try:
            found = tuple(float(word) for word in text.split(","))
        except ValueError:
            found = ()
        if len(found) != count or not all(abs(value) <= FARTHEST_M for value in found):
            raise argparse.ArgumentTypeError(f"got '{text}'; allowed: {count} numbers separated by commas, up to {FARTHEST_M:g}")
        return found

    return check
