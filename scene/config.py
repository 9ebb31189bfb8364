"""The base of every config model: frozen, unknown keys refused with the nearest right one."""

from __future__ import annotations

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
        raise InputError("; ".join(_describe(model, item) for item in error.errors()), where=where) from None


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


def _describe(model: type[BaseModel], item: ErrorDetails) -> str:
    """One mistake as `section.key: message (got value)`, with the nearest key for an unknown one."""
    path = [str(part) for part in item["loc"]]
    key = ".".join(path)
    if item["type"] == "extra_forbidden":
        known = _known_keys(model, path[:-1])
        hint = nearest(path[-1], known) or (f"allowed: {', '.join(sorted(known))}" if known else "")
        return f"unknown key '{key}'; {hint}" if hint else f"unknown key '{key}'"
    if item["type"] == "missing":
        return f"'{key}' is missing"
    message = item["msg"].removeprefix("Value error, ")
    if not key:  # of the whole, which is not worth repeating
        return message
    return f"'{key}': {message[0].lower()}{message[1:]}, got {item['input']!r}"


def _known_keys(model: type[BaseModel], path: list[str]) -> set[str]:
    """The field names of the section at `path`, over all the alternatives of a union."""
    models: list[type[BaseModel]] = [model]
    for part in path:
        step = [inner for outer in models if part in outer.model_fields for inner in _models_in(outer, part)]
        models = step or models  # a union's tag or a list's index is no field: stay where we are
    return {name for found in models for name in found.model_fields}


def _models_in(model: type[BaseModel], field: str) -> list[type[BaseModel]]:
    pending: list[Any] = [model.model_fields[field].annotation]
    found = []
    while pending:
        annotation = pending.pop()
        if isinstance(annotation, type) and issubclass(annotation, BaseModel):
            found.append(annotation)
        pending.extend(getattr(annotation, "__args__", ()))
    return found
