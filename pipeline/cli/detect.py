"""`scarpsim detect`: find rockfalls in difference maps."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path

from pipeline.cli.command_output import CommandOutput
from pipeline.cli.parser import add_output_options
from pipeline.report.words import counted

SUMMARY = "find rockfalls in difference maps: masks, events, pictures"
EXAMPLE = """  scarpsim detect default runs/my_run --out found
  scarpsim detect my_detector/best difference_001.tif difference_002.tif --confidence 0.9 --out found
  scarpsim detect baseline my_dataset/test --out found_by_threshold"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `scarpsim detect` on its parser."""
    parser.add_argument(
        "model",
        metavar="MODEL",
        help="'default' (network that comes with scarpsim), 'baseline' (threshold, no network), or folder of a trained detector",
    )
    parser.add_argument(
        "inputs",
        type=Path,
        nargs="+",
        metavar="INPUT",
        help="difference maps (TIFF), run folders, or folders with annotations.json",
    )
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder for the results (default: a new one under runs/)")
    parser.add_argument(
        "--confidence",
        type=float,
        action="append",
        metavar="P",
        help="smallest score to accept; may be given several times (default: 0.9 0.95 0.99)",
    )
    parser.add_argument(
        "--mirrored",
        action="store_true",
        help="also search mirror images of the maps: takes three to four times as long and draws blocks better",
    )
    parser.add_argument("--no-pictures", action="store_true", help="write neither overlays nor mask rasters")
    add_output_options(parser)


def run(arguments: argparse.Namespace) -> CommandOutput:
    """Find fallen blocks in difference maps and write masks, tables and pictures, for the command `scarpsim detect`."""
    from pipeline.cli.train import load_keras
    from pipeline.detection.products.run import BASELINE, CONFIDENCES, detect, sorted_confidences
    from pipeline.formats.files.atomic import check_place, new_folder
    from pipeline.report.progress import shown_progress

    confidences = sorted_confidences(arguments.confidence or CONFIDENCES)
    out = arguments.out or new_folder(Path("runs"), "detect")
    check_place(out)
    if arguments.model != BASELINE:
        from pipeline.detection.inference.weights import check_detector
        from pipeline.detection.products.run import detector_folder, find_inputs

        check_detector(
            detector_folder(arguments.model), mirrored=arguments.mirrored
        )  # report mistakes before TensorFlow takes its time to load
        find_inputs(arguments.inputs)
        load_keras(quiet=arguments.quiet)
    with shown_progress(quiet=arguments.quiet) as progress:
        found = detect(
            arguments.model,
            arguments.inputs,
            out,
            confidences,
            not arguments.no_pictures,
            progress,
            mirrored=arguments.mirrored,
        )
    volume = sum(item.volume_m3 for item in found)
    told = f"{counted(len(found), 'block')} with a score of {min(confidences):g} or more, {volume:.3g} m³"
    document = {
        "folder": str(out),
        "confidence": min(confidences),
        "volume_m3": volume,
        "events": [asdict(item) for item in found],
    }
    return CommandOutput(f"{told}\nresults: {out}", lambda: document)
