"""`scarpsim gap`: find where simulation and measurement disagree, and name the effects that explain it.

The command also writes the improved model.
"""

from __future__ import annotations

import argparse
from contextlib import ExitStack
from pathlib import Path

from pipeline.cli.command_output import CommandOutput, record_document
from pipeline.cli.measurement import add_source_arguments, build_measurement_folder
from pipeline.cli.parser import add_output_options, at_least, between, one_of
from scene.common.errors import InputError

SUMMARY = "find where a measurement and the model disagree, name the effects, add them, measure the gap again"
EXAMPLE = """  scarpsim gap my_measurement --out diagnosis
  scarpsim gap scan.laz --reference wall.ply --scanner riegl_vz400i --out diagnosis
  scarpsim gap cloud.ply --reference wall.ply --photographs --out diagnosis
  scarpsim gap monitored --scanner riegl_vz400i --out diagnosis
  scarpsim gap --identifiability my_site.yaml --sensor tls --out plans/gap"""


_SOURCE_OPTIONS = (
    "reference", "scanner", "model", "position", "unit", "reference_unit", "columns", "cameras", "photographs", "pair", "scan"
)  # fmt: skip
"""Names of the options that describe raw scans."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `scarpsim gap` on its parser."""
    parser.add_argument(
        "measurement",
        nargs="+",
        type=Path,
        metavar="MEASUREMENT",
        help="folder with measurement.yaml, folder that monitor wrote (its stable rock is diagnosed), or raw scans with "
        "--reference and --scanner; with --identifiability also the config of a simulation instead",
    )
    add_source_arguments(parser)
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder for the results (default: a new one under runs/)")
    parser.add_argument(
        "--seed", type=at_least(0), default=1, metavar="N", help="seed of the simulated null distributions (default: 1)"
    )
    parser.add_argument(
        "--identifiability",
        action="store_true",
        help="only say which effects this geometry can tell apart, without using residuals",
    )
    parser.add_argument(
        "--sensor", type=one_of("stereo", "tls"), metavar="stereo|tls", help="with --identifiability: sensor of the config"
    )
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        dest="overrides",
        metavar="KEY=VALUE",
        help="change a threshold of the diagnosis, as mean.class_margin=4 (gap.json lists them under decisions); with "
        "--identifiability override a key of the config",
    )
    parser.add_argument(
        "--reference-error",
        type=between(0.0, 100.0),
        metavar="M",
        help="standard error of the reference surface, m, correlated over metres: largest one that the diagnosis may assume "
        "(default: estimated), or with --identifiability the one to expect (default: 0.001 tls, 0.005 stereo)",
    )
    add_output_options(parser)


def run(arguments: argparse.Namespace) -> CommandOutput:
    """Diagnose where a measurement and its sensor model disagree, and write the report.

    With --identifiability, predict instead which effects a planned measurement could show.
    """
    from pipeline.formats.files.atomic import check_place, new_folder

    out = arguments.out or new_folder(Path("runs"), "gap")
    check_place(out)
    if (out / "measurement.yaml").exists():
        raise InputError(
            "the folder is a measurement, whose files the results would join",
            where=f"--out {out}",
            remedy="name another folder for the results",
        )
    if arguments.sensor and not arguments.identifiability:
        raise InputError("the option is for --identifiability only", where="--sensor", remedy="leave the option out")
    return _identifiability(arguments, out) if arguments.identifiability else _diagnosis(arguments, out)


def _measurement_folder(arguments: argparse.Namespace, out: Path) -> Path:
    """Return the folder to read; if raw scans are given, build it first in the folder of the results."""
    given: list[Path] = arguments.measurement
    if _of_monitor(given):
        return _folder_of_monitoring(arguments, given[0], out / "measurement")
    if len(given) == 1 and not given[0].suffix and not given[0].exists():
        return given[0]  # its reader says that there is no such folder
    if len(given) == 1 and (given[0].is_dir() or given[0].suffix in (".yaml", ".yml")):
        _check_options(arguments, _SOURCE_OPTIONS, "the folder of a measurement, which knows its files and its instrument")
        return given[0]
    folders = [path for path in given if path.is_dir()]
    if folders:
        raise InputError(
            f"a folder can only be given alone, but there are {len(given)} inputs",
            where=str(folders[0]),
            remedy="diagnose one folder at a time, or give raw scans only",
        )
    if not arguments.reference:
        raise InputError(
            "this is a raw file, and no reference is given to compare it with",
            where=str(given[0]),
            remedy="add --reference (a mesh, a cloud or the word half) and --scanner, or --photographs for a cloud from "
            "photographs without cameras; or give the folder of a measurement",
        )
    return build_measurement_folder(arguments, given, out / "measurement").folder


def _of_monitor(given: list[Path]) -> bool:
    """Return whether the argument is a folder of results of `scarpsim monitor`."""
    from pipeline.monitoring.recorded import is_monitoring

    return len(given) == 1 and is_monitoring(given[0])


def _folder_of_monitoring(arguments: argparse.Namespace, given: Path, out: Path) -> Path:
    """Build the measurement of the stable rock of a monitoring, and return its folder."""
    from pipeline.formats.files.atomic import empty_folder
    from pipeline.monitoring.stable_measurement import build_from_monitoring

    allowed = {"scanner", "model", "position"}
    known = "a folder of scarpsim monitor, which knows its files; allowed are --scanner, --model and --position"
    _check_options(arguments, tuple(name for name in _SOURCE_OPTIONS if name not in allowed), known)
    empty_folder(out)
    found = build_from_monitoring(given, out, scanner=arguments.scanner, model=arguments.model, position=arguments.position)
    return found.folder


def _check_options(arguments: argparse.Namespace, names: tuple[str, ...], known: str) -> None:
    """Raise InputError if one of some options is given. known: the input that makes them meaningless."""
    for name in names:
        if getattr(arguments, name):
            raise InputError(
                f"the option cannot be combined with {known}",
                where=f"--{name.replace('_', '-')}",
                remedy="leave the option out, or give the raw scans instead of the folder",
            )


def _diagnosis(arguments: argparse.Namespace, out: Path) -> CommandOutput:
    """Diagnose a measurement and write the report."""
    from pipeline.formats.measurements.measurement import read_measurement
    from pipeline.gap.naming.workflow import STEPS, diagnose
    from pipeline.gap.report.report import summarise, write_report
    from pipeline.gap.thresholds import read_thresholds
    from pipeline.report.progress import shown_progress

    known = arguments.reference_error
    thresholds = read_thresholds([*arguments.overrides, *([f"mean.most_reference_error={known}"] if known else [])])
    weights = {**STEPS, "report": 2.0}
    steps = iter(weights)
    with shown_progress(quiet=arguments.quiet) as progress, ExitStack() as stage:

        def begin_next(_done: str = "") -> None:
            stage.close()
            stage.enter_context(progress.stage(next(steps)))

        progress.plan(weights)
        begin_next()
        measurement = read_measurement(_measurement_folder(arguments, out))
        found = diagnose(measurement, arguments.seed, begin_next, thresholds)
        report = write_report(out, found, measurement)
    return CommandOutput(f"{summarise(found)}\nreport: {report}", record_document(report, "gap.json"))


def _identifiability(arguments: argparse.Namespace, out: Path) -> CommandOutput:
    """Report which effects the geometry of a measurement or config can tell apart."""
    from pipeline.gap.report.identifiability_report import summarise, write_identifiability
    from pipeline.gap.survey.identifiability import format_table, identifiability
    from pipeline.gap.survey.load_surveys import load_surveys

    if len(arguments.measurement) > 1:
        raise InputError(
            f"the option takes one input, but got {len(arguments.measurement)}",
            where="--identifiability",
            allowed="one",
            remedy="give one measurement or config",
        )
    given = arguments.measurement[0]
    if given.is_file() and given.suffix.lower() not in (".yaml", ".yml", ".json"):
        raise InputError(
            "the file is neither a config nor a measurement",
            where=f"--identifiability {given}",
            allowed="a folder with measurement.yaml, a folder of monitor, or a config (.yaml, .json)",
            remedy="build the folder first with scarpsim measurement SCAN --reference FILE --scanner PRESET --out FOLDER",
        )
    if _of_monitor([given]):
        given = _folder_of_monitoring(arguments, given, out / "measurement")
    wanted = load_surveys(given, arguments.overrides, arguments.sensor)
    found = [identifiability(survey, arguments.reference_error) for survey in wanted]
    report = write_identifiability(out, found)
    told = "\n\n".join(f"{summarise(each)}\n{format_table(each)}" for each in found)
    return CommandOutput(f"{told}\nreport: {report}", record_document(report, "identifiability.json"))
