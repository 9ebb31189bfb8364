"""The folder of a data set on disk: who may write to it, what is in it, and whether that is whole.

    dataset.json            configs, seed, versions, whether it is complete
    shards/                 a record of each epoch: its tiles with their checksums, its annotations
    train/ val/ test/       the tiles and annotations.json
    README.md, card/        the data set card
    checksums.sha256        as sha256sum reads it

An epoch counts as done when its shard has its final name, which is after all of its tiles have theirs. Files are written into a
staging folder of the job and renamed; a later job removes the staging folders of dead ones, whose workers may live on a while.
"""

from __future__ import annotations

import errno
import fcntl
import hashlib
import json
import os
import shutil
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.dataset.config import DATASET_FILE, DatasetConfig
from pipeline.formats.atomic import write_text
from scene.errors import InputError

SCHEMA = 1
SHARDS, STAGING, CHECKSUMS, LOCK, TRUTH = "shards", ".staging", "checksums.sha256", ".lock", "truth"
Record = dict[str, Any]


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Hold the folder for one job; the lock goes with the process, however it ends. Raises InputError where another holds it."""
    if folder.exists() and not folder.is_dir():
        raise InputError("is a file", where=str(folder), remedy="choose a folder")
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / LOCK).open("a+") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno not in (errno.EWOULDBLOCK, errno.EACCES):
                raise
            file.seek(0)
            holder = file.read().strip() or "another job"
            raise InputError(
                f"is in use by {holder}", where=str(folder), remedy="wait for it to end, or choose another folder"
            ) from None
        file.truncate(0)
        file.write(f"process {os.getpid()} on {socket.gethostname()}\n")
        file.flush()
        yield


def is_free(folder: Path) -> bool:
    """Whether a folder holds nothing but a lock."""
    return folder.is_dir() and all(path.name == LOCK for path in folder.iterdir())


def fingerprint(config: DatasetConfig) -> str:
    """What tells sets apart: a hash of the resolved config and of the files that its walls and cameras are read from."""
    digest = hashlib.sha256(config.model_dump_json().encode())
    for wall in config.walls.values():
        for path in (getattr(wall.wall, "mesh", None), getattr(wall.cameras, "file", None)):
            for file in _files(path):
                digest.update(sha256(file).encode())
    return digest.hexdigest()[:12]


def _files(path: Any) -> list[Path]:
    if not isinstance(path, Path):
        return []
    return sorted(path.iterdir()) if path.is_dir() else [path]


def sha256(path: Path) -> str:
    """The checksum of a file, in hexadecimal; raises InputError where it cannot be read."""
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror})", where=str(path)) from None


def read_dataset_file(folder: Path) -> Record:
    """dataset.json of a data set; raises InputError where the folder is none."""
    path = folder / DATASET_FILE
    try:
        return dict(json.loads(path.read_text(encoding="utf-8")))
    except OSError:
        raise InputError("is not a data set: it has no dataset.json", where=str(folder), remedy="check the path") from None
    except ValueError:
        remedy = "run the `scarpsim dataset` command again that made it"
        raise InputError("is damaged", where=str(path), remedy=remedy) from None


def shard_name(source: str, index: int) -> str:
    return f"{source}_{index:06d}.json"


def write_shard(folder: Path, name: str, record: Record) -> None:
    """Write an epoch's record with its own checksum."""
    text = json.dumps(record, allow_nan=False, separators=(",", ":"))
    write_text(folder / SHARDS / name, f"{hashlib.sha256(text.encode()).hexdigest()}\n{text}\n")


def read_shard(folder: Path, name: str) -> Record | None:
    """An epoch's record; None where there is none, or a damaged one."""
    try:
        digest, _, text = (folder / SHARDS / name).read_text(encoding="utf-8").partition("\n")
    except (OSError, UnicodeDecodeError):
        return None
    text = text.removesuffix("\n")
    return json.loads(text) if hashlib.sha256(text.encode()).hexdigest() == digest else None


def tile_files(record: Record) -> Iterator[tuple[Path, str]]:
    """The files of an epoch, relative to the data set's folder, and their checksums."""
    split = Path(record["epoch"]["split"])
    for tile in record["tiles"]:
        yield split / tile["image"]["file_name"], tile["sha256"]
        if tile["truth_sha256"] is not None:
            yield split / tile["image"]["truth_file_name"], tile["truth_sha256"]


@dataclass(frozen=True)
class Damage:
    """What is wrong with an epoch's files. file: relative to the data set's folder; problem: missing, damaged."""

    file: Path
    problem: str

    @property
    def is_missing_shard(self) -> bool:
        """Whether the epoch has not been made so far."""
        return self.problem == "missing" and self.file.parent.name == SHARDS


def damages(folder: Path, name: str) -> list[Damage]:
    """What is missing or damaged of an epoch, every byte of its tiles read; empty where all is well."""
    record = read_shard(folder, name)
    if record is None:
        path = Path(SHARDS) / name
        return [Damage(path, "damaged" if (folder / path).exists() else "missing")]
    found = []
    for file, digest in tile_files(record):
        if not (folder / file).exists():
            found.append(Damage(file, "missing"))
        elif sha256(folder / file) != digest:
            found.append(Damage(file, "damaged"))
    return found


def remove_leftovers(folder: Path) -> None:
    """Remove what dead jobs left under temporary names."""
    shutil.rmtree(folder / STAGING, ignore_errors=True)
    for part in folder.rglob(".*.part*"):
        part.unlink(missing_ok=True)
