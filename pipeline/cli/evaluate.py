"""`scarpsim evaluate`: score detections against the true blocks."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.cli.command_output import CommandOutput
from pipeline.cli.parser import add_output_options, one_of

if TYPE_CHECKING:
    from pipeline.detection.evaluation.evaluate import Overlap

SUMMARY = "compare detections with the truth: precision, recall, F1, mask areas, COCO metrics"
EXAMPLE = """  scarpsim evaluate my_dataset/test/annotations.json found/detections.json
  scarpsim evaluate my_dataset/test found/detections.json --by noise --confidence 0.5 --confidence 0.9 --out scores"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `scarpsim evaluate` on its parser."""
    parser.add_argument("truth", type=Path, metavar="TRUTH", help="COCO annotations, or a folder with annotations.json")
    parser.add_argument("predictions", type=Path, metavar="PREDICTIONS", help="COCO detections with scores")
    parser.add_argument(
        "--by", action="append", default=[], metavar="KEY", help="also score separately for each value of this key of the images"
    )
    parser.add_argument(
        "--iou",
        type=one_of("both", "segm", "bbox"),
        default="both",
        metavar="both|segm|bbox",
        help="match by overlap of masks (segm), of boxes (bbox), or both in separate tables (default)",
    )
    parser.add_argument(
        "--confidence",
        type=float,
        action="append",
        metavar="P",
        help="smallest score that counts; may be given several times (default: 0.9 0.95 0.99)",
    )
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="folder for scores.json, scores.csv and reliability.png (default: only print)"
    )
    add_output_options(parser)


def run(arguments: argparse.Namespace) -> CommandOutput:
    """Score the detections of fallen blocks against annotations and print the tables."""
    from pipeline.detection.products.run import CONFIDENCES, sorted_confidences
    from pipeline.detection.products.score_files import as_text, assess, write
    from pipeline.formats.files.atomic import check_place

    confidences = sorted_confidences(arguments.confidence or CONFIDENCES)
    if arguments.out:
        check_place(arguments.out)
    kinds: tuple[Overlap, ...] = ("segm", "bbox") if arguments.iou == "both" else (arguments.iou,)
    assessment = assess(arguments.truth, arguments.predictions, arguments.by, kinds, confidences)
    if arguments.out:
        write(assessment, arguments.out)
    place = f"\nscores: {arguments.out}" if arguments.out else ""
    return CommandOutput(as_text(assessment) + place, assessment.to_dict)
