"""The base of every config model: frozen, unknown keys refused with the nearest right one."""

from __future__ import annotations

import math
import re
import reprlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import pydantic
import yaml
from pydantic import BaseModel, ConfigDict
from pydantic_core import ErrorDetails

from scene.errors import InputError, nearest
from scene.yaml_text import parse_yaml


class Config(BaseModel):
    """A frozen config section. Field names carry their unit (`_m`, `_rad`, `_px`, `_ppm`)."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


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


def load_yaml(path: Path) -> Any:
    """Read a YAML file (`parse_yaml` says which YAML); unreadable or malformed files are InputErrors."""
    try:
        return parse_yaml(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(
            f"cannot be read ({error.strerror})", where=str(path), remedy="check the path and the permissions"
        ) from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        problem = " ".join(str(error).split())
        raise InputError(f"is not valid YAML: {problem}", where=str(path)) from None


_MOST_MISTAKES = 4
"""More are counted only: a file of another kind is wrong in every key."""


def _listed(mistakes: list[str]) -> str:
    more = len(mistakes) - _MOST_MISTAKES
    return "; ".join(mistakes[:_MOST_MISTAKES] + ([f"and {more} more"] if more > 0 else []))


def _describe(model: type[BaseModel], item: ErrorDetails) -> str:
    """One mistake as `section.key: message, got value`, with the nearest key for an unknown one."""
    keys, known = _path(model, item["loc"])
    key = ".".join(keys)
    if item["type"] == "extra_forbidden":
        if keys[-1] in known:  # of another kind of this section
            return f"'{key}' does not go with the other keys of '{'.'.join(keys[:-1])}'; leave it or them out"
        hint = nearest(keys[-1], known) or (f"allowed: {', '.join(sorted(known))}" if known else "")
        return f"unknown key '{key}'; {hint}" if hint else f"unknown key '{key}'"
    if item["type"] == "missing":
        return f"'{key}' is missing"
    message = item["msg"].removeprefix("Value error, ")
    if not key:  # of the whole, which is not worth repeating
        return message
    hint = _hint(keys, item)
    return f"'{key}': {message[0].lower()}{message[1:]}, got {_shown(item['input'])}" + (f"; {hint}" if hint else "")


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


def _path(model: type[BaseModel], location: tuple[str | int, ...]) -> tuple[list[str], set[str]]:
    """The keys that lead to a mistake, without the tags of unions, and the names allowed beside the last of them."""
    keys: list[str] = []
    models: list[type[BaseModel]] = [model]
    known: set[str] = set()
    for depth, part in enumerate(location):
        holders = [found for found in models if part in found.model_fields]
        if holders or isinstance(part, int) or depth == len(location) - 1:
            keys.append(str(part))
        if not isinstance(part, int):
            known = {name for found in models for name in found.model_fields}
        if holders:
            models = [inner for outer in holders for inner in _models_in(outer, str(part))]
    return keys, known


def _models_in(model: type[BaseModel], field: str) -> list[type[BaseModel]]:
    pending: list[Any] = [model.model_fields[field].annotation]
    found = []
    while pending:
        annotation = pending.pop()
        if isinstance(annotation, type) and issubclass(annotation, BaseModel):
            found.append(annotation)
        pending.extend(getattr(annotation, "__args__", ()))
    return found
