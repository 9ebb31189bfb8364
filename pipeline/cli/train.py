"""`scarpsim train`: train a rockfall detector on a data set of difference maps."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from pipeline.cli.command_output import CommandOutput
from pipeline.cli.parser import add_output_options, at_least
from scene.common.errors import InputError

SUMMARY = "train a rockfall detector on a data set"
EXAMPLE = """  scarpsim train my_dataset --out my_detector
  scarpsim train my_dataset --config configs/detectors/resnet50.yaml --set training.epochs=40 --out my_detector --resume"""
_SPLITS = ("train", "val")
"""Parts of a data set that training needs."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `scarpsim train` on its parser."""
    parser.add_argument(
        "data_set", type=Path, metavar="DATASET", help="folder with train/ and val/, as scarpsim dataset makes them"
    )
    parser.add_argument(
        "--out", type=Path, required=True, metavar="DIR", help="folder for the detector, its checkpoints and training curves"
    )
    parser.add_argument(
        "--config", type=Path, metavar="FILE", help="config of network and training (default: the bundled detectors/light.yaml)"
    )
    parser.add_argument(
        "--set", action="append", default=[], dest="overrides", metavar="KEY=VALUE", help="override a key of the config, as a.b=c"
    )
    parser.add_argument(
        "--seed",
        type=at_least(0),
        metavar="N",
        help="seed of the initial weights, the order and the flips of tiles (default: the config's)",
    )
    parser.add_argument("--resume", action="store_true", help="continue the interrupted training in the folder --out")
    add_output_options(parser)


def run(arguments: argparse.Namespace) -> CommandOutput:
    """Train a detector of fallen blocks on a data set, or continue its training."""
    from pipeline.config.bundled import bundled_config, config_path
    from pipeline.detection.inference.weights import check_detector
    from pipeline.detection.network.config import load_train_config
    from pipeline.detection.network.data import CocoFolder
    from pipeline.detection.products.run import detector_folder
    from pipeline.formats.files.atomic import check_place, empty_folder
    from pipeline.report.progress import shown_progress

    if arguments.resume:
        check_place(arguments.out)
        _check_training(arguments.out)
    else:
        empty_folder(arguments.out, "add --resume to continue a training in it, or choose another --out")
    overrides = [*arguments.overrides, *([f"training.seed={arguments.seed}"] if arguments.seed is not None else [])]
    path = config_path("detectors", arguments.config) if arguments.config else bundled_config("detectors", "light")
    config = load_train_config(path, overrides)
    _check_data_set(arguments.data_set)
    for split in _SPLITS:
        CocoFolder(arguments.data_set / split).check_images()  # report mistakes before TensorFlow takes its time to load
    if config.training.start is not None:
        check_detector(detector_folder(config.training.start))
    load_keras(quiet=arguments.quiet)
    from pipeline.detection.training.training import train

    arguments.kept = f"the last checkpoint is in {arguments.out}; continue with --resume"
    with shown_progress(quiet=arguments.quiet) as progress:
        history = train(arguments.data_set, config, arguments.out, resume=arguments.resume, progress=progress)
    best, model = min(history.total), arguments.out / "best"
    count = len(history.total)
    told = f"{count} epoch{'s' if count > 1 else ''}, validation loss {history.total[-1]:.4f}, best {best:.4f}: {model}"
    document = {"folder": str(arguments.out), "model": str(model), "epochs": count}
    return CommandOutput(told, lambda: document | {"validation_loss": history.total[-1], "best_validation_loss": best})


def _check_data_set(folder: Path) -> None:
    """Raise InputError if a folder lacks one of the two parts of a data set."""
    missing = [split for split in _SPLITS if not (folder / split / "annotations.json").is_file()]
    if not missing:
        return
    if not folder.is_dir():
        raise InputError("there is no such folder", where=str(folder), remedy="give the folder that scarpsim dataset made")
    remedy = "give the folder that scarpsim dataset made"
    if (folder / "annotations.json").is_file():
        remedy = f"this is one part of a data set: give the folder around it, {folder.parent}"
    raise InputError(
        f"the folder is no data set to train on ({missing[0]}/annotations.json is missing)",
        where=str(folder),
        allowed=f"a folder with {' and '.join(_SPLITS)}",
        remedy=remedy,
    )


def _check_training(out: Path) -> None:
    """Raise InputError if a folder contains no training, or other things in the place of its folders."""
    from pipeline.detection.network.config import BEST, CHECKPOINT, CURVES, EVENTS
    from pipeline.formats.files.own_folders import require_own_folder

    if not any((out / name).exists() for name in (CHECKPOINT, BEST, EVENTS, CURVES)):
        raise InputError(
            "there is no training to continue",
            where=f"--resume, --out {out}",
            remedy="start a training without --resume, in a new folder",
        )
    for name in (CHECKPOINT, BEST, EVENTS):
        require_own_folder(out / name)


def load_keras(*, quiet: bool) -> None:
    """Import Keras and its backend, after a message that this takes time. quiet: leave out the message."""
    from pipeline.detection.network.keras_backend import check_installed, import_keras

    backend = check_installed()
    if not quiet:
        print(f"loading {backend}, which takes ten seconds or more", file=sys.stderr, flush=True)
    import_keras()
