"""dataset.json and the shards as they are read: of the right types, with their checksums, and naming no file elsewhere."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, NonNegativeInt, StringConstraints, ValidationError, model_validator

from pipeline.dataset.config import DATASET_FILE
from pipeline.dataset.plan import Split
from pipeline.formats.files.atomic import write_json, write_text
from scene.common.config import parse
from scene.common.errors import InputError
from scene.common.regular_file import read_json, read_text

SCHEMA = 1
SHARDS = "shards"
Record = dict[str, Any]
_MOST_EPOCHS = 100_000
"""Of a set: a plan of 1,620 tiles has as many at the most, and a million that are not there took two minutes to name."""
_REMEDY = "put it back from a copy, or make the set again in another folder; tiles and annotations.json stay usable"
_Fingerprint = Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{12}$")]
_Word = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$")]


class _Source(BaseModel):
    """How some of a set's epochs are made. prefix: of their files' names."""

    model_config = ConfigDict(extra="forbid")
    config: dict[str, Any]
    versions: dict[str, str]
    command: str
    prefix: str


class _DatasetFile(BaseModel):
    """dataset.json. sources: by fingerprint; epochs: those that the set holds of each; sha256: of all that is before it."""

    model_config = ConfigDict(extra="forbid")
    schema_: Literal[1] = Field(alias="schema")
    name: _Word
    fingerprint: str
    complete: bool
    sources: dict[_Fingerprint, _Source] = Field(min_length=1)
    epochs: dict[_Fingerprint, Annotated[list[NonNegativeInt], Field(max_length=_MOST_EPOCHS)]]
    sha256: str = ""

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if list(self.epochs) != list(self.sources):
            raise ValueError("`epochs` and `sources` are not of the same fingerprints")
        for fingerprint, source in self.sources.items():
            if source.prefix not in ("", f"{fingerprint}_"):
                raise ValueError(
                    f"'sources.{fingerprint}.prefix' is {source.prefix!r:.80}; allowed: nothing, or '{fingerprint}_'"
                )
        return self


class _ShardImage(BaseModel):
    file_name: str
    truth_file_name: str = ""


class _Tile(BaseModel):
    image: _ShardImage
    sha256: str
    truth_sha256: str | None
    annotations: list[dict[str, Any]]


class _Epoch(BaseModel):
    index: NonNegativeInt
    split: Split
    sensor: _Word
    wall: _Word
    noise: _Word
    size: _Word


class _Shard(BaseModel):
    """An epoch's record, as far as it is used here."""

    source: _Fingerprint
    epoch: _Epoch
    seed: int
    tiles: list[_Tile] = Field(min_length=1)
    outside_blocks: dict[str, Any]


def read_dataset_file(folder: Path) -> Record:
    """dataset.json of a data set; raises InputError where the folder is none, and where the file is not as it was written."""
    path = folder / DATASET_FILE
    if not path.exists():
        raise InputError("is not a data set: it has no dataset.json", where=str(folder), remedy="check the path")
    values = read_json(path, remedy=_REMEDY)
    parse(_DatasetFile, values, str(path))
    if values.pop("sha256", "") != _digest(_text(values)):
        raise _damaged(path)
    return dict(values)


def write_dataset_file(
    folder: Path, name: str, sources: dict[str, Any], epochs: dict[str, list[int]], *, complete: bool = False
) -> None:
    """Write dataset.json. sources: config, versions, command, prefix of file names, by fingerprint; epochs: the set's."""
    head = {"schema": SCHEMA, "name": name, "fingerprint": "-".join(sources), "complete": complete}
    values = {**head, "sources": sources, "epochs": epochs}
    write_json(folder / DATASET_FILE, {**values, "sha256": _digest(_text(values))})


def shard_name(source: str, index: int) -> str:
    return f"{source}_{index:06d}.json"


def write_shard(folder: Path, name: str, record: Record) -> None:
    """Write an epoch's record with its own checksum."""
    text = _text(record)
    write_text(folder / SHARDS / name, f"{_digest(text)}\n{text}\n")


def read_shard(folder: Path, name: str) -> Record | None:
    """An epoch's record; None where there is none, or a damaged one."""
    try:
        digest, _, text = read_text(folder / SHARDS / name).partition("\n")
        text = text.removesuffix("\n")
        record = dict(json.loads(text)) if _digest(text) == digest else None
        found = None if record is None else _Shard.model_validate(record)
    except (ValueError, TypeError, RecursionError, ValidationError):  # ValueError: an InputError is one
        return None
    return record if found and shard_name(found.source, found.epoch.index) == name else None


def _text(values: Record) -> str:
    return json.dumps(values, allow_nan=False, separators=(",", ":"))


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def _damaged(path: Path) -> InputError:
    return InputError("is damaged: it is not as it was written", where=str(path), remedy=_REMEDY)
