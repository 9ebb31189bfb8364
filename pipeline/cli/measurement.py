"""`scarpsim measurement`: the folder that `gap` takes, out of raw scans and a surface to compare them with."""

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
"""No coordinate system of a survey reaches farther."""
SUMMARY = "build the folder that gap takes out of raw scans and a reference; say what was understood"
EXAMPLE = """  scarpsim measurement scan.e57 --reference wall.ply --scanner riegl_vz400i --out my_measurement
  scarpsim measurement cloud.laz --cameras cameras.xml --reference scan.laz --out my_measurement
  scarpsim measurement cloud.ply --reference wall.ply --photographs --out my_measurement
  scarpsim measurement scan.laz --reference half --scanner leica_p50 --position 12.1,40.3,2.5 --out my_measurement"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument(
        "scans", nargs="+", type=Path, metavar="SCAN", help="raw scan: las, laz, e57, ply, ptx, pts, xyz, csv; several: epochs"
    )
    add_source_arguments(parser)
    parser.add_argument("--out", type=Path, required=True, metavar="FOLDER", help="new folder of the measurement")
    add_output_options(parser)


def add_source_arguments(parser: argparse.ArgumentParser) -> None:
    """What a raw scan needs beside itself; `gap` takes the same."""
    parser.add_argument(
        "--reference",
        metavar="FILE|half",
        help="the surface as known: a mesh, a cloud, another epoch, a DEM; half: of the scan itself",
    )
    parser.add_argument("--scanner", metavar="PRESET", help="what is believed about the scanner, such as riegl_vz400i, or a file")
    parser.add_argument("--model", type=Path, metavar="FILE", help="a model.yaml instead of --scanner")
    parser.add_argument(
        "--position",
        type=comma_separated_numbers(3),
        metavar="X,Y,Z",
        help="where the scanner stood, m, in the points' frame, if no header says; with --photographs any place before the wall",
    )
    parser.add_argument(
        "--unit",
        type=one_of(*METRES),
        metavar="|".join(METRES),
        help="of the scan (default: as the file states, m where it states none); us-ft: US survey foot",
    )
    parser.add_argument(
        "--reference-unit", type=one_of(*METRES), metavar="|".join(METRES), help="of the reference (default: as for --unit)"
    )
    parser.add_argument(
        "--columns",
        type=comma_separated_words,
        default=[],
        metavar="x,y,z,...",
        help="of a text file; - for one that is left out",
    )
    parser.add_argument(
        "--cameras",
        type=Path,
        metavar="FILE",
        help="the points are from photographs: cameras.yaml, Metashape XML or .psx, COLMAP",
    )
    parser.add_argument(
        "--photographs",
        action="store_true",
        help="the points, mesh or DEM are from photographs whose cameras are not at hand: only the surface is compared",
    )
    parser.add_argument("--pair", type=pair, metavar="LEFT,RIGHT", help="which two cameras of a project")
    parser.add_argument("--scan", type=at_least(1), metavar="N", help="take one scan of a file that holds several")


def run(arguments: argparse.Namespace) -> CommandOutput:
    """Build the measurement folder and say how the inputs were interpreted."""
    found = build_measurement_folder(arguments, arguments.scans, arguments.out)
    return CommandOutput(f"{found.summary()}\npicture: {found.folder / 'understood.png'}", found.to_dict)


def build_measurement_folder(arguments: argparse.Namespace, scans: list[Path], out: Path) -> Interpretation:
    """Build the folder that the arguments ask for."""
    from pipeline.formats.files.atomic import empty_folder
    from pipeline.measurement.build import build, build_stereo
    from pipeline.measurement.surface import build_surface

    empty_folder(out)
    request = _request(arguments, scans)
    if arguments.cameras and arguments.photographs:
        raise InputError("is for a cloud whose cameras are not at hand", where="--photographs", remedy="leave it out")
    if arguments.photographs:
        return build_surface(request, out)
    return build_stereo(request, arguments.cameras, arguments.pair, out) if arguments.cameras else build(request, out)


def _request(arguments: argparse.Namespace, scans: list[Path]) -> Request:
    from pipeline.measurement.request import Request

    if arguments.reference is None:
        remedy = "name a mesh, a cloud or another epoch, or say half"
        raise InputError("is missing", where="--reference", remedy=remedy)
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
    """An argument's type: words between commas."""
    return [word.strip().lower() for word in text.split(",")]


def pair(text: str) -> tuple[str, str]:
    """An argument's type: two labels."""
    labels = [label.strip() for label in text.split(",")]
    if len(labels) != 2 or not all(labels):
        raise argparse.ArgumentTypeError(f"got '{text}'; allowed: two cameras' labels with a comma between")
    return labels[0], labels[1]


def comma_separated_numbers(count: int) -> Callable[[str], Any]:
    """An argument's type: so many coordinates between commas."""

    def check(text: str) -> tuple[float, ...]:
        try:
            found = tuple(float(word) for word in text.split(","))
        except ValueError:
            found = ()
        if len(found) != count or not all(abs(value) <= FARTHEST_M for value in found):
            raise argparse.ArgumentTypeError(f"got '{text}'; allowed: {count} numbers between commas, up to {FARTHEST_M:g}")
        return found

    return check
