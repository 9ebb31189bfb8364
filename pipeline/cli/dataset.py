"""`scarpsim dataset`: training data at scale, and its checking, merging and splitting."""

from __future__ import annotations

import argparse
import shlex
from pathlib import Path

from pipeline.cli.parser import at_least
from scene.errors import InputError

SUMMARY = "make a set of annotated tiles for training, or check, merge, split finished ones"
EXAMPLE = """  scarpsim dataset configs/datasets/small.yaml --out sets/small --workers 2
  scarpsim dataset verify sets/small
  scarpsim dataset merge sets/small sets/other --out sets/both
  scarpsim dataset split sets/small --by sensor,noise --out sets/parts"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "words", nargs="+", metavar="CONFIG | verify DIR | merge DIR ... | split DIR", help="what to make, or what to do with it"
    )
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder of the set; if it is unfinished the command goes on")
    parser.add_argument("--workers", type=at_least(1), metavar="N", help="local worker processes (default: this process alone)")
    parser.add_argument("--scheduler", metavar="ADDRESS", help="a Dask scheduler instead, such as tcp://host:8786")
    parser.add_argument("--seed", type=at_least(0), metavar="N", help="seed of all random numbers (default: the config's)")
    parser.add_argument(
        "--set", action="append", default=[], dest="overrides", metavar="KEY=VALUE", help="override a key of the config, as a.b=c"
    )
    parser.add_argument(
        "--by", default="sensor,noise,size", metavar="KEYS", help="split: one set for each combination (default: %(default)s)"
    )
    parser.add_argument("--report-only", action="store_true", help="verify: do not make damaged tiles again; exit with 1")
    parser.add_argument("--quiet", action="store_true", help="no progress")


def run(arguments: argparse.Namespace) -> int:
    if arguments.workers and arguments.scheduler:
        raise InputError("are given both", where="--workers and --scheduler", remedy="give one of them")
    action, *folders = arguments.words
    if action == "verify":
        return _verify(arguments, _one(folders, "verify"))
    if action == "merge":
        return _merge(arguments, folders)
    if action == "split":
        return _split(arguments, _one(folders, "split"))
    if folders:
        raise InputError(f"unexpected argument '{folders[0]}'", where="scarpsim dataset", remedy="see scarpsim dataset --help")
    return _make(arguments, Path(action))


def _make(arguments: argparse.Namespace, path: Path) -> int:
    out = _out(arguments)
    from pipeline.dataset.config import load_dataset_config
    from pipeline.dataset.run import Workers, make_dataset
    from pipeline.progress import shown_progress

    config = load_dataset_config(path, arguments.overrides, arguments.seed)
    arguments.kept = f"what was finished is in {out} and usable; the same command goes on"
    workers = Workers(arguments.workers or 0, arguments.scheduler or "")
    with shown_progress(quiet=arguments.quiet) as progress:
        summary = make_dataset(config, out, workers, command=_command(arguments, path), progress=progress)
    print(summary.summary())
    return 0


def _verify(arguments: argparse.Namespace, folder: Path) -> int:
    from pipeline.dataset.run import Workers, verify_dataset
    from pipeline.progress import shown_progress

    workers = Workers(arguments.workers or 0, arguments.scheduler or "")
    with shown_progress(quiet=arguments.quiet) as progress:
        summary = verify_dataset(folder, workers, repair=not arguments.report_only, progress=progress)
    for damage in summary.damage:
        print(f"{damage.problem}: {folder / damage.file}")
    if arguments.report_only:
        print(f"{len(summary.damage)} files are missing or damaged" if summary.damage else "the set is whole")
        return 1 if summary.damage else 0
    print(f"{len(summary.damage)} files were missing or damaged, {len(summary.made)} epochs made again; the set is whole")
    return 0


def _merge(arguments: argparse.Namespace, folders: list[str]) -> int:
    out = _out(arguments)
    from pipeline.dataset.combine import merge_datasets

    print(merge_datasets([Path(folder) for folder in folders], out).summary())
    return 0


def _split(arguments: argparse.Namespace, folder: Path) -> int:
    out = _out(arguments)
    from pipeline.dataset.combine import split_dataset

    for summary in split_dataset(folder, out, arguments.by.split(",")):
        print(summary.summary())
    return 0


def _one(folders: list[str], action: str) -> Path:
    if len(folders) != 1:
        raise InputError(f"takes one folder, got {len(folders)}", where=f"scarpsim dataset {action}")
    return Path(folders[0])


def _out(arguments: argparse.Namespace) -> Path:
    if arguments.out is None:
        raise InputError("needs a folder for the results", where="scarpsim dataset", remedy="add --out DIR")
    return Path(arguments.out)


def _command(arguments: argparse.Namespace, path: Path) -> str:
    """The command that makes the set; by how many workers and where to has no part in its bytes."""
    words = ["scarpsim", "dataset", str(path), "--out", "DIR"]
    words += [] if arguments.seed is None else ["--seed", str(arguments.seed)]
    return shlex.join(words + [word for override in arguments.overrides for word in ("--set", override)])
