"""The folder of a data set on disk: its files, and whether they are complete.

    dataset.json            configs, seed, versions, whether it is complete
    shards/                 a record of each epoch: its tiles with their checksums, its annotations
    train/ val/ test/       the tiles and annotations.json
    README.md, card/        the data set card
    checksums.sha256        as sha256sum reads it

An epoch is done when its shard has its final name, which is after all of its tiles have theirs. Files are written into a staging
folder of the job and then renamed. A later job removes the staging folders of dead jobs, whose workers may live on for a while.
"""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from pipeline.config.simulation import CamerasFile
from pipeline.dataset.config import DATASET_FILE, DatasetConfig
from pipeline.dataset.plan import SPLITS
from pipeline.dataset.records import SHARDS, Record, read_shard
from pipeline.formats.files.checksum import sha256
from pipeline.formats.files.inside import inside
from pipeline.formats.files.own_folders import require_own_folder
from scene.common.errors import InputError
from scene.walls.imported import ImportedWall

STAGING, CHECKSUMS, TRUTH = ".staging", "checksums.sha256", "truth"


def fingerprint(config: DatasetConfig) -> str:
    """Return a hash that identifies a data set, so that a job continues only the set of its own config.

    It is of the resolved config, and of the files of its walls and cameras.
    """
    digest = hashlib.sha256(config.model_dump_json().encode())
    for wall in config.walls.values():
        meshes = [*wall.wall.files] if isinstance(wall.wall, ImportedWall) else []
        cameras = wall.cameras.files() if isinstance(wall.cameras, CamerasFile) else []
        for file in [*meshes, *cameras]:
            digest.update(sha256(file).encode())
    return digest.hexdigest()[:12]


def tile_files(record: Record) -> Iterator[tuple[str, str]]:
    """Yield the tile files of an epoch, as pairs of path relative to the data set's folder and SHA-256 checksum.

    record: the epoch's record in the data set.
    """
    split = PurePosixPath(record["epoch"]["split"])
    for tile in record["tiles"]:
        yield str(split / tile["image"]["file_name"]), tile["sha256"]
        if tile["truth_sha256"] is not None:
            yield str(split / tile["image"]["truth_file_name"]), tile["truth_sha256"]


@dataclass(frozen=True)
class Damage:
    """A damaged file of a data set. file: relative to the set's folder; problem: "missing", "damaged" or "a folder"."""

    file: Path
    problem: str

    @property
    def is_missing_shard(self) -> bool:
        """Whether the file is missing because it is the record of an epoch that has not been made yet."""
        return self.problem == "missing" and self.file.parent.name == SHARDS


def epoch_damage(folder: Path, name: str) -> list[Damage]:
    """Return which files of an epoch in a data set are missing or damaged, after reading every byte of its tiles.

    folder: the data set's. name: file name of the epoch's record.
    """
    record = read_shard(folder, name)
    if record is None:
        return file_damage(folder, f"{SHARDS}/{name}", "", name)
    return [each for file, digest in tile_files(record) for each in file_damage(folder, file, digest, f"{SHARDS}/{name}")]


def file_damage(folder: Path, file: str, digest: str, where: str) -> list[Damage]:
    """Check whether one file of a data set is missing or damaged.

    Parameters
    ----------
    folder : Folder of the set.
    file : The file, relative to `folder`.
    digest : SHA-256 checksum that it should have.
    where : The file of the set that names it, for errors.

    Returns
    -------
    A list with the damage; empty if the file is as it should be.

    Raises
    ------
    InputError
        If the file lies outside the folder.
    """
    path = inside(folder, file, folder / where)
    if path.is_dir():
        return [Damage(Path(file), "a folder")]
    if not path.exists():
        return [Damage(Path(file), "missing")]
    return [] if sha256(path) == digest else [Damage(Path(file), "damaged")]


def require_no_folders(folder: Path, damage: list[Damage]) -> None:
    """Check that damaged files of a data set can be written again; raise InputError if a folder is in the place of one.

    folder: the data set's. damage: its damaged files.
    """
    for each in damage:
        if (folder / each.file).is_dir():
            raise InputError(
                "a folder is in the place of a file of the set",
                where=str(folder / each.file),
                remedy="move this folder out of the data set",
            )


def require_own_folders(folder: Path) -> None:
    """Check that a job can write to the subfolders of a data set.

    Raises InputError if something else, such as a file, is in the place of one; the folder of a split may be a link to a
    folder.
    """
    for name in (STAGING, SHARDS, *SPLITS):
        if name not in SPLITS or not (folder / name).is_dir():
            require_own_folder(folder / name)


def discard_unbegun(folder: Path) -> None:
    """Remove what a data set job wrote to `folder`, if it ended before its first epoch was made; all other files stay."""
    if any((folder / SHARDS).glob("*.json")):
        return
    _remove_staging(folder)
    own = [folder / name for name in (SHARDS, *(f"{split}/{TRUTH}" for split in SPLITS), *SPLITS)]
    for each in own:
        with suppress(OSError):  # does not exist, or contains tiles
            each.rmdir()
    if not any(each.exists() for each in own):
        (folder / DATASET_FILE).unlink(missing_ok=True)


def remove_leftovers(folder: Path) -> None:
    """Remove temporary files that killed jobs left in a data set's folder."""
    _remove_staging(folder)
    for part in folder.rglob(".*.part*"):
        part.unlink(missing_ok=True)


def _remove_staging(folder: Path) -> None:
    """Remove the staging folders."""
    if (folder / STAGING).is_dir():  # rmtree would wait forever at a pipe
        shutil.rmtree(folder / STAGING, ignore_errors=True)
