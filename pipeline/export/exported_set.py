"""Read a data set's folder for export."""

from __future__ import annotations

from pathlib import Path

from pipeline.dataset.loaders import Tiles
from pipeline.dataset.plan import SPLITS
from scene.common.errors import InputError


def splits_of(folder: Path) -> dict[str, Tiles]:
    """Return the tiles of each split (train, val, test) in a data set's folder. Raises InputError if there is no split."""
    splits = [split for split in SPLITS if (folder / split / "annotations.json").is_file()]
    if not splits:
        raise InputError(
            "the folder contains no split of a data set" if folder.is_dir() else "there is no such folder",
            where=str(folder),
            allowed=f"a folder with {', '.join(SPLITS)}",
            remedy="give the folder that scarpsim dataset made",
        )
    return {split: Tiles(folder / split) for split in splits}
