"""Read and write dataset.json and the shards (records of single epochs), with checks of types, checksums and file names."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, NonNegativeInt, StringConstraints, ValidationError, model_validator

from pipeline.dataset.config import DATASET_FILE, MOST_EPOCHS
from pipeline.dataset.plan import Split
from pipeline.formats.files.atomic import write_json, write_text
from scene.common.config import parse
from scene.common.errors import InputError
from scene.common.regular_file import read_json, read_text

SCHEMA = 1
SHARDS = "shards"
Record = dict[str, Any]
_REMEDY = "restore it from a copy, or make the set again in another folder; tiles and annotations.json are still usable"
_Fingerprint = Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{12}$")]
_Word = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$")]


class _Source(BaseModel):
    """How some epochs of a set are made; prefix: of their file names."""

    model_config = ConfigDict(extra="forbid")
    config: dict[str, Any]
    versions: dict[str, str]
    command: str
    prefix: str


class _DatasetFile(BaseModel):
    """Content of dataset.json.

    Attributes
    ----------
    sources : How epochs are made, by fingerprint.
    epochs : Indices of the epochs in the set, by the fingerprint of their source.
    sha256 : Checksum of everything before it.
    """

    model_config = ConfigDict(extra="forbid")
    schema_: Literal[1] = Field(alias="schema")
    name: _Word
    fingerprint: str
    complete: bool
    sources: dict[_Fingerprint, _Source] = Field(min_length=1)
    epochs: dict[_Fingerprint, Annotated[list[NonNegativeInt], Field(max_length=MOST_EPOCHS)]]
    sha256: str = ""

    @model_validator(mode="after")
    def _fits(self) -> Self:
        """Check that `epochs` and `sources` match."""
        if list(self.epochs) != list(self.sources):
            raise ValueError("`epochs` and `sources` have different fingerprints")
        for fingerprint, source in self.sources.items():
            if source.prefix not in ("", f"{fingerprint}_"):
                raise ValueError(
                    f"'sources.{fingerprint}.prefix' is {source.prefix!r:.80}; allowed: nothing, or '{fingerprint}_'"
                )
        return self


class _ShardImage(BaseModel):
    """File names of a tile."""

    file_name: str
    truth_file_name: str = ""


class _Tile(BaseModel):
    """A tile's entry in a shard."""

    image: _ShardImage
    sha256: str
    truth_sha256: str | None
    annotations: list[dict[str, Any]]


class _Epoch(BaseModel):
    """Which epoch a shard describes."""

    index: NonNegativeInt
    split: Split
    sensor: _Word
    wall: _Word
    noise: _Word
    size: _Word


class _Shard(BaseModel):
    """The parts of an epoch's record that are used here."""

    source: _Fingerprint
    epoch: _Epoch
    seed: int
    tiles: list[_Tile] = Field(min_length=1)
    outside_blocks: dict[str, Any]


def read_dataset_file(folder: Path) -> Record:
    """Read dataset.json, which describes a data set.

    Raises InputError if the folder is not a data set or the file was changed.
    """
    path = folder / DATASET_FILE
    if not path.exists():
        raise InputError(
            "the folder is not a data set: it has no dataset.json",
            where=str(folder),
            remedy="give the folder that scarpsim dataset made",
        )
    values = read_json(path, remedy=_REMEDY)
    parse(_DatasetFile, values, str(path))
    if values.pop("sha256", "") != _digest(_text(values)):
        raise _damaged(path)
    return dict(values)


def write_dataset_file(
    folder: Path, name: str, sources: dict[str, Any], epochs: dict[str, list[int]], *, complete: bool = False
) -> None:
    """Write dataset.json, which describes a data set.

    Parameters
    ----------
    folder : Folder of the set.
    name : Name of the set.
    sources : Config, versions, command and file name prefix of each set that this one was made of (one, unless it was merged),
        by fingerprint, a hash of the config.
    epochs : Indices of the set's epochs in the plan of each config, by fingerprint.
    complete : Whether all epochs are made.
    """
    head = {"schema": SCHEMA, "name": name, "fingerprint": "-".join(sources), "complete": complete}
    values = {**head, "sources": sources, "epochs": epochs}
    write_json(folder / DATASET_FILE, {**values, "sha256": _digest(_text(values))})


def shard_name(source: str, index: int) -> str:
    """Return the file name of the record of an epoch in a data set.

    source: fingerprint (hash) of the epoch's config. index: of the epoch in the plan of that config.
    """
    return f"{source}_{index:06d}.json"


def write_shard(folder: Path, name: str, record: Record) -> None:
    """Write the record of a data set's epoch, with a checksum of its content.

    folder: the data set's. name: file name, as of `shard_name`. record: the record, JSON types.
    """
    text = _text(record)
    write_text(folder / SHARDS / name, f"{_digest(text)}\n{text}\n")


def read_shard(folder: Path, name: str) -> Record | None:
    """Read the record of a data set's epoch; None if it is missing or damaged.

    folder: the data set's. name: file name, as of `shard_name`.
    """
    try:
        digest, _, text = read_text(folder / SHARDS / name).partition("\n")
        text = text.removesuffix("\n")
        record = dict(json.loads(text)) if _digest(text) == digest else None
        found = None if record is None else _Shard.model_validate(record)
    except (ValueError, TypeError, RecursionError, ValidationError):  # ValueError includes InputError
        return None
    return record if found and shard_name(found.source, found.epoch.index) == name else None


def _text(values: Record) -> str:
    """Return the JSON text that checksums are computed from."""
    return json.dumps(values, allow_nan=False, separators=(",", ":"))


def _digest(text: str) -> str:
    """Return the SHA-256 of a text."""
    return hashlib.sha256(text.encode()).hexdigest()


def _damaged(path: Path) -> InputError:
    """Return the error for a changed dataset.json."""
    return InputError("the file is damaged: its checksum differs", where=str(path), remedy=_REMEDY)
