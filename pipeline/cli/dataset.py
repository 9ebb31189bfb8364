"""`scarpsim dataset`: make training data in large numbers, and verify, merge and split finished sets."""

from __future__ import annotations

import argparse
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.cli.command_output import CommandOutput
from pipeline.cli.parser import add_output_options, at_least
from scene.common.errors import InputError

if TYPE_CHECKING:
    from pipeline.dataset.run import DatasetSummary

SUMMARY = "make a set of annotated tiles for training, or verify, merge or split finished sets"
EXAMPLE = """  scarpsim dataset configs/datasets/small.yaml --out sets/small --workers 2
  scarpsim dataset verify sets/small
  scarpsim dataset merge sets/small sets/other --out sets/both
  scarpsim dataset split sets/small --by sensor,noise --out sets/parts"""


_DEFAULT_SPLIT_KEYS = "sensor,noise,size"
"""Keys by which `split` separates a set unless --by is given."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `scarpsim dataset` on its parser."""
    parser.add_argument(
        "words",
        nargs="+",
        metavar="CONFIG | verify DIR | merge DIR ... | split DIR",
        help="config of a set to make, or an action and the sets to apply it to",
    )
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder of the set; an unfinished set is continued")
    parser.add_argument(
        "--workers", type=at_least(1), metavar="N", help="number of local worker processes (default: only this process)"
    )
    parser.add_argument("--scheduler", metavar="ADDRESS", help="use a Dask scheduler instead, such as tcp://host:8786")
    parser.add_argument("--seed", type=at_least(0), metavar="N", help="seed of all random numbers (default: the config's)")
    parser.add_argument(
        "--set", action="append", default=[], dest="overrides", metavar="KEY=VALUE", help="override a key of the config, as a.b=c"
    )
    parser.add_argument(
        "--by", metavar="KEYS", help=f"split: make one set per combination of these keys (default: {_DEFAULT_SPLIT_KEYS})"
    )
    parser.add_argument("--report-only", action="store_true", help="verify: only report damage (exit status 1), repair nothing")
    add_output_options(parser)


def run(arguments: argparse.Namespace) -> CommandOutput:
    """Make, verify, merge or split a data set of annotated difference map tiles."""
    if arguments.workers and arguments.scheduler:
        raise InputError("the two options cannot be combined", where="--workers and --scheduler", remedy="give only one of them")
    action, *folders = arguments.words
    for option, given, goes_with in (
        ("--by", arguments.by is not None, "split"),
        ("--report-only", arguments.report_only, "verify"),
    ):
        if given and action != goes_with:
            raise InputError(
                f"the option works only with scarpsim dataset {goes_with}, not with '{action}'",
                where=option,
                remedy=f"write scarpsim dataset {goes_with} DIR, or leave the option out",
            )
    if action == "verify":
        return _verify(arguments, _single_folder(folders, "verify"))
    if action == "merge":
        return _merge(arguments, folders)
    if action == "split":
        return _split(arguments, _single_folder(folders, "split"))
    if folders:
        raise InputError(
            f"unexpected argument '{folders[0]}'",
            where="scarpsim dataset",
            remedy="remove the argument; scarpsim dataset --help lists those that are known",
        )
    return _make(arguments, Path(action))


def _make(arguments: argparse.Namespace, path: Path) -> CommandOutput:
    """Make a set, or continue an unfinished one."""
    out = _output_folder(arguments)
    from pipeline.config.bundled import config_path
    from pipeline.dataset.config import load_dataset_config
    from pipeline.dataset.run import Workers, make_dataset
    from pipeline.report.progress import shown_progress

    config = load_dataset_config(config_path("datasets", path), arguments.overrides, arguments.seed)
    arguments.kept = f"finished epochs are in {out} and usable; run the same command again to continue"
    workers = Workers(arguments.workers or 0, arguments.scheduler or "")
    with shown_progress(quiet=arguments.quiet) as progress:
        summary = make_dataset(config, out, workers, command=_reproducing_command(arguments, path), progress=progress)
    return CommandOutput(summary.summary(), lambda: _document(summary))


def _verify(arguments: argparse.Namespace, folder: Path) -> CommandOutput:
    """Check a set's files and, unless --report-only is given, make damaged epochs again."""
    from pipeline.dataset.run import Workers, verify_dataset
    from pipeline.report.progress import shown_progress

    workers = Workers(arguments.workers or 0, arguments.scheduler or "")
    with shown_progress(quiet=arguments.quiet) as progress:
        summary = verify_dataset(folder, workers, repair=not arguments.report_only, progress=progress)
    found = [f"{damage.problem}: {folder / damage.file}" for damage in summary.damage]
    if arguments.report_only:
        end = f"{len(found)} files are missing or damaged" if found else "the set is complete and undamaged"
        return CommandOutput("\n".join([*found, end]), lambda: _document(summary), 1 if found else 0)
    end = f"{len(found)} files were missing or damaged, {len(summary.made)} epochs made again; the set is complete"
    return CommandOutput("\n".join([*found, end]), lambda: _document(summary))


def _merge(arguments: argparse.Namespace, folders: list[str]) -> CommandOutput:
    """Merge several sets into a new one."""
    out = _output_folder(arguments)
    from pipeline.dataset.combine import merge_datasets

    summary = merge_datasets([Path(folder) for folder in folders], out)
    return CommandOutput(summary.summary(), lambda: _document(summary))


def _split(arguments: argparse.Namespace, folder: Path) -> CommandOutput:
    """Split a set into one set per combination of the keys given with --by."""
    out = _output_folder(arguments)
    from pipeline.dataset.combine import split_dataset

    parts = list(split_dataset(folder, out, (arguments.by or _DEFAULT_SPLIT_KEYS).split(",")))
    return CommandOutput("\n".join(part.summary() for part in parts), lambda: {"sets": [_document(part) for part in parts]})


def _document(summary: DatasetSummary) -> dict[str, Any]:
    """Return what --json prints about a set."""
    damage = [{"file": str(each.file), "problem": each.problem} for each in summary.damage]
    counts = {"images": summary.images, "annotations": summary.annotations}
    return {"folder": str(summary.folder), "epochs_made": len(summary.made), **counts, "damage": damage}


def _single_folder(folders: list[str], action: str) -> Path:
    """Return the only folder in a list; raise InputError if there are none or several."""
    if len(folders) != 1:
        raise InputError(
            f"the command takes one folder, but got {len(folders)}",
            where=f"scarpsim dataset {action}",
            remedy="give one folder, and run the command once for each",
        )
    return Path(folders[0])


def _output_folder(arguments: argparse.Namespace) -> Path:
    """Return the folder given with --out; raise InputError without one."""
    if arguments.out is None:
        raise InputError("the command needs a folder for the results", where="scarpsim dataset", remedy="add --out DIR")
    return Path(arguments.out)


def _reproducing_command(arguments: argparse.Namespace, path: Path) -> str:
    """Return the command that makes the set again, without --workers and --out, which do not affect its bytes."""
    words = ["scarpsim", "dataset", str(path), "--out", "DIR"]
    words += [] if arguments.seed is None else ["--seed", str(arguments.seed)]
    return shlex.join(words + [word for override in arguments.overrides for word in ("--set", override)])
