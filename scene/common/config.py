"""The base of every config model: frozen, unknown keys refused with the nearest right one."""

from __future__ import annotations

import math
import re
import reprlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Literal, TypeVar, get_args, get_origin

import pydantic
import yaml
from pydantic import BaseModel, ConfigDict
from pydantic_core import ErrorDetails

from scene.common.errors import InputError, nearest
from scene.common.regular_file import read_json, read_text
from scene.common.yaml_text import parse_yaml


class Config(BaseModel):
    """A frozen config section. Field names carry their unit (`_m`, `_rad`, `_px`, `_ppm`)."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
    short_forms: ClassVar[tuple[str, ...]] = ()
    """Keys that a file may have in this section and that are resolved to others before it is parsed; messages name them too."""


ConfigT = TypeVar("ConfigT", bound=BaseModel)


def parse(model: type[ConfigT], values: Any, where: str) -> ConfigT:
    """Validate `values` (a mapping) as `model`; every mistake is named in one InputError.

    `where` is the file or option the values came from; it stands at the front of the message.
    """
    if not isinstance(values, Mapping):
        raise InputError(
            f"expected a mapping of keys, got {type(values).__name__}", where=where, remedy="write `key: value` lines"
        )
    try:
        return model.model_validate(dict(values))
    except pydantic.ValidationError as error:
        raise InputError(_listed([_describe(model, item) for item in error.errors()]), where=where) from None


_MOST_YAML_BYTES = 4_000_000
"""YAML takes some twenty seconds for as much."""


def load_yaml(path: Path) -> Any:
    """Read a YAML file (`parse_yaml` says which YAML), or a JSON file; unreadable or malformed files are InputErrors."""
    if path.suffix == ".json":
        return read_json(path)
    try:
        remedy = "check the path and the permissions"
        return parse_yaml(read_text(path, most_bytes=_MOST_YAML_BYTES, remedy=remedy, smaller="give it as .json, which is fast"))
    except yaml.YAMLError as error:
        problem = " ".join(str(error).split())
        raise InputError(f"is not valid YAML: {problem}", where=str(path)) from None


_MOST_MISTAKES = 4
"""More are counted only: a file of another kind is wrong in every key."""


def _listed(mistakes: list[str]) -> str:
    more = len(mistakes) - _MOST_MISTAKES
    return "; ".join(mistakes[:_MOST_MISTAKES] + ([f"and {more} more"] if more > 0 else []))


def _describe(model: type[BaseModel], item: ErrorDetails) -> str:
    """One mistake as `section.key: message, got value`, with the nearest key for an unknown one."""
    keys, sections = _place(model, item["loc"])
    key = ".".join(keys)
    if item["type"] == "extra_forbidden":
        return _unknown(keys, sections)
    if item["type"] == "missing":
        return f"'{key}' is missing"
    message = item["msg"].removeprefix("Value error, ")
    if not key:  # of the whole, which is not worth repeating
        return message
    hint = _hint(keys, item)
    return f"'{key}': {message[0].lower()}{message[1:]}, got {_shown(item['input'])}" + (f"; {hint}" if hint else "")


def _unknown(keys: list[str], sections: list[_Section]) -> str:
    """What a key that is not allowed is: one of another kind of this section, or of none."""
    key, name = ".".join(keys), keys[-1]
    owners = list(dict.fromkeys(section.kind for section in sections if name in section.names()))
    picked = [section for section in sections if section.picked]
    known = sorted({each for section in picked for each in section.names()})
    allowed = f"allowed: {', '.join(known)}" if known else ""
    if owners and name not in known:
        more = f" and {len(owners) - _MOST_MISTAKES} more" if len(owners) > _MOST_MISTAKES else ""
        return f"'{key}' belongs to {', '.join(owners[:_MOST_MISTAKES])}{more}, not to {picked[0].kind}; {allowed}"
    if owners:  # of kinds that no word tells apart
        return f"'{key}' does not go with the other keys of '{'.'.join(keys[:-1])}'; leave it or them out"
    hint = nearest(name, known) or allowed
    return f"unknown key '{key}'; {hint}" if hint else f"unknown key '{key}'"


def _hint(keys: list[str], item: ErrorDetails) -> str:
    """What was probably meant: a word in another spelling, or an angle in degrees."""
    value, told = item["input"], item.get("ctx", {})
    if item["type"] == "literal_error" and isinstance(value, str):
        return nearest(value.lower(), re.findall(r"'([^']*)'", told["expected"]))
    if item["type"] == "union_tag_invalid":
        return nearest(str(told["tag"]).lower(), re.findall(r"'([^']*)'", told["expected_tags"]))
    in_radians = any(part.endswith("_rad") for part in keys)
    if in_radians and item["type"].startswith(("less", "greater")) and isinstance(value, int | float) and value:
        return f"angles are in radians: {value:g} degrees are {math.radians(value):.4g}"
    return ""


def _shown(value: Any) -> str:
    """The value as it is written, cut where it is long: a file's aliases can make one of any size."""
    short = reprlib.Repr()
    short.maxstring = short.maxother = 80
    short.maxdict = short.maxlist = 6
    short.maxlevel = 2
    return short.repr(value)


@dataclass(frozen=True)
class _Section:
    """A model that may stand at a place of a config. kind: the word that picks it, or that picks what it stands in, such as an
    effect's name; "" where none does; picked: whether the config picks it."""

    model: type[BaseModel]
    kind: str = ""
    picked: bool = True

    def names(self) -> set[str]:
        """What may stand in it."""
        return {*self.model.model_fields, *getattr(self.model, "short_forms", ())}

    def inside(self, field: str) -> list[_Section]:
        """The models that the annotation of a field holds."""
        pending: list[Any] = [self.model.model_fields[field].annotation]
        found = []
        while pending:
            annotation = pending.pop(0)
            if isinstance(annotation, type) and issubclass(annotation, BaseModel):
                found.append(_Section(annotation, _word_of(annotation) or self.kind, self.picked))
            pending.extend(getattr(annotation, "__args__", ()))
        return found


def _word_of(model: type[BaseModel]) -> str:
    """The only value of the field that tells a model from others of its union; "" where it has no such field."""
    words = (get_args(field.annotation) for field in model.model_fields.values() if get_origin(field.annotation) is Literal)
    return next((str(word[0]) for word in words if len(word) == 1), "")


def _place(model: type[BaseModel], location: tuple[str | int, ...]) -> tuple[list[str], list[_Section]]:
    """The keys that lead to a mistake, without the tags of unions, and the sections that may stand around the last of them."""
    keys: list[str] = []
    sections = around = [_Section(model)]
    for depth, part in enumerate(location):
        holders = [section for section in sections if part in section.model.model_fields]
        if holders or isinstance(part, int) or depth == len(location) - 1:
            keys.append(str(part))
        elif any(section.kind == part for section in sections):
            sections = [replace(section, picked=section.picked and section.kind == part) for section in sections]
        if not isinstance(part, int):
            around = sections
        if holders:
            sections = [inner for outer in holders for inner in outer.inside(str(part))]
    return keys, around
