"""`scarpsim export`: write results in the formats of other programs."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from pipeline.cli.command_output import CommandOutput
from pipeline.cli.parser import add_output_options, at_least, between, one_of
from scene.common.errors import InputError

SUMMARY = "export pictures, animations, glTF, COPC, data sets for YOLO or Hugging Face, and checksums of results"
EXAMPLE = """  scarpsim export runs/my_run picture --epoch 1 --out wall.png
  scarpsim export runs/my_run gltf --out wall.glb
  scarpsim export runs/my_run epochs --out epochs.gif
  scarpsim export runs/my_run copc --out wall.copc.laz
  scarpsim export sets/small yolo --out sets/small_yolo
  scarpsim export sets/small huggingface --out sets/small_hf
  scarpsim export runs/my_run package"""
_SUFFIXES = {"picture": ".png", "gltf": ".glb", "epochs": ".gif", "scan": ".gif", "copc": ".copc.laz"}
"""Forms in which a run is exported, with the file name's ending."""
_SETS = ("yolo", "huggingface")
FORMS = (*_SUFFIXES, *_SETS, "package")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `scarpsim export` on its parser."""
    sets = " and ".join(_SETS)
    parser.add_argument("folder", type=Path, metavar="FOLDER", help=f"a run; for {sets} a data set; for package any result")
    parser.add_argument(
        "form",
        type=one_of(*FORMS),
        metavar="FORM",
        help="picture: the wall in 3D (PNG); gltf: wall and niches coloured by the difference (.glb); "
        "epochs, scan: animated GIF "
        "of the epochs, or of a laser scan in progress; copc: points as cloud-optimised LAZ (QGIS, web); yolo: data set for "
        "YOLO; huggingface: data set as Parquet files for load_dataset and the Hub; package: datapackage.json with checksums",
    )
    parser.add_argument(
        "--out", type=Path, metavar="PATH", help=f"file to write, or folder for {sets} (default: next to FOLDER or inside it)"
    )
    parser.add_argument(
        "--epoch", type=at_least(0, at_most=9999), metavar="N", help="picture, gltf, scan, copc: the epoch (default: 1)"
    )
    parser.add_argument(
        "--width", type=at_least(320, at_most=4000), metavar="PX", help="picture: width in pixels (default: 1280)"
    )
    parser.add_argument(
        "--limit-m",
        type=between(1e-4, 100),
        metavar="M",
        help="yolo: difference shown as black or white, m (default: 6 sigma)",
    )
    add_output_options(parser)


def run(arguments: argparse.Namespace) -> CommandOutput:
    """Export a run, a data set or a result to the format asked for (glTF, YOLO, a picture, ...)."""
    form = arguments.form
    _check_options(arguments)
    if form in _SETS:
        return _export_data_set(arguments)
    if form == "package":
        from pipeline.export.package import PACKAGE_FILE, save_package

        path = arguments.out or arguments.folder / PACKAGE_FILE
        count = save_package(arguments.folder, path)
        return CommandOutput(f"{count:,} files: {path}", lambda: {"file": str(path), "files": count})
    return _export_run(arguments)


def _check_options(arguments: argparse.Namespace) -> None:
    """Raise InputError for an option that does not belong to the form, or a file name with another ending."""
    allowed = {"epoch": ("picture", "gltf", "scan", "copc"), "width": ("picture",), "limit_m": ("yolo",)}
    for option, forms in allowed.items():
        if getattr(arguments, option) is not None and arguments.form not in forms:
            raise InputError(
                f"the option works only with {', '.join(forms)}",
                where=f"--{option.replace('_', '-')}",
                remedy="leave the option out",
            )
    suffix = _SUFFIXES.get(arguments.form)
    if suffix and arguments.out is not None and not arguments.out.name.lower().endswith(suffix):
        raise InputError(
            f"the file name '{arguments.out.name}' has another ending",
            where="--out",
            allowed=suffix,
            remedy="choose a file name with this ending",
        )


def _export_data_set(arguments: argparse.Namespace) -> CommandOutput:
    """Export a data set for YOLO or Hugging Face."""
    from pipeline.formats.files.atomic import empty_folder
    from pipeline.report.progress import shown_progress

    form = arguments.form
    out = empty_folder(arguments.out or arguments.folder.with_name(f"{arguments.folder.resolve().name}_{form}"))
    with shown_progress(quiet=arguments.quiet) as progress:
        if form == "yolo":
            from pipeline.export import yolo

            made = yolo.save_yolo(arguments.folder, out, arguments.limit_m, progress)
            return CommandOutput(yolo.summary(made), lambda: yolo.to_dict(made))
        from pipeline.export import huggingface

        written = huggingface.save_huggingface(arguments.folder, out, progress)
        return CommandOutput(huggingface.summary(written), lambda: huggingface.to_dict(written))


def _export_run(arguments: argparse.Namespace) -> CommandOutput:
    """Export an epoch, or all epochs, of a run."""
    from pipeline.export.exported_run import ExportedRun
    from pipeline.report.progress import shown_progress

    run, form, number = ExportedRun(arguments.folder), arguments.form, 1 if arguments.epoch is None else arguments.epoch
    if number > run.last or (number == 0 and form == "gltf"):
        raise InputError(
            f"there is no epoch {number}",
            where="--epoch",
            allowed=f"{int(form == 'gltf')} to {run.last}",
            remedy="choose one of these epochs",
        )
    path = arguments.out or arguments.folder / f"{form}{'' if form == 'epochs' else f'_{number:03d}'}{_SUFFIXES[form]}"
    with shown_progress(quiet=arguments.quiet) as progress:
        _save(form, run, number, path, arguments.width or 1280, progress)
    return CommandOutput(str(path), lambda: {"file": str(path), "bytes": path.stat().st_size})


def _save(form: str, run: Any, number: int, path: Path, width: int, progress: Any) -> None:
    """Write one form of a run to a file."""
    if form == "gltf":
        from pipeline.export.gltf import save_gltf

        with progress.stage("surface"):
            save_gltf(run, number, path)
        return
    if form == "copc":
        from pipeline.formats.points.laz import LazHeader
        from pipeline.run.clouds import write_cloud

        with progress.stage("points"):
            cloud, wkt = run.survey_points(number)
            write_cloud(path, cloud, LazHeader(wkt=wkt, standard_time=bool(run.record["config"].get("series"))))
        return
    from pipeline.export import pictures

    if form == "epochs":
        pictures.save_epochs(run, path, progress)
        return
    with progress.stage(form):
        if form == "scan":
            pictures.save_scan(run, number, path)
        else:
            pictures.save_picture(run, number, path, width)
